"""Scenes with known answers, the rules that discretise Lagrangians, and the reference flow."""

from herglotz.scenes.cart_pole import cart_pole as cart_pole
from herglotz.scenes.chain import chain as chain
from herglotz.scenes.double_pendulum import double_pendulum as double_pendulum
from herglotz.scenes.duffing import driven_duffing as driven_duffing, duffing as duffing
from herglotz.scenes.exact import (
    NumericallyExact as NumericallyExact,
    Reason as Reason,
    exact_discrete_lagrangian as exact_discrete_lagrangian,
)
from herglotz.scenes.kepler import kepler as kepler
from herglotz.scenes.linear_drag import ExactLinearDrag as ExactLinearDrag, linear_drag as linear_drag
from herglotz.scenes.nonlinear_action import nonlinear_action as nonlinear_action
from herglotz.scenes.oscillator import (
    ExactForcedOscillator as ExactForcedOscillator,
    ExactOscillator as ExactOscillator,
    damped_oscillator as damped_oscillator,
)
from herglotz.scenes.parachute import (
    ExactParachute as ExactParachute,
    PrintedParachute as PrintedParachute,
    parachute as parachute,
    quadratic_drag as quadratic_drag,
)
from herglotz.scenes.pendulum import damped_pendulum as damped_pendulum, driven_pendulum as driven_pendulum
from herglotz.scenes.reference import (
    herglotz_motion as herglotz_motion,
    path_action as path_action,
    reference_flow as reference_flow,
    reference_solve as reference_solve,
)
from herglotz.scenes.registry import scene as scene, scene_names as scene_names
from herglotz.scenes.rigid_body import rigid_body as rigid_body
from herglotz.scenes.rules import (
    ORDERS as ORDERS,
    left as left,
    midpoint as midpoint,
    midpoint_heun as midpoint_heun,
    midpoint_plain as midpoint_plain,
    right as right,
    strang as strang,
    trapezoid as trapezoid,
    trapezoid_heun as trapezoid_heun,
    trapezoid_plain as trapezoid_plain,
)
from herglotz.scenes.scene import Scene as Scene
from herglotz.scenes.servo_axis import servo_axis as servo_axis
from herglotz.scenes.van_der_pol import van_der_pol as van_der_pol
