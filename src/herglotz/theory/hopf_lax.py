"""The discrete Hopf–Lax form of the Hamilton–Jacobi equation, the well-posed one (erratum E7)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.stepping.state import Status, step_sizes
from herglotz.theory.boundary import Curve, checked, family_value
from herglotz.theory.function_germ import Function, FunctionGerm


@dataclass(frozen=True)
class HopfLax:
    """S^{k+N}(y) and its derivatives; NaN where the status is not CONVERGED."""

    S: Tensor  # (...)
    dS: Tensor  # (..., n)
    d2S: Tensor  # (..., n, n)
    x: Tensor  # (..., n) the stationary point q_k
    status: Tensor  # (...) Status; SINGULAR at a caustic and beyond it
    curve: Curve  # the characteristic from x to y; `curve.opening` measures the distance from a caustic


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

    Stationary in x: D1L_d + c dS^k(x) = 0. All N extremals are sought together, as one discrete curve that ends in y
    and starts with p_0 = dS(x), s_0 = S(x). By the envelope theorem dS^{k+N}(y) = p_N; d2S is the slope of the family.

    M may be singular: the extremum needs the pivot W = ∂²/∂x² [S + L_d] only. For a degenerate L_d, whose step is a
    relation and no map, this is the implicit Hamilton–Jacobi equation. A crossing of a caustic is seen where M is
    regular, or where W changes its inertia from step to step.

    Parameters
    ----------
    S
        S^k: a callable on (..., n), e.g. `Quadratic` or `PointSource`. Values are values of s.
    h, steps
        A scalar h with a count N, or (N,) or (..., N) steps.
    beyond
        Accept a solution that has crossed a caustic, where S is not a function on all of Q any more.
    throw
        Raise `StepError` if a sample fails.

    Returns
    -------
    HopfLax
        Status SINGULAR where the second derivative in x is singular (A + cα = 0 for a quadratic S) or where a caustic
        was passed, which the inertia of W tells (`theory.caustics`).

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
    """S^{k+N} as a function on Q again, evaluated by Hopf–Lax where it is asked for; NaN at and beyond caustics."""

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
