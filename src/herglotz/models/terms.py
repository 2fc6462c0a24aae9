"""The terms of a model, with closed-form derivatives by jets.

    L_d = (c − 1)(s0 − h/2 V0) + √c K − h/2 (V0 + V1) + N,    c = e^g

V0 = V(q0), V1 = V(q1). L_d is Strang's splitting into kinetic, dissipative and potential parts: of order 2 in h for
every g(q, v), and exact for linear drag up to a constant factor on K.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.models.config import ModelConfig
from herglotz.models.feature_potential import named_potential
from herglotz.models.jet import Jet, coordinates, pairs
from herglotz.models.network import Network, feature_count, position_features
from herglotz.models.phase import Phase
from herglotz.models.term import Term
from herglotz.models.translations import blind, projection


class Kinetic(nn.Module):
    """K = Δᵀ m Δ / 2h with Δ = q1 − q0 and a constant mass matrix m = C Cᵀ, C₁₁ = 1.

    Positions do not determine the scale of L_d (gauge), so the first entry of the mass is fixed at 1. With `alike`
    m = 1, without parameters; with `diagonal` m is diagonal.
    """

    def __init__(self, dof: int, alike: bool = False, diagonal: bool = False):
        super().__init__()
        self.dof = dof
        for name, size, fixed in (
            ("log_diagonal", dof - 1, alike),
            ("off_diagonal", dof * (dof - 1) // 2, alike or diagonal),
        ):
            zero = torch.zeros(size, dtype=torch.float64)
            setattr(self, name, nn.Parameter(zero)) if not fixed else self.register_buffer(name, zero, persistent=False)
        self.log_diagonal: Tensor
        self.off_diagonal: Tensor

    def factor(self) -> Tensor:
        """C, lower triangular with C₁₁ = 1, shape (n, n)."""
        d = self.log_diagonal
        if self.dof == 1:
            return torch.ones(1, 1, dtype=d.dtype, device=d.device)
        C = torch.diag_embed(torch.cat([torch.ones(1, dtype=d.dtype, device=d.device), d.exp()]))
        i, j = torch.tril_indices(self.dof, self.dof, -1, device=d.device)
        return C.index_put((i, j), self.off_diagonal)

    def mass(self) -> Tensor:
        """The mass matrix, shape (n, n)."""
        C = self.factor()
        return C if self.dof == 1 else C @ C.T

    def forward(self, phase: Phase) -> Jet:
        """K as a jet over (q0, q1)."""
        n, h, order, delta = self.dof, phase.h, phase.order, phase.move
        m = self.mass()
        momentum = delta @ m / h[..., None]  # (..., n)
        value = (momentum * delta).sum(-1) / 2
        gradient = torch.cat([-momentum, momentum], -1).movedim(-1, 0)
        rows = [value[None], gradient]
        if order == 2:
            i, j = pairs(2 * n, m.device)
            block = torch.cat([torch.cat([m, -m], 1), torch.cat([-m, m], 1)])[i, j]
            rows.append(block.reshape(-1, *(1,) * value.ndim) / h.expand(value.shape))
        return Jet(torch.cat(rows), 2 * n, order)


class Potential(nn.Module):
    """V(q) = Σ kᵢ (1 − cos qᵢ) + bᵢ sin qᵢ (angles) or Σ kᵢ qᵢ²/2 + bᵢ qᵢ (others), plus a zero-initialised network.

    The tilt b moves the equilibrium away from the sensor's zero; for a falling body b is the weight. The network is
    multiplied by the energy scale Σ speed², so that its weights are of order one. `features` are added to V.

    With `alike` or `order` 4 the features make V, and k and b are fixed. With `translations` k and b are fixed too: at
    0 beside features, otherwise as springs of the projected position, which set the unit of the learned masses.
    """

    def __init__(self, config: ModelConfig, generator: torch.Generator):
        super().__init__()
        self.angles, self.scale = config.angles, config.scale
        self.energy = sum(v * v for v in config.speed)
        fixed = config.alike or config.order == 4 or bool(config.translations)
        for name, numbers in (("stiffness", config.stiffness), ("tilt", config.tilt)):
            named = config.order == 4 or (config.translations and (config.features or config.known))
            start = (0.0,) * config.dof if named else numbers
            value = torch.tensor(start, dtype=torch.float64)
            setattr(self, name, nn.Parameter(value)) if not fixed else self.register_buffer(name, value)
        self.stiffness: Tensor
        self.tilt: Tensor
        self.register_buffer("across", projection(config.translations, config.angles), persistent=False)
        self.across: Tensor | None
        self.features = named_potential(config)
        # The named terms of the model, which holds them as its own modules.
        self.more: tuple[Term, ...] = ()
        self.network: Network | None = None
        if config.potential_width:
            sizes = [feature_count(config.angles), *[config.potential_width] * config.potential_depth]
            self.network = Network(sizes, 1.0, generator, activation=config.activation)
            self.network.projection = blind(config, 0)

    def baseline(self, q: Tensor, order: int) -> Jet:
        """The springs and tilts of V: Σ f(xᵢ) with x = A q, so V′ = Aᵀf′ and V″ = Aᵀ diag(f″) A."""
        n, A = q.shape[-1], self.across
        f = self._own(q if A is None else q @ A.T)
        rows = [f[0].sum(-1)[None], (f[1] if A is None else f[1] @ A).movedim(-1, 0)]
        if order == 2:
            A = torch.eye(n, dtype=q.dtype, device=q.device) if A is None else A
            i, j = pairs(n, q.device)
            rows.append((f[2] @ (A[:, i] * A[:, j])).movedim(-1, 0))
        return Jet(torch.cat(rows), n, order)

    def _own(self, x: Tensor) -> list[Tensor]:
        """Return f(x), f′ and f″ of every coordinate, (..., n) each."""
        k, b, angles = self.stiffness, self.tilt, self.angles
        of_lengths = [k * (x * x * 0.5) + b * x, k * x + b, k.expand(x.shape)]
        if not any(angles):
            return of_lengths
        sin, cos = x.sin(), x.cos()
        of_angles = [k * (1.0 - cos) + b * sin, k * sin + b * cos, k * cos - b * sin]
        if all(angles):
            return of_angles
        angle = torch.tensor(angles, device=x.device)
        return [torch.where(angle, a, b) for a, b in zip(of_angles, of_lengths, strict=True)]

    def departure(self, q: Jet) -> Jet | None:
        """The network's part of V, or None without a network."""
        if self.network is None:
            return None
        return self.network(position_features(q, self.angles, self.scale)) * self.energy

    def forward(self, q: Tensor, order: int) -> Jet:
        """V as a jet over the n components of q."""
        x = coordinates(q, order)
        V = self.baseline(q, order)
        departure = self.departure(x)
        V = V if departure is None else V + departure
        for own in (term.potential(x) for term in self.more):
            V = V if own is None else V + own
        return V if self.features is None else V + self.features(q, order)


class LinearDamping(nn.Module):
    """g = −γ h, so c = e^{−γh} exactly; γ is a plain parameter of either sign (a logarithm collapses to 0)."""

    constant = True

    def __init__(self, rate: float):
        super().__init__()
        self.rate = nn.Parameter(torch.tensor(rate, dtype=torch.float64))

    def forward(self, phase: Phase) -> Tensor:
        """The exponent g, independent of position."""
        return -self.rate * phase.h


class AffineDamping(nn.Module):
    """g = −γ h + λ·Δ − h G(q̄, v) with a zero-initialised network G; c = e^g > 0 by construction.

    λ alone describes a parachute (c = e^{λΔ}); G adds any drag that depends on position and velocity.
    """

    constant = False

    def __init__(self, config: ModelConfig, generator: torch.Generator):
        super().__init__()
        self.sizes = config
        self.rate = nn.Parameter(torch.tensor(config.rate, dtype=torch.float64))
        self.drag = nn.Parameter(torch.zeros(config.dof, dtype=torch.float64))
        self.network: Network | None = None
        # At the full level the units of `ActionFlow` read q̄ and v.
        if config.damping_width and config.level == "affine":
            self.network = _of_position_and_velocity(config, config.damping_width, 1, 0.3, generator)

    def forward(self, phase: Phase) -> Jet:
        """The exponent g as a jet over (q0, q1)."""
        g = (phase.velocity * self.drag).sum() - self.rate
        if self.network is not None:
            g = g - self.network(phase.features)
        return g * phase.h

    def departure(self, q: Tensor, v: Tensor) -> Tensor | None:
        """The network's rate G(q, v), shape (...), or None without a network."""
        if self.network is None:
            return None
        return self.network(Phase(q - v / 2, q + v / 2, q.new_ones(()), 1, self.sizes).features).value


class Correction(nn.Module):
    """Big-step correction N = h E G(q̄, v): a zero-initialised network that removes the rule's error at one step size.

    E = Σ speed² is a fixed energy scale. A network of several layers starts smooth (gain 0.1) and stays smooth where
    there are no data, for example near a separatrix, which lowers the worst rollout errors by one to two orders of
    magnitude. A single layer (gain 0.5) learns faster, for data without holes. Without a baseline the network is all
    of L_d but the damping: the model that collapses (trap 2).
    """

    def __init__(self, config: ModelConfig, generator: torch.Generator):
        super().__init__()
        self.energy = sum(v * v for v in config.speed)
        width, depth, alone = config.correction_width, config.correction_depth, not config.baseline
        gain = 1.0 if alone else 0.5 if depth == 1 else 0.1
        self.network = _of_position_and_velocity(config, width, depth, gain, generator, zero=not alone)

    def forward(self, phase: Phase) -> Jet:
        """N as a jet over (q0, q1)."""
        return self.network(phase.features) * (phase.h * self.energy)


def _of_position_and_velocity(
    config: ModelConfig, width: int, depth: int, gain: float, generator: torch.Generator, zero: bool = True
) -> Network:
    """A scalar network of the features of q̄ and v, invariant under the model's translations."""
    inputs = feature_count(config.angles) + config.dof
    network = Network([inputs, *[width] * depth], gain, generator, zero=zero, activation=config.activation)
    network.projection = blind(config, config.dof)
    return network
