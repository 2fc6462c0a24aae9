"""Time steppers: batched Newton, steps, rollouts."""

from herglotz.mechanics.newton import solve
from herglotz.stepping.composition import Composition, adjoint_pair, kahan_li, suzuki, yoshida
from herglotz.stepping.events import Event
from herglotz.stepping.explain import explain_step
from herglotz.stepping.linearise import Linearised
from herglotz.stepping.method import OneStepMethod
from herglotz.stepping.newton import Solution, solve_step
from herglotz.stepping.state import Status
from herglotz.stepping.stepper import Crossings, Rollout, State, Step, StepError, Stepper, step_sizes

__all__ = [
    "Composition",
    "Crossings",
    "Event",
    "Linearised",
    "OneStepMethod",
    "Rollout",
    "Solution",
    "State",
    "Status",
    "Step",
    "StepError",
    "Stepper",
    "adjoint_pair",
    "explain_step",
    "kahan_li",
    "solve",
    "solve_step",
    "step_sizes",
    "suzuki",
    "yoshida",
]
