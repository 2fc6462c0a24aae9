"""The iteration of `herglotz.mechanics.newton` for one sample, in plain numbers: small tensors cost the most there.

Same rules, same constants; |F|, |J⁻¹F| and every decision are Python floats.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite, nan
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.mechanics.newton import ARMIJO, CONTRACTION, NEAR, Equation, Found, Point, Rules

Numbers = Callable[[Tensor, Point, float], tuple[float, float]]  # `Sizes` of one sample


class _Here(NamedTuple):
    """Where the sample is, and Newton's step from there."""

    x: Tensor  # (1, …, m)
    point: Point
    J: Tensor
    delta: Tensor | float  # −J⁻¹F
    left: float  # |J⁻¹F|
    merit: float  # |F|


def newton_one(equation: Equation, x: Tensor, rules: Rules, sizes: Numbers) -> Found:
    """Iterate from x by rules that measure |F| and have a matrix for a Jacobian."""
    here = _evaluate(equation, x, None)
    scale, floor = sizes(x, here.point, here.left)
    tiny, near = rules.tol * scale, NEAR * scale
    # A direction that is not finite can never be followed: such a sample is over.
    done, fraction, slow, iterations = not tiny < here.left < inf, 1.0, False, 0
    while iterations < rules.max_iterations and not done:
        iterations += 1
        # At a trial that may be far off, the Jacobian is wanted as well.
        fresh = slow or not rules.keep or here.left > near
        move = here.delta if fraction == 1.0 else fraction * here.delta
        trial = _evaluate(equation, here.x + move, None if fresh else here.J)
        settled = trial.left <= tiny
        better = settled or trial.merit <= (1 - ARMIJO * fraction) * here.merit
        stalled = not better and here.left <= floor  # rounding, not a wrong direction
        done = settled or stalled
        slow = not (fresh or settled) and CONTRACTION * here.left < trial.left < inf
        if better or (slow and not stalled):
            here, fraction = trial, 1.0
        else:
            fraction /= 2
    return _found(here, done, iterations)


def _found(here: _Here, done: bool, iterations: int) -> Found:
    shape, healthy = here.x.shape[:-1], done and isfinite(here.merit + here.left)
    merit, residual = here.x.new_full(shape, here.merit), here.x.new_full(shape, here.left)
    flag = torch.full(shape, done, device=here.x.device)
    return Found(here.x, here.point, merit, residual, flag, iterations, healthy)


def _evaluate(equation: Equation, x: Tensor, kept: Tensor | None) -> _Here:
    """The equation at x and Newton's step by its Jacobian, or by the kept one if there is one."""
    point = equation(x, kept is None)
    J = point.J if kept is None else kept
    assert J is not None
    return _Here(x, point, J, *newton_step(J, point.F))


def newton_step(J: Tensor, F: Tensor) -> tuple[Tensor | float, float, float]:
    """−J⁻¹F, not finite where J is singular, |J⁻¹F| and |F|."""
    n = F.shape[-1]
    if n == 1:
        f, j = F.item(), J.item()
        delta = -f / j if j else (-inf if f else nan)
        return delta, abs(delta), abs(f)
    f = F.flatten().tolist()
    if n == 2:
        delta = _eliminate(*J.flatten().tolist(), *f)
        return torch.tensor(delta, dtype=F.dtype, device=F.device).reshape(F.shape), norm(delta), norm(f)
    delta = -torch.linalg.solve_ex(J, F[..., None])[0][..., 0]
    return delta, norm(delta.flatten().tolist()), norm(f)


def _eliminate(a: float, b: float, c: float, d: float, x: float, y: float) -> list[float]:
    """−(a b; c d)⁻¹ (x, y), Gauss with a row exchange."""
    if abs(c) > abs(a):
        a, b, c, d, x, y = c, d, a, b, y, x
    if not a:
        return [nan, nan]
    factor = c / a
    pivot = d - factor * b
    if not pivot:
        return [nan, nan]
    second = (y - factor * x) / pivot
    return [(b * second - x) / a, -second]


def norm(values: list[float]) -> float:
    """The largest absolute value, NaN if one is."""
    return nan if any(v != v for v in values) else max(map(abs, values), default=0.0)
