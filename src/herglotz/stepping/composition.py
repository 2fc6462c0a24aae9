"""Compositions: a method over several fractions of a step, some of them negative, makes one of higher order.

Fractions that sum to 1 and whose (p+1)-th powers sum to 0 raise the order from p; a symmetric list of a method that is
its own adjoint skips the odd orders. Every stage is a contact map, so the composition is one, with c = ∏ c_i.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian
from herglotz.stepping.method import OneStepMethod
from herglotz.stepping.single_step import SingleStep
from herglotz.stepping.state import State, Status, Step, check_h, check_state


@runtime_checkable
class Substeps(Protocol):
    """A method that steps by itself, over a time of either sign."""

    def substep(self, state: State, h: Tensor) -> Step:
        """One step over h, which may be negative."""
        ...


Method = DiscreteLagrangian | Substeps
MAX_ITERATIONS = 30  # of a substep, as of `Stepper`
ADJOINT = 2 / 3  # power of eps that a step forth and back may miss: Newton's rounding leaves 1e-15 to 1e-13


class Composition(OneStepMethod):
    """A stepper that applies several methods one after the other, each over its fraction of the step.

    Parameters
    ----------
    stages
        Pairs (method, fraction) in the order of application. A method is a discrete Lagrangian, which is stepped as
        `Stepper` steps it, or has a `substep`, as `ContactSplitting` has. Fractions may be negative.
    self_adjoint
        Warn at the first step if the first method is not its own adjoint, Φ_{−h}∘Φ_h ≠ 1: the order counts on that.

    Raises
    ------
    InputError
        If the fractions do not sum to 1.
    """

    def __init__(self, stages: Sequence[tuple[Method, float]], *, self_adjoint: bool = False):
        total = sum(fraction for _, fraction in stages)
        if not abs(total - 1.0) < 1e-12:
            raise InputError(f"the fractions of a composition must sum to 1, got {total:.15g}")
        single_steps: dict[int, SingleStep] = {}
        for method, _ in stages:
            if not isinstance(method, Substeps):
                single_steps[id(method)] = SingleStep(method, None, MAX_ITERATIONS, False)
        self.stages, self._single_steps = tuple(stages), single_steps
        self._to_check = self_adjoint

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:  # noqa: ARG002  nothing to guess
        """One step of h > 0, scalar or (...): all stages. The status is that of the first stage that failed.

        Raises
        ------
        InputError
            If shapes or dtypes do not fit or h is not positive.
        """
        state = check_state(state)
        h = check_h(h, state.q)
        if self._to_check and not torch.compiler.is_compiling():
            self._to_check = False
            self._warn_unless_self_adjoint(state, h)
        return self.substep(state, h)

    def substep(self, state: State, h: Tensor) -> Step:
        """The same for h of either sign, unchecked, so that compositions can be composed."""
        c, iterations = torch.ones_like(state.s), 0
        residual = torch.zeros_like(state.s)
        status = torch.zeros_like(state.s, dtype=torch.uint8)
        for method, fraction in self.stages:
            part = self._part(method, state, fraction * h)
            state, c, iterations = part.state, c * part.c, iterations + part.iterations
            first = status == Status.CONVERGED
            residual = torch.where(first, torch.maximum(residual, part.residual), residual)
            status = torch.where(first, part.status, status)
        return Step(state, c, status, residual, iterations)

    def _warn_unless_self_adjoint(self, state: State, h: Tensor) -> None:
        """Step forth and back by the first method; the state must come back."""
        method = self.stages[0][0]
        with torch.no_grad():
            back = self._part(method, self._part(method, state, h).state, -h).state
            off = max(
                float(((a - b).abs() / (1 + b.abs())).nan_to_num(0.0).max()) for a, b in zip(back, state, strict=True)
            )
        if off > torch.finfo(state.q.dtype).eps ** ADJOINT:
            warnings.warn(
                f"the method under this composition is not its own adjoint: a step forth and back misses by {off:.1g}; "
                "its order falls short, compose adjoint_pair(method, adjoint) instead",
                stacklevel=3,
            )

    def _part(self, method: Method, state: State, h: Tensor) -> Step:
        if isinstance(method, Substeps):
            return method.substep(state, h)
        return self._single_steps[id(method)](state, h, state.q)[0]


def suzuki(method: Method, order: int = 4) -> Composition:
    """Order 4 with 5 stages or 6 with 25, from a method of order 2 that is its own adjoint.

    More stages than Yoshida's triple jump and a much smaller error constant: the fractions stay below 1 in size.

    Source: M. Suzuki, Phys. Lett. A 146 (1990) 319.
    """
    if order not in (4, 6):
        raise InputError(f"suzuki has order 4 or 6, got {order}")
    root = 4.0 ** (1 / (order - 1))
    part = 1 / (4 - root)
    base = method if order == 4 else suzuki(method, 4)
    middle = 1 - 4 * part
    return Composition([(base, part), (base, part), (base, middle), (base, part), (base, part)], self_adjoint=True)


def adjoint_pair(method: Method, adjoint: Method) -> Composition:
    """Half a step of a method, then half of its adjoint: its own adjoint, of even order; left and right give 2."""
    return Composition([(method, 0.5), (adjoint, 0.5)])
