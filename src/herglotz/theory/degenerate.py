"""The conclusions: degenerate discrete Lagrangians, whose step is a Legendrian relation and need not be a map.

    c p0 = −D1 L_d(q0, q1, s0),    p1 = D2 L_d(q0, q1, s0),    s1 = s0 + L_d        (parametrised by (q0, q1, s0))

is Legendrian in the contact product whatever the rank of M: η1 = c η0 holds on its tangent vectors. Where M is
singular, FL⁻ cannot be inverted: a step starts only from states on the primary constraint, and one step alone does not
determine q1. The condition that the *next* steps exist determines the rest of q1. `LegendrianStepper` solves for q1
together with the positions of `ahead` further steps, by Gauss–Newton with the pseudo-inverse.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import (
    DiscreteLagrangian,
    momentum_jacobian,
    momentum_minus,
    momentum_plus,
    momentum_residual,
    partials,
)
from herglotz.mechanics.contact import Triple, jacobian
from herglotz.mechanics.newton import SHORTEST, Point, Rules, largest, newton
from herglotz.stepping.rollout import OneStepMethod
from herglotz.stepping.state import State, Status, Step, check_h, check_state
from herglotz.theory.contact_manifolds import contact_product_point

# A singular value below eps ** RANK_POWER times the largest counts as zero.
RANK_POWER = 0.5
# Of Gauss–Newton; `Stepper` has the same limit.
MAX_ITERATIONS = 30
# x → the equations and the size of their terms, both (..., m).
System = Callable[[Tensor], tuple[Tensor, Tensor]]


def legendrian_relation(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> Triple:
    """The point of the relation over (q0, q1, s0), in Darboux coordinates of the contact product with τ = c.

    Source: section 6 of `docs/mathematics.md`, erratum E1 for the coordinates.
    """
    P = partials(L_d, q0, q1, s0, h)
    return contact_product_point((q0, momentum_minus(P), s0), (q1, momentum_plus(P), s0 + P.L), P.c)


class LegendrianStepper(OneStepMethod):
    """Steps along the Legendrian relation of a discrete Lagrangian whose M may be singular.

    Parameters
    ----------
    L_d
        Any discrete Lagrangian. With a regular M the steps are those of `Stepper`, only slower.
    ahead
        The number of further steps that must exist: 0 for a regular M, 1 for a singular M where the next step
        determines the rest of q1, more for a longer chain of constraints.

    Source: section 6 of `docs/mathematics.md`; the paper treats regular L_d only.
    """

    iterates = True

    def __init__(self, L_d: DiscreteLagrangian, *, ahead: int = 1):
        if ahead < 0:
            raise InputError(f"ahead must be >= 0, got {ahead}")
        self.L_d, self.ahead = L_d, ahead

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:
        """One step; `residual` is |c p0 + D1 L_d| of this step and those ahead, relative to the terms.

        The state must be on the primary constraint; `consistent` moves it there. Moves have least norm: directions of
        q1 that no equation determines stay at the guess, by default q. The status is SINGULAR where least squares ended
        with a residual that is not zero: no step starts from the state. The result carries no graph. Raise InputError
        if shapes or dtypes do not fit or h is not positive.
        """
        state = State(*(x.detach() for x in check_state(state)))
        h = check_h(h, state.q).detach()
        q0, _, s0 = state
        chain = self.ahead + 1
        start = torch.cat([q0 if guess is None else guess.detach()] * chain, -1)
        x, status, residual, iterations = self._least_squares(lambda x: self._chain(state, h, x), start)
        q1 = x[..., : q0.shape[-1]]
        P = partials(self.L_d, q0, q1, s0, h)
        forgets = (P.c == 0) & (status == Status.CONVERGED)
        status = torch.where(forgets, Status.SINGULAR, status).to(torch.uint8)
        new = State(*(x.detach() for x in (q1, momentum_plus(P), s0 + P.L)))
        return Step.of(new, P.c.detach(), status, residual, iterations)

    def consistent(self, state: State, h: Tensor | float) -> State:
        """The nearest state from which a step exists; only the directions of q in the kernel of M move.

        p, s and all other directions of q stay: an inner stage or a multiplier in q gets the value that belongs to p.
        NaN where no such state exists.
        """
        state = State(*(x.detach() for x in check_state(state)))
        h = check_h(h, state.q).detach()
        q0, p0, s0 = state
        n = q0.shape[-1]
        J = momentum_jacobian(partials(self.L_d, q0, q0, s0, h, order=2), p0)
        _, sizes, V = torch.linalg.svd(J)
        small = sizes <= torch.finfo(q0.dtype).eps ** RANK_POWER * sizes.amax(-1, keepdim=True)
        # The columns are a basis of ker J, and zeros.
        kernel = V.mT * small[..., None, :].to(V.dtype)

        def moved(y: Tensor) -> State:
            return State(q0 + (kernel @ y[..., :n, None])[..., 0], p0, s0)

        start = torch.cat([torch.zeros_like(q0), *[q0] * (self.ahead + 1)], -1)
        y, status, _, _ = self._least_squares(lambda y: self._chain(moved(y), h, y[..., n:]), start)
        nan = torch.where(status == Status.CONVERGED, torch.zeros_like(s0), torch.nan)
        return State(moved(y).q + nan[..., None], p0, s0)

    def _chain(self, state: State, h: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """c_j p_j + D1 L_d(q_j, q_{j+1}, s_j) of all steps for x = (q1, q2, …), and the size of the terms."""
        q, p, s = state
        equations, sizes = [], []
        for q1 in x.split(q.shape[-1], -1):
            P = partials(self.L_d, q, q1, s, h)
            F = momentum_residual(P, p)
            pull = (P.c[..., None] * p).abs()
            equations.append(F)
            sizes.append((pull + (F - P.c[..., None] * p).abs()).amax(-1, keepdim=True).expand_as(F))
            q, p, s = q1, momentum_plus(P), s + P.L
        return torch.cat(equations, -1), torch.cat(sizes, -1).detach()

    def _least_squares(self, system: System, start: Tensor) -> tuple[Tensor, Tensor, Tensor, int]:
        """Gauss–Newton from `start` with moves of least norm: x, status, relative residual, iterations."""
        eps = torch.finfo(start.dtype).eps

        def at(x: Tensor, second: bool = True) -> Point:  # noqa: ARG001  one signature for all
            terms: list[Tensor] = []

            def F(x: Tensor) -> Tensor:
                value, size = system(x)
                terms.append(torch.where(size > 0, size, 1.0))
                return value

            value, J = jacobian(F, x)
            J = torch.where(torch.isfinite(J).all(-1).all(-1)[..., None, None], J, 0.0).detach()
            return Point(value.detach(), torch.linalg.pinv(J, rtol=eps**RANK_POWER), terms[-1])

        def sizes(x: Tensor, _: Point, left: Tensor) -> tuple[Tensor, Tensor]:
            scale = torch.maximum(largest(x), torch.nan_to_num(left, nan=0.0, posinf=0.0))
            return scale, eps ** (2 / 3) * scale

        solver = lambda inverse, F: (inverse @ F[..., None])[..., 0]  # noqa: E731
        rules = Rules(4 * eps, MAX_ITERATIONS, natural=True, shortest=SHORTEST, solver=solver)
        found = newton(at, start, rules, sizes)
        point = at(found.x) if found.mixed else found.point
        residual = largest(point.F / point.rest)
        # 1.8e-12 in float64: steps leave at most 2e-13, a state off the constraint 1e-3 (`test_degenerate.py`).
        status = torch.where(residual <= eps**0.75, int(Status.CONVERGED), int(Status.SINGULAR))
        status = torch.where(torch.isfinite(residual), status, int(Status.DIVERGED))
        return found.x, status, residual, found.iterations
