"""Arguments and results of steppers: states, steps, rollouts and the checks of inputs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from herglotz.errors import InputError, check_whole, refuse
from herglotz.mechanics.contact import join, normal, split
from herglotz.mechanics.newton import Root
from herglotz.mechanics.partials import check_arguments, check_positions, check_tensors, in_vmap


class Status(IntEnum):
    """The end of the solve for a step."""

    CONVERGED = 0
    # No convergence within the allowed iterations.
    MAX_ITERATIONS = 1
    # det J = 0 or c = 0: the step is not defined there, erratum E4.
    SINGULAR = 2
    # An input, or a number of the state before or after the step, is not finite.
    DIVERGED = 3
    # No failure: a terminal event ended the trajectory in or before this step.
    STOPPED = 4
    # h is not positive and finite, in an exported file; a stepper raises an error instead.
    BAD_INPUT = 5
    # Solved, but h does not resolve the motion: set by `tune.flag_unresolved`, never by a stepper.
    UNRESOLVED = 6


class StepError(RuntimeError):
    """A step failed and `throw=True`; the message names the sample, the step and the residual."""


class State(NamedTuple):
    """A point (q, p, s) of T*Q × R, where the contact form is η = ds − p·dq (section 1 of `docs/mathematics.md`).

    Parameters
    ----------
    q
        (..., n) position, in the units of the data.
    p
        (..., n) momentum, in units of mass times q per time; learned models have mass 1 in the first coordinate.
    s
        (...) action variable, in units of p times q.
    """

    q: Tensor  # (..., n) position
    p: Tensor  # (..., n) momentum
    s: Tensor  # (...) action variable

    @property
    def joined(self) -> Tensor:
        """All numbers side by side, (..., 2n+1)."""
        return join(*self)

    @property
    def finite(self) -> Tensor:
        """(...) whether all numbers of a sample are finite."""
        return torch.isfinite(self.q).all(-1) & torch.isfinite(self.p).all(-1) & torch.isfinite(self.s)


def state_of(x: Tensor) -> State:
    """The point of numbers side by side, (..., 2n+1)."""
    return State(*split(x))


@dataclass(frozen=True)
class Step:
    """A step: the new state, its status and its residual."""

    # `State`, or `herglotz.theory.BodyState`.
    state: Any
    c: Tensor  # (...) conformal factor of the step
    status: Tensor  # (...) Status values
    residual: Tensor  # (...) |J⁻¹F| of the step equation, in units of q
    iterations: int
    outside: Tensor | None = None  # (...) of an exported file: 1 where the step leaves the box it was fitted in

    @classmethod
    def of(cls, new: Any, c: Tensor, status: Tensor, residual: Tensor, iterations: int) -> Step:
        """The step, NaN in the samples that failed."""
        failed = status != Status.CONVERGED
        if bool(failed.any()):
            nan = torch.where(failed, torch.nan, torch.zeros_like(c))
            add = lambda x: x + nan.reshape(nan.shape + (1,) * (x.ndim - nan.ndim))  # noqa: E731
            new, c = type(new)(*map(add, new)), c + nan
        return cls(new, c, status, residual, iterations)


@dataclass(frozen=True, repr=False)
class Crossings:
    """The crossings of an event, over all samples of a rollout, in the order of the steps."""

    sample: Tensor  # (M, batch dimensions) index of the sample
    step: Tensor  # (M,) the step k of each crossing
    t: Tensor  # (M,) time since the start
    state: State  # (M, n), (M, n), (M,)

    def __repr__(self) -> str:
        return f"Crossings({len(self.step)})"


@dataclass(frozen=True, repr=False)
class Rollout:
    """A trajectory of K steps; entry 0 is the start. All entries after a failed step are NaN, with its status.

    With `every=m` an entry stands for m steps, and status and residual are the worst of the m steps. `events` has the
    crossings of each event.
    """

    q: Tensor  # (..., K+1, n)
    p: Tensor  # (..., K+1, n)
    s: Tensor  # (..., K+1)
    sigma: Tensor  # (..., K+1) accumulated conformal factor σ_k = ∏ c_j
    status: Tensor  # (..., K)
    residual: Tensor  # (..., K)
    events: tuple[Crossings, ...] = ()
    outside: Tensor | None = None  # (..., K) of an exported file: 1 where a step leaves the box it was fitted in

    def __repr__(self) -> str:
        batch, failed = tuple(self.s.shape[:-1]), int((~self.ok).sum())
        of = f" of a batch {batch}, {failed} failed" if batch else ", failed" if failed else ""
        return f"Rollout({self.status.shape[-1]} steps, q {tuple(self.q.shape)}{of})"

    @property
    def states(self) -> State:
        """All states, the start first."""
        return State(self.q, self.p, self.s)

    @property
    def final(self) -> State:
        """The last state; for a sample that an event stopped, the state at the event."""
        return State(self.q[..., -1, :], self.p[..., -1, :], self.s[..., -1])

    @property
    def ok(self) -> Tensor:
        """(...) whether no step failed: each converged or came after a terminal event."""
        return ((self.status == Status.CONVERGED) | (self.status == Status.STOPPED)).all(-1)


def parts_of(state: Any) -> tuple[Tensor, Tensor, Tensor]:
    """q, p and s of a state; raise InputError for an object that is no three of them."""
    refuse({
        f"a state is State(q, p, s), got a {type(state).__name__}; init_qv(q, v, h=h) makes one, and a rollout has "
        "those of its .states, the last of which is .final":
            not isinstance(state, tuple | list) or len(state) != 3,
    })  # fmt: skip
    q, p, s = state
    return q, p, s


def action_of(s: Tensor | None, **positions: Tensor) -> Tensor:
    """s, by default 0 for every sample of the first of the `positions` (..., n), which are checked."""
    check_positions(**positions)
    return torch.zeros_like(next(iter(positions.values()))[..., 0]) if s is None else s


def spread_over(state: State, h: Tensor) -> State:
    """The state in the shape (...) that it has together with steps h; raise InputError if they do not spread."""
    check_spreads(h, state.s)
    batch = torch.broadcast_shapes(h.shape, state.s.shape)
    return State(state.q.expand(*batch, -1), state.p.expand(*batch, -1), state.s.expand(batch))


def guess_of(guess: Tensor | None, q: Tensor) -> Tensor | None:
    """The start of Newton's method for the positions q (..., n), in their dtype; raise InputError for other shapes."""
    if guess is None:
        return None
    check_tensors(guess=guess)
    refuse({f"guess needs the shape of q, {tuple(q.shape)}, got {tuple(guess.shape)}": guess.shape != q.shape})
    return guess.to(q)


def check_batch(states: tuple[Tensor, Tensor, Tensor]) -> State:
    """The states as a batch (B, n), (B, n), (B); raise InputError for other types or shapes."""
    q, p, s = parts_of(states)
    check_arguments(q, p, s, ("q", "p", "s"))
    if q.ndim != 2 or p.shape != q.shape or s.shape != q.shape[:1]:
        raise InputError(f"states need shapes (B, n), (B, n), (B,); got {[tuple(x.shape) for x in (q, p, s)]}")
    return State(q, p, s)


def check_state(
    state: State, L_d: Any = None, names: tuple[str, str, str] = ("q", "p", "s"), finite: bool = False
) -> State:
    """Return the state.

    A tensor of inference mode is copied, because autograd, by which an L_d without closed forms is stepped, refuses it.
    Raise InputError if shapes or dtypes do not fit one another and the parameters of L_d (of an exported file: `dof`
    and `dtype`); with `finite`, also if a number is not finite.
    """
    q, p, s = parts_of(state)
    check_arguments(q, p, s, names)
    if in_vmap(q) or in_vmap(p) or in_vmap(s):
        raise InputError(
            "torch.func.vmap does not go through steps, which iterate until they converge; leave it out: q, p, s and h "
            "take any leading dimensions"
        )
    # Linear solves of torch have no other dtypes.
    if q.dtype not in (torch.float32, torch.float64):
        raise InputError(
            f"{names[0]} must be floating point of 32 or 64 bits, got {q.dtype}; convert it with .double()"
        )
    if p.shape != q.shape or s.shape != q.shape[:-1]:
        shapes = [tuple(x.shape) for x in state]
        raise InputError(f"{', '.join(names)} need shapes (..., n), (..., n), (...); got {shapes}")
    if p.dtype != q.dtype or s.dtype != q.dtype:
        raise InputError(f"q, p and s need one dtype, got {q.dtype}, {p.dtype}, {s.dtype}")
    dtype = getattr(next(L_d.parameters(), None) if isinstance(L_d, torch.nn.Module) else L_d, "dtype", None)
    if dtype is not None and dtype != q.dtype:
        raise InputError(f"{names[0]} must be {dtype}, as the model is, got {q.dtype}; convert one with .to(dtype)")
    n = getattr(getattr(L_d, "config", L_d), "dof", None)
    if n is not None and q.shape[-1] != n:
        raise InputError(f"{names[0]} has {q.shape[-1]} coordinates, the model {n}; its shape must be (..., {n})")
    for name, x in zip(names, state, strict=True):
        if finite and not bool(torch.isfinite(x).all()):
            raise InputError(f"{name} must be finite, got {int((~torch.isfinite(x)).sum())} values that are not")
    return State(*map(normal, state))


def check_started(state: State) -> State:
    """Return a state that `init` made; raise StepError if any of its numbers is not finite."""
    good = torch.isfinite(state.p).all(-1) & torch.isfinite(state.s)
    if not bool(good.all()):
        sample = tuple(int(i) for i in (~good).nonzero()[0])
        raise StepError(f"init failed at sample {sample}: p1 or s1 is not finite; take positions closer together")
    return state


def check_moving(v: Tensor, status: Tensor) -> Tensor:
    """Return the velocities; raise StepError for the first sample without a velocity."""
    if bool((lost := status != Status.CONVERGED).any()):
        sample = tuple(int(i) for i in lost.nonzero()[0])
        raise StepError(
            f"no velocity at sample {sample}: {Status(int(status[sample])).name}; L_v(q, v, s) = p has no solution "
            "near v = 0, so p is beyond what this L_d reaches"
        )
    return v


def check_h(h: Tensor | float, like: Tensor) -> Tensor:
    """The time step as a tensor of the dtype and device of `like`.

    Raise InputError if h is no number or tensor, or is not positive and finite.
    """
    try:
        h = torch.as_tensor(h, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError):
        raise InputError(f"h must be a number or a tensor, in the unit of time, got {h!r}") from None
    if not h.numel():
        raise InputError("h holds no step; give at least one")
    if not bool(((h > 0) & (h < torch.inf)).all()):
        wrong = float(h[~((h > 0) & (h < torch.inf))].flatten()[0])
        raise InputError(f"h must be {'finite' if wrong > 0 else '> 0'}, got {wrong:g}")
    return h


def check_spreads(h: Tensor, s: Tensor) -> None:
    """Raise InputError if steps h (...) do not spread over the batch of a state with the action s (...)."""
    try:
        torch.broadcast_shapes(h.shape, s.shape)
    except RuntimeError:
        raise InputError(
            f"h of shape {tuple(h.shape)} does not spread over states of shape {tuple(s.shape)}; give one step for all "
            "or one for each"
        ) from None


def rows_of(inputs: Any) -> Tensor:
    """The inputs of a rollout as a tensor; raise InputError if they are no numbers."""
    try:
        return torch.as_tensor(inputs)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"inputs must be numbers of shape (K, m) or (..., K, m), got {inputs!r}") from None


def check_rows(inputs: Tensor) -> None:
    """Raise InputError if the inputs of a rollout are no rows: each step takes a row (m)."""
    if inputs.ndim < 2:
        raise InputError(f"inputs need the shape (K, m) or (..., K, m), got {tuple(inputs.shape)}")


def step_sizes(h: Tensor, steps: int | None) -> Tensor:
    """All K steps, (K,) or (..., K), from a scalar and a count or from a list.

    Raise InputError if a scalar comes without a count, or a list has another length than the count.
    """
    if steps is not None:
        check_whole(1, steps=steps)
    if h.ndim == 0:
        if steps is None:
            raise InputError("a scalar h needs steps >= 1, got steps=None")
        return h.expand(steps)
    if steps is not None and steps != h.shape[-1]:
        raise InputError(f"h lists {h.shape[-1]} steps but steps={steps}; give one of the two")
    return h


def status_of_root(
    root: Root,
    finite: Tensor,  # (...) whether the step has finite numbers
    singular: Tensor | None = None,  # (...) whether the step is undefined at the solution, beside a singular J
) -> Tensor:
    """The status of each sample from where its iteration ended, uint8."""
    singular = ~torch.isfinite(root.error) if singular is None else singular | ~torch.isfinite(root.error)
    status = torch.where(root.converged, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    status = torch.where(singular, int(Status.SINGULAR), status)
    return torch.where(finite, status, int(Status.DIVERGED)).to(torch.uint8)


def throw_failure(status: Tensor, residual: Tensor) -> None:
    """Raise `StepError` for the first failed sample, if any, with the reason and the remedy."""
    failed = (status != Status.CONVERGED) & (status != Status.STOPPED)
    if bool(failed.any()):
        index = tuple(int(i) for i in failed.nonzero()[0])
        what = f"{Status(int(status[index])).name}, residual {float(residual[index]):.3g}"
        raise StepError(f"step failed at sample {index}: {what}; try a smaller h")
