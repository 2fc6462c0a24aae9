"""One-step objectives: the distance of each recorded q_{k+1} from the position that the model predicts.

r_k = J⁻¹R_k with R_k the discrete Herglotz residual and J = ∂R_k/∂q_{k+1}, which is M where R = 0. To first order r_k
is the error of the predicted position. It is invariant under gauge transformations, and a smaller M does not make it
smaller. A smaller M does shrink the raw residual R_k, which is an objective only to show this (docs/verification.md).

Positions determine L_d up to a gauge. Recorded s and p remove the gauge, and with it the unknown s₀ that makes the full
level unreliable from positions alone (`SupervisedProblem`). Their unit remains unknown: the model's first mass is 1 and
the recorded mass is not, so that s and p are those of the model times one factor κ > 0, which is fitted as well.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import Triples, join
from herglotz.errors import InputError
from herglotz.least_squares import least_squares
from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian, OwnLagrangian
from herglotz.stepping import solve
from herglotz.training.distributed import LaneSums, add_over_processes, own_parts, world
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.least_squares import LeastSquares

# From this number of coordinates on, second derivatives of L_d by θ would cost more than all the rest.
MANY = 6
# Triples whose Jacobian is in memory at once: 4096 · 2 coordinates · 300 parameters are 20 MB.
CHUNK = 4096
# Multiple of the rounding of the largest s, below which a change of s is rounding.
ROUNDING = 16


class OneStep(LeastSquares, ABC):
    """Σ ρ(r/σ) + prior over the parameters and a few further unknowns, with r a function of three samples.

    A subclass defines `start`, `_rows` (the arguments of `_local` for some triples) and `_local` (the residuals of one
    triple or of a batch). `chunk` triples have their Jacobian in memory at once; `settings` go to `LeastSquares`.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        data: Trajectories,
        triples: Triples,
        *,
        sigma: float = 1.0,
        chunk: int = CHUNK,
        **settings: Any,
    ):
        super().__init__(model, data, sigma=sigma, **settings)
        self.triples, self.chunk = triples, chunk
        # Standard deviation of every r.
        self.deviation = triples.h0.new_full((len(triples), 1), sigma)  # (T, 1)

    @abstractmethod
    def start(self) -> Tensor:
        """All unknowns, the parameters first."""

    @abstractmethod
    def _rows(self, part: Tensor | slice, carried: Any) -> tuple[Tensor | None, ...]: ...

    @abstractmethod
    def _local(self, x: Tensor, *rows: Any) -> Tensor: ...

    def _carried(self, x: Tensor, *, derivative: bool) -> Any:  # noqa: ARG002
        """Values along whole trajectories that the triples need: none."""
        return None

    def _linearised(self, x: Tensor, part: Tensor, carried: Any) -> tuple[Tensor, Tensor]:
        """Residuals (T, k) of some triples and their Jacobian (T, k, unknowns)."""
        rows = self._rows(part, carried)
        axes = tuple(None if y is None else 0 for y in rows)
        J, r = vmap(jacrev(lambda *y: (r := self._local(*y), r), has_aux=True), (None, *axes))(x, *rows)
        return r, J

    @property
    def rows(self) -> int:
        """Number of triples."""
        return len(self.triples)

    def all_residuals(self, x: Tensor) -> Tensor:
        """The residual r of every triple, (T, k), in units of q."""
        with torch.no_grad():
            return self._local(x, *self._rows(slice(None), self._carried(x, derivative=False)))

    def residuals(self, x: Tensor) -> Tensor:
        """Errors of the recorded positions, (T, n), over the balance of the coordinates (raw metric: units of p)."""
        return self.all_residuals(x)[:, : self.n]

    def cost(self, x: Tensor) -> Tensor:
        """Σ ρ(r/σ) + prior."""
        return self.loss(self.all_residuals(x) / self.deviation) + self.prior_cost(x[: self.P])

    def cost_and_gradient(self, x: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(cost, ∂cost/∂x) without a Jacobian, for Adam; with `rows` scaled from these triples to all."""
        rank, processes = world()
        own = (torch.arange(self.rows) if rows is None else rows)[rank::processes].to(x.device)
        x = x.detach().requires_grad_()
        cost = self.loss(self._local(x, *self._rows(own, None)) / self.deviation[own])
        if rows is not None:
            cost = cost * (self.rows / len(rows))
        if rank == 0:
            cost = cost + self.prior_cost(x[: self.P])
        (gradient,) = torch.autograd.grad(cost, x)
        cost = cost.detach()
        add_over_processes(cost, gradient)
        return cost, gradient

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(cost, JᵀJ, Jᵀr), accumulated over chunks of triples."""
        sums = LaneSums(x.new_zeros(len(x), len(x)), x.new_zeros(len(x)), x.new_zeros(()))
        carried, deviation = self._carried(x, derivative=True), self.deviation
        for lane, part in own_parts(self.rows, self.chunk, x.device):
            r, J = self._linearised(x, part, carried)
            J = (J / deviation[part][..., None]).reshape(-1, len(x))
            r = (r / deviation[part]).reshape(-1)
            cost = self.loss(r)
            if self.freedom is not None:
                by = self.root_weights(r)
                J, r = by[:, None] * J, by * r
            sums.add(lane, J.T @ J, J.T @ r, cost)
        A, b, cost = sums.total()
        of_prior = self.prior_equations(x[: self.P])
        A[: self.P, : self.P] += of_prior[1]
        b[: self.P] += of_prior[2]
        return cost + of_prior[0], A, b

    def _inputs(self, rows: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Inputs of the two steps of the triples that start at these rows; None, None for a model without inputs."""
        return (None, None) if self.u is None else (self.u[rows], self.u[rows + 1])


class ResidualProblem(OneStep):
    """½ Σ |r_k|² / σ² + prior over parameters and, if s enters the motion, one latent s per trajectory.

    s is integrated along each trajectory from its latent start. `metric` is "position" for J⁻¹R or "raw" for R. Triples
    with a step longer than `max_step` (gaps) are left out. `expected` adds triples that were not recorded, with their
    standard deviation (`baseline_motion`); `residuals` leaves them out. If s does not enter the motion, `most` limits
    the recorded triples, evenly spread. The latent starts of s begin at those of `s` (N,), else at 0, with the prior
    N(there, its natural size²). `settings` are those of `OneStep`.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        data: Trajectories,
        *,
        metric: str = "position",
        max_step: float | None = None,
        expected: tuple[Triples, float] | None = None,
        most: int | None = None,
        s: Tensor | None = None,
        **settings: Any,
    ):
        self.metric, self.carries_s, triples = metric, model.s_enters_motion, data.triples(max_step)
        if most is not None and not self.carries_s:
            triples = triples.spread_out(most)
        super().__init__(model, data, triples if expected is None else join(triples, expected[0]), **settings)
        # The expected triples follow the recorded ones.
        self.recorded = len(triples)
        if expected is not None:
            self.deviation[self.recorded :] = expected[1]
        self.latents = len(data) if self.carries_s else 0
        first = data.t.new_zeros(len(data)) if s is None else s[torch.tensor(data.offsets, device=s.device)]
        self.first = first[: self.latents]
        # The natural size of s, the deviation of its starts as in `ShootingProblem`.
        self.action = sum(v * x for v, x in zip(model.config.speed, model.config.scale, strict=True))
        # An `OwnLagrangian` has its second derivatives from autograd.
        costly = data.dof >= MANY or isinstance(model, OwnLagrangian)
        self.many = costly and not self.carries_s and metric == "position"

    def start(self) -> Tensor:
        """The parameters, then the first s of every trajectory if it is latent."""
        theta = self.parameters.get()
        return torch.cat([theta, self.first.to(theta)])

    def cost(self, x: Tensor) -> Tensor:
        """See `OneStep`, with the prior of the latent starts of s."""
        return super().cost(x) + self._astray(x).square().sum() / 2

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `OneStep`, with the prior of the latent starts of s."""
        cost, A, b = super().normal_equations(x)
        astray = self._astray(x)
        A[self.P :, self.P :].diagonal().add_(1 / self.action**2)
        b[self.P :] += astray / self.action
        return cost + astray.square().sum() / 2, A, b

    def _astray(self, x: Tensor) -> Tensor:
        """The latent starts of s from where they began, over the natural size of s, (latents,)."""
        return (x[self.P :] - self.first) / self.action

    def residuals(self, x: Tensor) -> Tensor:
        """Residuals of the recorded triples, (T, n); see `OneStep`."""
        return self.all_residuals(x)[: self.recorded]

    def cost_and_gradient(self, x: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `OneStep`; if s enters the motion, by the normal equations, which include the recurrence of s."""
        if not self.carries_s:
            return super().cost_and_gradient(x, rows)
        # `FitConfig` refuses batches here.
        assert rows is None
        cost, _, gradient = self.normal_equations(x)
        return cost, gradient

    def _carried(self, x: Tensor, *, derivative: bool) -> tuple[Tensor, Tensor | None] | None:
        """The action s at every sample, (N,), and ds/dx, (N, unknowns)."""
        if not self.carries_s:
            return None
        theta, latent = x[: self.P], x[self.P :]
        with torch.no_grad():
            s = action(self.parameters, theta, self.data, latent)
        return s, action_derivative(self.parameters, theta, self.data, s) if derivative else None

    def _rows(self, part: Tensor | slice, carried: tuple[Tensor, Tensor | None] | None) -> tuple[Tensor | None, ...]:
        t = self.triples
        i = t.index[part]
        s0 = torch.zeros_like(t.h0[part]) if carried is None else carried[0][i]
        return t.q0[part], t.q1[part], t.q2[part], s0, t.h0[part], t.h1[part], *self._inputs(i)

    def _linearised(self, x: Tensor, part: Tensor, carried: Any) -> tuple[Tensor, Tensor]:
        theta, rows = x[: self.P], self._rows(part, carried)
        if self.many:
            return self._linearised_many(theta, *rows)
        r, J = super()._linearised(theta, part, carried)
        if carried is None:
            return r, J
        axes = tuple(None if y is None else 0 for y in rows)
        r_s = vmap(jacrev(self._local, 4), (None, *axes))(theta, *rows)
        J = torch.cat([J, torch.zeros_like(J[..., :1]).expand(*J.shape[:-1], self.latents)], -1)
        return r, J + r_s[..., None] * carried[1][self.triples.index[part]][:, None, :]

    def _local(self, x: Tensor, *rows: Any) -> Tensor:
        """J⁻¹R over the balance of the coordinates (or R) of one triple or of a batch."""
        q0, q1, q2, s0, h0, h1, u0, u1 = rows
        theta = x[: self.P] if self.carries_s else x
        before = self.parameters.partials(theta, q0, q1, s0, h0, 1, u0)
        after = self.parameters.partials(theta, q1, q2, s0 + before.L, h1, 2, u1)
        p = momentum_plus(before)
        R = momentum_residual(after, p)
        if self.metric == "raw":
            return R
        return solve(momentum_jacobian(after, p), R) / self.data.balance

    def _linearised_many(self, theta: Tensor, *rows: Any) -> tuple[Tensor, Tensor]:
        """J⁻¹R, (T, n), and its derivative without that of J, J⁻¹ ∂R/∂θ, (T, n, P); the omitted part is of order R."""
        q0, q1, q2, s0, h0, h1, u0, u1 = rows

        def residual(theta: Tensor, q0: Tensor, q1: Tensor, q2: Tensor, h0: Tensor, h1: Tensor, *u: Tensor) -> Tensor:
            before = self.parameters.partials(theta, q0, q1, torch.zeros_like(h0), h0, 1, *u[:1])
            after = self.parameters.partials(theta, q1, q2, torch.zeros_like(h1), h1, 1, *u[1:])
            return momentum_residual(after, momentum_plus(before))

        inputs = () if u0 is None or u1 is None else (u0, u1)
        slopes = vmap(jacrev(residual), (None, *(0,) * (5 + len(inputs))))(theta, q0, q1, q2, h0, h1, *inputs)
        with torch.no_grad():
            p = momentum_plus(self.parameters.partials(theta, q0, q1, s0, h0, 1, u0))
            after = self.parameters.partials(theta, q1, q2, s0, h1, 2, u1)
            J, R = momentum_jacobian(after, p), momentum_residual(after, p)
            slopes = torch.linalg.solve_ex(J, slopes)[0] / self.data.balance[:, None]
            return solve(J, R) / self.data.balance, slopes


class SupervisedProblem(OneStep):
    """Sum of ρ(r/σ) + prior over parameters and log κ, with for three samples in a row

        r_q = J⁻¹R at the recorded s,    r_s = (s₁ − s₀)/κ − L_d,    r_p = p₁/κ − D2 L_d − F⁺ (with momenta only),

    r_s and r_p brought to units of q by the natural sizes of s and p; r_p counts with `momenta` only. Settings are
    those of `ResidualProblem`. Raise InputError if s, or p with `momenta`, is not recorded.
    """  # noqa: D400  the formula is part of the sentence

    def __init__(
        self,
        model: ContactLagrangian,
        data: Trajectories,
        *,
        momenta: bool,
        max_step: float | None = None,
        **settings: Any,
    ):
        for name, wanted in (("s", True), ("p", momenta)):
            if wanted and getattr(data, name) is None:
                raise InputError(
                    f"{data.source or 'data'}: supervision by {name} needs {name} at every sample; "
                    "record it or set supervision='q'"
                )
        super().__init__(model, data, data.triples(max_step), **settings)
        self.momenta = momenta
        size = max(model.config.scale)
        self.of_s = size / sum(v * x for v, x in zip(model.config.speed, model.config.scale, strict=True))
        self.of_p = size / data.q.new_tensor(model.config.speed)

    def start(self) -> Tensor:
        """Parameters, then log κ, at first by least squares of s₁ − s₀ in κ L_d(s = 0) and h s₀."""
        theta, t, s = self.parameters.get(), self.triples, self.data.s
        assert s is not None
        before, (u0, _) = s[t.index], self._inputs(t.index)
        with torch.no_grad():
            L = self.parameters.partials(theta, t.q0, t.q1, torch.zeros_like(t.h0), t.h0, 1, u0).L
        columns = torch.stack([L, t.h0 * before], 1).cpu()
        kappa = float(least_squares(columns, (s[t.index + 1] - before)[:, None].cpu())[0])
        return torch.cat([theta, theta.new_tensor([kappa if kappa > 0 else 1.0]).log()])

    def _rows(self, part: Tensor | slice, carried: Any) -> tuple[Tensor | None, ...]:  # noqa: ARG002
        t, d = self.triples, self.data
        assert d.s is not None
        i = t.index[part]
        p1 = d.p[i + 1] if self.momenta and d.p is not None else None
        return t.q0[part], t.q1[part], t.q2[part], d.s[i], d.s[i + 1], p1, t.h0[part], t.h1[part], *self._inputs(i)

    def _local(self, x: Tensor, *rows: Any) -> Tensor:
        """All residuals of one triple or of a batch of them, in units of q."""
        q0, q1, q2, s0, s1, p1, h0, h1, u0, u1 = rows
        theta, per_unit = x[:-1], (-x[-1]).exp()
        before = self.parameters.partials(theta, q0, q1, s0 * per_unit, h0, 1, u0)
        after = self.parameters.partials(theta, q1, q2, s1 * per_unit, h1, 2, u1)
        p = momentum_plus(before)
        r_q = solve(momentum_jacobian(after, p), momentum_residual(after, p)) / self.data.balance
        r_s = ((s1 - s0) * per_unit - before.L) * self.of_s
        parts = [r_q, r_s[..., None]]
        if p1 is not None:
            parts.append((p1 * per_unit - p) * self.of_p)
        return torch.cat(parts, -1)


def action(
    parameters: ParameterVector,
    theta: Tensor,  # (P,)
    data: Trajectories,
    latent: Tensor,  # (B,)
) -> Tensor:
    """The action s at every sample, (N,), s_{k+1} = s_k + L_d(q_k, q_{k+1}, s_k) from `latent` in every trajectory.

    Newton's method on all steps at once: with s near s*, s_{k+1} = c_k s_k + L_d(s*_k) − (c_k − 1) s*_k. For L_d affine
    in s the first iteration gives s. Each iteration makes at least one further step exact.
    """
    q, h, s = data.q, data.t.diff(), torch.zeros_like(data.t)
    samples = list(_samples(data))
    for _ in samples:
        P = parameters.partials(theta, q[:-1], q[1:], s[:-1], h, 1)
        c, gained = P.c.detach(), (P.L - (P.c - 1) * s[:-1]).detach()
        near, s = s, torch.zeros_like(s)
        s[samples[0][0]] = latent[samples[0][1]]
        for now, _ in samples[1:]:
            s[now] = c[now - 1] * s[now - 1] + gained[now - 1]
        if not float((s - near).abs().max()) > ROUNDING * torch.finfo(s.dtype).eps * float(s.abs().max()):
            break
    return s


def action_derivative(
    parameters: ParameterVector,
    theta: Tensor,  # (P,)
    data: Trajectories,
    s: Tensor,  # (N,)
) -> Tensor:
    """Derivative ds/d(θ, latent) of `action` at every sample, (N, P + B), by ds_{k+1} = c_k ds_k + ∂L_d/∂θ."""
    q, h = data.q, data.t.diff()

    def increment(theta: Tensor, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        P = parameters.partials(theta, q0, q1, s0, h, 1)
        return P.L, P.c.detach()

    L_theta, c = vmap(jacrev(increment, has_aux=True), (None, 0, 0, 0, 0))(theta, q[:-1], q[1:], s[:-1], h)
    ds = s.new_zeros(len(s), len(theta) + len(data))
    for k, (now, live) in enumerate(_samples(data)):
        if k == 0:
            ds[now, len(theta) + live] = 1.0
        else:
            ds[now] = c[now - 1, None] * ds[now - 1]
            ds[now, : len(theta)] += L_theta[now - 1]
    return ds


def _samples(data: Trajectories) -> Iterator[tuple[Tensor, Tensor]]:
    """For k = 0, 1, …: rows of the k-th samples, and indices of the trajectories with more than k samples."""
    lengths = torch.tensor(data.lengths, device=data.t.device)
    offsets = lengths.cumsum(0) - lengths
    for k in range(int(lengths.max())):
        live = (lengths > k).nonzero()[:, 0]
        yield offsets[live] + k, live
