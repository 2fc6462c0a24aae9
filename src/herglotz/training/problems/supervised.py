"""The one-step objective where more than positions is recorded: s, or s and p.

Positions determine L_d up to a gauge. Recorded s and p remove the gauge, and with it the unknown s₀ that makes the full
level unreliable from positions alone. Their unit remains unknown: the model's first mass is 1 and the recorded mass is
not, so that s and p are those of the model times one factor κ > 0, which is fitted beside the parameters.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.least_squares import least_squares
from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian
from herglotz.stepping import solve
from herglotz.training.problems.one_step import OneStep


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
