"""Discrete Legendre transforms FL⁻, FL⁺, the discrete Herglotz equation, regularity, and the derivative of a step.

The conditions of regularity are c ≠ 0, det M ≠ 0, no pole of L_d, det D2D2 L_d ≠ 0 (H⁺), det D1D1 L⁻ ≠ 0 (H⁻). Stepping
needs the first three, the right discrete Hamiltonian the fourth, the left one the fifth (erratum E4). All margins are
free of units: 0 where the condition is lost, of order 1 for a kinetic term.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics.newton import solve_columns
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials


def momentum_minus(P: Partials) -> Tensor:
    """p_k = −(D1 L_d + F⁻) / c, the momentum of FL⁻ at (q_k, q_{k+1}, s_k); F⁻ = 0 without forces; shape (..., n)."""
    D1 = P.D1 if P.force is None else P.D1 + P.force.minus
    return -D1 / P.c[..., None]


def momentum_plus(P: Partials) -> Tensor:
    """p_{k+1} = D2 L_d + F⁺, the momentum of FL⁺ at (q_k, q_{k+1}, s_k); F⁺ = 0 without forces; shape (..., n)."""
    return P.D2 if P.force is None else P.D2 + P.force.plus


def legendre_minus(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """FL⁻(q0, q1, s0) = (q0, −D1 L_d / c, s0). Source: discrete Legendre transforms of the paper."""
    return q0, momentum_minus(partials(L_d, q0, q1, s0, h)), s0


def legendre_plus(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """FL⁺(q0, q1, s0) = (q1, D2 L_d, s0 + L_d), plus F⁺ where there are forces; s is taken at s0 (erratum E3)."""
    P = partials(L_d, q0, q1, s0, h)
    return q1, momentum_plus(P), s0 + P.L


def herglotz_residual(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n) q_{k−1}
    q1: Tensor,  # (..., n) q_k
    q2: Tensor,  # (..., n) q_{k+1}
    s0: Tensor,  # (...) s_{k−1}
    h0: Tensor | float,  # () or (...) t_k − t_{k−1}
    h1: Tensor | float,  # () or (...) t_{k+1} − t_k
) -> Tensor:
    """R_k = D1 L_d(q_k, q_{k+1}, s_k) + c_k D2 L_d(q_{k−1}, q_k, s_{k−1}), with s_k = s_{k−1} + L_d; (..., n).

    R_k has the unit of momentum and is zero along discrete trajectories.

    Source: discrete Herglotz equations; indices by erratum E3.
    """
    _, p, s1 = legendre_plus(L_d, q0, q1, s0, h0)
    P = partials(L_d, q1, q2, s1, h1)
    return momentum_residual(P, p)


def momentum_residual(P: Partials, p0: Tensor) -> Tensor:
    """F = D1 + c p0 (+ F⁻), the equation that a step solves for q1; shape (..., n).

    Where dry friction holds a coordinate, F⁻ is a set and F is the distance from this set: 0 if friction suffices.
    """
    F = unheld_residual(P, p0)
    held = None if P.force is None else P.force.held
    return F if held is None else torch.where(held > 0, soft_threshold(F, held), F)


def soft_threshold(x: Tensor, bound: Tensor) -> Tensor:
    """Soft thresholding x − clamp(x, −bound, bound): the part of x beyond ±bound. Value and slope are 0 between."""
    below = torch.where(x > bound, bound, x)
    return x - torch.where(-bound > below, -bound, below)


def momentum_jacobian(P: Partials, p0: Tensor) -> Tensor:
    """J = ∂F/∂q1 = D1D2 + p0 ⊗ D2D3 (+ ∂F⁻/∂q1), shape (..., n, n). Equal to M where F = 0. Needs order 2.

    A coordinate that dry friction holds obeys Δ = q1 − q0 = 0 instead; its row is e_i, scaled by J's diagonal.
    """
    J = unheld_jacobian(P, p0)
    held = None if P.force is None else P.force.held
    return J if held is None else torch.where((held > 0)[..., None], torch.diag_embed(J.diagonal(0, -2, -1)), J)


def unheld_residual(P: Partials, p0: Tensor) -> Tensor:
    """F without the impulse of dry friction on coordinates at rest; shape (..., n)."""
    F = P.D1 + P.c[..., None] * p0
    return F if P.force is None else F + P.force.minus


def unheld_jacobian(P: Partials, p0: Tensor) -> Tensor:
    """∂F/∂q1 of `unheld_residual`, (..., n, n)."""
    J = P.D12 + p0[..., :, None] * P.D23[..., None, :]
    return J if P.force is None else J + P.force.minus_2


def mixed_hessian(P: Partials) -> Tensor:
    """M = D1D2 − D1 ⊗ D3D2 / c, shape (..., n, n); with forces J at p0 = momentum_minus. Needs order 2.

    FL⁻ and FL⁺ are local diffeomorphisms exactly where c ≠ 0 and det M ≠ 0 (erratum E4).
    """
    return momentum_jacobian(P, momentum_minus(P))


CONDITIONS = {
    "finite": "L_d or a derivative is not finite",
    "c": "c = 0: FL⁻ is not defined",
    "M": "det M = 0: FL⁻ and FL⁺ cannot be inverted",
    "pole": "L_d has a pole at this h (conjugate point): p and s are lost to rounding",
    "H_plus": "det D2D2 L_d = 0: H⁺ does not exist",
    "H_minus": "det D1D1 L⁻ = 0: H⁻ does not exist",
}


@dataclass(frozen=True)
class Regularity:
    """The margin of every condition at (q0, q1, s0); NaN where another failure leaves a margin undefined."""

    finite: Tensor  # (...) 1 or 0
    c: Tensor  # (...) |c| / (1 + |D3|)
    M: Tensor  # (...) smallest singular value of M, coordinates scaled by the diagonals of M, D11, D22
    pole: Tensor  # (...) smallest of 1 and |M(h(1 ± √eps))| / |M(h)|
    H_plus: Tensor  # (...) that of D2D2 L_d
    H_minus: Tensor  # (...) that of c D1D1 L⁻
    h: Tensor  # (...)
    tol: float

    def lost(self, name: str) -> Tensor:
        """(...) bool: whether the condition of that name fails.

        NaN, where another failure leaves the margin undefined, is not below the bound.
        """
        bound = 0.5 if name in ("finite", "pole") else self.tol
        return getattr(self, name) < bound

    def report(self) -> list[str]:
        """Return a line for every failed condition of a sample: `sample (3,), h = 5: c = 0: FL⁻ is not defined`."""
        lines = []
        for name, statement in CONDITIONS.items():
            for index in self.lost(name).nonzero().tolist():
                lines.append(f"{_where(index)}h = {float(self.h[tuple(index)])!r}: {statement}")
        return lines


def regularity(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> Regularity:
    """The margin of every condition at (q0, q1, s0).

    L_d is also evaluated at h(1 ± √eps): near a pole in h its derivatives change by a factor there.

    Source: erratum E4; for H⁻ the same argument on the left Lagrangian of erratum E5.
    """
    eps = torch.finfo(q0.dtype).eps
    # A thousand roundings: a smaller margin cannot be told from 0.
    tol = 1e3 * eps
    h = torch.as_tensor(h, dtype=q0.dtype, device=q0.device)
    with torch.no_grad():
        P = partials(L_d, q0, q1, s0, h, order=2)
        finite = torch.isfinite(P.L) & torch.isfinite(P.D11 + P.D12 + P.D22).all(-1).all(-1)
        c = torch.where(finite, P.c.abs() / (1 + P.D3.abs()), torch.nan)
        usable = finite & (c >= tol)
        M = mixed_hessian(P)
        size = M.abs().amax((-2, -1))
        beside = [
            mixed_hessian(partials(L_d, q0, q1, s0, h * (1 + sign * eps**0.5), 2)).abs().amax((-2, -1))
            for sign in (-1, 1)
        ]
        pole = torch.where(usable & (size > 0), torch.minimum(*beside) / size, torch.nan).clamp(max=1.0)
        M = torch.where(usable[..., None, None], M, torch.nan)
        sizes = (M.nan_to_num(), P.D11, P.D22)
        return Regularity(
            finite=finite.to(q0.dtype),
            c=c,
            M=scaled_margin(M, *sizes),
            pole=pole,
            H_plus=scaled_margin(torch.where(finite[..., None, None], P.D22, torch.nan), *sizes),
            H_minus=scaled_margin(torch.where(usable[..., None, None], left_hessian(P), torch.nan), *sizes),
            h=h.expand_as(P.L),
            tol=tol,
        )


def left_hessian(P: Partials, p0: Tensor | None = None) -> Tensor:
    """Return c D1D1 L⁻ = D11 + p0 ⊗ D13 + D13 ⊗ p0 + D33 p0 ⊗ p0, (..., n, n), regular exactly where H⁻ exists.

    This matrix is the second derivative of L_d(x, q1, s0 + p0·(x − q0)) in x; `p0` defaults to that of the step.
    """
    p0 = momentum_minus(P) if p0 is None else p0
    cross = p0[..., :, None] * P.D13[..., None, :]
    return P.D11 + cross + cross.mT + P.D33[..., None, None] * p0[..., :, None] * p0[..., None, :]


def scaled_margin(X: Tensor, *sizes: Tensor) -> Tensor:
    """Smallest singular value of X (..., n, n), coordinates scaled by the diagonals of `sizes`; NaN if X has a NaN."""
    scale = torch.stack([x.diagonal(dim1=-2, dim2=-1).abs() for x in sizes]).sum(0)
    scale = torch.where(scale > 0, scale, 1.0).rsqrt()
    scaled = scale[..., :, None] * X * scale[..., None, :]
    return torch.where(torch.isfinite(scaled).all(-1).all(-1), least_singular_value(scaled), torch.nan)


def least_singular_value(X: Tensor) -> Tensor:
    """Smallest singular value of X (..., m, n), shape (...); 0 where X is not finite.

    (svdvals refuses a whole batch if one matrix is not finite.)
    """
    finite = torch.isfinite(X).all(-1).all(-1)
    return torch.linalg.svdvals(torch.where(finite[..., None, None], X, 0.0))[..., -1]


def _where(index: list[int]) -> str:
    return f"sample {tuple(index)}, " if index else ""


def step_derivative(
    P: Partials,  # (q0, q1, s0) of a solved step, order 2
    p0: Tensor,  # (..., n)
) -> Tensor:
    """DΦ̃ at (q0, p0, s0), shape (..., 2n+1, 2n+1), ordered q, p, s.

    From F(q0, q1, p0, s0) = D1 + c p0 = 0:

        dq1 = −J⁻¹ (F_q0 dq0 + c dp0 + F_s ds0),    J = D1D2 + p0 ⊗ D2D3
        dp1 = D2D1 dq0 + D2D2 dq1 + D2D3 ds0
        ds1 = D1·dq0 + D2·dq1 + c ds0

    With forces ∂F⁻ joins F_q0, J and F_s, and ∂F⁺ the three coefficients of dp1.
    """
    n = p0.shape[-1]
    eye = torch.eye(n, dtype=p0.dtype, device=p0.device)
    F_q0 = P.D11 + p0[..., :, None] * P.D13[..., None, :]
    F_p0 = P.c[..., None, None] * eye
    F_s0 = (P.D13 + p0 * P.D33[..., None])[..., None]
    p1_q0, p1_q1, p1_s0 = P.D12.mT, P.D22, P.D23[..., None]
    if P.force is not None:
        F_q0, F_s0 = F_q0 + P.force.minus_1, F_s0 + P.force.minus_3[..., None]
        p1_q0, p1_q1, p1_s0 = p1_q0 + P.force.plus_1, p1_q1 + P.force.plus_2, p1_s0 + P.force.plus_3[..., None]
    J = momentum_jacobian(P, p0)
    # A coordinate that dry friction holds obeys Δ = q1 − q0 = 0 in place of F = 0.
    if P.force is not None and P.force.held is not None:
        rows = (P.force.held > 0)[..., None]
        F_q0, F_p0, F_s0 = torch.where(rows, -J, F_q0), torch.where(rows, 0.0, F_p0), torch.where(rows, 0.0, F_s0)
    dq1 = -solve_columns(J, torch.cat([F_q0, F_p0, F_s0], -1))
    zero = torch.zeros_like(F_p0)
    dp1 = p1_q1 @ dq1 + torch.cat([p1_q0, zero, p1_s0], -1)
    ds1 = (P.D2[..., None, :] @ dq1)[..., 0, :] + torch.cat([P.D1, zero[..., 0], P.c[..., None]], -1)
    return torch.cat([dq1, dp1, ds1[..., None, :]], -2)
