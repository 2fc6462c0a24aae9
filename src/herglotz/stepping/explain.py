"""Why a step fails: which condition of erratum E4, at which sample, at which h."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian
from herglotz.mechanics.legendre import CONDITIONS, Regularity, regularity
from herglotz.stepping.newton import solve_step
from herglotz.stepping.state import State, Status

# Strides of the continuation in h: each failure halves the stride, and 1e-9 of h is reached after 28 halvings.
MAX_STRIDES = 60
# Ratio of the ways in the second and the first half of a step above which a motion escapes; a fold has 2.4.
ESCAPE = 4.0
# Newton iterations from an extrapolated start: a start that needs more came from too long a stride.
MAX_CORRECTIONS = 15
# Quantities that a step needs; H⁺ and H⁻ may be lost.
STEPPING = ("finite", "c", "M", "pole")


def explain_step(
    L_d: DiscreteLagrangian, state: State, h: torch.Tensor | float, *, max_iterations: int = 30
) -> list[str]:
    """Return a line for every sample whose step fails or cannot be trusted, with the condition that does not hold.

    The step is solved again, and the conditions c ≠ 0, det M ≠ 0 and no pole of L_d are tested where Newton ended.
    A step can converge and still be lost: at a conjugate point q1 is right and p1 is rounding. Where Newton fails, the
    longest step that exists is sought, which tells a motion that reaches infinity before h from a motion that ends.
    A line is, for example, `sample (3,), h = 5: SINGULAR: c = 0: FL⁻ is not defined`.

    Source: erratum E4 and the critical steps of section 4 of `docs/mathematics.md`.
    """
    state = State(*(x.detach() for x in state))
    q = state.q
    sizes = torch.as_tensor(h, dtype=q.dtype, device=q.device)
    if not bool((sizes > 0).all()):
        raise InputError(f"h must be > 0, got {float(sizes.min()):g}")
    with torch.no_grad():
        solution = solve_step(L_d, state, sizes, q, 64 * torch.finfo(q.dtype).eps, max_iterations)
        at = regularity(L_d, q, solution.q1, state.s, sizes)
        failed = solution.status != Status.CONVERGED
        reach, escapes = longest_step(L_d, state, at.h, max_iterations) if bool(failed.any()) else (at.h, failed)
    lost = {name: at.lost(name) for name in STEPPING}
    lines = []
    for index in torch.ones_like(solution.status, dtype=torch.bool).nonzero().tolist():
        i = tuple(index)
        reasons = [CONDITIONS[name] for name in STEPPING if bool(lost[name][i])]
        status = Status(int(solution.status[i]))
        instead = [] if status == Status.CONVERGED else _not_reached(at, i, reach, escapes)
        if bool(lost["pole"][i]) and not instead:
            status = Status.SINGULAR
        if status != Status.CONVERGED:
            size, residual = float(solution.q1[i].abs().max()), float(solution.residual[i])
            reasons = instead or reasons
            ended = f"Newton ended at |q1| = {size:.3g}"
            reasons = [*reasons, ended] if reasons else [_no_solution(at, i, ended, residual)]
        if reasons:
            where = f"sample {i}, " if i else ""
            lines.append(f"{where}h = {float(at.h[i])!r}: {status.name}: {'; '.join(reasons)}")
    return lines


def longest_step(
    L_d: DiscreteLagrangian,
    state: State,
    h: Tensor,  # (...)
    max_iterations: int = 30,
) -> tuple[Tensor, Tensor]:
    """The longest step h' ≤ h that can be taken from a state, (...), and whether the motion escapes there, (...).

    The motion escapes if h' < h, and q1 goes `ESCAPE` times as far between h'/2 and h' as before, and a fifth of that
    way in the last thousandth of h'. Towards a logarithmic pole, q1 = −ln(1 − h/h*)/λ, both ratios grow without bound;
    towards a fold, q1 = q* − a√(h* − h), the ratios are 2.4 and 0.04.
    """
    reach, end = _continued(L_d, state, h, max_iterations)
    # Both parts of the step are one batch.
    both = State(*(x.expand(2, *x.shape) for x in state))
    half, late = _continued(L_d, both, torch.stack([0.5 * reach, 0.999 * reach]), max_iterations)[1]
    before, after, last = ((b - a).norm(dim=-1) for a, b in ((state.q, half), (half, end), (late, end)))
    return reach, (reach < h) & (after > ESCAPE * before) & (last > 0.2 * after)


def _continued(L_d: DiscreteLagrangian, state: State, h: Tensor, max_iterations: int) -> tuple[Tensor, Tensor]:
    """The largest h' ≤ h to which q1(h') can be continued from q1(0) = q0, and q1(h'); each start is extrapolated."""
    state = State(*(x.detach() for x in state))
    q = state.q
    tol, most = 64 * torch.finfo(q.dtype).eps, min(max_iterations, MAX_CORRECTIONS)
    at, stride = torch.zeros_like(h), h / 4
    q1, slope = q.expand(*h.shape, q.shape[-1]), torch.zeros_like(q)
    for _ in range(MAX_STRIDES):
        trial = torch.minimum(at + stride, h)
        moved = (trial - at)[..., None]
        solution = solve_step(L_d, state, trial, q1 + slope * moved, tol, most)
        good = (solution.status == Status.CONVERGED) & (at < h)
        slope = torch.where(good[..., None], (solution.q1 - q1) / moved, slope)
        q1 = torch.where(good[..., None], solution.q1, q1)
        at, stride = torch.where(good, trial, at), torch.where(good, 1.5 * stride, 0.5 * stride)
        if bool(((at >= h) | (stride < 1e-9 * h)).all()):
            break
    return at, q1


def _not_reached(at: Regularity, i: tuple[int, ...], reach: Tensor, escapes: Tensor) -> list[str]:
    """Why Newton did not find q1 although all shorter steps exist; empty if a shorter step does not exist."""
    if bool(escapes[i]):
        return [f"the motion escapes: q1 grows without bound as h → {float(reach[i])!r}"]
    known = "a solution exists, continued from smaller h, but Newton does not reach it from q0"
    return [known] if bool(reach[i] >= at.h[i]) else []


def _no_solution(at: Regularity, i: tuple[int, ...], ended: str, residual: float) -> str:
    margins = {"c": float(at.c[i]), "det M": float(at.M[i])}
    name = min(margins, key=lambda key: margins[key] if margins[key] == margins[key] else 0.0)
    return (
        f"no q1 was found with FL⁻(q0, q1, s0) = p0: {ended}, |J⁻¹F| = {residual:.3g}, "
        f"where the margin of {name} ≠ 0 is {margins[name]:.2g}"
    )
