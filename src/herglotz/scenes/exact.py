"""The exact discrete Lagrangian of any contact system, to near round-off.

L_d(q0, q1, s0, h) = s(h) − s0 along the motion with q(0) = q0, q(h) = q1, s(0) = s0. The boundary-value problem is
solved by collocation: polynomials satisfy q̇ = v, ṗ = L_q + L_s p and ṡ = L at Gauss–Lobatto nodes. One Newton
iteration solves for all nodes of all samples, and one more linear equation gives the sensitivities of the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import Partials
from herglotz.mechanics.contact import jacobian, join, split
from herglotz.mechanics.newton import find_root
from herglotz.scenes.reference import Motion, lagrangian_motion
from herglotz.scenes.scene import StateFunction
from herglotz.scenes.special import as_step

Array = np.ndarray
# Most nodes of a motion; the next finer nodes, 2k − 1, estimate its error.
MAX_NODES = 65


@cache
def lobatto(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The nodes c_i (k,), the matrix a_ij = ∫_0^{c_i} l_j (k, k), and the values l_j on 2k − 1 nodes, (2k − 1, k).

    The `count` k is at least 3, both ends are nodes, and the last row of a is the quadrature; float64. The Legendre
    series of l_j is exact, and loses no digits with many nodes as powers of x would.
    """
    last = np.polynomial.legendre.Legendre.basis(count - 1)
    x = np.concatenate([[-1.0], np.sort(last.deriv().roots().real), [1.0]])
    x = 0.5 * (x - x[::-1])
    inner = x[1:-1]
    # The roots come from eigenvalues; three Newton steps give the last digits.
    for _ in range(3):
        inner = inner - last.deriv()(inner) / last.deriv(2)(inner)
    x[1:-1] = inner
    degrees = np.arange(count)
    P = np.polynomial.legendre.legvander(x, count)
    # Squared norms of P_k. That of the last P_k does not matter, because its integral is 0 at every node.
    norm = 2 / (2 * degrees + 1)
    weights = 2 / (count * (count - 1) * P[:, count - 1] ** 2)
    series = (P[:, :-1] * weights[:, None] / norm).T  # (degree, j) coefficients of l_j
    integral = np.empty((count, count))  # (i, degree) of P_k from −1 to x_i
    integral[:, 0] = x + 1
    integral[:, 1:] = (P[:, 2:] - P[:, :-2]) / (2 * degrees[1:] + 1)
    integral[0] = 0.0
    if count % 2 == 0 or count > MAX_NODES:
        finer = np.zeros((0, count))
    else:
        finer = _values(x, np.sqrt(weights), 2 * lobatto(2 * count - 1)[0].numpy() - 1)
    return torch.from_numpy((x + 1) / 2), torch.from_numpy(integral @ series / 2), torch.from_numpy(finer)


def _values(nodes: Array, size: Array, x: Array) -> Array:
    """l_j(x) by the barycentric formula, whose weights are ± the square roots `size` of the quadrature's weights."""
    distance = x[:, None] - nodes
    hit = np.abs(distance) < 1e-15
    terms = size * (-1.0) ** np.arange(len(nodes)) / np.where(hit, 1.0, distance)
    return np.where(hit.any(1, keepdims=True), hit, terms / terms.sum(1, keepdims=True))


# Newton converges quadratically: after a move below 1e-8 of the unknowns the next move is below rounding.
LAST_MOVE = 1e-8
# Nodes between two checks for a conjugate point.
NODES_PER_PIECE = 4


class End(NamedTuple):
    """A motion at both ends of the step, and the derivatives of the end in (q0, p0, s0)."""

    p0: Tensor  # (..., n)
    p1: Tensor  # (..., n)
    L: Tensor  # (...) s1 − s0
    c: Tensor  # (...) conformal factor
    D: Tensor  # (..., 2n+1, 2n+1) ∂(q1, p1, s1)/∂(q0, p0, s0)
    log_c: Tensor  # (..., 2n+1) its gradient
    opened: Tensor  # (...) bool: no conjugate point seen


@dataclass(frozen=True)
class Collocation:
    """The motion from q0 to q1 as polynomials through `count` = k nodes: x_i = (q_i, y_i, s_i), (B, k, 2n+1).

    With z = (q, p, s) and f = ż, the integrated equations are z_i = z_0 + h Σ_j a_ij f_j for i > 0. The equations of
    the first node are the boundary values of q_0, q_{k−1} and s_0.
    """

    motion: Motion
    count: int
    q0: Tensor  # (B, n)
    q1: Tensor  # (B, n)
    s0: Tensor  # (B,)
    h: Tensor  # (B,)

    def start(self) -> Tensor:
        """A uniform motion with its action, (B, k, 2n+1)."""
        c, a, _ = (x.to(self.q0) for x in lobatto(self.count))
        q = self.q0[:, None] + c[:, None] * (self.q1 - self.q0)[:, None]
        s = self.s0[:, None].expand(-1, self.count)
        y = self.motion.start(q, ((self.q1 - self.q0) / self.h[:, None])[:, None].expand_as(q), s)
        s = s + self.h[:, None] * (self.motion.balance(q, y, s)[3] @ a.mT)
        return join(q, y, s)

    def nodes(self, guess: Tensor | None, iterations: int) -> tuple[Tensor, Tensor]:
        """The motion (B, k, 2n+1), and whether Newton's method has converged, (B,)."""
        x = self.start() if guess is None else guess

        def equations(flat: Tensor) -> tuple[Tensor, Tensor]:
            F, _, J, *_ = self._equations(flat.unflatten(-1, x.shape[1:]))
            return F.flatten(1), J.flatten(1, 2).flatten(2)

        scale = (1.0 + x.abs().amax(1, keepdim=True)).expand_as(x)
        root = find_root(equations, x.flatten(1), scale.flatten(1), iterations=iterations, tol=LAST_MOVE)
        return (root.x + root.move).unflatten(-1, x.shape[1:]), root.converged

    def log_c(self, x: Tensor) -> Tensor:
        """The integral ln c = ∫ L_s dt, (B,)."""
        rate = self.motion.balance(*split(x))[4]
        return self.h * (rate @ lobatto(self.count)[1][-1].to(x))

    def _equations(self, x: Tensor) -> tuple[Tensor, ...]:
        """The equations F (B, k, 2n+1), z, ∂F/∂x (B, k, 2n+1, k, 2n+1), ∂z/∂x, L_s and ∂L_s/∂x."""
        n, k = self.q0.shape[-1], self.count
        a = lobatto(k)[1].to(x)
        difference = torch.eye(k, dtype=x.dtype, device=x.device)
        difference[:, 0] -= 1.0

        def rates(x: Tensor) -> Tensor:
            """p, q̇, ṗ, ṡ, L_s."""
            q_dot, p, p_dot, s_dot, rate = self.motion.balance(*split(x))
            return torch.cat([p, q_dot, p_dot, s_dot[..., None], rate[..., None]], -1)

        R, J = jacobian(rates, x)
        z = torch.cat([x[..., :n], R[..., :n], x[..., -1:]], -1)
        z_x = torch.eye(2 * n + 1, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], -1, -1).clone()
        z_x[..., n : 2 * n, :] = J[..., :n, :]
        f, f_x = R[..., n:-1], J[..., n:-1, :]
        F = z - z[:, :1] - self.h[:, None, None] * (a @ f)
        F_x = difference[:, None, :, None] * z_x.movedim(1, 2)[:, None]
        F_x = F_x - (self.h[:, None, None] * a)[:, :, None, :, None] * f_x.movedim(1, 2)[:, None]
        F[:, 0] = torch.cat([x[:, 0, :n] - self.q0, x[:, -1, :n] - self.q1, (x[:, 0, -1] - self.s0)[:, None]], -1)
        F_x[:, 0] = 0.0
        unit = torch.eye(n, dtype=x.dtype, device=x.device)
        F_x[:, 0, :n, 0, :n], F_x[:, 0, n : 2 * n, -1, :n], F_x[:, 0, -1, 0, -1] = unit, unit, 1.0
        return F, z, F_x, z_x, R[..., -1], J[..., -1, :]

    def end(self, x: Tensor) -> tuple[End, Tensor]:
        """The result of a motion, and the residual of the equations, (B,), relative to 1 + |z|."""
        n, k = self.q0.shape[-1], self.count
        weights = lobatto(k)[1][-1].to(x)
        F, z, F_x, z_x, rate, rate_x = self._equations(x)
        error = (F.abs() / (1.0 + z.abs())).flatten(1).amax(1)
        # The momentum p0 is given in place of q1.
        F_x[:, 0, n : 2 * n] = 0.0
        F_x[:, 0, n : 2 * n, 0] = z_x[:, 0, n : 2 * n]
        given = x.new_zeros(k * (2 * n + 1), 2 * n + 1)
        given[: 2 * n + 1] = torch.eye(2 * n + 1, dtype=x.dtype, device=x.device)
        x_0 = torch.linalg.solve_ex(F_x.flatten(1, 2).flatten(2), given.expand(len(x), -1, -1))[0]
        # ∂x_i/∂(q0, p0, s0)
        x_0 = x_0.unflatten(1, (k, 2 * n + 1))
        D = z_x @ x_0
        log_c = self.h * (rate @ weights)
        gradient = self.h[:, None] * torch.einsum("bkm,bkmr,k->br", rate_x, x_0, weights)
        opened = _regular(D[:, ::NODES_PER_PIECE], n)
        return End(
            z[:, 0, n:-1], z[:, -1, n:-1], z[:, -1, -1] - self.s0, log_c.exp(), D[:, -1], gradient, opened
        ), error


def _regular(D: Tensor, n: int) -> Tensor:
    """Whether there is no conjugate point, from the derivatives D_i of (q, p, s) at the ends of the pieces, (B,).

    Within a piece alone, Y = ∂q/∂p of the piece must have eigenvalues with positive real parts, as for t → 0. Where a
    piece with the derivative `own` is joined to the motion before, the action must be a minimum in the position q of
    the joint. Its second derivative there is W = c own⁻¹ now before⁻¹, with ∂q/∂p0 `before` and `now` at both ends of
    the piece, and W > 0 exactly where the symmetric beforeᵀ own⁻¹ now > 0. The eigenvalues of `now` do not decide:
    gyroscopic terms rotate `now`, and two eigenvalues may change sign together.
    """
    pieces = torch.linalg.solve_ex(D[:, :-1], D[:, 1:], left=False)[0]
    own, Y = pieces[..., :n, n : 2 * n], D[..., :n, n : 2 * n]
    W = Y[:, 1:-1].mT @ torch.linalg.solve_ex(own[:, 1:], Y[:, 2:])[0]
    finite = torch.isfinite(own).flatten(1).all(1) & torch.isfinite(W).flatten(1).all(1)
    # Matrices that are not finite become 0, which is not positive.
    own, W = (torch.where(finite[:, None, None, None], x, 0.0) for x in (own, W))
    opened = (torch.linalg.eigvals(own).real > 0).flatten(1).all(1)
    return opened & (torch.linalg.eigvalsh(0.5 * (W + W.mT)) > 0).flatten(1).all(1)


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
            reason, *ends = (x.reshape(shape + x.shape[1:]) for x in self._solved((q0, q1, s0, h), NODES))
            P = _second(End(*ends))
            nan = torch.where(reason == Reason.NONE, 0.0, torch.nan)
            P = P.map(lambda x: x + nan.reshape(shape + (1,) * (x.ndim - len(shape))))
        return Shot(P, reason)

    def _solved(
        self, given: tuple[Tensor, ...], counts: Sequence[int], guess: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """The reason and the `End` of samples `given` as (q0, q1, s0, h), by the first count of nodes that suffices."""
        count, *more = counts
        problem, finer = (Collocation(self.motion, k, *given) for k in (count, 2 * count - 1))
        x, converged = problem.nodes(guess, self.max_iterations)
        guess = lobatto(count)[2].to(x) @ x
        if not bool(converged.all()):
            guess = torch.where(converged[:, None, None], guess, finer.start())
        end, error = finer.end(guess)
        error = torch.maximum(error, (problem.log_c(x) - end.c.log()).abs())
        reason = torch.where(error <= self.tolerance, int(Reason.NONE), int(Reason.UNRESOLVED))
        reason = torch.where(end.opened, reason, int(Reason.CONJUGATE))
        reason = torch.where(converged, reason, int(Reason.NOT_CONVERGED)).to(torch.uint8)
        found, left = (reason, *end), ~(converged & (error <= self.tolerance))
        if more and 2 * count <= self.max_nodes and bool(left.any()):
            better = self._solved(tuple(x[left] for x in given), more, guess[left])
            for own, x in zip(found, better, strict=True):
                own[left] = x
        return found


def exact_discrete_lagrangian(system: Motion | StateFunction, **options: Any) -> NumericallyExact:
    """The exact discrete Lagrangian of a continuous L(q, v, s), or of a `Motion`; see `NumericallyExact`.

    `system` is any regular L(q, v, s), differentiated by autograd, or a `Motion` with the equations written out, which
    is several times faster; `options` are `tolerance`, `max_nodes` and `max_iterations` of `NumericallyExact`.
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
