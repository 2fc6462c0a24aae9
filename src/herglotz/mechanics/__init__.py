"""Derivatives, momenta and regularity of every discrete contact Lagrangian, for learning and stepping."""

from herglotz.mechanics.contact import (
    contact_defect as contact_defect,
    contact_form as contact_form,
    flow_derivative as flow_derivative,
)
from herglotz.mechanics.legendre import (
    Regularity as Regularity,
    herglotz_residual as herglotz_residual,
    legendre_minus as legendre_minus,
    legendre_plus as legendre_plus,
    mixed_hessian as mixed_hessian,
    momentum_jacobian as momentum_jacobian,
    momentum_minus as momentum_minus,
    momentum_plus as momentum_plus,
    momentum_residual as momentum_residual,
    regularity as regularity,
    step_derivative as step_derivative,
)
from herglotz.mechanics.partials import (
    ClosedForm as ClosedForm,
    DiscreteLagrangian as DiscreteLagrangian,
    Driven as Driven,
    Forced as Forced,
    Forces as Forces,
    Partials as Partials,
    autograd_partials as autograd_partials,
    partials as partials,
)
