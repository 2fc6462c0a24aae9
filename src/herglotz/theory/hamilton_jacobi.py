"""Discrete Hamilton–Jacobi theory: S^k, functions S on Q that solve the equation, their flow, and Theorem 3.

S^k(q̂0, q_k, ŝ0) = s_k − ŝ0 along the discrete solution that joins q̂0 to q_k in k steps. S^k generates Φ̃^k:

    D2 S^k = p_k,    1 + D3 S^k = σ_k,    D1 S^k = −σ_k p̂0.

The left generating function has s_k, the value of s at the other end, as its argument:

    S^{k−}(q̂0, q_k, s_k) = s_k − ŝ0,    p̂0 = −D1 S^{k−},    p_k = D2 S^{k−} / (1 − D3 S^{k−}),    1 − D3 S^{k−} = 1/σ_k.

The functions below compute S from the flow and never from these identities, so that the identities can be checked.

S is the paper's S_d^k = ŝ0 + S^k(q̂0, ·, ŝ0): the values of S are values of s. `hopf_lax` takes S from step to step, by
the form of the equation that is well-posed (erratum E7).

`check` says whether S^{k+1} follows S^k on an open set of q_k, by Theorem 3. Three residuals are measured at q_{k+1} =
Φ̃^γ(q_k). None is computed from another:

    right      S^{k+1}(q_{k+1}) − S^k(q_k) − dS^{k+1}·q_{k+1} + H⁺(q_k, dS^{k+1}, S^k(q_k))
    left       S^{k+1}(q_{k+1}) − S^k(q_k) + dS^k·q_k + H⁻(dS^k, q_{k+1}, S^{k+1}(q_{k+1}))
    diagram    Φ̃∘γ^k − γ^{k+1}∘Φ̃^γ

The right equation alone accepts wrong functions: along the flow the residual of S^{k+1} + δ is δ + ½ dδ·(D22 L_d)⁻¹dδ,
an eikonal equation, which δ = −½ (q − κ)·D22 (q − κ) solves (erratum E10). The left equation rejects such functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import Flow, flow_derivative, flow_derivatives, join
from herglotz.mechanics.legendre import least_singular_value
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials, value
from herglotz.stepping import State, Stepper
from herglotz.stepping.state import Status, step_sizes
from herglotz.theory.contact_manifolds import Function, FunctionGerm, germ, prolongation
from herglotz.theory.hamiltonian_dynamics import LeftHamiltonian, RightHamiltonian
from herglotz.theory.lagrangian_dynamics import Curve, checked, stationary_curve


@dataclass(frozen=True)
class GeneratingFunction:
    """S^k and its derivatives by (q̂0, q_k, ŝ0), or S^{k−} and those by (q̂0, q_k, s_k), for a batch of solutions.

    (q, p, s) is the end (q_k, p_k, s_k) of the flow. `spread` is the smallest singular value of ∂q_k/∂p̂0: zero at a
    caustic, where S^k is not defined, and after a failed step.
    """

    S: Tensor  # (...)
    D1: Tensor  # (..., n)
    D2: Tensor  # (..., n)
    D3: Tensor  # (...)
    q: Tensor  # (..., n)
    p: Tensor  # (..., n)
    s: Tensor  # (...)
    spread: Tensor  # (...)

    def map(self, change: Callable[[Tensor], Tensor]) -> GeneratingFunction:
        """Apply `change` to every tensor."""
        return GeneratingFunction(**{name: change(x) for name, x in vars(self).items()})

    @classmethod
    def of(cls, s: Tensor, end: tuple[Tensor, Tensor, Tensor], D: Tensor) -> GeneratingFunction:
        """S^k from ŝ0, (q_k, p_k, s_k) and the derivative of Φ̃^k (`mechanics.flow_derivative`)."""
        (q_k, p_k, s_k), n = end, end[0].shape[-1]
        Y_q, Y_p, Y_s = D[..., :n, :n], D[..., :n, n : 2 * n], D[..., :n, 2 * n]
        G_q, G_p, G_s = D[..., 2 * n, :n], D[..., 2 * n, n : 2 * n], D[..., 2 * n, 2 * n]
        D2 = torch.linalg.solve_ex(Y_p.mT, G_p[..., None])[0][..., 0]
        D1 = G_q - (Y_q.mT @ D2[..., None])[..., 0]
        D3 = G_s - 1.0 - (D2 * Y_s).sum(-1)
        return cls(s_k - s, D1, D2, D3, q_k, p_k, s_k, least_singular_value(Y_p))


def generating_function(
    flow_k: Flow,
    q: Tensor,  # (..., n) q̂0
    p: Tensor,  # (..., n) p̂0
    s: Tensor,  # (...) ŝ0
) -> GeneratingFunction:
    """S^k and its three derivatives along the solutions that start at (q̂0, p̂0, ŝ0); `flow_k` is the map Φ̃^k.

    The chain rule through the endpoint map (q̂0, p̂0, ŝ0) ↦ q_k gives D2 S = (∂s_k/∂p̂0)(∂q_k/∂p̂0)⁻¹, and D1 and D3
    follow from D2.

    Source: generating functions of the paper, with the sign of erratum E1.
    """
    return GeneratingFunction.of(s, *flow_derivative(flow_k, q, p, s))


def generating_functions(flows: Iterable[Flow], q: Tensor, p: Tensor, s: Tensor) -> list[GeneratingFunction]:
    """`generating_function` of the first map, of the first two maps composed, and so on; each map is evaluated once."""
    return [GeneratingFunction.of(s, *found) for found in flow_derivatives(flows, q, p, s)]


def left_generating_function(flow_k: Flow, q: Tensor, p: Tensor, s: Tensor) -> GeneratingFunction:
    """S^{k−}(q̂0, q_k, s_k) = s_k − ŝ0 and its three derivatives along the solutions from (q̂0, p̂0, ŝ0).

    The chain rule through (p̂0, ŝ0) ↦ (q_k, s_k) at fixed q̂0 gives D2 and D3 = ∂S^{k−}/∂s_k together, and D1 follows.
    S^{k−} is not defined where σ_k = 0 or at a caustic.

    Source: erratum E5 for k = 1, applied to Φ̃^k.
    """
    n = q.shape[-1]
    (q_k, p_k, s_k), D = flow_derivative(flow_k, q, p, s)
    # ∂(q_k, s_k)/∂(p̂0, ŝ0) and ∂(s_k − ŝ0)/∂(p̂0, ŝ0).
    ends = torch.cat([D[..., :n, n:], D[..., 2 * n :, n:]], -2)
    rate = D[..., 2 * n, n:].clone()
    rate[..., n] -= 1.0
    slopes = torch.linalg.solve_ex(ends.mT, rate[..., None])[0][..., 0]
    D2, D3 = slopes[..., :n], slopes[..., n]
    D1 = (1 - D3)[..., None] * D[..., 2 * n, :n] - (D[..., :n, :n].mT @ D2[..., None])[..., 0]
    return GeneratingFunction(s_k - s, D1, D2, D3, q_k, p_k, s_k, least_singular_value(D[..., :n, n : 2 * n]))


def hamilton_jacobi_residual(
    S1: Tensor,  # (...) S^{k+1}(q_{k+1})
    S0: Tensor,  # (...) S^k(q_k)
    dS1: Tensor,  # (..., n) dS^{k+1}(q_{k+1})
    q1: Tensor,  # (..., n) q_{k+1}
    H_plus: Tensor,  # (...) H⁺(q_k, dS^{k+1}(q_{k+1}), s_k), s_k = ŝ0 + S^k
) -> Tensor:
    """S^{k+1}(q_{k+1}) − S^k(q_k) − dS^{k+1}·q_{k+1} + H⁺(q_k, dS^{k+1}, s_k), shape (...).

    The residual of a solution is zero on an open set of q_k if q_{k+1} = Φ̃^γ(q_k), and only then (erratum E7). A zero
    residual alone does not make S a solution: the left equation must hold too (erratum E10). `check` measures both.

    Source: right discrete contact Hamilton–Jacobi equation of the paper.
    """
    return S1 - S0 - (dS1 * q1).sum(-1) + H_plus


def left_hamilton_jacobi_residual(
    S1: Tensor,  # (...) S^{k+1}(q_{k+1})
    S0: Tensor,  # (...) S^k(q_k)
    dS0: Tensor,  # (..., n) dS^k(q_k)
    q0: Tensor,  # (..., n) q_k
    H_minus: Tensor,  # (...) H⁻(dS^k(q_k), q_{k+1}, s_{k+1}), s_{k+1} = ŝ0 + S^{k+1}
) -> Tensor:
    """S^{k+1}(q_{k+1}) − S^k(q_k) + dS^k(q_k)·q_k + H⁻(dS^k(q_k), q_{k+1}, s_{k+1}), shape (...).

    The residual of a solution is zero on an open set of q_k if q_{k+1} = Φ̃^γ(q_k), and only then (erratum E7).

    Source: left discrete contact Hamilton–Jacobi equation, erratum E6.
    """
    return S1 - S0 + (dS0 * q0).sum(-1) + H_minus


@dataclass(frozen=True)
class Quadratic:
    """S(q) = ½ q·αq + β·q + δ."""

    alpha: Tensor  # (..., n, n) symmetric
    beta: Tensor  # (..., n)
    delta: Tensor  # (...)

    def __call__(self, q: Tensor) -> Tensor:
        """S(q), shape (...)."""
        return ((0.5 * (self.alpha @ q[..., None])[..., 0] + self.beta) * q).sum(-1) + self.delta


@dataclass(frozen=True)
class PointSource:
    """S¹(y) = ŝ0 + L_d(q̂0, y, ŝ0) of all solutions through one point; S⁰ is not a function (erratum E7)."""

    L_d: DiscreteLagrangian
    q: Tensor  # (..., n) q̂0
    s: Tensor  # (...) ŝ0
    h: Tensor | float

    def __call__(self, y: Tensor) -> Tensor:
        """S¹(y), shape (...)."""
        return self.s + value(self.L_d, self.q, y, self.s, self.h)


def projected_flow(flow: Flow, S: Function, q: Tensor) -> Tensor:
    """Φ̃^γ(q_k): the position of Φ̃(γ^k(q_k)), shape (..., n)."""
    return flow(*prolongation(S, q))[0]


def projected_step(
    H_plus: DiscreteLagrangian, S0: Function, S1: Function, q0: Tensor, h: Tensor | float, guess: Tensor | None = None
) -> Tensor:
    """q_{k+1} = D2H⁺(q_k, dS^{k+1}(q_{k+1}), S^k(q_k)), solved for q_{k+1} by Newton's method; shape (..., n).

    NaN where there is no solution.  Source: projected discrete flow of the paper, with s = S^k(q_k).
    """
    s0 = germ(S0, q0).S
    eye = torch.eye(q0.shape[-1], dtype=q0.dtype, device=q0.device)

    def equations(q1: Tensor) -> tuple[Tensor, Tensor]:
        at = germ(S1, q1)
        P = partials(H_plus, q0, at.dS, s0, h, order=2)
        return q1 - P.D2, eye - P.D22 @ at.d2S

    return find_root(equations, q0 if guess is None else guess).solved


def commutation_defect(flow: Flow, S0: Function, S1: Function, q: Tensor) -> Tensor:
    """Φ̃(γ^k(q)) − γ^{k+1}(Φ̃^γ(q)), shape (..., 2n+1), for any map Φ̃ of T*Q × R; the first n components are zero.

    For the flow of an L_d, the defect is zero on an open set of q exactly if S solves the right and the left discrete
    Hamilton–Jacobi equation there; the right equation alone is not sufficient (erratum E10).

    Source: Theorem 3 of the paper; γ^{k+1} has dS^{k+1} (erratum E8).
    """
    q1, p1, s1 = flow(*prolongation(S0, q))
    return join(q1, p1, s1) - join(*prolongation(S1, q1))


def riccati_step(P: Partials, S: Quadratic) -> Quadratic:
    """S^{k+1} of a quadratic L_d = (c−1)s0 + ½q0·Aq0 + q0·Bq1 + ½q1·Cq1 and a quadratic S^k.

    α′ = C − Bᵀ(A + cα)⁻¹B,    β′ = −cBᵀ(A + cα)⁻¹β,    δ′ = cδ − ½c²β·(A + cα)⁻¹β

    P are the partials of L_d to second order at the origin, and S is S^k. The result is not finite at a caustic, where
    A + cα is singular.

    Source: section 3 of `docs/mathematics.md`.
    """
    c = P.c
    pivot = P.D11 + c[..., None, None] * S.alpha
    X = torch.linalg.solve_ex(pivot, torch.cat([P.D12, S.beta[..., None]], -1))[0]
    pivot_B, pivot_beta = X[..., :-1], X[..., -1]
    return Quadratic(
        P.D22 - P.D12.mT @ pivot_B,
        -c[..., None] * (P.D12.mT @ pivot_beta[..., None])[..., 0],
        c * S.delta - 0.5 * c**2 * (S.beta * pivot_beta).sum(-1),
    )


@dataclass(frozen=True)
class HopfLax:
    """S^{k+N}(y) and its derivatives; NaN where the status is not CONVERGED.

    `x` is the stationary point q_k and `curve` the characteristic from x to y; `curve.opening` measures the distance
    from a caustic. The status is SINGULAR at a caustic and beyond.
    """

    S: Tensor  # (...)
    dS: Tensor  # (..., n)
    d2S: Tensor  # (..., n, n)
    x: Tensor  # (..., n)
    status: Tensor  # (...)
    curve: Curve


def hopf_lax(
    L_d: DiscreteLagrangian,
    S: Function,
    y: Tensor,  # (..., n)
    *,
    h: Tensor | float,
    steps: int | None = 1,
    beyond: bool = False,
    throw: bool = False,
) -> HopfLax:
    """S^{k+1}(y) = ext_x [S^k(x) + L_d(x, y, S^k(x))], N times over.

    The extremum satisfies D1L_d + c dS^k(x) = 0. All N extremals are solved together, as one discrete curve that ends
    in y and starts with p_0 = dS(x), s_0 = S(x). By the envelope theorem dS^{k+N}(y) = p_N; d2S is the slope of the
    family.

    M may be singular: only the pivot W = ∂²/∂x² [S + L_d] must be regular. For a degenerate L_d, whose step is a
    relation and not a map, this is the implicit Hamilton–Jacobi equation. A crossed caustic is detected where M is
    regular, or where the inertia of W changes from step to step.

    Parameters
    ----------
    S
        S^k: a callable on (..., n) whose values are values of s, e.g. `Quadratic` or `PointSource`.
    h, steps
        A scalar h with a count N, or (N,) or (..., N) steps.
    beyond
        Accept a solution that has crossed a caustic, beyond which S is no longer a function on all of Q.
    throw
        Raise `StepError` if a sample fails.

    Returns
    -------
    HopfLax
        Status SINGULAR where the second derivative in x is singular (A + cα = 0 for a quadratic S), or where the
        inertia of W shows a crossed caustic (`theory.lagrangian_dynamics`).

    Source: erratum E7.
    """
    sizes = torch.as_tensor(h, dtype=y.dtype, device=y.device)
    sizes = step_sizes(sizes, steps if sizes.ndim == 0 else None)
    y = y.detach().expand(*torch.broadcast_shapes(y.shape[:-1], sizes.shape[:-1]), y.shape[-1])
    # Newton's iteration starts with all points q_k … q_{k+N−1} at y.
    start = y[..., None, :].expand(*y.shape[:-1], sizes.shape[-1], y.shape[-1])
    curve = checked(stationary_curve(L_d, start, [y], S, sizes, beyond), throw)
    slope = torch.where((curve.status == Status.CONVERGED)[..., None, None], curve.opening.slope, torch.nan)
    return HopfLax(curve.s[..., -1], curve.p[..., -1, :], slope, curve.q[..., 0, :], curve.status, curve)


@dataclass(frozen=True)
class Propagated:
    """S^{k+N} as a function on Q: each evaluation solves the Hopf–Lax problem; NaN at and beyond caustics."""

    L_d: DiscreteLagrangian
    S: Function
    h: Tensor | float
    steps: int = 1

    def __call__(self, y: Tensor) -> Tensor:
        """S^{k+N}(y), shape (...)."""
        return self.germ(y).S

    def germ(self, y: Tensor) -> FunctionGerm:
        """Value and derivatives."""
        out = hopf_lax(self.L_d, self.S, y, h=self.h, steps=self.steps)
        return FunctionGerm(out.S, out.dS, out.d2S)


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
        (`Propagated`), or else from autograd.
    q
        (B, n) positions q_k that represent an open set: they spread in all n directions. On a single trajectory the
        equations determine nothing (erratum E7).
    bound
        Largest residual that passes, relative to the terms of its equation.

    Raise InputError if the points do not spread, or a function or L_d is not usable.

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
