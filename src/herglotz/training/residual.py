"""The residual objective: how far each recorded q_{k+1} is from the position the model predicts.

r_k = J⁻¹R_k with R_k the discrete Herglotz residual and J = ∂R_k/∂q_{k+1}, which is M where R = 0. To first order r_k
is the error of the predicted position, it does not change under a gauge transformation, and it cannot be made small
by shrinking M. The raw residual R_k can, and does: it is offered only so that this can be seen (trap 2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import Triples, join
from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian
from herglotz.stepping import solve
from herglotz.training.distributed import LaneSums, add_over_processes, own_parts, world
from herglotz.training.flat import FlatModel
from herglotz.training.inputs import step_inputs
from herglotz.training.prior import Prior
from herglotz.training.robust import loss, root_weights

OBJECTIVES = ("position", "raw")
MANY = 6  # coordinates from which on second derivatives of L_d by θ would cost more than all the rest


class ResidualProblem:
    """½ Σ |r_k|² / σ² + prior over parameters and, where s enters the motion, one latent s per trajectory.

    Parameters
    ----------
    model
        Its current parameters are not changed.
    data
        Trajectories; s is integrated along each of them from its latent start.
    metric
        "position" for J⁻¹R, "raw" for R.
    max_step
        Leave out triples that span a longer step (gaps).
    sigma
        Scale of r: a standard deviation, in units of q.
    prior
        Penalty on the parameters.
    freedom
        Degrees of freedom ν of Student's t for r/σ (`robust`); None: least squares.
    expected
        Triples that were not recorded, and their standard deviation (`baseline_motion`). `residuals` leaves them out.
    most
        Use at most so many recorded triples, evenly spread; None: all. Where s enters the motion all are used.
    chunk
        Triples whose Jacobian is held in memory at once.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        data: Trajectories,
        *,
        metric: str = "position",
        max_step: float | None = None,
        sigma: float = 1.0,
        prior: Prior | None = None,
        freedom: float | None = None,
        expected: tuple[Triples, float] | None = None,
        most: int | None = None,
        chunk: int = 4096,
    ):
        self.flat = FlatModel(model)
        self.data, self.metric, self.sigma, self.prior, self.chunk = data, metric, sigma, prior, chunk
        self.freedom = freedom
        self.coupled = model.s_enters_motion
        self.triples: Triples = data.triples(max_step)
        if most is not None and not self.coupled:
            self.triples = self.triples.spread_out(most)
        self.expected, self.error = 0, sigma
        if expected is not None:
            self.triples, self.expected, self.error = join(self.triples, expected[0]), len(expected[0]), expected[1]
        self.u = step_inputs(model, data)  # (N, m)
        self.latents = len(data) if self.coupled else 0
        self.many = data.dof >= MANY and not self.coupled and metric == "position"

    @property
    def recorded(self) -> int:
        """How many of the triples are data; those that are only expected follow them."""
        return len(self.triples) - self.expected

    @property
    def scale(self) -> Tensor:
        """The standard deviation of every r, (T, 1)."""
        return torch.cat([self.triples.h0.new_full((k, 1), s) for k, s in
                          ((self.recorded, self.sigma), (self.expected, self.error))])  # fmt: skip

    def start(self) -> Tensor:
        """The flat unknowns: parameters, then the latents (zero)."""
        theta = self.flat.get()
        return torch.cat([theta, theta.new_zeros(self.latents)])

    def residuals(self, x: Tensor) -> Tensor:
        """r, shape (T, n), in units of q (or of p for the raw metric)."""
        return self._all(x)[: self.recorded]

    def _all(self, x: Tensor) -> Tensor:
        """The residuals, and then those of the triples that are only expected."""
        theta, latent = self._split(x)
        t = self.triples
        with torch.no_grad():
            s0 = self._action(theta, latent)[t.index]
            return self._local(theta, t.q0, t.q1, t.q2, s0, t.h0, t.h1, *self._inputs(t.index))

    def cost(self, x: Tensor) -> Tensor:
        """½ Σ |r|²/σ² + prior."""
        cost = loss(self._all(x) / self.scale, self.freedom)
        return cost if self.prior is None else cost + self.prior.cost(self._split(x)[0])

    @property
    def rows(self) -> int:
        """Number of triples."""
        return len(self.triples)

    def cost_and_gradient(self, x: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(cost, ∂cost/∂x) without a Jacobian, for Adam; of some triples where the motion has no s."""
        if self.coupled:  # through the recurrence for s: the normal equations already hold its derivative
            assert rows is None  # FitConfig checked
            cost, _, gradient = self.normal_equations(x)
            return cost, gradient
        t, (rank, processes) = self.triples, world()
        own = (torch.arange(len(t)) if rows is None else rows)[rank::processes].to(x.device)
        theta = x.detach().requires_grad_()
        inputs, zero = self._inputs(t.index[own]), torch.zeros_like(t.h0[own])
        r = self._local(theta, t.q0[own], t.q1[own], t.q2[own], zero, t.h0[own], t.h1[own], *inputs)
        cost = loss(r / self.scale[own], self.freedom)
        if rows is not None:
            cost = cost * (len(t) / len(rows))
        if self.prior is not None and rank == 0:
            cost = cost + self.prior.cost(theta)
        (gradient,) = torch.autograd.grad(cost, theta)
        cost = cost.detach()
        add_over_processes(cost, gradient)
        return cost, gradient

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(cost, JᵀJ, Jᵀr), accumulated over chunks of triples."""
        theta, latent = self._split(x)
        s = self._action(theta, latent)
        ds = self._action_derivative(theta, s) if self.coupled else None
        sums, scale = LaneSums(x.new_zeros(len(x), len(x)), x.new_zeros(len(x)), x.new_zeros(())), self.scale
        t, axes = self.triples, (0,) * 6 + ((None, None) if self.u is None else (0, 0))
        for lane, part in own_parts(len(t), self.chunk, x.device):
            arguments = (t.q0[part], t.q1[part], t.q2[part], s[t.index[part]], t.h0[part], t.h1[part])
            arguments += self._inputs(t.index[part])
            r = self._local(theta, *arguments)
            if self.many:
                J = self._many(theta, *arguments)
            else:
                J = vmap(jacrev(self._local), (None, *axes))(theta, *arguments)
            if ds is not None:
                r_s = vmap(jacrev(self._local, 4), (None, *axes))(theta, *arguments)
                J = torch.cat([J, torch.zeros_like(J[..., :1]).expand(*J.shape[:-1], self.latents)], -1)
                J = J + r_s[..., None] * ds[t.index[part]][:, None, :]
            J = (J / scale[part][..., None]).reshape(-1, len(x))
            r = (r / scale[part]).reshape(-1)
            cost = loss(r, self.freedom)
            if self.freedom is not None:
                by = root_weights(r, self.freedom)
                J, r = by[:, None] * J, by * r
            sums.add(lane, J.T @ J, J.T @ r, cost)
        A, b, cost = sums.total()
        if self.prior is not None:
            prior_cost, prior_A, prior_b = self.prior.normal_equations(theta)
            P = len(theta)
            A[:P, :P] += prior_A
            b[:P] += prior_b
            cost = cost + prior_cost
        return cost, A, b

    def pieces(self) -> Iterator[tuple[Tensor, Callable[[Tensor], Tensor]]]:
        """The triples of each of this process's chunks, and their r/σ as a function of the parameters.

        For models whose motion has no s.
        """
        t, scale = self.triples, self.scale
        zero = torch.zeros_like(t.h0)
        for _, part in own_parts(len(t), self.chunk, zero.device):
            rows = (t.q0[part], t.q1[part], t.q2[part], zero[part], t.h0[part], t.h1[part])
            rows += self._inputs(t.index[part])
            yield part, lambda theta, rows=rows, by=scale[part]: (self._local(theta, *rows) / by).reshape(-1)

    def _split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        P = len(x) - self.latents
        return x[:P], x[P:]

    def _inputs(self, rows: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Inputs of the two steps of the triples that start at these rows; None, None for a model without inputs."""
        return (None, None) if self.u is None else (self.u[rows], self.u[rows + 1])

    def _local(
        self,
        theta: Tensor,
        q0: Tensor,
        q1: Tensor,
        q2: Tensor,
        s0: Tensor,
        h0: Tensor,
        h1: Tensor,
        u0: Tensor | None,
        u1: Tensor | None,
    ) -> Tensor:
        """J⁻¹R (or R) of one triple or of a batch of them."""
        before = self.flat.partials(theta, q0, q1, s0, h0, 1, u0)
        after = self.flat.partials(theta, q1, q2, s0 + before.L, h1, 2, u1)
        p = momentum_plus(before)
        R = momentum_residual(after, p)
        if self.metric == "raw":
            return R
        return solve(momentum_jacobian(after, p), R)

    def _many(self, theta: Tensor, q0: Tensor, q1: Tensor, q2: Tensor, s0: Tensor, h0: Tensor, h1: Tensor,
              u0: Tensor | None, u1: Tensor | None) -> Tensor:  # fmt: skip
        """J⁻¹ ∂R/∂θ, (T, n, P): the derivative of J⁻¹R without that of J, which is of the size of R."""

        def residual(theta: Tensor, q0: Tensor, q1: Tensor, q2: Tensor, h0: Tensor, h1: Tensor, *u: Tensor) -> Tensor:
            before = self.flat.partials(theta, q0, q1, torch.zeros_like(h0), h0, 1, *u[:1])
            after = self.flat.partials(theta, q1, q2, torch.zeros_like(h1), h1, 1, *u[1:])
            return momentum_residual(after, momentum_plus(before))

        inputs = () if u0 is None or u1 is None else (u0, u1)
        R = vmap(jacrev(residual), (None, *(0,) * (5 + len(inputs))))(theta, q0, q1, q2, h0, h1, *inputs)
        with torch.no_grad():
            p = momentum_plus(self.flat.partials(theta, q0, q1, s0, h0, 1, u0))
            J = momentum_jacobian(self.flat.partials(theta, q1, q2, s0, h1, 2, u1), p)
        return torch.linalg.solve_ex(J, R)[0]

    def _action(self, theta: Tensor, latent: Tensor) -> Tensor:
        """S at every sample, (N,): integrated along the recorded positions; zero where it does not matter."""
        s = torch.zeros_like(self.data.t)
        if not self.coupled:
            return s
        h = self.data.t.diff()
        for k, (now, live) in enumerate(self._columns()):
            if k == 0:
                s[now] = latent[live]
            else:
                P = self.flat.partials(theta, self.data.q[now - 1], self.data.q[now], s[now - 1], h[now - 1], 1)
                s[now] = s[now - 1] + P.L.detach()
        return s

    def _action_derivative(self, theta: Tensor, s: Tensor) -> Tensor:
        """ds/dx at every sample, (N, P + B), by the recurrence ds_{k+1} = c_k ds_k + ∂L_d/∂θ."""
        q, h = self.data.q, self.data.t.diff()

        def increment(theta: Tensor, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
            P = self.flat.partials(theta, q0, q1, s0, h, 1)
            return P.L, P.c.detach()

        L_theta, c = vmap(jacrev(increment, has_aux=True), (None, 0, 0, 0, 0))(theta, q[:-1], q[1:], s[:-1], h)
        ds = s.new_zeros(len(s), len(theta) + self.latents)
        for k, (now, live) in enumerate(self._columns()):
            if k == 0:
                ds[now, len(theta) + live] = 1.0
            else:
                ds[now] = c[now - 1, None] * ds[now - 1]
                ds[now, : len(theta)] += L_theta[now - 1]
        return ds

    def _columns(self) -> list[tuple[Tensor, Tensor]]:
        """For k = 0, 1, …: sample numbers of the k-th samples, and which trajectories are that long."""
        lengths = torch.tensor(self.data.lengths, device=self.data.t.device)
        offsets = lengths.cumsum(0) - lengths
        columns = []
        for k in range(int(lengths.max())):
            live = (lengths > k).nonzero()[:, 0]
            columns.append((offsets[live] + k, live))
        return columns
