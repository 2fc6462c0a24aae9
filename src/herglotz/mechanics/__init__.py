"""What is true of every discrete contact Lagrangian."""

from herglotz.mechanics.contact import contact_defect, contact_form, flow_derivative
from herglotz.mechanics.continuous import contact_vector_field
from herglotz.mechanics.generating import GeneratingFunction, generating_function, hamilton_jacobi_residual
from herglotz.mechanics.hamiltonian import (
    left_hamiltonian_on_flow,
    right_hamiltonian,
    right_hamiltonian_on_flow,
    solve_right_position,
)
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
from herglotz.mechanics.tangent import step_derivative

__all__ = [
    "ClosedForm",
    "DiscreteLagrangian",
    "Driven",
    "Forced",
    "Forces",
    "GeneratingFunction",
    "Partials",
    "autograd_partials",
    "contact_defect",
    "contact_form",
    "contact_vector_field",
    "flow_derivative",
    "generating_function",
    "hamilton_jacobi_residual",
    "herglotz_residual",
    "left_hamiltonian_on_flow",
    "legendre_minus",
    "legendre_plus",
    "mixed_hessian",
    "momentum_jacobian",
    "momentum_minus",
    "momentum_plus",
    "momentum_residual",
    "partials",
    "right_hamiltonian",
    "right_hamiltonian_on_flow",
    "solve_right_position",
    "step_derivative",
]
