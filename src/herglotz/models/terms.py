"""The terms of a model, with closed-form derivatives by jets.

    L_d = (c − 1)(s0 − h/2 V0) + √c K − h/2 (V0 + V1) + N,    c = e^g

V0 = V(q0), V1 = V(q1). L_d is Strang's splitting into kinetic, dissipative and potential parts: of order 2 in h for
every g(q, v), and exact for linear drag up to a constant factor on K.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import torch
from torch import Tensor, nn

from herglotz.models.config import ModelConfig
from herglotz.models.feature_potential import Combination, named_potential, sorted_features
from herglotz.models.features import Feature
from herglotz.models.jet import Jet, concatenate, coordinates, of_mean_and_velocity, pairs
from herglotz.models.network import Network, feature_count, midpoint_velocity_jets, position_features
from herglotz.models.term import Term
from herglotz.models.translations import blind, projection


@dataclass(eq=False)
class Phase:
    """q̄ = (q0 + q1)/2, v = Δ/h and their features as jets over (q0, q1), each computed at its first use.

    `order` is that of the jets, 0, 1 or 2; `sizes` has the angles, scale and speed of the coordinates.
    """

    q0: Tensor  # (..., n)
    q1: Tensor  # (..., n)
    h: Tensor  # (...)
    order: int
    sizes: ModelConfig
    delta: Tensor | None = None  # (..., n) q1 − q0 without the rounding of the subtraction

    @property
    def move(self) -> Tensor:
        """Δ = q1 − q0, (..., n)."""
        return self.q1 - self.q0 if self.delta is None else self.delta

    @property
    def mean(self) -> Jet:
        """q̄, vector-valued (..., n)."""
        return self._pair[0]

    @property
    def velocity(self) -> Jet:
        """v, vector-valued (..., n)."""
        return self._pair[1]

    @cached_property
    def position(self) -> Jet:
        """Features of q̄: (sin, cos) of an angle, q̄ / scale of another coordinate."""
        return position_features(self.mean, self.sizes.angles, self.sizes.scale)

    @cached_property
    def features(self) -> Jet:
        """Features of q̄, then v / speed."""
        v = self.velocity
        v = Jet(v.data / v.data.new_tensor(self.sizes.speed), v.tangents, v.order)
        return concatenate([self.position, v])

    @cached_property
    def _pair(self) -> tuple[Jet, Jet]:
        return midpoint_velocity_jets(self.q0, self.q1, self.h, self.order, self.delta)


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


class FeatureKinetic(nn.Module):
    """K = K of `base` + h Σ_g θ_g f_g(w·q̄) ∏v: couplings of speeds, magnetic terms.

    A fit makes the mass positive definite where there are data, not elsewhere.
    """

    def __init__(
        self, base: Kinetic | PositionKinetic, features: Sequence[Feature], known: Sequence[Feature], dof: int
    ):
        super().__init__()
        self.base = base
        self.sum = Combination(features, known, dof)
        velocities = [tuple(sorted(p.velocities)) for p in self.sum.products]
        self.monomials = list(dict.fromkeys(velocities))
        # The row of a product has 1 at its monomial of velocities.
        of = [[float(own == monomial) for monomial in self.monomials] for own in velocities]
        self.register_buffer("of", torch.tensor(of, dtype=torch.float64), persistent=False)
        self.of: Tensor  # (A, monomials)

    def forward(self, phase: Phase) -> Jet:
        """Return K as a jet over (q0, q1)."""
        K, v = self.base(phase), coordinates(phase.velocity.value, phase.order)
        return K + self._summed(phase, {0: self._each([_times(v, of) for of in self.monomials])}) * phase.h

    def mass(self, q: Tensor) -> Tensor:
        """Return the features' part of ∂²K/∂v², (..., n, n), at q (..., n)."""
        c, n = self.sum, self.sum.dof
        f = (c.value(q, c.ridge(c.forms(q), 0)) * c.weights()) @ self.of
        out = q.new_zeros(*q.shape, n)
        for k, velocities in enumerate(self.monomials):
            if len(velocities) == 2:
                i, j = velocities
                unit = torch.zeros(n, n, dtype=q.dtype, device=q.device)
                unit[i, j] += 1.0
                unit[j, i] += 1.0
                out = out + f[..., k, None, None] * unit
        return out

    def straight(self, phase: Phase, rate: Tensor) -> Jet:
        """Return K_qq[v, v] + 2γ K_q v + γ² K of the features, the change of K along the straight line."""
        v = coordinates(phase.velocity.value, phase.order)
        P, w = self._each([_times(v, of) for of in self.monomials]), v.linear(self.sum.form)
        Pw = P * w
        return self._summed(phase, {0: P * (rate * rate), 1: Pw * (2 * rate), 2: Pw * w})

    def along(self, phase: Phase, b: Tensor, y: Tensor, rate: Tensor) -> Jet:
        """Return bᵀ(K_q − K_qv v − γ K_v − K_vv y) of the features, b and y (..., n) constant; up to two velocities."""
        v, form = coordinates(phase.velocity.value, phase.order), self.sum.form
        P = self._each([_times(v, of) for of in self.monomials])
        by_b = self._each([_derivative(v, of, b) for of in self.monomials])
        twice = torch.stack([_second(of, b, y) for of in self.monomials], -1) @ self.of.T
        return self._summed(phase, {1: P * (b @ form.T) - by_b * v.linear(form), 0: by_b * -rate - twice})

    def _each(self, monomials: list[Jet]) -> Jet:
        """Return the scalar jet of each product's monomial, as a jet (..., A)."""
        first = monomials[0]
        return Jet(torch.stack([m.data for m in monomials], -1) @ self.of.T, first.tangents, first.order)

    def _summed(self, phase: Phase, by_order: dict[int, Jet]) -> Jet:
        """Return Σ_g θ_g Σ_k f_g⁽ᵏ⁾(w_g·q̄) R_k,g(v) over (q0, q1), for jets R_k over v, (..., A), by k.

        Each f is a function of one number, so its derivatives are f′ w and f″ w wᵀ and no jets are multiplied.
        """
        c, order, q = self.sum, phase.order, phase.mean.value
        weights, x = c.weights(), c.forms(q)
        f = [c.ridge(x, k) * weights for k in range(max(by_order) + order + 1)]
        # The sums over k of the j-th derivatives of f times a part of R.
        total = lambda j, part: reduce(torch.add, [f[k + j] * part(R) for k, R in by_order.items()])  # noqa: E731
        values = [total(j, lambda R: R.value) for j in range(order + 1)]
        value = c.value(q, values[0]).sum(-1)
        if not order:
            return Jet(value[None], 0, 0)
        slopes = [total(j, lambda R: R.gradient) for j in range(order)]
        by_q, by_v = c.slope(q, *values[:2]), c.value(q, slopes[0]).sum(-1)
        second = None
        if order == 2:
            by_qq, by_vq = c.bend(q, *values).movedim(-1, 0), c.slope(q, *slopes).movedim(-1, 1)
            second = by_qq, by_vq, c.value(q, total(0, lambda R: R.second)).sum(-1)
        return of_mean_and_velocity(value, by_q.movedim(-1, 0), by_v, second, phase.h)


def kinetic_term(config: ModelConfig, generator: torch.Generator) -> Kinetic | PositionKinetic | FeatureKinetic:
    """Return the K of a model: a constant or position-dependent mass, and the named features with velocities."""
    n = config.dof
    mass = PositionKinetic(config, generator) if config.mass_width else Kinetic(n, config.alike, config.diagonal)
    learned, known = (sorted_features(names, config.angles)[1] for names in (config.features, config.known))
    return FeatureKinetic(mass, learned, known, n) if learned or known else mass


def _times(v: Jet, velocities: tuple[int, ...]) -> Jet:
    """Return the product ∏v."""
    product = v.select(velocities[0])
    for i in velocities[1:]:
        product = product * v.select(i)
    return product


def _derivative(v: Jet, velocities: tuple[int, ...], b: Tensor) -> Jet:
    """Return the derivative of ∏v along b, for at most two velocities."""
    if len(velocities) == 1:
        return v.select(0) * 0.0 + b[..., velocities[0]]
    i, j = velocities
    return v.select(i) * b[..., j] + v.select(j) * b[..., i]


def _second(velocities: tuple[int, ...], b: Tensor, y: Tensor) -> Tensor:
    """Return the second derivative of ∏v along b and y, for at most two velocities."""
    if len(velocities) == 1:
        return torch.zeros_like(b[..., 0])
    i, j = velocities
    return b[..., i] * y[..., j] + b[..., j] * y[..., i]
