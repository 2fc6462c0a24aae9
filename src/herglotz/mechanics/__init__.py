"""What learning and stepping need of every discrete contact Lagrangian: derivatives, momenta, regularity."""

from herglotz.mechanics.contact import contact_defect, contact_form, flow_derivative
from herglotz.mechanics.legendre import (
    herglotz_residual,
    legendre_minus,
    legendre_plus,
    mixed_hessian,
    momentum_jacobian,
    momentum_minus,
    momentum_plus,
    momentum_residual,
)
from herglotz.mechanics.partials import (
    ClosedForm,
    DiscreteLagrangian,
    Driven,
    Forced,
    Forces,
    Partials,
    autograd_partials,
    partials,
)
from herglotz.mechanics.regularity import Regularity, regularity
from herglotz.mechanics.tangent import step_derivative

__all__ = [
    "ClosedForm",
    "DiscreteLagrangian",
    "Driven",
    "Forced",
    "Forces",
    "Partials",
    "Regularity",
    "autograd_partials",
    "contact_defect",
    "contact_form",
    "flow_derivative",
    "herglotz_residual",
    "legendre_minus",
    "legendre_plus",
    "mixed_hessian",
    "momentum_jacobian",
    "momentum_minus",
    "momentum_plus",
    "momentum_residual",
    "partials",
    "regularity",
    "step_derivative",
]
