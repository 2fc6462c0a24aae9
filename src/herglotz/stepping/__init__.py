"""Time steppers: batched Newton, steps, rollouts."""

from herglotz.stepping.boundary import Curve, boundary_value, initial_value
from herglotz.stepping.composition import Composition, adjoint_pair, kahan_li, suzuki, yoshida
from herglotz.stepping.constrained import ConstrainedStepper
from herglotz.stepping.events import Event
from herglotz.stepping.evolution import EvolutionStepper
from herglotz.stepping.explain import explain_step
from herglotz.stepping.hopf_lax import HopfLax, Propagated, hopf_lax
from herglotz.stepping.legendrian import LegendrianStepper, legendrian_relation
from herglotz.stepping.linearise import Linearised
from herglotz.stepping.newton import Solution, Status, solve, solve_step
from herglotz.stepping.rotation import BodyRollout, BodyState, BodyStep, RigidBodyStepper
from herglotz.stepping.splitting import ContactSplitting, linear_damping
from herglotz.stepping.stepper import Crossings, Rollout, State, Step, StepError, Stepper, step_sizes

__all__ = [
    "BodyRollout",
    "BodyState",
    "BodyStep",
    "Composition",
    "ConstrainedStepper",
    "ContactSplitting",
    "Crossings",
    "Curve",
    "Event",
    "EvolutionStepper",
    "HopfLax",
    "LegendrianStepper",
    "Linearised",
    "Propagated",
    "RigidBodyStepper",
    "Rollout",
    "Solution",
    "State",
    "Status",
    "Step",
    "StepError",
    "Stepper",
    "adjoint_pair",
    "boundary_value",
    "explain_step",
    "hopf_lax",
    "initial_value",
    "kahan_li",
    "legendrian_relation",
    "linear_damping",
    "solve",
    "solve_step",
    "step_sizes",
    "suzuki",
    "yoshida",
]
