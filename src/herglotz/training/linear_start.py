"""Starting values of a dictionary of features: the coefficients of L_d from one linear problem.

L_d is linear in the coefficients x of its masses, features and friction, and so are the discrete Herglotz residual R
and its derivative J = ∂R/∂q2. Positions do not determine the scale of L_d (gauge), and a small L_d has a small R: so

    Σ |J_k⁻¹ R(x)|² / Σ |J_k⁻¹ J(x)|²

is minimised, J_k being the J of the round before. This is a generalised eigenproblem, whose smallest eigenvalue is 0 if
the features make the motion exactly. (If one coefficient were fixed instead, the others would cancel its term: trap 2.
A least-squares fit from a constant mass ends in other minima.) With noise the rounds do not converge: the coordinate
with the least error counts ever more, because its mass grows where others hardly act on it. From the best round on,

    Σ_i log Σ_k e_i²,    e = J(x)⁻¹R(x),

the log-likelihood with a size of the errors for each coordinate, is minimised by Levenberg–Marquardt. It is the same in
all units, and for all factors of an equation that shares no coefficient with another. Noise biases the result, as it
does every linear regression: the result starts a fit and does not end one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import vmap

from herglotz.data.windows import Triples
from herglotz.least_squares import least_squares
from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.jet import pairs
from herglotz.training.parameter_vector import ParameterVector

LINEAR = ("kinetic.sum.coefficient", "potential.stiffness", "potential.tilt", "potential.features.sum.coefficient",
          "friction.viscous", "coupling.viscous", "friction.coulomb", "friction.input_map",
          "drag.coefficient")  # fmt: skip
# Constant masses, of a coordinate and between two coordinates.
MASS, SHARED = "mass", "mass of two"
# Most steps of Levenberg–Marquardt, which ends at a smaller gain of log-likelihood.
MAX_STEPS, MIN_GAIN = 40, 1e-4
# Numbers of J that are formed together: 8 MB.
AT_ONCE = 1_000_000
# A coefficient beside which the fixed masses, of size 1, are lost in rounding; a power of two divides out exactly.
LARGE = 2.0**30
# Rounds of weights J_k: the unit matrix, then twice the J of the coefficients found.
ROUNDS = 3


@dataclass(frozen=True)
class LinearFit:
    """Residuals of a dictionary over a set of triples, and the coefficients that they determine."""

    R: Tensor  # (T, n, F) of each column of coefficient 1
    J: Tensor  # (T, n, n, F)
    names: tuple[str, ...]  # (F,) parameter that each column belongs to; `MASS` and `SHARED` come first

    @classmethod
    def of(
        cls, angles: Sequence[bool], features: Sequence[str], t: Triples, balance: Tensor, *,
        drag: tuple[str, ...] = (), dry: tuple[float, ...] = (), u: Tensor | None = None,
    ) -> LinearFit:  # fmt: skip
        """The columns of a model of order 2 with these features, viscous friction and no other damping but `drag`.

        With typical speeds `dry` (n,) there is dry friction at its starting widths, with u (T, m) inputs, held over
        both steps of a triple. Friction between coordinates is a column where one of them is an angle. Forces and
        positions are over the `balance` (n,) of the coordinates: the errors of all of them count alike.
        """
        n = len(angles)
        zero = (0.0,) * n
        model = ContactLagrangian(
            ModelConfig(angles=tuple(angles), level="forced", coupled=any(angles), features=tuple(features),
                        potential_width=0, stiffness=zero, tilt=zero, scale=(1.0,) * n, speed=dry or (1.0,) * n,
                        rate=0.0, drag=drag, coulomb=bool(dry), inputs=0 if u is None else u.shape[1])
        ).to(t.q0)  # fmt: skip
        parameters = ParameterVector(model)
        which = [name for name in LINEAR if name in parameters.names]
        columns = torch.cat([parameters.index(name) for name in which])
        zero = torch.zeros_like(t.h0)

        def both(theta: Tensor) -> tuple[Tensor, Tensor]:
            before = parameters.partials(theta, t.q0, t.q1, zero, t.h0, 2, u)
            after = parameters.partials(theta, t.q1, t.q2, zero, t.h1, 2, u)
            p = momentum_plus(before)
            return momentum_residual(after, p), momentum_jacobian(after, p)

        # R and J are linear in every coefficient: the difference to a large one is the derivative up to rounding.
        start = parameters.get()
        units = torch.eye(len(start), dtype=start.dtype, device=start.device)[columns]
        large = vmap(both, chunk_size=max(1, AT_ONCE // (n * n * len(t))))(start + LARGE * units)
        R, J = ((x - own).movedim(0, -1) / LARGE for x, own in zip(large, both(start), strict=True))
        i, j = pairs(n, t.q0.device)
        eye = torch.eye(n, dtype=t.q0.dtype, device=t.q0.device)
        unit = eye[:, i, None] * eye[:, j].T[None]  # (n, pairs, n), then symmetric
        unit = torch.where((i == j)[None, :, None], unit, unit + eye[:, j, None] * eye[:, i].T[None])
        kick = (t.q1 - t.q0) / t.h0[:, None] - (t.q2 - t.q1) / t.h1[:, None]
        R = torch.cat([torch.einsum("apb,tb->tap", unit, kick), R], -1)
        own = -unit.movedim(1, 2) / t.h1[:, None, None, None]
        J = torch.cat([own, J], -1)
        R, J = R * balance[:, None], J * (balance[:, None] * balance)[..., None]
        masses = [MASS if alone else SHARED for alone in (i == j).tolist()]
        return cls(R, J, (*masses, *(name for name in which for _ in parameters.index(name))))

    def rows(self, which: Tensor) -> LinearFit:
        """The same over some of the triples, (T,) bool."""
        return LinearFit(self.R[which], self.J[which], self.names)

    def solve(self, columns: Tensor) -> Tensor:
        """Coefficients (F,) of unit size, 0 outside `columns` (F,) bool; all are 0 where no round is finite."""
        own = LinearFit(self.R[..., columns], self.J[..., columns], ())
        x = min(own._eigenvectors(), key=own._misfit, default=own.R.new_zeros(own.R.shape[-1]))
        out = self.R.new_zeros(len(self.names))
        out[columns] = own._polished(x)
        return out

    def _eigenvectors(self) -> Iterator[Tensor]:
        """The coefficients of unit size after each round of the ratio at the head of this module, while finite."""
        R, J, n = self.R, self.J, self.R.shape[1]
        Jk = torch.eye(n, dtype=R.dtype, device=R.device).expand(len(R), n, n)
        for _ in range(ROUNDS):
            inverse = torch.linalg.pinv(Jk)
            top = (inverse @ R).flatten(0, 1)
            bottom = torch.einsum("tij,tjkf->tikf", inverse, J).flatten(0, 2)
            # In the unit of the motion; in other units rounding of the larger part would hide the smaller part.
            unit = float(top[:, 0].norm() / bottom[:, 0].norm())
            top = top / unit if 0 < unit < math.inf else top
            size = bottom.square().sum(0).add(top.square().sum(0)).sqrt()
            # Columns differ by powers of the unit of length.
            size = torch.where(size > 0, size, 1.0)
            # All of R and J in one thin factor: R = Q₁ U, J = Q₂ U with Q₁ᵀQ₁ + Q₂ᵀQ₂ = 1; x = U⁻¹ y, least |Q₁ y|.
            Q, U = torch.linalg.qr(torch.cat([top, bottom]) / size)
            if not bool(torch.isfinite(Q).all()):
                return
            y = torch.linalg.svd(Q[: len(top)], full_matrices=False).Vh[-1]
            x = least_squares(U, y[:, None])[:, 0] / size
            yield x
            Jk = J @ x

    def _misfit(self, x: Tensor) -> float:
        """Σ_i log of the mean square error of coordinate i; inf where the masses are no positive definite matrix."""
        M = -(self.J @ x) * x[0].sign()
        if int(torch.linalg.cholesky_ex((M + M.mT) / 2)[1].sum()):
            return math.inf
        return float(self.errors(x).square().mean(0).clamp_min(torch.finfo(x.dtype).tiny).log().sum())

    def _polished(self, x: Tensor) -> Tensor:
        """The minimum of `_misfit` from x with the first mass held; x where `_misfit` is infinite there."""
        best, damping, tiny = self._misfit(x), 1e-3, torch.finfo(x.dtype).tiny
        for _ in range(MAX_STEPS if best < math.inf else 0):
            e = self.errors(x)
            size = e.square().mean(0).sqrt().clamp_min(tiny)
            D = torch.linalg.solve(self.J @ x, self.R - torch.einsum("tijf,tj->tif", self.J, e))[..., 1:]
            D, e = (D / size[:, None]).flatten(0, 1), (e / size).flatten()
            A = D.T @ D
            scale = torch.where(A.diagonal() > 0, A.diagonal(), 1.0).sqrt()
            A = A / scale[:, None] / scale + damping * torch.eye(len(A)).to(A)
            other = x.clone()
            other[1:] -= torch.linalg.solve_ex(A, D.T @ e / scale)[0] / scale
            gain = best - (misfit := self._misfit(other))
            # A step that is no number has no gain.
            if not gain > 0:
                damping *= 5
                continue
            x, best, damping = other, misfit, damping / 5
            if gain < MIN_GAIN:
                break
        return x

    def errors(self, x: Tensor) -> Tensor:
        """J⁻¹R of every triple at x, (T, n), over the balance of the coordinates; inf where J is singular."""
        r, info = torch.linalg.solve_ex(self.J @ x, self.R @ x)
        return torch.where((info != 0)[:, None], torch.inf, r).nan_to_num(nan=torch.inf)

    def start(self, x: Tensor) -> dict[str, Tensor] | None:
        """Starting values by the name of the parameter, the first mass being 1; None where no mass matrix fits."""
        n = self.R.shape[1]
        i, j = pairs(n, x.device)
        mass = x.new_zeros(n, n)
        mass[i, j] = mass[j, i] = x[: len(i)]
        if float(mass[0, 0]) == 0:
            return None
        factor, info = torch.linalg.cholesky_ex(mass / mass[0, 0])
        if int(info):
            return None
        a, b = torch.tril_indices(n, n, -1, device=x.device)
        values = {"kinetic.base.log_diagonal": factor.diagonal()[1:].log(), "kinetic.base.off_diagonal": factor[a, b]}
        for name in dict.fromkeys(self.names[len(i) :]):
            values[name] = x[[k for k, other in enumerate(self.names) if other == name]] / mass[0, 0]
        return values
