"""Rollouts: of vector fields by Runge–Kutta, of three-point equations by Newton, and starts fitted to a history."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

SUBSTEP = 0.1  # longest Runge–Kutta step in units of the data's time scale, see `fields.substeps`
Field = Callable[..., Tensor]  # (B, 2n) → (B, 2n), with the inputs (B, m) where there are some


class Predictor(Protocol):
    """A trained model: two positions in, a motion out."""

    @property
    def parameters(self) -> int:
        """Number of trained values."""
        ...

    def rollout(self, q0: Tensor, q1: Tensor, steps: int, exact: Tensor | None = None) -> Tensor:
        """Positions (B, steps + 2, n) from q0, q1 on, at equal steps; `exact` is the exact state at q1, (B, 2n)."""
        ...


def rk4(field: Field, y: Tensor, h: float, substeps: int, *u: Tensor) -> Tensor:
    """One step of length h with held inputs, by `substeps` classical Runge–Kutta steps."""
    k = h / substeps
    for _ in range(substeps):
        a = field(y, *u)
        b = field(y + k / 2 * a, *u)
        c = field(y + k / 2 * b, *u)
        y = y + k / 6 * (a + 2 * (b + c) + field(y + k * c, *u))
    return y


@dataclass(frozen=True)
class Flow:
    """A vector field ẏ = f(y) on y = (q, v) or (q, p) as a predictor.

    Without an exact state the velocity (or momentum) at q0 is the one whose flow meets q1: the model starts from the
    same two positions as every other. `momentum` says that the second half of y is p.
    """

    field: Field
    h: float
    substeps: int
    parameters: int
    step: Callable[[Tensor], Tensor] | None = None  # another integrator for one step of length h
    momentum: bool = False

    def advance(self, y: Tensor, *u: Tensor) -> Tensor:
        """The state a step later, with held inputs."""
        return (self.step(y) if self.step else rk4(self.field, y, self.h, self.substeps, *u)).detach()

    def rollout(self, q0: Tensor, q1: Tensor, steps: int, exact: Tensor | None = None) -> Tensor:
        """See `Predictor`."""
        n = q0.shape[-1]
        y = self.advance(torch.cat([q0, self.shoot(q0, q1)], -1)) if exact is None else exact
        out = [q0, q1]
        for _ in range(steps):
            y = self.advance(y)
            out.append(y[:, :n])
        return torch.stack(out, 1)

    def shoot(self, q0: Tensor, q1: Tensor, iterations: int = 8) -> Tensor:
        """The second half of the state at q0 from which the flow meets q1, by Newton with differences."""
        v, n = (q1 - q0) / self.h, q0.shape[-1]
        bump = 1e-6 * v.abs().max().clamp_min(1e-3)
        for _ in range(iterations):
            moved = [v, *(v + bump * torch.eye(n, dtype=v.dtype)[i] for i in range(n))]
            ends = self.advance(torch.cat([torch.cat([q0, x], -1) for x in moved]))[:, :n].reshape(n + 1, -1, n)
            slope = ((ends[1:] - ends[0]) / bump).permute(1, 2, 0)  # (B, n, n)
            change = solve(slope, ends[0] - q1)
            v = v - change
            if float(change.nan_to_num(0.0).abs().max()) < 1e-12:
                break
        return v


def solve(A: Tensor, b: Tensor) -> Tensor:
    """A⁻¹ b of a batch; NaN where A is singular or not finite."""
    bad = ~(torch.isfinite(A).all(-1).all(-1) & torch.isfinite(b).all(-1))
    A = torch.where(bad[:, None, None], torch.eye(A.shape[-1], dtype=A.dtype), A)
    x, info = torch.linalg.solve_ex(A, b)
    return torch.where((bad | (info != 0))[:, None], torch.nan, x)


def newton(residual: Callable[[Tensor], Tensor], x: Tensor, iterations: int = 12) -> Tensor:
    """The root (B, n) of a residual (B, n) near x; NaN where Newton's iteration does not converge."""
    n, change = x.shape[-1], torch.full_like(x, torch.inf)
    for _ in range(iterations):
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            r = residual(x)
            rows = [torch.autograd.grad(r[:, i].sum(), x, retain_graph=i + 1 < n)[0] for i in range(n)]
        change = solve(torch.stack(rows, 1).detach(), r.detach())
        x = x.detach() - change
        if float(change.nan_to_num(0.0).abs().max()) < 1e-11:
            break
    return torch.where(change.abs().amax(-1, keepdim=True) < 1e-6, x, torch.nan)


@dataclass(frozen=True)
class ThreePoint:
    """An implicit equation R(q0, q1, q2) = 0 as a predictor: Newton for q2 from the extrapolated line."""

    residual: Callable[[Tensor, Tensor, Tensor], Tensor]  # (B, n) each → (B, n)
    parameters: int

    def rollout(self, q0: Tensor, q1: Tensor, steps: int, exact: Tensor | None = None) -> Tensor:  # noqa: ARG002
        """See `Predictor`; NaN from the step on at which Newton fails."""
        out = [q0, q1]
        for _ in range(steps):
            q0, q1 = out[-2:]
            out.append(newton(partial(self.residual, q0, q1), 2 * q1 - q0))
        return torch.stack(out, 1)


def fitted_start(model: Predictor, history: Tensor, iterations: int = 8) -> tuple[Tensor, Tensor]:
    """The pair (q0, q1) from which the model's motion lies nearest to a history (B, K, n) of noisy positions.

    Missing positions are NaN, but not the first two. Levenberg–Marquardt over the 2n numbers of the pair, with
    differences; one damping a sample.
    """
    B, K, n = history.shape
    x = torch.cat([history[:, 0], history[:, 1]], -1)
    damping = torch.full((B, 1, 1), 1e-3, dtype=x.dtype)
    bump = 1e-6

    def misfit(x: Tensor) -> Tensor:
        out = model.rollout(x[:, :n].contiguous(), x[:, n:].contiguous(), K - 2)
        seen = history.repeat(len(x) // B, 1, 1)
        return torch.where(torch.isnan(seen), 0.0, (out - seen).nan_to_num(1e3, 1e3, -1e3)).flatten(1)

    r = misfit(x)
    for _ in range(iterations):
        moved = torch.cat([x + bump * torch.eye(2 * n, dtype=x.dtype)[i] for i in range(2 * n)])
        J = ((misfit(moved).reshape(2 * n, B, -1) - r) / bump).permute(1, 2, 0)  # (B, Kn, 2n)
        A = J.mT @ J
        A = A + damping * torch.diag_embed(A.diagonal(dim1=-2, dim2=-1) + 1e-12)
        step = solve(A, (J.mT @ r[..., None])[..., 0]).nan_to_num(0.0)
        tried = misfit(x - step)
        better = (tried.square().sum(1) < r.square().sum(1))[:, None]
        x, r = torch.where(better, x - step, x), torch.where(better, tried, r)
        damping = torch.where(better[..., None], damping / 4, damping * 8).clamp(1e-9, 1e6)
    return x[:, :n], x[:, n:]
