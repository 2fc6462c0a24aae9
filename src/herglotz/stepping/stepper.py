"""From a discrete Lagrangian to a time stepper on (q, p, s) or on (q_k, q_{k+1}, s_k)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from numbers import Real

import torch
from torch import Tensor

from herglotz.errors import check_whole, refuse
from herglotz.mechanics import DiscreteLagrangian, legendre_plus
from herglotz.mechanics.partials import check_function
from herglotz.models import capabilities
from herglotz.stepping.explain import explain_step
from herglotz.stepping.linearise import Linearised, linearise
from herglotz.stepping.rollout import OneStepMethod
from herglotz.stepping.single_step import SingleStep, driven_by
from herglotz.stepping.state import (
    State,
    Step,
    StepError,
    action_of,
    check_h,
    check_moving,
    check_rows,
    check_spreads,
    check_started,
    check_state,
    guess_of,
    spread_over,
    throw_failure,
)
from herglotz.stepping.velocity import legendre, momentum, velocity


class Stepper(OneStepMethod):
    """The flow Φ̃ = FL⁺ ∘ (FL⁻)⁻¹ of a discrete Lagrangian (section 1 of `docs/mathematics.md`).

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
        check_function(L_d)
        check_whole(1, max_iterations=max_iterations)
        refuse({f"tol must be a number > 0, got {tol!r}": tol is not None and not (isinstance(tol, Real) and tol > 0)})
        self.L_d = L_d
        self.tol = tol
        self.max_iterations = max_iterations
        self.throw = throw
        self.explicit = explicit
        made_of = capabilities(L_d)
        self.iterates = not (explicit and made_of is not None and made_of.explicit)

    def __repr__(self) -> str:
        of = getattr(self.L_d, "__name__", type(self.L_d).__name__)
        return f"Stepper({of}, {'' if self.tol is None else f'tol {self.tol:g}, '}{self.max_iterations} iterations)"

    def init(
        self, q0: Tensor, q1: Tensor, s0: Tensor | None = None, h: Tensor | float = 1.0, u: Tensor | None = None
    ) -> State:
        """The state (q1, p1, s1) = FL⁺(q0, q1, s0) from two positions: p1 = D2 L_d, s1 = s0 + L_d.

        Source: section 1 of `docs/mathematics.md`.

        Parameters
        ----------
        q0, q1
            (..., n) positions h apart, in the units of L_d, as all that follows.
        s0
            (...) action, in the unit of L_d; left out: 0 (a choice of gauge).
        h
            () or (...) step between them, in the unit of time.
        u
            (..., m) input of this step, in its own units, where L_d takes inputs.

        Returns
        -------
        State
            At q1.

        Raises
        ------
        InputError
            If shapes or dtypes do not fit, a number is not finite, h is not positive, or L_d takes no inputs.
        StepError
            If p1 or s1 of a sample is too large a number.
        """
        s0 = action_of(s0, q0=q0, q1=q1)
        start = check_state(State(q0, q1, s0), self.L_d, ("q0", "q1", "s0"), finite=True)
        h = check_h(h, q0)
        return check_started(State(*legendre_plus(driven_by(self.L_d, u), *spread_over(start, h), h)))

    def init_qv(self, q: Tensor, v: Tensor, s: Tensor | None = None, h: Tensor | float = 1.0) -> State:
        """The state (q, p, s) of a position and a velocity: p = L_v(q, v, s) of the model's L = lim L_d/h, h → 0.

        Source: section 9 of `docs/trajectory.md`; `herglotz.stepping.velocity` defines p for an L_d that is no model.

        Parameters
        ----------
        q, v
            (..., n) position and velocity, in the units of L_d and over the unit of time.
        s
            (...) action, in the unit of L_d; left out: 0 (a choice of gauge).
        h
            () or (...) step of the motion that starts here, in the unit of time. h matters where dry friction
            is set-valued, and where L_d is no model.

        Returns
        -------
        State
            With p as accurate as the steps: to order 4 for a model of order 4 without forces, else to order 2.

        Raises
        ------
        InputError
            If shapes or dtypes do not fit, a number is not finite, or h is not positive.
        StepError
            If p of a sample is too large a number.
        """
        start = check_state(State(q, v, action_of(s, q=q, v=v)), self.L_d, ("q", "v", "s"), finite=True)
        h = check_h(h, q)
        q, v, s = spread_over(start, h)
        return check_started(State(q, momentum(partial(legendre, self.L_d), q, v, s, h), s))

    def velocity(self, state: State, h: Tensor | float = 1.0) -> Tensor:
        """The velocity v (..., n) of states: L_v(q, v, s) = p solved for v, the inverse of `init_qv`.

        Source: section 9 of `docs/trajectory.md`. Differentiable once with respect to the state, by the
        implicit-function theorem.

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...).
        h
            () or (...) step of the motion that the states are of, in the unit of time; see `init_qv`.

        Returns
        -------
        Tensor
            (..., n), in units of q over the unit of time.

        Raises
        ------
        InputError
            If shapes or dtypes do not fit, a number is not finite, or h is not positive.
        StepError
            If no velocity of a sample has this p; the message names the sample.
        """
        state = check_state(state, self.L_d, finite=True)
        h = check_h(h, state.q)
        v, status = velocity(partial(legendre, self.L_d), spread_over(state, h), h)
        return check_moving(v, status)

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None, u: Tensor | None = None) -> Step:
        """Take a step: solve p = −D1 L_d / c for q1, then p1 = D2 L_d and s1 = s + L_d.

        Source: section 1 of `docs/mathematics.md`.
        Differentiable with respect to the state, h, u and the parameters of L_d by the implicit-function theorem,
        whatever the number of Newton iterations was (once: second derivatives stop at the solve).

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...).
        h
            Time step > 0, scalar or (...), in the unit of time.
        guess
            (..., n) start of the Newton iteration for q1, in the units of q; default q.
        u
            (m,) or (..., m) input of this step in its own units, for an L_d with `at(u)`: a motor's torque, or time.

        Returns
        -------
        Step
            In the units of the state; NaN in the samples whose status is not `Status.CONVERGED`.

        Raises
        ------
        InputError
            If shapes or dtypes do not fit, h is not positive, or L_d takes no inputs.
        """
        state = check_state(state, self.L_d)
        h = check_h(h, state.q)
        check_spreads(h, state.s)
        step, _ = self._single_step()(state, h, guess_of(guess, state.q), u)
        self._check_step(step, state, h, u)
        return step

    def linearise(
        self, state: State, h: Tensor | float, u: Tensor | None = None, parameters: Sequence[str] = ()
    ) -> Linearised:
        """Take a step with its derivative d(q, p, s)′ / d(q, p, s, h, u, θ), by the implicit-function theorem.

        All derivatives follow from ∂q1/∂p = −c M⁻¹ (erratum E4 of `docs/mathematics.md`).

        Parameters
        ----------
        state, h, u
            As in `step`, units too: q, p (..., n) and s (...); () or (...); (..., m).
        parameters
            Names of K numbers θ of the model, `friction.viscous[1]`, or `friction.viscous` for all that begin so.

        Returns
        -------
        Linearised
            `by_state` (..., 2n+1, 2n+1), `by_h` (..., 2n+1), `by_input` (..., 2n+1, m) or None, `by_parameters`
            (..., 2n+1, K), or None where none are named, and the step itself;
            the unit of ∂a/∂b is the unit of a over the unit of b.

        Raises
        ------
        InputError
            As `step`, and if L_d is no model that has these numbers.
        """
        with torch.no_grad():
            step = self.step(state, h, u=u)
        return linearise(self.L_d, state, check_h(h, state.q), u, step, parameters)

    def step_pair(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h0: Tensor | float, h1: Tensor | float | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Φ: (q_k, q_{k+1}, s_k) → (q_{k+1}, q_{k+2}, s_{k+1}), where R_{k+1} = 0 (section 1 of `docs/mathematics.md`).

        Parameters
        ----------
        q0, q1
            (..., n) positions h0 apart, in the units of L_d, as all that follows.
        s0
            (...) action at q0, in the unit of L_d.
        h0, h1
            () or (...) steps before and after q1, in the unit of time; h1 is h0 by default.

        Returns
        -------
        tuple of Tensor
            Shapes and units as q0, q1, s0; NaN where the step fails.

        Raises
        ------
        InputError
            As `init` and `step`.
        """
        state = self.init(q0, q1, s0, h0)
        step = self.step(state, h0 if h1 is None else h1, 2 * state.q - q0)
        return state.q, step.state.q, state.s

    def _checked(self, state: State) -> State:
        return check_state(state, self.L_d)

    def _checked_inputs(self, inputs: Tensor, like: Tensor) -> Tensor:
        check_rows(inputs)
        inputs = inputs.to(like)
        driven_by(self.L_d, inputs[..., 0, :])
        return inputs

    def _check_step(self, step: Step, state: State, h: Tensor, u: Tensor | None) -> None:
        """With `throw`, raise `StepError` if a sample failed, with the condition that does not hold."""
        if not self.throw:
            return
        try:
            throw_failure(step.status, step.residual)
        except StepError as error:
            lines = explain_step(driven_by(self.L_d, u), state, h, max_iterations=self.max_iterations)
            raise StepError("; ".join([str(error), *lines[:1]])) from None

    def _single_step(self) -> SingleStep:
        return SingleStep(self.L_d, self.tol, self.max_iterations, self.explicit)
