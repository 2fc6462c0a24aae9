"""Time steppers: batched Newton, steps, rollouts."""

from herglotz.mechanics.newton import solve as solve
from herglotz.stepping.events import Event as Event
from herglotz.stepping.explain import explain_step as explain_step
from herglotz.stepping.linearise import Linearised as Linearised
from herglotz.stepping.newton import Solution as Solution, solve_step as solve_step
from herglotz.stepping.rollout import OneStepMethod as OneStepMethod
from herglotz.stepping.state import (
    Crossings as Crossings,
    Rollout as Rollout,
    State as State,
    Status as Status,
    Step as Step,
    StepError as StepError,
    state_of as state_of,
    step_sizes as step_sizes,
)
from herglotz.stepping.stepper import Stepper as Stepper
