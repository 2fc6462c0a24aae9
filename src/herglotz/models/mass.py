"""A mass that depends on position: K = vᵀ m(q̄) v h / 2."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.models.config import ModelConfig
from herglotz.models.jet import Jet
from herglotz.models.network import Network, feature_count, position_features
from herglotz.models.phase import Phase
from herglotz.models.terms import Kinetic

# A diagonal factor of the mass stays within e^±2 of its value at q = 0.
MAX_LOG_FACTOR = 2.0


class PositionKinetic(nn.Module):
    """K = h |Tᵀ C̄ᵀ v|² / 2, so m(q̄) = C̄ T(q̄) T(q̄)ᵀ C̄ᵀ is symmetric and positive definite for every weight.

    C̄ is the constant Cholesky factor of `Kinetic`. The lower triangular matrix T(q̄) comes from one zero-initialised
    network r of the position's features: T_ii = exp(2 tanh(r_ii / 2)), within e^±2 of 1, and T_ij = r_ij below the
    diagonal. The network's value at q = 0 is subtracted, so T(0) = I and C̄C̄ᵀ is the mass at q = 0, where C̄₁₁ = 1 fixes
    the scale of L_d that positions do not determine (gauge).
    """

    def __init__(self, config: ModelConfig, generator: torch.Generator):
        super().__init__()
        n = config.dof
        self.angles, self.scale = config.angles, config.scale
        self.constant = Kinetic(n)
        sizes = [feature_count(config.angles), *[config.mass_width] * config.mass_depth]
        self.network = Network(sizes, 0.3, generator, outputs=n * (n + 1) // 2, activation=config.activation)
        row, column = torch.tril_indices(n, n, -1)
        place = torch.zeros(n, len(row), dtype=torch.float64)
        place[column, torch.arange(len(row))] = 1.0
        origin = torch.cat([torch.tensor([0.0, 1.0] if a else [0.0], dtype=torch.float64) for a in config.angles])
        for name, value in (("row", row), ("place", place), ("origin", origin)):
            self.register_buffer(name, value, persistent=False)
        self.row: Tensor  # (pairs) row of each entry below the diagonal
        self.place: Tensor  # (n, pairs) has 1 at the column of each entry
        self.origin: Tensor  # (m) features of q = 0

    def mass(self, q: Tensor) -> Tensor:
        """Return m(q), (..., n, n), in units of the first coordinate's mass at q = 0; q is (..., n)."""
        n = q.shape[-1]
        diagonal, below = self._factors(position_features(Jet(q[None], 0, 1), self.angles, self.scale))
        spread = torch.nn.functional.one_hot(self.row, n).to(q.dtype)  # (pairs, n)
        T = torch.diag_embed(diagonal.value) + torch.einsum("...p,pi,jp->...ij", below.value, spread, self.place)
        C = self.constant.factor() @ T
        return C @ C.mT

    def forward(self, phase: Phase) -> Jet:
        """Return K as a jet over (q0, q1)."""
        diagonal, below = self._factors(phase.position)
        # w = C̄ᵀ v, and then Tᵀ w.
        w = phase.velocity.linear(self.constant.factor().T)
        Tw = diagonal * w
        # Exported files take no tensor without entries.
        if len(self.row):
            Tw = Tw + (below * w.select(self.row)).linear(self.place)
        return (Tw * Tw).sum() * (phase.h / 2)

    def _factors(self, x: Jet) -> tuple[Jet, Jet]:
        """Return the diagonal (..., n) of T and the entries below it (..., n(n−1)/2)."""
        n = self.constant.dof
        at_zero = self.network(Jet(self.origin[None], 0, 1)).value
        r = self.network(x) - at_zero
        log_diagonal = (r.select(slice(0, n)) / MAX_LOG_FACTOR).tanh() * MAX_LOG_FACTOR
        return log_diagonal.exp(), r.select(slice(n, None))
