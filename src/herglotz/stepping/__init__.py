"""Time steppers: batched Newton, steps, rollouts."""

from herglotz.stepping.newton import Solution, Status, solve, solve_step
from herglotz.stepping.stepper import Rollout, State, Step, StepError, Stepper, step_sizes

__all__ = [
    "Rollout",
    "Solution",
    "State",
    "Status",
    "Step",
    "StepError",
    "Stepper",
    "solve",
    "solve_step",
    "step_sizes",
]
