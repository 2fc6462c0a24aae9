"""Which condition fails where: c ≠ 0, det M ≠ 0, no pole of L_d, det D2D2 L_d ≠ 0 (H⁺), det D1D1 L⁻ ≠ 0 (H⁻).

Stepping needs the first three, the right discrete Hamiltonian the fourth, the left one the fifth (erratum E4). All
margins are free of units: 0 where the condition is lost, of order 1 for a kinetic term.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics.legendre import mixed_hessian, momentum_minus
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials

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
