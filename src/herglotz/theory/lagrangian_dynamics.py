"""Discrete Lagrangian dynamics: the Herglotz action of a discrete curve, its stationary curves, and caustics.

The ends of a stationary curve are fixed, or its last point and an initial function S are given. Newton's method solves
for all unknown points together. With δs_k as an unknown beside δq_k, the second variation couples neighbours only: the
system is block tridiagonal with blocks of size n + 1. Block elimination is the Riccati recursion of the Hamilton–Jacobi
equation, and a singular pivot is a caustic.

At a caustic the map from the parameter of a family of solutions to q_N is singular. A family with S^k on Q is continued
by S^{k+1}(y) = ext_x [S^k(x) + L_d(x, y, S^k(x))]. With p = dS^k(x),

    W_k = D11 + p ⊗ D13 + D13 ⊗ p + D33 p ⊗ p + c d²S^k,    d²S^{k+1} = D22 − Jᵀ W_k⁻¹ J,    J = D12 + p ⊗ D23.

The extremum is lost where the symmetric pivot W_k is singular, whether J is regular or not. A family has passed a
caustic inside step k where the number of negative eigenvalues of W_k differs from that of the kinetic term. The
eigenvalues of ∂q_{k+1}/∂q_k = −J⁻¹ W_k, J regular, decide nothing: with gyroscopic terms they may be complex.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import (
    DiscreteLagrangian,
    Partials,
    momentum_jacobian,
    momentum_minus,
    momentum_plus,
    partials,
    step_derivative,
)
from herglotz.mechanics.legendre import least_singular_value, left_hessian, momentum_residual, scaled_margin
from herglotz.mechanics.newton import Root, find_root
from herglotz.mechanics.partials import value
from herglotz.stepping.block_tridiagonal import Blocks, solve_blocks
from herglotz.stepping.rollout import Drive, OneStep, Plan, roll_out
from herglotz.stepping.state import Rollout, State, Status, Step, StepError, status_of_root, step_sizes
from herglotz.stepping.stepper import Stepper
from herglotz.theory.contact_manifolds import Function, FunctionGerm, germ
from herglotz.theory.hamiltonian_dynamics import unforced


@dataclass(frozen=True)
class Action:
    """The action variable s_k along a discrete curve, and the first variation of s_N."""

    s: Tensor  # (..., N+1) s_0 … s_N
    sigma: Tensor  # (..., N+1) σ_k = ∏_{j<k} c_j; ∂s_N/∂s_0 = σ_N
    residual: Tensor  # (..., N−1, n) R_1 … R_{N−1}, the discrete Herglotz residuals
    gradient: Tensor  # (..., N+1, n) ∂s_N/∂q_k


def curve_action(
    L_d: DiscreteLagrangian,
    q: Tensor,  # (..., N+1, n)
    s0: Tensor,  # (...)
    h: Tensor | float,  # (), (N,) or (..., N)
) -> Tensor:
    """s_0 … s_N with s_{k+1} = s_k + L_d(q_k, q_{k+1}, s_k), shape (..., N+1).

    Raise InputError if the curve has fewer than two points or h does not fit.  Source: discrete Cauchy problem of the
    paper.
    """
    sizes = curve_steps(q, h)
    s = [s0.expand(q.shape[:-2])]
    for k in range(q.shape[-2] - 1):
        s.append(s[-1] + value(L_d, q[..., k, :], q[..., k + 1, :], s[-1], sizes[..., k]))
    return torch.stack(s, -1)


def herglotz_action(L_d: DiscreteLagrangian, q: Tensor, s0: Tensor, h: Tensor | float) -> Action:
    """The action s_N[q_0 … q_N; s_0] and its gradient in closed form.

    q_k enters L_d(q_{k−1}, q_k) and L_d(q_k, q_{k+1}); all later steps depend on q_k through s alone. Hence

        ∂s_N/∂q_k = (∏_{j>k} c_j) R_k,    R_k = D1L_d(q_k, q_{k+1}, s_k) + c_k D2L_d(q_{k−1}, q_k, s_{k−1})

    with R_0 = D1L_d and, at the last point, ∂s_N/∂q_N = D2L_d = p_N. The gradients at interior points vanish exactly on
    the solutions of the discrete Herglotz equations. Raise InputError if the curve has fewer than two points, h does
    not fit, or L_d comes with forces.  Source: discrete Herglotz action and equations of the paper, indices by erratum
    E3.
    """
    s = curve_action(L_d, q, s0, h)
    P = curve_partials(L_d, q, s, h)
    later = P.map(lambda x: x.narrow(P.L.ndim - 1, 1, s.shape[-1] - 2))
    residual = momentum_residual(later, P.D2[..., :-1, :])
    one = torch.ones_like(s[..., :1])
    sigma = torch.cat([one, P.c.cumprod(-1)], -1)
    # The product of the factors after k is not formed by division, because a factor c may be 0.
    after = torch.cat([P.c[..., 1:].flip(-1).cumprod(-1).flip(-1), one], -1)
    rows = torch.cat([P.D1[..., :1, :], residual], -2) * after[..., None]
    return Action(s, sigma, residual, torch.cat([rows, P.D2[..., -1:, :]], -2))


def curve_partials(L_d: DiscreteLagrangian, q: Tensor, s: Tensor, h: Tensor | float, order: int = 1) -> Partials:
    """Partials of all N steps of a curve at once; every entry has a step axis, (..., N, *)."""
    return unforced(partials(L_d, q[..., :-1, :], q[..., 1:, :], s[..., :-1], curve_steps(q, h), order))


def curve_steps(q: Tensor, h: Tensor | float) -> Tensor:
    """The sizes h of all steps of a curve, shape (..., N).

    Raise InputError if the curve has fewer than two points or h is not positive or does not fit.
    """
    if q.ndim < 2 or q.shape[-2] < 2:
        raise InputError(f"a discrete curve needs shape (..., N+1, n) with N >= 1, got {tuple(q.shape)}")
    h = torch.as_tensor(h, dtype=q.dtype, device=q.device)
    shape = (*q.shape[:-2], q.shape[-2] - 1)
    try:
        h = h.broadcast_to(shape)
    except RuntimeError:
        raise InputError(
            f"a curve of {shape[-1]} steps needs h of shape (), (N,) or (..., N), got {tuple(h.shape)}"
        ) from None
    if not bool((h > 0).all()):
        raise InputError(f"h must be > 0, got {float(h.min()):g}")
    return h


@dataclass(frozen=True)
class Opening:
    """How far a family of solutions with n parameters has spread after N steps.

    `final` is 0 at a caustic. It is the smallest singular value of Y_N = ∂q_N over the largest norm of any Y_k or,
    where a J is singular, the smallest margin of any W_k. `crossed` is the first step inside which the family passes a
    caustic, or −1. `slope` is ∂p_N/∂q_N = d²S^N.
    """

    final: Tensor  # (...)
    crossed: Tensor  # (...)
    slope: Tensor  # (..., n, n)


def opening(
    P: Partials,
    p: Tensor,  # (..., N, n)
    tangent: Tensor,  # (..., 2n+1, n)
) -> Opening:
    """Propagate the tangent vectors Y_k = ∂q_k and the pivots W_k of a family along its solution.

    P are the second-order partials of the N steps, with entries (..., N, *), p the momenta p_0 … p_{N−1}, and `tangent`
    the derivative of (q_0, p_0, s_0) by the parameter.

    If p_0 is the parameter, Y_0 = 0 and a caustic is a conjugate point. If q_0 is the parameter, with p_0 = dS(q_0),
    then Y_0 = 1 and a caustic is a point where W_k, the A + cα of the Riccati recursion, is singular.
    """
    n, point = p.shape[-1], not bool((tangent[..., : p.shape[-1], :] != 0).any())
    J, D = momentum_jacobian(P, p), step_derivative(P, p)
    A, kinetic = left_hessian(P, p), _negative_kinetic(J)
    regular = (scaled_margin(J, J, P.D11, P.D22) > 1e3 * torch.finfo(p.dtype).eps).all(-1)
    start = tangent[..., n : 2 * n, :]
    # A point source has S¹ = L_d.
    slope = P.D22[..., 0, :, :] if point else start
    Y, current, margins = [tangent[..., :n, :]], tangent, []
    crossed = first = torch.full_like(P.L[..., 0], -1, dtype=torch.long)
    for k in range(p.shape[-2]):
        current = D[..., k, :, :] @ current
        Y.append(current[..., :n, :])
        if k == 0 and point:
            continue
        bend = P.c[..., k, None, None] * slope
        W = A[..., k, :, :] + bend
        margins.append(scaled_margin(W, W, A[..., k, :, :], bend).nan_to_num(0.0))
        count = _negative(W)
        first = count if len(margins) == 1 else first
        # A singular J does not determine the kinetic term; the inertia of the first pivot stands in for it.
        passed = count != torch.where(regular, kinetic[..., k], first)
        crossed = torch.where(passed & (crossed < 0), k, crossed)
        slope = P.D22[..., k, :, :] - J[..., k, :, :].mT @ torch.linalg.solve_ex(W, J[..., k, :, :])[0]
    largest = torch.stack([torch.linalg.matrix_norm(y, ord="fro") for y in Y], -1).amax(-1)
    final = torch.nan_to_num(least_singular_value(Y[-1]) / largest, nan=0.0)
    carried = torch.linalg.solve_ex(current[..., :n, :].mT, current[..., n : 2 * n, :].mT)[0]
    slope = torch.where(regular[..., None, None], carried, slope)
    if margins:
        final = torch.where(regular, final, torch.stack(margins, -1).amin(-1))
    return Opening(final, crossed, 0.5 * (slope + slope.mT))


def _negative_kinetic(J: Tensor) -> Tensor:
    """Number of negative eigenvalues of the kinetic term m/h, found from −J = m/h.

    A strong magnetic field turns −J. Where the skew part of J exceeds its symmetric part, the latter says nothing about
    the mass, and a positive kinetic term is assumed: the number is 0.
    """
    symmetric, skew = 0.5 * (J + J.mT), 0.5 * (J - J.mT)
    turned = torch.linalg.matrix_norm(skew) > torch.linalg.matrix_norm(symmetric)
    return torch.where(turned, 0, _negative(-symmetric))


def _negative(W: Tensor) -> Tensor:
    """Number of negative eigenvalues of a symmetric matrix; −1 where W is not finite, as after a caustic at a node."""
    finite = torch.isfinite(W).all(-1).all(-1)
    W = torch.where(finite[..., None, None], 0.5 * (W + W.mT), 0.0)
    return torch.where(finite, (torch.linalg.eigvalsh(W) < 0).sum(-1), -1)


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
    return checked(stationary_curve(L_d, interior, [first, last], s, h_all, beyond=True), throw)


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


def stationary_curve(
    L_d: DiscreteLagrangian,
    guess: Tensor,  # (..., K, n)
    ends: list[Tensor],
    source: Tensor | Function,
    h: Tensor,
    beyond: bool,
) -> Curve:
    """The stationary curve through K unknown points.

    `ends` is [q_0, q_N] with `source` s_0, or [q_N] with `source` a function S: then p_0 = dS(q_0), s_0 = S(q_0), and
    S(q_0) + Σ L_d is stationary in q_0 too. Unless `beyond`, a curve that has crossed a caustic is SINGULAR.
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
