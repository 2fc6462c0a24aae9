"""Continuous dynamics: Theorem 1, when a field is tangent to the section γ = j¹F of T*Q × R → Q.

    continuous   Tγ(X^γ) = X_H∘γ  ⇔  H∘γ = 0            for the contact field X_H
                 Tγ(E^γ) = E_H∘γ  ⇔  d(H∘γ) = 0         for the evolution field E_H

with the projected field X^γ = Tρ(X∘γ) on Q. The paper prints the second condition for the first field. H = p and F = q
is a counterexample: d(H∘γ) = 0, and X_H is not related (erratum E2).
"""

from __future__ import annotations

from torch import Tensor

from herglotz.mechanics.contact import join
from herglotz.mechanics.scalar_fields import Hamiltonian, gradient
from herglotz.theory.function_germ import Function, prolongation
from herglotz.theory.jacobi import Field


def energy_on_section(H: Hamiltonian, F: Function, q: Tensor) -> tuple[Tensor, Tensor]:
    """H∘γ and d(H∘γ) at q, shapes (...) and (..., n), for γ = j¹F."""
    value, slope, _ = gradient(lambda q: H(*prolongation(F, q)), q)
    return value, slope


def projected_field(field: Field, F: Function, q: Tensor) -> Tensor:
    """X^γ(q) = Tρ(X(γ(q))), shape (..., n): the motion on Q along the section."""
    return field(*prolongation(F, q))[0]


def relatedness_defect(field: Field, F: Function, q: Tensor) -> Tensor:
    """Tγ(X^γ) − X∘γ at q, shape (..., 2n+1); the field is any (q, p, s) → (q̇, ṗ, ṡ).

    The defect of X_H is (0, d(H∘γ), H∘γ), that of E_H is (0, d(H∘γ), 0).

    Source: Theorem 1 of the paper, erratum E2.
    """
    value, F_q, F_qq = gradient(F, q, order=2)
    X = field(q, F_q, value)
    v = X[0]
    lifted = join(v, (F_qq @ v[..., None])[..., 0], (F_q * v).sum(-1))
    return lifted - join(*X)
