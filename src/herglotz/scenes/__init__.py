"""Scenes with known answers, the rules that discretise them, and the reference flow they are measured against."""

from herglotz.scenes.cart_pole import cart_pole
from herglotz.scenes.chain import chain
from herglotz.scenes.double_pendulum import double_pendulum
from herglotz.scenes.driven import DrivenRule, driven_scene
from herglotz.scenes.driven_duffing import driven_duffing
from herglotz.scenes.driven_pendulum import driven_pendulum
from herglotz.scenes.duffing import duffing
from herglotz.scenes.exact import NumericallyExact, Reason, exact_discrete_lagrangian
from herglotz.scenes.forced_oscillator import ExactForcedOscillator
from herglotz.scenes.galerkin import GalerkinLobatto, lobatto4, lobatto6
from herglotz.scenes.kepler import kepler
from herglotz.scenes.linear_drag import ExactLinearDrag, linear_drag
from herglotz.scenes.motion import Motion, herglotz_motion, lagrangian_motion
from herglotz.scenes.nonlinear_action import nonlinear_action
from herglotz.scenes.oscillator import ExactOscillator, damped_oscillator
from herglotz.scenes.parachute import ExactParachute, parachute
from herglotz.scenes.pendulum import damped_pendulum
from herglotz.scenes.printed_parachute import PrintedParachute
from herglotz.scenes.quadratic_drag import quadratic_drag
from herglotz.scenes.reference import ReferenceSolution, path_action, reference_flow, reference_solve
from herglotz.scenes.registry import scene, scene_names
from herglotz.scenes.rigid_body import rigid_body
from herglotz.scenes.rules import (
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
from herglotz.scenes.scene import Scene
from herglotz.scenes.servo_axis import servo_axis
from herglotz.scenes.van_der_pol import van_der_pol

__all__ = [
    "ORDERS",
    "DrivenRule",
    "ExactForcedOscillator",
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
    "cart_pole",
    "chain",
    "damped_oscillator",
    "damped_pendulum",
    "double_pendulum",
    "driven_duffing",
    "driven_pendulum",
    "driven_scene",
    "duffing",
    "exact_discrete_lagrangian",
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
    "servo_axis",
    "strang",
    "trapezoid",
    "trapezoid_heun",
    "trapezoid_plain",
    "van_der_pol",
]
