"""The iteration of `herglotz.stepping.newton` for one sample, in plain numbers: small tensors cost the most there.

Same rules, same constants; |F|, |J⁻¹F| and every decision are Python floats.
"""

from __future__ import annotations

from math import inf, isfinite, nan
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.stepping.equation import Equation, Point

CLOSE = 1e-3  # of the size of q: nearer than this a Jacobian that is one iteration old converges fast enough
CONTRACTION = 0.05  # an old Jacobian that gains less than this per iteration is replaced


class Found(NamedTuple):
    """Where an iteration ended."""

    x: Tensor  # (..., n) the unknown
    point: Point
    merit: Tensor  # (...) |F|
    residual: Tensor  # (...) |J⁻¹F|
    done: Tensor  # (...)
    iterations: int
    healthy: bool  # one sample that is done, all numbers finite; False where that is not known


class _Move(NamedTuple):
    """A Newton step."""

    delta: Tensor | float  # −J⁻¹F
    left: float  # |J⁻¹F|
    merit: float  # |F|


def find_one(
    equation: Equation, q0: Tensor, x: Tensor, tol: float, max_iterations: int, order: int, increments: bool
) -> Found:
    """Newton with backtracking from x."""
    point, J = _evaluate(equation, x, None)
    move = _newton(J, point.F)
    scale = _scale(equation, q0, x, point, J, move.left, increments)
    eps = torch.finfo(x.dtype).eps
    tiny, near = tol * scale, CLOSE * scale
    floor = 1e3 * eps * max(scale, equation.typical_increment().item())
    # A direction that is not finite can never be followed: such a sample is over.
    done, length, slow, iterations = move.left <= tiny or not isfinite(move.left), 1.0, False, 0
    while iterations < max_iterations and not done:
        iterations += 1
        trial = x + (move.delta if length == 1.0 else length * move.delta)
        fresh = slow or move.left > near  # at a trial that may be far off, the Jacobian is wanted as well
        point_trial, J_trial = _evaluate(equation, trial, None if order == 2 or fresh else J)
        new = _newton(J_trial, point_trial.F)
        settled = new.left <= tiny
        better = settled or new.merit <= (1 - 1e-4 * length) * move.merit
        stalled = not better and move.left <= floor  # rounding, not a wrong direction
        slow = False
        if order == 1:
            slow = not (fresh or settled) and new.left > CONTRACTION * move.left and isfinite(new.left)
            better = better or (slow and not stalled)
        if better:
            x, point, J, move, length = trial, point_trial, J_trial, new, 1.0
        else:
            length /= 2
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


def _newton(J: Tensor, F: Tensor) -> _Move:
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


def _scale(equation: Equation, q0: Tensor, x: Tensor, point: Point, J: Tensor, left: float, increments: bool) -> float:
    """The size that steps are compared with: of the positions or, in increments, of the increment."""
    size = norm(x.flatten().tolist())
    other = _newton(J, equation.push(point)).left + size if increments else norm(q0.flatten().tolist())
    limits = torch.finfo(x.dtype)  # the floor: tolerances of denormal size would keep a motion from coming to rest
    return max(size, other, left, limits.tiny / limits.eps) if isfinite(size + other + left) else 1.0


def norm(values: list[float]) -> float:
    """The largest absolute value, NaN if one is."""
    return nan if any(v != v for v in values) else max(map(abs, values), default=0.0)
