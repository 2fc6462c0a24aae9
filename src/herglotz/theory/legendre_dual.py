"""Continuous dynamics: the Legendre transform p = L_v, H = v·L_v − L, and its inverse v = H_p, L = p·H_p − H.

The transform is an involution, so one function serves both directions: the dual of f(q, x, s) is
f*(q, y, s) = x·y − f(q, x, s) with f_x(q, x, s) = y.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.scalar_fields import ScalarField, derivatives


def fiber_derivative(
    f: ScalarField,
    q: Tensor,  # (..., n)
    x: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> Tensor:
    """f_x(q, x, s), shape (..., n): the momentum p = L_v of a Lagrangian, the velocity v = H_p of a Hamiltonian."""
    return derivatives(f, q, x, s).D2


def fiber_inverse(
    f: ScalarField,
    q: Tensor,  # (..., n)
    y: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> Tensor:
    """The x with f_x(q, x, s) = y, by Newton's method from y: v of a momentum (f = L), p of a velocity (f = H).

    x is once differentiable with respect to q, y and s, by the implicit-function theorem. Raise InputError if a sample
    does not converge; the message names the sample.
    """
    q, y = torch.broadcast_tensors(q, y)

    def equation(x: Tensor) -> tuple[Tensor, Tensor]:
        P = derivatives(f, q, x, s, order=2)
        return P.D2 - y, P.D22

    root = find_root(equation, y)
    if not bool(root.converged.all()):
        sample = tuple(int(i) for i in (~root.converged).nonzero()[0])
        raise InputError(
            f"Legendre transform: no x with f_x = {y[sample].tolist()} found at sample {sample} (after "
            f"{root.iterations} Newton steps); check that a solution exists and that f_xx is not singular"
        )
    return root.with_slope(lambda x: fiber_derivative(f, q, x, s) - y)


def legendre_dual(f: ScalarField) -> ScalarField:
    """The Legendre transform f*(q, y, s) = x·y − f(q, x, s) with f_x = y: L ↦ H and H ↦ L.

    The value is stationary in x. The first derivative of x therefore makes f* correct up to its third derivatives. f*
    raises `InputError` where `fiber_inverse` does.
    """

    def dual(q: Tensor, y: Tensor, s: Tensor) -> Tensor:
        x = fiber_inverse(f, q, y, s)
        return (x * y).sum(-1) - f(q, x, s)

    return dual
