"""From a discrete Lagrangian to a time stepper on (q, p, s) or on (q_k, q_{k+1}, s_k)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian, legendre_plus
from herglotz.models import capabilities
from herglotz.stepping.engine import Engine, driven_by
from herglotz.stepping.events import Event, Watch
from herglotz.stepping.explain import explain_step
from herglotz.stepping.linearise import Linearised, linearise
from herglotz.stepping.rollout import Advance, Plan, Walk, roll_out
from herglotz.stepping.state import (
    Crossings,
    Rollout,
    State,
    Step,
    StepError,
    check_h,
    check_state,
    step_sizes,
    throw_failure,
)

__all__ = ["Crossings", "Rollout", "State", "Step", "StepError", "Stepper", "step_sizes"]


class Stepper:
    """The flow Φ̃ = FL⁺ ∘ (FL⁻)⁻¹ of a discrete Lagrangian.

    Parameters
    ----------
    L_d
        Any discrete Lagrangian: a scene's, a learned model, or a callable `(q0, q1, s0, h)`.
    tol
        Newton tolerance relative to the size of the positions; default 4 machine epsilons.
    max_iterations
        Bound on Newton iterations (backtracking included).
    throw
        Raise `StepError` at the first sample that fails, instead of reporting its status.
    explicit
        Step in closed form where the terms of L_d allow it (`herglotz.stepping.explicit`); False always iterates.
    """

    def __init__(
        self,
        L_d: DiscreteLagrangian,
        *,
        tol: float | None = None,
        max_iterations: int = 30,
        throw: bool = False,
        explicit: bool = True,
    ):
        self.L_d = L_d
        self.tol = tol
        self.max_iterations = max_iterations
        self.throw = throw
        self.explicit = explicit

    def init(
        self,
        q0: Tensor,
        q1: Tensor,
        s0: Tensor | None = None,
        h: Tensor | float = 1.0,
        u: Tensor | None = None,
    ) -> State:
        """The state (q1, p1, s1) = FL⁺(q0, q1, s0) from two positions; s0 defaults to 0 (a choice of gauge).

        `u`, (..., m), is the input of the step from q0 to q1 where L_d takes inputs.
        """
        s0 = torch.zeros_like(q0[..., 0]) if s0 is None else s0
        return State(*legendre_plus(driven_by(self.L_d, u), q0, q1, s0, h))

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None, u: Tensor | None = None) -> Step:
        """One step: guess → solve → momentum → action.

        Differentiable with respect to the state, h, u and the parameters of L_d by the implicit-function theorem,
        whatever the number of Newton iterations was (once: second derivatives stop at the solve).

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...).
        h
            Time step > 0, scalar or (...).
        guess
            (..., n) start of the Newton iteration for q1; default q.
        u
            (m,) or (..., m) input of this step, for an L_d with `at(u)`: a motor's torque, or the time.

        Returns
        -------
        Step
            NaN in the samples whose status is not `Status.CONVERGED`.

        Raises
        ------
        InputError
            If shapes or dtypes do not fit, h is not positive, or L_d takes no inputs.
        """
        state = check_state(state, self.L_d)
        h = check_h(h, state.q)
        step, _ = self._engine()(state, h, state.q if guess is None else guess, u)
        if self.throw:
            self._throw(step, state, h, u)
        return step

    def linearise(self, state: State, h: Tensor | float, u: Tensor | None = None) -> Linearised:
        """One step with its derivatives d(q, p, s)′ / d(q, p, s), d/dh and d/du, by the implicit-function theorem.

        Parameters
        ----------
        state, h, u
            As in `step`.

        Returns
        -------
        Linearised
            `by_state` (..., 2n+1, 2n+1), `by_h` (..., 2n+1), `by_input` (..., 2n+1, m) or None, and the step itself.

        Raises
        ------
        InputError
            As `step`.
        """
        with torch.no_grad():
            step = self.step(state, h, u=u)
        return linearise(self.L_d, state, check_h(h, state.q), u, step)

    def step_pair(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h0: Tensor | float, h1: Tensor | float | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Φ: (q_k, q_{k+1}, s_k) → (q_{k+1}, q_{k+2}, s_{k+1}); h1 defaults to h0."""
        state = self.init(q0, q1, s0, h0)
        step = self.step(state, h0 if h1 is None else h1, 2 * q1 - q0)
        return q1, step.state.q, state.s

    def rollout(
        self,
        q: Tensor,
        p: Tensor,
        s: Tensor | None = None,
        *,
        h: Tensor | float,
        steps: int | None = None,
        inputs: Tensor | None = None,
        every: int = 1,
        events: Sequence[Event | Callable[[State], Tensor]] = (),
        checkpoint: int | None = None,
        chunk: int = 1024,
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
            K; needed for a scalar h without inputs only.
        inputs
            (K, m) or (..., K, m): u_k of each step, for an L_d with `at(u)`.
        every
            Keep each m-th state only; m divides K. Statuses and residuals are the worst of the m steps.
        events
            `Event`s, or functions of the state that stop a sample where they change sign. A sample that stopped keeps
            its state at the event, with `Status.STOPPED`. The time of an event is a constant for the gradient.
        checkpoint
            Length of the segments whose inner steps the backward pass computes again: with K steps, memory for about
            K / length + length of them instead of K. Without gradients it does nothing.
        chunk
            Steps gathered before they are written into the result.

        Returns
        -------
        Rollout
            K/m + 1 states and K/m statuses.

        Raises
        ------
        InputError
            If h is not positive, lengths disagree, L_d takes no inputs, or options do not fit together.
        """
        start = check_state(State(q, p, torch.zeros_like(q[..., 0]) if s is None else s), self.L_d)
        if inputs is not None:
            inputs = self._checked_inputs(inputs, q)
            steps = inputs.shape[-2] if steps is None and torch.as_tensor(h).ndim == 0 else steps
        h_all = step_sizes(check_h(h, q), steps)
        if inputs is not None and inputs.shape[-2] != h_all.shape[-1]:
            raise InputError(f"inputs list {inputs.shape[-2]} steps, but the rollout has {h_all.shape[-1]}")
        if events and checkpoint is not None:
            raise InputError("events and checkpoint exclude one another; leave one out")
        watch = Watch(events, start) if events else None
        plan = Plan(h_all.shape[-1], every, chunk, checkpoint)
        of_model = capabilities(self.L_d)
        iterates = not (self.explicit and of_model is not None and of_model.explicit)
        return roll_out(start, h_all, lambda: self._advance(h_all, inputs, watch), plan, watch, iterates)

    def _checked_inputs(self, inputs: Tensor, q: Tensor) -> Tensor:
        inputs = torch.as_tensor(inputs, dtype=q.dtype, device=q.device)
        if inputs.ndim < 2:
            raise InputError(f"inputs need the shape (K, m) or (..., K, m), got {tuple(inputs.shape)}")
        driven_by(self.L_d, inputs[..., 0, :])
        return inputs

    def _throw(self, step: Step, state: State, h: Tensor, u: Tensor | None) -> None:
        """Raise `StepError` if a sample failed, with the condition that it failed on."""
        try:
            throw_failure(step.status, step.residual)
        except StepError as error:
            lines = explain_step(driven_by(self.L_d, u), state, h, max_iterations=self.max_iterations)
            raise StepError("; ".join([str(error), *lines[:1]])) from None

    def _engine(self) -> Engine:
        return Engine(self.L_d, self.tol, self.max_iterations, self.explicit)

    def _advance(self, h: Tensor, inputs: Tensor | None, watch: Watch | None) -> Advance:
        """The function that takes step k of a rollout."""
        engine = self._engine()
        equal = h[..., 0] if h.stride(-1) == 0 else None  # one tensor, so that what depends on h alone is kept

        def take(k: int, walk: Walk, guess: Tensor) -> tuple[Step, State | None]:
            h_k = h[..., k] if equal is None else equal
            u = None if inputs is None else inputs[..., k, :]
            step, low = engine(walk.state, h_k, guess, u, walk.low)
            if watch is not None:
                by = lambda tau, guess: engine(walk.state, tau, guess, u, walk.low)[0]  # noqa: E731
                step = watch.after(k, walk.state, step, h_k, by)
            if self.throw:
                try:
                    self._throw(step, walk.state, h_k, u)
                except StepError as error:
                    raise StepError(f"step {k}: {error}") from None
            return step, low

        return take
