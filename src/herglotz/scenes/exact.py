"""The exact discrete Lagrangian of any contact system, to near round-off.

L_d(q0, q1, s0, h) = s(h) − s0 along the motion with q(0) = q0, q(h) = q1, s(0) = s0. The boundary-value problem is
solved by collocation: polynomials satisfy q̇ = v, ṗ = L_q + L_s p and ṡ = L at Gauss–Lobatto nodes. One Newton iteration
solves for all nodes of all samples, and one more linear equation gives the sensitivities of the motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import Partials
from herglotz.scenes.collocation import Collocation, End, lobatto
from herglotz.scenes.motion import Motion, lagrangian_motion
from herglotz.scenes.scene import StateFunction
from herglotz.scenes.special import as_step

# Numbers of nodes that are tried in turn until a step reaches the tolerance; 2k − 1 nodes judge k nodes.
NODES = (9, 17, 33, 65)


class Reason(IntEnum):
    """Why L_d is NaN at a sample.

    NOT_CONVERGED: no motion from q0 to q1 was found. CONJUGATE: a conjugate point lies inside the step, where motions
    from q0 cross again and L_d has further branches. UNRESOLVED: the largest number of nodes misses the tolerance.
    """

    NONE = 0
    NOT_CONVERGED = 1
    CONJUGATE = 2
    UNRESOLVED = 3


@dataclass(frozen=True)
class Shot:
    """The derivatives of L_d to order 2, NaN where `reason` is not NONE."""

    P: Partials
    reason: Tensor  # (...) values of `Reason`


@dataclass(frozen=True)
class NumericallyExact:
    """The exact L_d of a `Motion`, with partial derivatives by the flow's sensitivities.

    With Y_p = ∂q1/∂p0, Y_s = ∂q1/∂s0, P_p = ∂p1/∂p0, P_s = ∂p1/∂s0 of the flow and c = exp ∫ L_s dt:

        D1 = −c p0,  D2 = p1,  D3 = c − 1,
        D22 = P_p Y_p⁻¹,  D23 = P_s − D22 Y_s,  D12 = −c Y_p⁻¹ − p0 ⊗ D23,
        D33 = ∂c/∂s0 − D23·Y_s,  D13 = c Y_p⁻¹ Y_s − p0 D33,  D11 = c Y_p⁻¹ Y_q − p0 ⊗ D13.

    The computation is in float64. L_d is NaN without a motion or with several branches; `shoot` returns the reason.
    A step has no conjugate point if none of its pieces has a conjugate point and the action is a minimum in the
    positions between the pieces. L_d can be differentiated twice and the first partials once; a further derivative
    raises, and so does a derivative with respect to h.

    Parameters
    ----------
    motion
        The equations.
    tolerance
        Largest residual of the integrated equations between the nodes, relative to 1 + |component|.
    max_nodes
        Largest number of nodes of a step; a sample that needs more is `UNRESOLVED`.
    max_iterations
        Largest number of Newton iterations.

    Source: section 1 of `docs/mathematics.md` (FL⁻, FL⁺ and Φ̃*η = cη along the flow).
    """

    motion: Motion
    tolerance: float = 1e-13
    max_nodes: int = NODES[-1]
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
        """Solve the boundary-value problem of each sample, with more nodes where fewer do not resolve the motion."""
        shape = torch.broadcast_shapes(q0.shape[:-1], q1.shape[:-1], s0.shape, as_step(h, q0).shape)
        n = q0.shape[-1]
        with torch.no_grad():
            q0, q1 = (x.double().expand(*shape, n).reshape(-1, n) for x in (q0, q1))
            s0, h = (x.double().expand(shape).reshape(-1) for x in (s0, as_step(h, q0)))
            left, guess = torch.arange(len(s0), device=q0.device), None
            solved: list[tuple[Tensor, ...]] = []
            for count in NODES:
                problem = Collocation(self.motion, count, q0[left], q1[left], s0[left], h[left])
                x, converged = problem.nodes(guess, self.max_iterations)
                finer = Collocation(self.motion, 2 * count - 1, q0[left], q1[left], s0[left], h[left])
                guess = lobatto(count)[2].to(x) @ x
                if not bool(converged.all()):
                    guess = torch.where(converged[:, None, None], guess, finer.start())
                end, error = finer.end(guess)
                error = torch.maximum(error, (problem.log_c(x) - end.c.log()).abs())
                done = (converged & (error <= self.tolerance)) | (2 * count > self.max_nodes)
                reason = torch.where(error <= self.tolerance, int(Reason.NONE), int(Reason.UNRESOLVED))
                reason = torch.where(end.opened, reason, int(Reason.CONJUGATE))
                reason = torch.where(converged, reason, int(Reason.NOT_CONVERGED)).to(torch.uint8)
                solved.append((left[done], reason[done], *(x[done] for x in end)))
                left, guess = left[~done], guess[~done]
                if not len(left):
                    break
            rows, *found = (torch.cat(x) for x in zip(*solved, strict=True))
            reason, *ends = (x[rows.argsort()].reshape(shape + x.shape[1:]) for x in found)
            P = _second(End(*ends))
            nan = torch.where(reason == Reason.NONE, 0.0, torch.nan)
            P = P.map(lambda x: x + nan.reshape(shape + (1,) * (x.ndim - len(shape))))
        return Shot(P, reason)


def exact_discrete_lagrangian(system: Motion | StateFunction, **options: Any) -> NumericallyExact:
    """The exact discrete Lagrangian of a continuous L(q, v, s), or of a `Motion`; see `NumericallyExact`.

    Parameters
    ----------
    system
        Any regular L(q, v, s), differentiated by autograd; or a `Motion` with the equations written out, which is
        several times faster.
    **options
        `tolerance`, `max_nodes` and `max_iterations` of `NumericallyExact`.
    """
    return NumericallyExact(system if isinstance(system, Motion) else lagrangian_motion(system), **options)


def _second(end: End) -> Partials:
    """All partials of L_d, by the formulas of `NumericallyExact`."""
    n = end.p0.shape[-1]
    Y_q, Y_p, Y_s = end.D[..., :n, :n], end.D[..., :n, n : 2 * n], end.D[..., :n, 2 * n]
    P_p, P_s = end.D[..., n : 2 * n, n : 2 * n], end.D[..., n : 2 * n, 2 * n]
    inverse = torch.linalg.inv_ex(Y_p)[0]
    c, p0 = end.c, end.p0
    D22 = P_p @ inverse
    D23 = P_s - (D22 @ Y_s[..., None])[..., 0]
    D33 = c * end.log_c[..., 2 * n] - (D23 * Y_s).sum(-1)
    D13 = c[..., None] * (inverse @ Y_s[..., None])[..., 0] - p0 * D33[..., None]
    return Partials(
        end.L,
        -c[..., None] * p0,
        end.p1,
        c - 1.0,
        D11=c[..., None, None] * (inverse @ Y_q) - p0[..., :, None] * D13[..., None, :],
        D12=-c[..., None, None] * inverse - p0[..., :, None] * D23[..., None, :],
        D22=D22,
        D13=D13,
        D23=D23,
        D33=D33,
    )


class _Last(torch.autograd.Function):
    """The identity on x, whose derivative by the arguments is an error, not a silent zero.

    The gradient is 0, and no error, where x only multiplies an increment of value 0.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, *arguments: Tensor) -> Tensor:  # noqa: ARG004
        return x.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:  # type: ignore[override]  # noqa: ARG004
        if bool((gradient.abs() > 0).any()):
            raise InputError("third derivatives of the numerically exact L_d are not available")
        return None, None, None, None


def _attached(P: Partials, e0: Tensor, e1: Tensor, es: Tensor) -> Partials:
    """The partials with their derivatives, as Taylor polynomials in increments e whose values are zero."""
    D11, D12, D22, D13, D23, D33 = (_Last.apply(x, e0, e1, es) for x in (P.D11, P.D12, P.D22, P.D13, P.D23, P.D33))

    def times(A: Tensor, e: Tensor) -> Tensor:
        return (A @ e[..., None])[..., 0]

    D1 = P.D1 + times(D11, e0) + times(D12, e1) + D13 * es[..., None]
    D2 = P.D2 + times(D12.mT, e0) + times(D22, e1) + D23 * es[..., None]
    D3 = P.D3 + (D13 * e0).sum(-1) + (D23 * e1).sum(-1) + D33 * es
    L = P.L + (0.5 * (P.D1 + D1) * e0).sum(-1) + (0.5 * (P.D2 + D2) * e1).sum(-1) + 0.5 * (P.D3 + D3) * es
    return Partials(L, D1, D2, D3, D11, D12, D22, D13, D23, D33)
