"""The residual objective where more than positions is recorded: s, or s and p.

Positions determine L_d up to a gauge; recorded s and p remove it, and with it the unknown s₀ that makes the full level
unreliable from positions alone. What is left is their unit: the model's first mass is 1, the recorded one is not, so
s and p are those of the model times one factor κ > 0 that is fitted beside the parameters.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian
from herglotz.stepping import solve
from herglotz.training.distributed import LaneSums, add_over_processes, own_parts, world
from herglotz.training.flat import FlatModel
from herglotz.training.inputs import step_inputs
from herglotz.training.prior import Prior
from herglotz.training.robust import loss, root_weights


class SupervisedProblem:
    """Sum of ρ(r/σ) + prior over parameters and log κ, with for three samples in a row

        r_q = J⁻¹R at the recorded s,    r_s = (s₁ − s₀)/κ − L_d,    r_p = p₁/κ − D2 L_d − F⁺ (with momenta only),

    r_s and r_p brought to units of q by the natural sizes of s and p.

    Parameters
    ----------
    model, data, max_step, sigma, prior, freedom, chunk
        As for `ResidualProblem`.
    momenta
        Use recorded momenta too.

    Raises
    ------
    InputError
        If s, or p where it is asked for, is not recorded.
    """  # noqa: D400  the formula is part of the sentence

    latents = 1

    def __init__(
        self,
        model: ContactLagrangian,
        data: Trajectories,
        *,
        momenta: bool,
        max_step: float | None = None,
        sigma: float = 1.0,
        prior: Prior | None = None,
        freedom: float | None = None,
        chunk: int = 4096,
    ):
        for name, wanted in (("s", True), ("p", momenta)):
            if wanted and getattr(data, name) is None:
                raise InputError(
                    f"{data.source or 'data'}: supervision by {name} needs {name} at every sample; "
                    "record it or set supervision='q'"
                )
        self.flat, self.data, self.sigma, self.prior = FlatModel(model), data, sigma, prior
        self.freedom, self.chunk, self.momenta = freedom, chunk, momenta
        self.triples, self.u = data.triples(max_step), step_inputs(model, data)
        size = max(model.config.scale)
        self.of_s = size / sum(v * x for v, x in zip(model.config.speed, model.config.scale, strict=True))
        self.of_p = size / data.q.new_tensor(model.config.speed)

    def start(self) -> Tensor:
        """The flat unknowns: parameters, then log κ, at first by least squares of s₁ − s₀ in κ L_d(s = 0) and h s₀."""
        theta, t, s = self.flat.get(), self.triples, self.data.s
        assert s is not None
        before = s[t.index]
        with torch.no_grad():
            L = self.flat.partials(theta, t.q0, t.q1, torch.zeros_like(t.h0), t.h0, 1, self._u(t.index)).L
        columns = torch.stack([L, t.h0 * before], 1).cpu()
        kappa = float(torch.linalg.lstsq(columns, (s[t.index + 1] - before)[:, None].cpu()).solution[0])
        return torch.cat([theta, theta.new_tensor([kappa if kappa > 0 else 1.0]).log()])

    def unit(self, x: Tensor) -> float:
        """κ: the recorded s and p over the model's."""
        return float(x[-1].exp())

    def residuals(self, x: Tensor) -> Tensor:
        """r_q, shape (T, n), in units of q."""
        with torch.no_grad():
            return self._local(x, *self._rows(slice(None)))[:, : self.data.dof]

    def cost(self, x: Tensor) -> Tensor:
        """Sum of ρ(r/σ) + prior."""
        with torch.no_grad():
            cost = loss(self._local(x, *self._rows(slice(None))) / self.sigma, self.freedom)
        return cost if self.prior is None else cost + self.prior.cost(x[:-1])

    @property
    def rows(self) -> int:
        """Number of triples."""
        return len(self.triples)

    def cost_and_gradient(self, x: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(cost, ∂cost/∂x) of all triples or of some, for Adam."""
        rank, processes = world()
        own = (torch.arange(self.rows) if rows is None else rows)[rank::processes].to(x.device)
        x = x.detach().requires_grad_()
        cost = loss(self._local(x, *self._rows(own)) / self.sigma, self.freedom)
        if rows is not None:
            cost = cost * (self.rows / len(rows))
        if self.prior is not None and rank == 0:
            cost = cost + self.prior.cost(x[:-1])
        (gradient,) = torch.autograd.grad(cost, x)
        cost = cost.detach()
        add_over_processes(cost, gradient)
        return cost, gradient

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(cost, JᵀJ, Jᵀr), accumulated over chunks of triples."""
        sums = LaneSums(x.new_zeros(len(x), len(x)), x.new_zeros(len(x)), x.new_zeros(()))
        for lane, part in own_parts(len(self.triples), self.chunk, x.device):
            rows = self._rows(part)
            axes = tuple(None if y is None else 0 for y in rows)
            r = self._local(x, *rows).reshape(-1) / self.sigma
            J = vmap(jacrev(self._local), (None, *axes))(x, *rows).reshape(-1, len(x)) / self.sigma
            cost = loss(r, self.freedom)
            by = root_weights(r, self.freedom)
            J, r = by[:, None] * J, by * r
            sums.add(lane, J.T @ J, J.T @ r, cost)
        A, b, cost = sums.total()
        if self.prior is not None:
            prior_cost, prior_A, prior_b = self.prior.normal_equations(x[:-1])
            A[:-1, :-1] += prior_A
            b[:-1] += prior_b
            cost = cost + prior_cost
        return cost, A, b

    def _u(self, rows: Tensor) -> Tensor | None:
        return None if self.u is None else self.u[rows]

    def _rows(self, part: Tensor | slice) -> tuple[Any, ...]:
        """What `_local` takes of these triples."""
        t, d = self.triples, self.data
        assert d.s is not None
        i = t.index[part]
        p1 = d.p[i + 1] if self.momenta and d.p is not None else None
        steps = t.h0[part], t.h1[part], self._u(i), self._u(i + 1)
        return t.q0[part], t.q1[part], t.q2[part], d.s[i], d.s[i + 1], p1, *steps

    def _local(
        self,
        x: Tensor,
        q0: Tensor,
        q1: Tensor,
        q2: Tensor,
        s0: Tensor,
        s1: Tensor,
        p1: Tensor | None,
        h0: Tensor,
        h1: Tensor,
        u0: Tensor | None,
        u1: Tensor | None,
    ) -> Tensor:
        """All residuals of one triple or of a batch of them, in units of q."""
        theta, per_unit = x[:-1], (-x[-1]).exp()
        before = self.flat.partials(theta, q0, q1, s0 * per_unit, h0, 1, u0)
        after = self.flat.partials(theta, q1, q2, s1 * per_unit, h1, 2, u1)
        p = momentum_plus(before)
        r_q = solve(momentum_jacobian(after, p), momentum_residual(after, p))
        r_s = ((s1 - s0) * per_unit - before.L) * self.of_s
        parts = [r_q, r_s[..., None]]
        if p1 is not None:
            parts.append((p1 * per_unit - p) * self.of_p)
        return torch.cat(parts, -1)
