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


class _Move(NamedTuple):
    """A Newton step."""

    delta: Tensor | float  # −J⁻¹F
    left: float  # |J⁻¹F|
    merit: float  # |F|


def newton_one(equation: Equation, x: Tensor, rules: Rules, sizes: Numbers) -> Found:
    """Iterate from x by rules that measure |F| and have a matrix for a Jacobian."""
    point, J = _evaluate(equation, x, None)
    move = newton_step(J, point.F)
    scale, floor = sizes(x, point, move.left)
    tiny, near = rules.tol * scale, NEAR * scale
    # A direction that is not finite can never be followed: such a sample is over.
    done, fraction, slow, iterations = move.left <= tiny or not isfinite(move.left), 1.0, False, 0
    while iterations < rules.max_iterations and not done:
        iterations += 1
        trial = x + (move.delta if fraction == 1.0 else fraction * move.delta)
        fresh = slow or move.left > near  # at a trial that may be far off, the Jacobian is wanted as well
        point_trial, J_trial = _evaluate(equation, trial, None if fresh or not rules.keep else J)
        new = newton_step(J_trial, point_trial.F)
        settled = new.left <= tiny
        better = settled or new.merit <= (1 - ARMIJO * fraction) * move.merit
        stalled = not better and move.left <= floor  # rounding, not a wrong direction
        slow = False
        if rules.keep:
            slow = not (fresh or settled) and new.left > CONTRACTION * move.left and isfinite(new.left)
            better = better or (slow and not stalled)
        if better:
            x, point, J, move, fraction = trial, point_trial, J_trial, new, 1.0
        else:
            fraction /= 2
        done = settled or stalled
    merit, residual = (x.new_full(x.shape[:-1], value) for value in (move.merit, move.left))
    flag = torch.full(x.shape[:-1], done, device=x.device)
    return Found(x, point, merit, residual, flag, iterations, done and isfinite(move.merit + move.left))


def _evaluate(equation: Equation, x: Tensor, kept: Tensor | None) -> tuple[Point, Tensor]:
    """The equation at x and its Jacobian, the kept one if there is one."""
    point = equation(x, kept is None)
    if kept is not None:
        return point, kept
    assert point.J is not None
    return point, point.J


def newton_step(J: Tensor, F: Tensor) -> _Move:
    """−J⁻¹F, not finite where J is singular."""
    n = F.shape[-1]
    if n == 1:
        f, j = F.item(), J.item()
        delta = -f / j if j else (-inf if f else nan)
        return _Move(delta, abs(delta), abs(f))
    f = F.flatten().tolist()
    if n == 2:
        delta = _eliminate(*J.flatten().tolist(), *f)
        return _Move(torch.tensor(delta, dtype=F.dtype, device=F.device).reshape(F.shape), norm(delta), norm(f))
    delta = -torch.linalg.solve_ex(J, F[..., None])[0][..., 0]
    return _Move(delta, norm(delta.flatten().tolist()), norm(f))


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
