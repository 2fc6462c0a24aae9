"""Losses for your own training loop: functions of tensors, differentiable by all parameters of L_d.

`herglotz_residual` compares three neighbouring positions and needs no state. `shooting` compares whole trajectories,
whose start states are unknowns beside the parameters. Noisy positions need `shooting`: noise biases the minimum of the
residual.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.errors import InputError, check_whole, refuse
from herglotz.mechanics import (
    DiscreteLagrangian,
    momentum_jacobian,
    momentum_plus,
    momentum_residual,
    partials,
)
from herglotz.mechanics.partials import in_vmap, value
from herglotz.stepping import Stepper, solve, state_of
from herglotz.stepping.single_step import driven_by
from herglotz.stepping.state import check_h
from herglotz.training.solvers.lifted_newton import SWEPT, attached, solve_path


def herglotz_residual(
    L_d: DiscreteLagrangian,
    q: Tensor,  # (..., K+1, n)
    h: Tensor | float,  # () or (..., K)
    *,
    s0: Tensor | None = None,  # (...)
    u: Tensor | None = None,  # (..., K, m)
    preconditioned: bool = True,
) -> Tensor:
    """J⁻¹R at every inner sample of recorded motions: the error of each next position, to first order.

    R_k = D1 L_d(q_k, q_{k+1}, s_k) + c_k D2 L_d(q_{k−1}, q_k, s_{k−1}), J = ∂R_k/∂q_{k+1}, which is the mixed Hessian M
    where R = 0, and s_{k+1} = s_k + L_d(q_k, q_{k+1}, s_k). Train on the mean of (J⁻¹R)². R alone is no loss: 0.1 L_d
    has a tenth of the residual and the same motion, so an optimiser shrinks L_d and learns nothing; J⁻¹R does not
    change. Minibatches are windows of at least three samples, stacked along the first axis.

    Parameters
    ----------
    L_d
        A module or function L_d(q0, q1, s0, h) → (...); with inputs it needs a method `at(u)`.
    q
        (..., K+1, n) positions, in their own units, K ≥ 2, of any float dtype and device.
    h
        () or (..., K) time steps between them, in the unit of time: `t.diff(dim=-1)`.
    s0
        (...) action at the first sample, in the unit of L_d; default 0. If L_d depends on s by more than −γs, train s0
        as a parameter.
    u
        (..., K, m) input of each step, in its own units.
    preconditioned
        False gives R, in units of momentum, to look at.

    Returns
    -------
    Tensor
        (..., K−1, n), in units of q.

    Raises
    ------
    InputError
        If shapes do not fit, a number is not finite, h is not positive, or J is singular: L_d does not couple q0 to q1.

    Source: discrete Herglotz equations; erratum E4 of `docs/mathematics.md`.
    """
    h, s0, u = _checked(q, h, s0, u)
    q0, q1 = q[..., :-1, :], q[..., 1:, :]
    s, axis = _action(L_d, q, h, s0, u), q.ndim - 2
    P = partials(driven_by(L_d, u), q0, q1, s, h, 2)
    p = momentum_plus(P).narrow(axis, 0, h.shape[-1] - 1)
    after = P.map(lambda x: x.narrow(axis, 1, h.shape[-1] - 1))
    R = momentum_residual(after, p)
    r = solve(momentum_jacobian(after, p), R) if preconditioned else R
    if not in_vmap(r) and len(bad := (~torch.isfinite(r)).nonzero()):
        *sample, k, _ = bad[0].tolist()
        raise InputError(
            f"J = ∂R/∂q1 is singular, or L_d not finite, at step {k + 1} of window {tuple(sample)}: a discrete "
            "Lagrangian must join q0 to q1, as m |q1 - q0|² / 2h does; add this term, or start from smaller weights"
        )
    return r


def _action(L_d: DiscreteLagrangian, q: Tensor, h: Tensor, s0: Tensor, u: Tensor | None) -> Tensor:
    """The action at the start of every step, (..., K); s0 throughout if no derivative of L_d depends on s."""
    q0, q1, L = q[..., :-1, :], q[..., 1:, :], driven_by(L_d, u)
    with torch.no_grad():
        first = s0[..., None].expand(h.shape).contiguous()
        P = partials(L, q0, q1, first, h)
        near = first + torch.nn.functional.pad(P.L.cumsum(-1)[..., :-1], (1, 0))
        other = partials(L, q0, q1, near, h)
        same = not in_vmap(P.L) and all(
            torch.equal(getattr(P, name), getattr(other, name)) for name in ("D1", "D2", "D3")
        )
    if same and not s0.requires_grad:
        return first
    found = [s0]
    for k in range(h.shape[-1] - 1):
        L = driven_by(L_d, None if u is None else u[..., k, :])
        found.append(found[-1] + value(L, q[..., k, :], q[..., k + 1, :], found[-1], h[..., k]))
    return torch.stack(found, -1)


class Starts(NamedTuple):
    """The first two positions of each of S segments and the action at the first: unknowns to train beside L_d.

    q0 are the positions at the samples 0, length, 2 length, …; q1 the positions one sample later.
    """

    q0: Tensor  # (..., S, n)
    q1: Tensor  # (..., S, n)
    s: Tensor  # (..., S)


class Shooting(NamedTuple):
    """Errors of segments of motion, in units of q.

    `misfit` is model minus recording at every sample; `joints` is the end of a segment minus the start of the next
    (two positions, and s rescaled).
    """

    misfit: Tensor  # (..., K+1, n)
    joints: Tensor  # (..., S−1, 2n+1)

    @property
    def loss(self) -> Tensor:
        """(Σ misfit² + Σ joints²) / (number of recorded values), ()."""
        return (self.misfit.square().sum() + self.joints.square().sum()) / self.misfit.numel()


def starts(
    q: Tensor,  # (..., K+1, n)
    length: int,
) -> Starts:
    """The starts of segments from the recorded positions, with s = 0, as leaf tensors that require gradients.

    Source: section 1 of `docs/mathematics.md`: two positions and s are a state.

    Parameters
    ----------
    q
        (..., K+1, n) positions, in their own units, K ≥ 2.
    length
        Steps of a segment; more than K − 1: one segment, the whole recording. The last segment takes the rest.

    Returns
    -------
    Starts
        For `shooting`, and `[*model.parameters(), *starts]` for an optimiser.

    Raises
    ------
    InputError
        If q has fewer than three samples, or length is not positive.
    """
    _checked(q, 1.0, None, None)
    check_whole(1, length=length)
    at = torch.arange(max((q.shape[-2] - 2) // length, 1), device=q.device) * length
    found = Starts(q[..., at, :], q[..., at + 1, :], q.new_zeros((*q.shape[:-2], len(at))))
    return Starts(*(x.detach().clone().requires_grad_() for x in found))


def shooting(
    L_d: DiscreteLagrangian,
    q: Tensor,  # (..., K+1, n)
    h: Tensor | float,  # () or (..., K)
    starts: Starts,
    *,
    u: Tensor | None = None,  # (..., K, m)
    length: int | None = None,
) -> Shooting:
    """Errors of segments of motions of L_d against a recording, and against the start of the next (multiple shooting).

    Each segment has its own start, two positions and an action, (q1, p1, s1) = FL⁺(q0, q1, s), and steps by
    D1 L_d + c p = 0. Train L_d and the starts together on `.loss`, with short segments first; a single segment is the
    whole trajectory, without joints. Newton's method solves all steps of all segments at once, from the recorded
    positions; the implicit function theorem gives the gradients.

    Parameters
    ----------
    L_d
        As in `herglotz_residual`.
    q
        (..., K+1, n) positions, K ≥ 2, in their own units.
    h
        () or (..., K) time steps between them, in the unit of time.
    starts
        S segments, from `starts(q, length)`.
    u
        (..., K, m) input of each step, in its own units.
    length
        Steps of a segment, as for `starts`; default: one segment.

    Returns
    -------
    Shooting
        `misfit` (..., K+1, n) and `joints` (..., S−1, 2n+1), in units of q.

    Raises
    ------
    InputError
        If shapes do not fit, or as `herglotz_residual`.
    StepError
        If a step has no solution. Use shorter segments, or first train on `herglotz_residual`.

    Source: multiple shooting (Bock 1984) on Φ̃ of section 1 of `docs/mathematics.md`.
    """
    h, _, u = _checked(q, h, None, u)
    refuse({f"starts must be those of herglotz.losses.starts(q, length), got a {type(starts).__name__}":
            not isinstance(starts, Starts)})  # fmt: skip
    K, (*batch, S, n) = h.shape[-1], starts.q0.shape
    length = min(K - 1 if length is None else length, K - 1)
    fitting = max((K - 1) // length, 1) == S and tuple(batch) == tuple(q.shape[:-2]) and n == q.shape[-1]
    refuse({f"starts of shape {tuple(starts.q0.shape)} are no segments of {length} steps of q {tuple(q.shape)}; "
            "make them by starts(q, length), with the same length": not fitting})  # fmt: skip
    in_first, whole = slice(0, (S - 1) * length + 1, length), slice(1, S * length + 1)
    start = Stepper(L_d).init(*starts, h=h[..., in_first], u=None if u is None else u[..., in_first, :])
    cut = lambda x, axis: x.unflatten(axis, (S, length))  # noqa: E731
    near = q[..., 1 : S * length + 2, :].unfold(-2, length + 1, length).mT
    x = _motions(L_d, start.joined, cut(h[..., whole], -1), None if u is None else cut(u[..., whole, :], -2), near)
    parts = [torch.cat([starts.q0[..., None, :], x[..., : length - 1, :n]], -2).flatten(-3, -2), x[..., -1, -2:, :n]]
    if tail := K - 1 - S * length:
        rest = None if u is None else u[..., -tail:, :]
        parts.append(_motions(L_d, x[..., -1, -1, :], h[..., -tail:], rest, q[..., -tail - 1 :, :])[..., 1:, :n])
    return Shooting(torch.cat(parts, -2) - q, _joints(x, starts))


def _motions(L_d: DiscreteLagrangian, start: Tensor, h: Tensor, u: Tensor | None, near: Tensor) -> Tensor:
    """The states (..., K+1, 2n+1) of motions from `start` (..., 2n+1), with their derivatives.

    All steps are solved at once, from the positions `near` (..., K+1, n); one by one if that does not converge.
    """
    K, d = h.shape[-1], start.shape[-1]
    first, steps = start.reshape(-1, d), h.reshape(-1, K)
    L = driven_by(L_d, None if u is None else u.reshape(-1, K, u.shape[-1]))
    with torch.no_grad():
        q = near.reshape(-1, K + 1, near.shape[-1])
        P = partials(L, q[:, :-1], q[:, 1:], first[:, -1:].expand(steps.shape), steps)
        along = torch.cat([q[:, 1:], momentum_plus(P), (first[:, -1:] + P.L.cumsum(-1))[..., None]], -1)
        guess = torch.cat([first[:, None], along], 1)
        path = solve_path(L, first.detach(), steps, guess, SWEPT * torch.finfo(q.dtype).eps)
    if path is None:
        return Stepper(L_d, throw=True).rollout(*state_of(start), h=h, inputs=u).states.joined
    return attached(L, path, first, steps).reshape(*h.shape[:-1], K + 1, d)


def _joints(x: Tensor, starts: Starts) -> Tensor:
    """End of each segment minus the start of the next; s is scaled by (spread of q) / (change of s along segments)."""
    q, s = x[..., : starts.q0.shape[-1]], x[..., -1]
    ends = q[..., :-1, :, :]
    positions = [ends[..., -2, :] - starts.q0[..., 1:, :], ends[..., -1, :] - starts.q1[..., 1:, :]]
    spread, change = (x.square().mean() for x in (q - q.mean(-2, True), s - s[..., :1]))
    # A root has no derivative at 0, where no segment changes s.
    by = (spread / torch.where(change > 0, change, 1.0)).sqrt()
    return torch.cat([*positions, ((s[..., :-1, -2] - starts.s[..., 1:]) * by)[..., None]], -1)


def _checked(q: Tensor, h: Tensor | float, s0: Tensor | None, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Check the arguments of a loss and expand them: h (..., K), s0 (...) and u (..., K, m)."""
    refuse({f"q must be a tensor (..., K+1, n), got a {type(q).__name__}; torch.as_tensor makes one":
            not isinstance(q, Tensor)})  # fmt: skip
    refuse({
        f"q needs shape (..., K+1, n) with at least 3 samples, got {tuple(q.shape)}; "
        "one coordinate is q[:, None]": q.ndim < 2 or q.shape[-2] < 3,
        f"q must hold float numbers, got {q.dtype}; convert it with .double()": not q.is_floating_point(),
    })  # fmt: skip
    if len(bad := (~torch.isfinite(q)).nonzero()):
        raise InputError(f"q is not finite at {tuple(bad[0].tolist())}; leave that window out")
    batch, K = q.shape[:-2], q.shape[-2] - 1
    h = check_h(h, q)
    refuse({f"s0 must be a tensor, got a {type(s0).__name__}": s0 is not None and not isinstance(s0, Tensor)})
    for name, x, shape in (("h", h, (*batch, K)), ("s0", s0, batch)):
        if x is not None and not _fits(x.shape, shape):
            raise InputError(f"{name} needs shape {shape} or one that spreads to it, got {tuple(x.shape)}")
    s0 = q.new_zeros(batch) if s0 is None else s0.expand(batch)
    if u is not None:
        wrong = not isinstance(u, Tensor) or u.ndim < 2 or not _fits(u.shape[:-1], (*batch, K))
        refuse({f"u needs shape {(*batch, K)} and its numbers last, got {tuple(getattr(u, 'shape', ()))}": wrong})
        u = u.expand(*batch, K, u.shape[-1])
    return h.expand(*batch, K), s0, u


def _fits(shape: torch.Size | tuple[int, ...], whole: tuple[int, ...]) -> bool:
    """True if a shape broadcasts to the shape `whole`."""
    short = len(shape) <= len(whole)
    return short and all(a in (1, b) for a, b in zip(reversed(shape), reversed(whole), strict=False))
