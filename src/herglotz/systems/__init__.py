"""Scenes with known answers, the rules that discretise them, and the reference flow they are measured against."""

from herglotz.systems.chain import chain
from herglotz.systems.double_pendulum import double_pendulum
from herglotz.systems.driven_pendulum import DrivenRule, driven_pendulum
from herglotz.systems.exact import NumericallyExact, Reason, exact_discrete_lagrangian
from herglotz.systems.galerkin import GalerkinLobatto, lobatto4, lobatto6
from herglotz.systems.kepler import kepler
from herglotz.systems.linear_drag import ExactLinearDrag, linear_drag
from herglotz.systems.motion import Motion, hamiltonian_motion, herglotz_motion, lagrangian_motion
from herglotz.systems.nonlinear_action import nonlinear_action
from herglotz.systems.oscillator import ExactOscillator, damped_oscillator
from herglotz.systems.parachute import ExactParachute, parachute
from herglotz.systems.path import path_action
from herglotz.systems.pendulum import damped_pendulum
from herglotz.systems.printed_parachute import PrintedParachute
from herglotz.systems.quadratic_drag import quadratic_drag
from herglotz.systems.reference import ReferenceSolution, reference_flow, reference_solve
from herglotz.systems.registry import scene, scene_names
from herglotz.systems.rigid_body import rigid_body
from herglotz.systems.rules import (
    ORDERS,
    adjoint,
    all_rules,
    left,
    midpoint,
    midpoint_heun,
    midpoint_plain,
    right,
    strang,
    trapezoid,
    trapezoid_heun,
    trapezoid_plain,
)
from herglotz.systems.scene import Scene

__all__ = [
    "ORDERS",
    "DrivenRule",
    "ExactLinearDrag",
    "ExactOscillator",
    "ExactParachute",
    "GalerkinLobatto",
    "Motion",
    "NumericallyExact",
    "PrintedParachute",
    "Reason",
    "ReferenceSolution",
    "Scene",
    "adjoint",
    "all_rules",
    "chain",
    "damped_oscillator",
    "damped_pendulum",
    "double_pendulum",
    "driven_pendulum",
    "exact_discrete_lagrangian",
    "hamiltonian_motion",
    "herglotz_motion",
    "kepler",
    "lagrangian_motion",
    "left",
    "linear_drag",
    "lobatto4",
    "lobatto6",
    "midpoint",
    "midpoint_heun",
    "midpoint_plain",
    "nonlinear_action",
    "parachute",
    "path_action",
    "quadratic_drag",
    "reference_flow",
    "reference_solve",
    "right",
    "rigid_body",
    "scene",
    "scene_names",
    "strang",
    "trapezoid",
    "trapezoid_heun",
    "trapezoid_plain",
]
