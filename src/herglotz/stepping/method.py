"""The interface of a stepper: `step` takes a single step, and the common driver of rollouts any number of steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.stepping.events import Event, Watch
from herglotz.stepping.rollout import Drive, OneStep, Plan, Track, roll_out
from herglotz.stepping.state import Rollout, State, Step, check_h, check_state, step_sizes, throw_failure


class OneStepMethod(ABC):
    """A stepper of states (q, p, s). A concrete stepper implements `step`; rollouts are the same for all steppers.

    With `throw` the first sample that fails raises `StepError`; `iterates` says whether steps want a guess.
    """

    throw: bool = False
    iterates: bool = False

    @abstractmethod
    def step(self, state: Any, h: Tensor | float, guess: Tensor | None = None) -> Step:
        """A step of h > 0, scalar or (...)."""

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
            m: keep every m-th state only; m divides K. Statuses and residuals are the worst of the m steps.
        events
            `Event`s, or functions of the state; a sample stops where a function changes sign. A stopped sample keeps
            its state at the event, with `Status.STOPPED`. The time of an event is a constant for the gradient.
        checkpoint
            Length of the segments whose inner steps the backward pass computes again: K steps then need memory for
            about K / length + length steps. Without gradients `checkpoint` has no effect.
        chunk
            Number of steps that are gathered before writing into the result.

        Returns
        -------
        Rollout
            K/m + 1 states and K/m statuses.

        Raises
        ------
        InputError
            If h is not positive, lengths disagree, the L_d takes no inputs, or options do not fit together.
        """
        start = self._checked(State(q, p, torch.zeros_like(q[..., 0]) if s is None else s))
        if inputs is not None:
            inputs = self._checked_inputs(torch.as_tensor(inputs), q)
            steps = inputs.shape[-2] if steps is None and torch.as_tensor(h).ndim == 0 else steps
        if events and checkpoint is not None:
            raise InputError("events and checkpoint exclude one another; leave one out")
        watch = Watch(events, start) if events else None
        track = self._roll_out(start, h, steps, inputs, watch, every=every, chunk=chunk, checkpoint=checkpoint)
        q, p, s = track.states
        return Rollout(q, p, s, track.sigma, track.status, track.residual, track.events, track.outside)

    def _roll_out(
        self,
        start: Any,
        h: Tensor | float,
        steps: int | None,
        inputs: Tensor | None = None,
        watch: Watch | None = None,
        **plan: Any,
    ) -> Track:
        """The rollout of a named tuple of tensors, the last of shape (...); exported files replace this loop."""
        h_all = step_sizes(check_h(h, start[-1]), steps)
        if inputs is not None and inputs.shape[-2] != h_all.shape[-1]:
            raise InputError(f"inputs list {inputs.shape[-2]} steps, but the rollout has {h_all.shape[-1]}")
        cut = Plan(h_all.shape[-1], **plan)
        return roll_out(start, Drive(self._single_step, h_all, cut, inputs, watch, self.iterates, self._check_step))

    def _checked(self, state: State) -> State:
        """The state, if this stepper can start from it."""
        return check_state(state)

    def _checked_inputs(self, inputs: Tensor, like: Tensor) -> Tensor:  # noqa: ARG002
        """The inputs (K, m) or (..., K, m) for positions `like`; raise InputError if the stepper takes no inputs."""
        raise InputError(f"{type(self).__name__} takes no inputs, got {tuple(inputs.shape)}; leave them out")

    def _single_step(self) -> OneStep:
        """The function that takes the steps of a rollout."""
        return lambda state, h, guess, u, low: (self.step(state, h, guess), None)  # noqa: ARG005  same signature for all

    def _check_step(self, step: Step, state: Any, h: Tensor, u: Tensor | None) -> None:  # noqa: ARG002
        """With `throw`, raise `StepError` if a sample failed."""
        if self.throw:
            throw_failure(step.status, step.residual)
