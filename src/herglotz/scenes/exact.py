"""The exact discrete Lagrangian of any contact system, to near round-off.

L_d(q0, q1, s0, h) = s(h) − s0 along the motion with q(0) = q0, q(h) = q1, s(0) = s0. The boundary-value problem is
solved by shooting: Newton's method on the initial momentum, with the reference flow and its sensitivities.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import Partials
from herglotz.mechanics.newton import SHORTEST, Point, Rules, largest, newton
from herglotz.scenes.motion import Motion, lagrangian_motion, state_change
from herglotz.scenes.reference import integrate
from herglotz.scenes.scene import StateFunction
from herglotz.scenes.special import as_step
from herglotz.theory.continuous import jacobian
from herglotz.theory.jacobi import split

PIECES = 2  # of the step; conjugate points are looked for at the end of each, and between two
MISS = 1e-11  # of q1, relative to the positions, that Newton may leave: a Taylor step in q1 takes the rest


class Reason(IntEnum):
    """Why L_d is NaN at a sample."""

    NONE = 0
    NOT_CONVERGED = 1  # the shooting found no motion from q0 to q1
    CONJUGATE = 2  # a conjugate point inside the step: motions from q0 cross again, L_d has further branches
    UNRESOLVED = 3  # the reference flow did not reach its tolerance


@dataclass(frozen=True)
class Shot:
    """The motion that joins q0 to q1, and everything that L_d is asked for."""

    P: Partials  # order 2, NaN where `reason` is not NONE
    p0: Tensor  # (..., n)
    reason: Tensor  # (...) Reason values


@dataclass(frozen=True)
class _End:
    """The end of a motion and its derivatives in (q0, p0, s0)."""

    q: Tensor
    p: Tensor
    s: Tensor
    c: Tensor  # conformal factor
    p0: Tensor
    D: Tensor  # (..., 2n+1, 2n+1) ∂(q1, p1, s1)/∂(q0, p0, s0)
    log_c: Tensor  # (..., 2n+1) its gradient
    y: Tensor  # (..., n, n) ∂q1/∂y0, y the variable that is shot with
    error: Tensor
    opened: Tensor  # (...) bool: no conjugate point seen


@dataclass(frozen=True)
class NumericallyExact:
    """The exact L_d of a `Motion`, with its partial derivatives in closed form of the flow's sensitivities.

    With Y_p = ∂q1/∂p0, Y_s = ∂q1/∂s0, P_p = ∂p1/∂p0, P_s = ∂p1/∂s0 of the flow and c = exp ∫ L_s dt:

        D1 = −c p0,  D2 = p1,  D3 = c − 1,
        D22 = P_p Y_p⁻¹,  D23 = P_s − D22 Y_s,  D12 = −c Y_p⁻¹ − p0 ⊗ D23,
        D33 = ∂c/∂s0 − D23·Y_s,  D13 = c Y_p⁻¹ Y_s − p0 D33,  D11 = c Y_p⁻¹ Y_q − p0 ⊗ D13.

    Always computed in float64. NaN where there is no such motion or more than one branch; `shoot` says which. There is
    no conjugate point inside the step where its halves have none and the action is a minimum in the position between
    them; in a half it is looked for at the end alone, so a step of many periods is not safe. L_d can be differentiated
    twice and its first partials once; a further derivative raises, and so does one with respect to h.

    Source: section 1 of `docs/mathematics.md` (FL⁻, FL⁺ and Φ̃*η = cη along the flow).
    """

    motion: Motion
    tolerance: float = 1e-13
    max_substeps: int = 32
    max_iterations: int = 20

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        return self.partials(q0, q1, s0, h).L

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """Value, gradient and Hessian blocks."""
        h = as_step(h, q0)
        if h.requires_grad:
            raise InputError("the numerically exact L_d has no derivative with respect to h; detach h")
        P = self.shoot(q0, q1, s0, h).P.map(lambda x: x.to(q0.dtype))
        if torch.is_grad_enabled() and (q0.requires_grad or q1.requires_grad or s0.requires_grad):
            P = _attached(P, *(x - x.detach() for x in (q0, q1, s0)))
        return P if order == 2 else Partials(P.L, P.D1, P.D2, P.D3)

    def shoot(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float) -> Shot:
        """Solve the boundary-value problem of each sample."""
        shape = torch.broadcast_shapes(q0.shape[:-1], q1.shape[:-1], s0.shape, as_step(h, q0).shape)
        n = q0.shape[-1]
        with torch.no_grad():
            q0, q1 = q0.double().expand(*shape, n), q1.double().expand(*shape, n)
            s0, h = s0.double().expand(shape), as_step(h, q0).expand(shape)
            y = self.motion.start(0.5 * (q0 + q1), (q1 - q0) / h[..., None], s0)
            scale = 1.0 + torch.maximum(q0.abs().amax(-1), q1.abs().amax(-1))

            def shot(y: Tensor, second: bool = True) -> Point:  # noqa: ARG001  one signature for all
                end = self._end(q0, y, s0, h)
                return Point(end.q - q1, end.y, end)

            unit = torch.ones_like(s0)
            # A move of y moves q1 by about h times as much.
            rules = Rules(
                MISS, self.max_iterations, natural=True, shortest=SHORTEST, length=lambda y: largest(y) * h / scale
            )
            found = newton(shot, y, rules, lambda *_: (unit, MISS * unit))
            end: _End = (shot(found.x) if found.mixed else found.point).rest
            miss = q1 - end.q
            far = ~(miss.abs().amax(-1) <= MISS * scale)
            reason = torch.full(shape, Reason.NONE, dtype=torch.uint8, device=q0.device)
            reason = torch.where(end.error <= self.tolerance, reason, Reason.UNRESOLVED)
            reason = torch.where(end.opened, reason, Reason.CONJUGATE)
            reason = torch.where(far, Reason.NOT_CONVERGED, reason).to(torch.uint8)
            nan = torch.where(reason == Reason.NONE, 0.0, torch.nan)
            P = _moved(_second(end, s0), miss)
            P = P.map(lambda x: x + nan.reshape(shape + (1,) * (x.ndim - len(shape))))
        return Shot(P, -P.D1 / P.c[..., None], reason)

    def _end(self, q0: Tensor, y0: Tensor, s0: Tensor, h: Tensor) -> _End:
        """Integrate over the pieces of the step and join their derivatives by the chain rule."""
        n = q0.shape[-1]
        x, q = torch.cat([q0, y0, s0[..., None]], -1), slice(0, n)
        change = torch.linalg.inv_ex(state_change(self.motion, q0, y0, s0))[0]
        D = torch.eye(2 * n + 1, dtype=x.dtype, device=x.device)
        log_c, gradient = torch.zeros_like(s0), x.new_zeros(1, 2 * n + 1)
        error, opened = torch.zeros_like(s0), torch.ones_like(s0, dtype=torch.bool)
        Y_p, to_y = None, change
        for _ in range(PIECES):
            found, J, more = self._sensitivities(x, h / PIECES)
            own = (J[..., :-1, :] @ to_y)[..., q, n : 2 * n]  # ∂q/∂p of this piece alone
            x, log_c = found[..., :-1], log_c + found[..., -1]
            D, gradient = J[..., :-1, :] @ D, gradient + J[..., -1:, :] @ D
            error, before, Y_p = torch.maximum(error, more), Y_p, (D @ change)[..., q, n : 2 * n]
            opened = opened & _opened(own)
            if before is not None:
                opened = opened & _minimal(before, own, Y_p)
            to_y = torch.linalg.inv_ex(state_change(self.motion, *split(x)))[0]
        q1, y1, s1 = x[..., :n], x[..., n : 2 * n], x[..., 2 * n]
        return _End(
            q1,
            self.motion.momentum(q1, y1, s1),
            s1,
            log_c.exp(),
            self.motion.momentum(q0, y0, s0),
            state_change(self.motion, q1, y1, s1) @ D @ change,
            (gradient @ change)[..., 0, :],
            D[..., q, n : 2 * n],
            error,
            opened,
        )

    def _sensitivities(self, x: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(q, y, s, ln c) after h, their derivative in (q, y, s), and the integrator's error estimate.

        A copy of the batch for each component of the result, so that one backward pass gives all rows.
        """
        n, rows = (x.shape[-1] - 1) // 2, x.shape[-1] + 1
        errors: list[Tensor] = []

        def f(x: Tensor) -> Tensor:
            q_dot, y_dot, s_dot, rate = self.motion.field(x[..., :n], x[..., n : 2 * n], x[..., 2 * n])
            return torch.cat([q_dot, y_dot, s_dot[..., None], rate[..., None]], -1)

        def own_component(copies: Tensor) -> Tensor:  # (rows, ..., 2n+1) → (rows, ..., 1)
            start = torch.cat([copies, torch.zeros_like(copies[..., :1])], -1)
            end, error = integrate(f, start, h, self.tolerance, self.max_substeps)
            errors.append(error.detach().amax(0))
            return end.diagonal(dim1=0, dim2=-1).movedim(-1, 0)[..., None]

        value, J = jacobian(own_component, x.expand(rows, *x.shape))
        return value[..., 0].movedim(0, -1), J[..., 0, :].movedim(0, -2), errors[0]


def exact_discrete_lagrangian(system: Motion | StateFunction, **options: Any) -> NumericallyExact:
    """The exact discrete Lagrangian of a continuous L(q, v, s), or of a `Motion`; see `NumericallyExact`.

    Parameters
    ----------
    system
        L(q, v, s), any regular one, differentiated by autograd; or a `Motion` with its equations written out, which is
        several times faster.
    **options
        `tolerance`, `max_substeps` and `max_iterations` of `NumericallyExact`.
    """
    return NumericallyExact(system if isinstance(system, Motion) else lagrangian_motion(system), **options)


def _second(end: _End, s0: Tensor) -> Partials:
    """All partials of L_d at (q0, end.q, s0), by the formulas of `NumericallyExact`."""
    n = end.q.shape[-1]
    Y_q, Y_p, Y_s = end.D[..., :n, :n], end.D[..., :n, n : 2 * n], end.D[..., :n, 2 * n]
    P_p, P_s = end.D[..., n : 2 * n, n : 2 * n], end.D[..., n : 2 * n, 2 * n]
    inverse = torch.linalg.inv_ex(Y_p)[0]
    c, p0 = end.c, end.p0
    D22 = P_p @ inverse
    D23 = P_s - (D22 @ Y_s[..., None])[..., 0]
    D33 = c * end.log_c[..., 2 * n] - (D23 * Y_s).sum(-1)
    D13 = c[..., None] * (inverse @ Y_s[..., None])[..., 0] - p0 * D33[..., None]
    return Partials(
        end.s - s0,
        -c[..., None] * p0,
        end.p,
        c - 1.0,
        D11=c[..., None, None] * (inverse @ Y_q) - p0[..., :, None] * D13[..., None, :],
        D12=-c[..., None, None] * inverse - p0[..., :, None] * D23[..., None, :],
        D22=D22,
        D13=D13,
        D23=D23,
        D33=D33,
    )


def _opened(Y: Tensor) -> Tensor:
    """Whether all eigenvalues of Y = ∂q/∂p of one piece have a positive real part, as they have at t → 0."""
    finite = torch.isfinite(Y).all(-1).all(-1)
    return finite & (torch.linalg.eigvals(torch.where(finite[..., None, None], Y, 0.0)).real > 0).all(-1)


def _minimal(before: Tensor, own: Tensor, now: Tensor) -> Tensor:
    """Whether the action is a minimum in the position q where the piece `own` is joined to those before.

    Its second derivative there is W = c own⁻¹ now before⁻¹, with `before` and `now` = ∂q/∂p0 at the ends of the piece.
    W > 0 exactly where the symmetric beforeᵀ own⁻¹ now is. The eigenvalues of `now` would not do: gyroscopic terms turn
    it, and two of them may change sign together.
    """
    W = before.mT @ torch.linalg.solve_ex(own, now)[0]
    finite = torch.isfinite(W).all(-1).all(-1)
    W = torch.where(finite[..., None, None], 0.5 * (W + W.mT), 0.0)
    return finite & (torch.linalg.eigvalsh(W) > 0).all(-1)


def _moved(P: Partials, e: Tensor) -> Partials:
    """The partials at q1 + e for a tiny e, to first order (L to second)."""
    D2 = P.D2 + (P.D22 @ e[..., None])[..., 0]
    return Partials(
        P.L + 0.5 * ((P.D2 + D2) * e).sum(-1),
        P.D1 + (P.D12 @ e[..., None])[..., 0],
        D2,
        P.D3 + (P.D23 * e).sum(-1),
        P.D11,
        P.D12,
        P.D22,
        P.D13,
        P.D23,
        P.D33,
    )


class _Last(torch.autograd.Function):
    """The identity on x; a derivative of x in the arguments that would count is an error, not a silent zero."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, *arguments: Tensor) -> Tensor:  # noqa: ARG004
        return x.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:  # type: ignore[override]  # noqa: ARG004
        if bool((gradient.abs() > 0).any()):  # 0 where x only multiplies an increment whose value is 0
            raise InputError("third derivatives of the numerically exact L_d are not available")
        return None, None, None, None


def _attached(P: Partials, e0: Tensor, e1: Tensor, es: Tensor) -> Partials:
    """Give the partials their derivatives: Taylor polynomials in increments whose values are zero."""
    D11, D12, D22, D13, D23, D33 = (_Last.apply(x, e0, e1, es) for x in (P.D11, P.D12, P.D22, P.D13, P.D23, P.D33))

    def times(A: Tensor, e: Tensor) -> Tensor:
        return (A @ e[..., None])[..., 0]

    D1 = P.D1 + times(D11, e0) + times(D12, e1) + D13 * es[..., None]
    D2 = P.D2 + times(D12.mT, e0) + times(D22, e1) + D23 * es[..., None]
    D3 = P.D3 + (D13 * e0).sum(-1) + (D23 * e1).sum(-1) + D33 * es
    L = P.L + (0.5 * (P.D1 + D1) * e0).sum(-1) + (0.5 * (P.D2 + D2) * e1).sum(-1) + 0.5 * (P.D3 + D3) * es
    return Partials(L, D1, D2, D3, D11, D12, D22, D13, D23, D33)
