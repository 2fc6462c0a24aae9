"""A motion between two positions by collocation: polynomials through Gauss–Lobatto nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from herglotz.mechanics.contact import join, split
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.scalar_fields import square_jacobian
from herglotz.scenes.motion import Motion

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

        R, J = square_jacobian(rates, x, 3 * n + 2)
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
