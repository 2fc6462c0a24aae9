"""Discrete Hamilton–Jacobi theory: the Hopf–Lax form of the equation, which is well-posed (erratum E7)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.stepping.state import Status, step_sizes
from herglotz.theory.contact_manifolds import Function, FunctionGerm
from herglotz.theory.lagrangian_dynamics import Curve, checked, family_value


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
    curve = checked(family_value(L_d, S, y, sizes, beyond), throw)
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
