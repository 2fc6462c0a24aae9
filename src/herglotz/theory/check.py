"""Discrete Hamilton–Jacobi theory: whether S^{k+1} follows S^k on an open set of q_k, by Theorem 3.

Three residuals are measured at q_{k+1} = Φ̃^γ(q_k). None is computed from another:

    right      S^{k+1}(q_{k+1}) − S^k(q_k) − dS^{k+1}·q_{k+1} + H⁺(q_k, dS^{k+1}, S^k(q_k))
    left       S^{k+1}(q_{k+1}) − S^k(q_k) + dS^k·q_k + H⁻(dS^k, q_{k+1}, S^{k+1}(q_{k+1}))
    diagram    Φ̃∘γ^k − γ^{k+1}∘Φ̃^γ

The right equation alone accepts wrong functions: along the flow the residual of S^{k+1} + δ is δ + ½ dδ·(D22 L_d)⁻¹dδ,
an eikonal equation, which δ = −½ (q − κ)·D22 (q − κ) solves (erratum E10). The left equation rejects such functions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.partials import DiscreteLagrangian
from herglotz.stepping import State, Stepper
from herglotz.theory.function_germ import Function, germ
from herglotz.theory.generating import hamilton_jacobi_residual, left_hamilton_jacobi_residual
from herglotz.theory.hamilton_jacobi import commutation_defect
from herglotz.theory.hamiltonian import LeftHamiltonian, RightHamiltonian

# Largest residual that passes, relative to the terms of its equation. A pair that solves the equations leaves 1e-16 to
# 1e-12; S^{k+1} wrong by 1e-6 leaves more than 1e-8 (`tests/unit/theory/test_check.py`).
BOUND = 1e-10
# Smallest spread of the points q in any direction, relative to the largest |q|. Points of a hyperplane
# spread across it by rounding alone, and represent no open set.
MIN_SPREAD = 1e-6


@dataclass(frozen=True)
class TheoremCheck:
    """The residuals of the two equations and of the diagram at every q_k.

    `right` and `left` are relative to the largest term of the equations, `diagram` to the largest p or s. An entry is
    NaN where a step fails or H± does not exist.
    """

    right: Tensor  # (B)
    left: Tensor  # (B)
    diagram: Tensor  # (B)
    q1: Tensor  # (B, n) q_{k+1} = Φ̃^γ(q_k)
    bound: float

    @property
    def passed(self) -> bool:
        """Whether the diagram commutes wherever a step exists, and both equations hold where H± does."""
        if not bool(torch.isfinite(self.diagram).any()):
            return False
        return all(_worst(x) <= self.bound for x in (self.right, self.left, self.diagram) if x.isfinite().any())

    def table(self) -> str:
        """Return the verdict and a row for each of the three residuals."""
        rows = [
            ("right discrete Hamilton–Jacobi equation", self.right),
            ("left discrete Hamilton–Jacobi equation", self.left),
            ("diagram: Φ̃∘γ^k = γ^{k+1}∘Φ̃^γ", self.diagram),
        ]
        lines = [f"S^k → S^(k+1): {'a solution' if self.passed else 'NOT a solution'}"]
        for claim, values in rows:
            lost = int((~values.isfinite()).sum())
            note = "" if not lost else f"  ({lost} of {len(values)} points left out: no step, or no H± there)"
            if lost == len(values):
                lines.append(f"  {claim:<42} does not apply{note}")
                continue
            worst = _worst(values)
            verdict = "ok" if worst <= self.bound else "FAIL"
            lines.append(f"  {claim:<42} {worst:9.3g}  ≤ {self.bound:g}  {verdict}{note}")
        if _worst(self.right) <= self.bound < _worst(self.diagram):
            lines.append("  The right equation alone accepts wrong functions (erratum E10).")
        return "\n".join(lines)

    __str__ = table


def check(
    L_d: DiscreteLagrangian,
    S0: Function,
    S1: Function,
    q: Tensor,  # (B, n)
    *,
    h: Tensor | float,
    bound: float = BOUND,
) -> TheoremCheck:
    """Measure whether S1 = S^{k+1} follows S0 = S^k under an L_d without forces.

    Parameters
    ----------
    S0, S1
        Functions on Q, (..., n) → (...), whose values are values of s. Their derivatives come from a method `germ`
        (`Quadratic`, `PointSource`, `Propagated`), or else from autograd.
    q
        (B, n) positions q_k that represent an open set: they spread in all n directions. On a single trajectory the
        equations determine nothing (erratum E7).
    bound
        Largest residual that passes, relative to the terms of its equation.

    Raises
    ------
    InputError
        If the points do not spread, or a function or L_d is not usable.

    Source: Theorems 2 and 3 of the paper; errata E5 to E7 and E10.
    """
    _check_open(q)
    with torch.no_grad():
        at0 = germ(S0, q)
        q1, p1, s1 = Stepper(L_d).step(State(q, at0.dS, at0.S), h).state
        found = torch.isfinite(q1).all(-1)
        # S1 may refuse positions that are not finite.
        q1 = torch.where(found[..., None], q1, q)
        at1 = germ(S1, q1)
        H_plus = RightHamiltonian(L_d, q1)(q, at1.dS, at0.S, h)
        H_minus = LeftHamiltonian(L_d, q)(at0.dS, q1, at1.S, h)
        right = hamilton_jacobi_residual(at1.S, at0.S, at1.dS, q1, H_plus)
        left = left_hamilton_jacobi_residual(at1.S, at0.S, at0.dS, q, H_minus)
        diagram = commutation_defect(lambda *_: (q1, p1, s1), S0, S1, q)
    lost = torch.where(found, 0.0, torch.nan)
    terms = _size(at0.S, at1.S, (at1.dS * q1).sum(-1), (at0.dS * q).sum(-1))
    state = _size(p1[found], s1[found])
    return TheoremCheck(
        right.abs() / terms + lost, left.abs() / terms + lost, diagram.abs().amax(-1) / state + lost, q1, bound
    )


def _check_open(q: Tensor) -> None:
    if q.ndim != 2 or not len(q):
        raise InputError(
            f"q needs shape (B, n) with B > 0, got {tuple(q.shape)}; "
            "give points of an open set, e.g. torch.rand(20, n, dtype=torch.float64)"
        )
    spread = torch.linalg.svdvals(q - q.mean(0))
    if not float(spread[-1]) > MIN_SPREAD * float(q.abs().max()):
        raise InputError(
            "the points q do not spread in every direction: their smallest singular value is "
            f"{float(spread[-1]):.2g}; a single trajectory determines nothing (E7), give points of an open set"
        )


def _size(*terms: Tensor) -> float:
    largest = _worst(torch.cat([x.abs().flatten() for x in terms]))
    return largest if largest > 0 else 1.0


def _worst(values: Tensor) -> float:
    finite = values[values.isfinite()]
    return float(finite.max()) if len(finite) else float("nan")
