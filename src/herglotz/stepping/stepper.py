"""From a discrete Lagrangian to a time stepper on (q, p, s) or on (q_k, q_{k+1}, s_k)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import (
    DiscreteLagrangian,
    legendre_plus,
    momentum_jacobian,
    momentum_plus,
    momentum_residual,
    partials,
)
from herglotz.stepping.newton import Status, solve, solve_step


class StepError(RuntimeError):
    """A step failed and `throw=True`; the message names the sample, the step and the residual."""


class State(NamedTuple):
    """A point of T*Q × R."""

    q: Tensor  # (..., n) position
    p: Tensor  # (..., n) momentum
    s: Tensor  # (...) action variable


@dataclass(frozen=True)
class Step:
    """One step and how it went."""

    state: State
    c: Tensor  # (...) conformal factor of the step
    status: Tensor  # (...) Status values
    residual: Tensor  # (...) |J⁻¹F|: what is left of the step equation, in units of q
    iterations: int


@dataclass(frozen=True)
class Rollout:
    """A trajectory of K steps; entry 0 is the start. Everything after a failed step is NaN, with its status."""

    q: Tensor  # (..., K+1, n)
    p: Tensor  # (..., K+1, n)
    s: Tensor  # (..., K+1)
    sigma: Tensor  # (..., K+1) accumulated conformal factor σ_k = ∏ c_j
    status: Tensor  # (..., K)
    residual: Tensor  # (..., K)

    @classmethod
    def of(cls, states: list[State], steps: list[Step]) -> Rollout:
        """Join K+1 states and the K steps between them."""
        factors = torch.stack([torch.ones_like(states[0].s), *(step.c for step in steps)], -1)
        return cls(
            q=torch.stack([x.q for x in states], -2),
            p=torch.stack([x.p for x in states], -2),
            s=torch.stack([x.s for x in states], -1),
            sigma=factors.cumprod(-1),
            status=torch.stack([step.status for step in steps], -1),
            residual=torch.stack([step.residual for step in steps], -1),
        )

    @property
    def final(self) -> State:
        """The last state."""
        return State(self.q[..., -1, :], self.p[..., -1, :], self.s[..., -1])

    @property
    def ok(self) -> Tensor:
        """(...) whether every step converged."""
        return (self.status == Status.CONVERGED).all(-1)


class Stepper:
    """The flow Φ̃ = FL⁺ ∘ (FL⁻)⁻¹ of a discrete Lagrangian.

    Parameters
    ----------
    L_d
        Any discrete Lagrangian: a scene's, a learned model, or a callable `(q0, q1, s0, h)`.
    tol
        Newton tolerance relative to the size of the positions; default 64 machine epsilons.
    max_iterations
        Bound on Newton iterations (backtracking included).
    throw
        Raise `StepError` at the first sample that fails, instead of reporting its status.
    """

    def __init__(
        self, L_d: DiscreteLagrangian, *, tol: float | None = None, max_iterations: int = 30, throw: bool = False
    ):
        self.L_d = L_d
        self.tol = tol
        self.max_iterations = max_iterations
        self.throw = throw

    def init(self, q0: Tensor, q1: Tensor, s0: Tensor | None = None, h: Tensor | float = 1.0) -> State:
        """The state (q1, p1, s1) = FL⁺(q0, q1, s0) from two positions; s0 defaults to 0 (a choice of gauge)."""
        s0 = torch.zeros_like(q0[..., 0]) if s0 is None else s0
        return State(*legendre_plus(self.L_d, q0, q1, s0, h))

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:
        """One step: guess → solve → momentum → action.

        Differentiable with respect to the state and the parameters of L_d by the implicit-function theorem, whatever
        the number of Newton iterations was.

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...).
        h
            Time step > 0, scalar or (...).
        guess
            (..., n) start of the Newton iteration for q1; default q.

        Returns
        -------
        Step
            NaN in the samples whose status is not `Status.CONVERGED`.
        """
        q0, p0, s0, h = _checked(state, h)
        tol = self.tol if self.tol is not None else 64 * torch.finfo(q0.dtype).eps
        with torch.no_grad():
            solution = solve_step(self.L_d, q0, p0, s0, h, q0 if guess is None else guess, tol, self.max_iterations)
        q1, P = solution.q1, solution.P
        if torch.is_grad_enabled():
            q1 = self._attach(q0, p0, s0, h, q1)
            P = partials(self.L_d, q0, q1, s0, h)
        failed = solution.status != Status.CONVERGED
        if self.throw and bool(failed.any()):
            raise StepError(_failure_message(solution.status, solution.residual))
        nan = torch.where(failed, torch.nan, torch.zeros_like(s0))
        new = State(q1 + nan[..., None], momentum_plus(P) + nan[..., None], s0 + P.L + nan)
        return Step(new, P.c + nan, solution.status, solution.residual, solution.iterations)

    def step_pair(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h0: Tensor | float, h1: Tensor | float | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Φ: (q_k, q_{k+1}, s_k) → (q_{k+1}, q_{k+2}, s_{k+1}); h1 defaults to h0."""
        state = self.init(q0, q1, s0, h0)
        step = self.step(state, h0 if h1 is None else h1, 2 * q1 - q0)
        return q1, step.state.q, state.s

    def rollout(
        self, q: Tensor, p: Tensor, s: Tensor | None = None, *, h: Tensor | float, steps: int | None = None
    ) -> Rollout:
        """Step K times from (q, p, s).

        Parameters
        ----------
        q, p
            (..., n).
        s
            (...); default 0.
        h
            A scalar for equal steps, (K,) for steps shared by the batch, or (..., K).
        steps
            K; needed for a scalar h only.

        Returns
        -------
        Rollout
            K+1 states and K statuses.

        Raises
        ------
        InputError
            If h is not positive or its length and `steps` disagree.
        """
        s = torch.zeros_like(q[..., 0]) if s is None else s
        h_all = step_sizes(torch.as_tensor(h, dtype=q.dtype, device=q.device), steps)
        states, guess = [State(q, p, s)], q
        results: list[Step] = []
        for k in range(h_all.shape[-1]):
            try:
                out = self.step(states[-1], h_all[..., k], guess)
            except StepError as error:
                raise StepError(f"step {k}: {error}") from None
            results.append(out)
            states.append(out.state)
            guess = _extrapolate([x.q.detach() for x in states[-4:]], h_all[..., max(0, k - 2) : k + 2])
        return Rollout.of(states, results)

    def _attach(self, q0: Tensor, p0: Tensor, s0: Tensor, h: Tensor, q1: Tensor) -> Tensor:
        """Give the solved q1 its derivative: one Newton step, which is zero in value and dq1 = −J⁻¹ dF in slope."""
        with torch.no_grad():
            J = momentum_jacobian(partials(self.L_d, q0, q1, s0, h, order=2), p0)
        F = momentum_residual(partials(self.L_d, q0, q1, s0, h), p0)
        return q1 - solve(J, F - F.detach())


def _checked(state: State, h: Tensor | float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    q, p, s = state
    if not q.is_floating_point():
        raise InputError(f"q must be floating point, got {q.dtype}; convert it with .double()")
    if p.shape != q.shape or s.shape != q.shape[:-1]:
        raise InputError(f"q, p, s need shapes (..., n), (..., n), (...); got {[tuple(x.shape) for x in state]}")
    if p.dtype != q.dtype or s.dtype != q.dtype:
        raise InputError(f"q, p and s need one dtype, got {q.dtype}, {p.dtype}, {s.dtype}")
    h = torch.as_tensor(h, dtype=q.dtype, device=q.device)
    if not bool((h > 0).all()):
        raise InputError(f"h must be > 0, got {float(h.min()):g}")
    return q, p, s, h


def step_sizes(h: Tensor, steps: int | None) -> Tensor:
    """All K steps, (K,) or (..., K), from a scalar and a count or from a list.

    Raises
    ------
    InputError
        If a scalar comes without a count, or a list with another one.
    """
    if h.ndim == 0:
        if steps is None or steps < 1:
            raise InputError(f"a scalar h needs steps >= 1, got steps={steps}")
        return h.expand(steps)
    if steps is not None and steps != h.shape[-1]:
        raise InputError(f"h lists {h.shape[-1]} steps but steps={steps}; give one of the two")
    return h


def _extrapolate(q: list[Tensor], h: Tensor) -> Tensor:
    """Where the polynomial through the last (up to four) positions goes next; h holds the steps between and after."""
    if h.shape[-1] < len(q):  # no next step
        return q[-1]
    t = torch.cat([torch.zeros_like(h[..., :1]), h[..., -len(q) :].cumsum(-1)], -1)
    t = t - t[..., -2:-1]
    target, guess = t[..., -1], torch.zeros_like(q[-1])
    for i, q_i in enumerate(q):
        weight = torch.ones_like(target)
        for j in range(len(q)):
            if j != i:
                weight = weight * (target - t[..., j]) / (t[..., i] - t[..., j])
        guess = guess + weight[..., None] * q_i
    return guess


def _failure_message(status: Tensor, residual: Tensor) -> str:
    index = tuple(int(i) for i in (status != Status.CONVERGED).nonzero()[0])
    name = Status(int(status[index])).name
    return f"step failed at sample {index}: {name}, residual {float(residual[index]):.3g}; try a smaller h"
