"""Discrete Lagrangian dynamics: curves on which the Herglotz action is stationary, and the discrete Cauchy problem.

The ends of a curve are fixed, or its last point and an initial function S are given. Newton's method solves for all
unknown points together. With δs_k as an unknown beside δq_k, the second variation couples neighbours only: the system
is block tridiagonal with blocks of size n + 1. Block elimination is the Riccati recursion of the Hamilton–Jacobi
equation, and a singular pivot is a caustic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian, Partials, momentum_minus, momentum_plus, partials
from herglotz.mechanics.newton import Root, find_root
from herglotz.stepping.block_tridiagonal import Blocks, solve_blocks
from herglotz.stepping.rollout import Drive, OneStep, Plan, roll_out
from herglotz.stepping.state import Rollout, State, Status, Step, StepError, status_of_root, step_sizes
from herglotz.stepping.stepper import Stepper
from herglotz.theory.action import curve_action, curve_partials
from herglotz.theory.caustics import Opening, opening
from herglotz.theory.function_germ import Function, FunctionGerm, germ


@dataclass(frozen=True)
class Curve:
    """One stationary curve for each sample; NaN where the status is not CONVERGED."""

    q: Tensor  # (..., N+1, n)
    p: Tensor  # (..., N+1, n)
    s: Tensor  # (..., N+1)
    sigma: Tensor  # (..., N+1)
    status: Tensor  # (...) Status values
    residual: Tensor  # (...) last Newton step over the size of the positions
    # The distance of each sample from a caustic.
    opening: Opening
    iterations: int

    @property
    def ok(self) -> Tensor:
        """Whether each sample converged, shape (...)."""
        return self.status == Status.CONVERGED

    def failures(self) -> list[str]:
        """Return one line for every sample that failed, with the reason."""
        lines = []
        for index in (~self.ok).nonzero().tolist():
            at = tuple(index)
            name = Status(int(self.status[at])).name
            why = f"residual {float(self.residual[at]):.3g}; start from a better guess"
            if name == "SINGULAR":
                why = f"caustic: ∂q_N has opened by {float(self.opening.final[at]):.2g} only, or c = 0"
                if int(self.opening.crossed[at]) >= 0:
                    why = f"caustic crossed in step {int(self.opening.crossed[at])}"
            lines.append(f"sample {at}: {name}: {why}")
        return lines


def boundary_value(
    L_d: DiscreteLagrangian,
    q_start: Tensor,  # (..., n)
    q_end: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    *,
    h: Tensor | float,
    steps: int | None = None,
    throw: bool = False,
) -> Curve:
    """The discrete curve from q_start to q_end on which s_N is stationary: R_1 = … = R_{N−1} = 0.

    Parameters
    ----------
    h, steps
        A scalar h with a count N, or (N,) or (..., N) steps.
    throw
        Raise `StepError` if a sample fails.

    Returns
    -------
    Curve
        Status SINGULAR where the ends are conjugate: there are infinitely many solutions, or none. A curve that has
        *crossed* a caustic (`opening.crossed`) is stationary and not minimal.

    Raises
    ------
    InputError
        If a setting does not fit or L_d comes with forces.
    StepError
        With `throw`, naming the samples.

    Source: discrete Herglotz action and equations of the paper.
    """
    h_all = step_sizes(torch.as_tensor(h, dtype=q_start.dtype, device=q_start.device), steps)
    batch = torch.broadcast_shapes(q_start.shape[:-1], q_end.shape[:-1], s0.shape, h_all.shape[:-1])
    first, last = (q.detach().expand(*batch, q.shape[-1]) for q in (q_start, q_end))
    s = s0.detach().expand(batch)
    interior = straight_line(first, last, h_all)[..., 1:-1, :]
    return checked(_critical(L_d, interior, [first, last], s, h_all, beyond=True), throw)


def family_value(
    L_d: DiscreteLagrangian,
    S: Function,
    y: Tensor,  # (..., n) q_N
    h: Tensor,  # (N,) or (..., N)
    beyond: bool,
) -> Curve:
    """The curve to y with p_0 = dS(q_0) and s_0 = S(q_0), on which S(q_0) + Σ L_d is stationary in q_0 too.

    Newton's iteration starts with all points q_0 … q_{N−1} at y.
    """
    return _critical(L_d, y[..., None, :].expand(*y.shape[:-1], h.shape[-1], y.shape[-1]), [y], S, h, beyond)


def checked(curve: Curve, throw: bool) -> Curve:
    """Return the curve; with `throw`, raise a `StepError` that names the samples that failed."""
    if throw and not bool(curve.ok.all()):
        raise StepError(f"no discrete curve at {'; '.join(curve.failures()[:3])}")
    return curve


def initial_value(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    *,
    h: Tensor | float,
    steps: int | None = None,
) -> Rollout:
    """Solve the discrete Cauchy problem: the solution with given q_0, q_1 and s_0 starts at FL⁻(q_0, q_1, s_0)."""
    h_all = step_sizes(torch.as_tensor(h, dtype=q0.dtype, device=q0.device), steps)
    P = partials(L_d, q0, q1, s0, h_all[..., 0])
    start = State(q0.expand(P.D1.shape), momentum_minus(P), s0.expand(P.L.shape))
    end = State(q1.expand(P.D1.shape), momentum_plus(P), s0 + P.L)
    first = Step(end, P.c, torch.zeros_like(P.L, dtype=torch.uint8), torch.zeros_like(P.L), 0)
    later = Stepper(L_d)
    single: OneStep = lambda state, h, guess, *_: (first if state is start else later.step(state, h, guess), None)  # noqa: E731
    track = roll_out(start, Drive(lambda: single, h_all, Plan(h_all.shape[-1])))
    q, p, s = track.states
    return Rollout(q, p, s, track.sigma, track.status, track.residual)


def straight_line(q_start: Tensor, q_end: Tensor, h: Tensor) -> Tensor:
    """Uniform motion between the ends with the steps h, shape (..., N+1, n)."""
    t = torch.cat([torch.zeros_like(h[..., :1]), h.cumsum(-1)], -1)
    t = (t / t[..., -1:])[..., None]
    return (1 - t) * q_start[..., None, :] + t * q_end[..., None, :]


def _critical(
    L_d: DiscreteLagrangian,
    guess: Tensor,  # (..., K, n)
    ends: list[Tensor],
    source: Tensor | Function,
    h: Tensor,
    beyond: bool,
) -> Curve:
    """The stationary curve through K unknown points.

    `ends` is [q_0, q_N] with `source` s_0, or [q_N] with `source` a function S, for which s_0 = S(q_0). Unless
    `beyond`, a curve that has crossed a caustic is SINGULAR.
    """

    def curve(x: Tensor) -> tuple[Tensor, Tensor, Partials, FunctionGerm | None]:
        interior = x.unflatten(-1, guess.shape[-2:]) if x.shape[-1] else guess
        q = torch.cat([*(e[..., None, :] for e in ends[:-1]), interior, ends[-1][..., None, :]], -2)
        if isinstance(source, Tensor):
            S, s0 = None, source
        else:
            S = germ(source, q[..., 0, :])
            s0 = S.S
        s = curve_action(L_d, q, s0, h)
        return q, s, curve_partials(L_d, q, s, h, order=2), S

    with torch.no_grad():
        root = _solved(curve, guess, ends)
        q, s, P, S = curve(root.x)
        p0 = momentum_minus(P)[..., 0, :] if S is None else S.dS
        p = torch.cat([p0[..., None, :], momentum_plus(P)], -2)
        family = opening(P, p[..., :-1, :], _parameters(q[..., 0, :], S))
        finite = torch.isfinite(s).all(-1) & torch.isfinite(q).all(-1).all(-1)
        singular = (family.final < 1e3 * torch.finfo(q.dtype).eps) | (P.c == 0).any(-1)
        if not beyond:
            singular = singular | (family.crossed >= 0)
        status = status_of_root(root, finite, singular)
        nan = torch.where(status == Status.CONVERGED, 0.0, torch.nan).to(q)
        sigma = torch.cat([torch.ones_like(s[..., :1]), P.c.cumprod(-1)], -1)
        q, p, s, sigma = q + nan[..., None, None], p + nan[..., None, None], s + nan[..., None], sigma + nan[..., None]
        return Curve(q, p, s, sigma, status, root.error, family, root.iterations)


def _solved(
    curve: Callable[[Tensor], tuple[Tensor, Tensor, Partials, FunctionGerm | None]], guess: Tensor, ends: list[Tensor]
) -> Root:
    """Newton's solution for the unknown points, which are one vector (..., K n)."""
    x, n = guess.detach().flatten(-2), guess.shape[-1]
    size = torch.cat([e.abs() for e in ends] + [x.abs()], -1).amax(-1, keepdim=True)
    if not x.shape[-1]:
        return Root(x, torch.ones_like(size[..., 0], dtype=torch.bool), 0 * size[..., 0], 0, None, x)

    def equations(x: Tensor) -> tuple[Tensor, Blocks]:
        _, _, P, S = curve(x)
        F, blocks = _system(P, S)
        return F.flatten(-2), blocks

    def solver(blocks: tuple[Tensor, ...], F: Tensor) -> Tensor:
        rhs = F.unflatten(-1, guess.shape[-2:])
        rhs = torch.cat([rhs, torch.zeros_like(rhs[..., :1])], -1)
        return solve_blocks(blocks, rhs)[..., :n].flatten(-2)  # type: ignore[arg-type]

    return find_root(equations, x, size.expand(x.shape), solver)


def _system(P: Partials, S: FunctionGerm | None) -> tuple[Tensor, Blocks]:
    """The residuals R_k at the unknown points, and the diagonal, upper and lower blocks for (δq_k, δs_k)."""
    batch = (slice(None),) * (P.L.ndim - 1)
    later, earlier = (*batch, slice(1, None)), (*batch, slice(None, -1))
    # The momentum that arrives at q_k, and its derivative by q_k.
    p, slope = P.D2, P.D22
    if S is None:
        here, p, slope = P.map(lambda x: x[later]), p[..., :-1, :], slope[..., :-1, :, :]
        before = P.map(lambda x: x[earlier])
    else:
        here = P
        p = torch.cat([S.dS[..., None, :], p[..., :-1, :]], -2)
        slope = torch.cat([S.d2S[..., None, :, :], slope[..., :-1, :, :]], -3)
        # `solve_blocks` does not read the first entry, the lower block of row 0.
        before = P.map(lambda x: torch.roll(x, 1, P.L.ndim - 1))
    c = here.c[..., None]
    F = here.D1 + c * p
    diagonal = _block(
        here.D11 + p[..., :, None] * here.D13[..., None, :] + c[..., None] * slope,
        here.D13 + p * here.D33[..., None],
        -p,
        torch.ones_like(here.L),
    )
    zero = torch.zeros_like(p)
    upper = _block(here.D12 + p[..., :, None] * here.D23[..., None, :], zero, zero, torch.zeros_like(here.L))
    lower = _block(c[..., None] * before.D12.mT, c * before.D23, -before.D1, -before.c)
    return F, (diagonal, upper, lower)


def _block(qq: Tensor, qs: Tensor, sq: Tensor, ss: Tensor) -> Tensor:
    """The block [[qq, qs], [sq, ss]], shape (..., n+1, n+1)."""
    bottom = torch.cat([sq, ss[..., None]], -1)
    return torch.cat([torch.cat([qq, qs[..., None]], -1), bottom[..., None, :]], -2)


def _parameters(q0: Tensor, S: FunctionGerm | None) -> Tensor:
    """The derivative of (q_0, p_0, s_0) by the family's parameter, which is p_0, or q_0 where S is given."""
    eye = torch.eye(q0.shape[-1], dtype=q0.dtype, device=q0.device).expand(*q0.shape, q0.shape[-1])
    if S is None:
        return torch.cat([torch.zeros_like(eye), eye, torch.zeros_like(eye[..., :1, :])], -2)
    return torch.cat([eye, S.d2S, S.dS[..., None, :]], -2)
