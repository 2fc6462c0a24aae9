"""The step equation F(q1) = D1 L_d + c p0 + F⁻ = 0: of any L_d by its partials, of a model by its terms.

A model's L_d = (c − 1) A + √c K − h/2 (V0 + V1) + N with A = s0 − h/2 V0 and c = e^g has

    F = a c + α D1 g − √c m v + D1 N + F⁻,    a = p0 − h/2 V0′,    α = c A + √c K / 2,
    J = ∂F/∂q1 = (c a − √c m v / 2) ⊗ D2 g + α D12 g + D1 g ⊗ ∂α/∂q1 − √c m / h + D12 N + ∂F⁻/∂q1,

so V is evaluated once a step (V at q0 is known from the step before) and an iteration costs only the networks of
(q̄, v), by sweeps of n tangents.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from herglotz.cached import cached
from herglotz.mechanics import (
    DiscreteLagrangian,
    Partials,
    momentum_jacobian,
    momentum_plus,
    momentum_residual,
    partials,
)
from herglotz.mechanics.newton import Point
from herglotz.models import ContactLagrangian, capabilities
from herglotz.models.sweep import Sweep, trigonometry
from herglotz.models.terms import AffineDamping, Kinetic, LinearDamping
from herglotz.stepping.explicit import Field, FieldOf
from herglotz.stepping.state import State


class End(NamedTuple):
    """The result of a solved step."""

    p1: Tensor  # (..., n)
    L: Tensor  # (...) s1 − s0
    c: Tensor  # (...)
    dp: Tensor | None = None  # (..., n) p1 − p0 if computed without that difference


class StepEquation(Protocol):
    """The step equation in the unknown x: q1 or, in increments, Δ = q1 − q0."""

    q0: Tensor  # (..., n)
    increments: bool

    def __call__(self, x: Tensor, second: bool) -> Point:
        """F, and J if `second`."""
        ...

    def push(self, point: Point) -> Tensor:
        """The momentum c p0, (..., n)."""
        ...

    def end(self, x: Tensor, point: Point) -> End:
        """p1 = D2 + F⁺, L and c at a solution."""
        ...

    def typical_increment(self) -> Tensor:
        """The size (...) to which the rounding of J⁻¹F is relative even at rest; 0 if unknown."""
        ...


def partials_at(L_d: Any, q0: Tensor, x: Tensor, s0: Tensor, h: Tensor, order: int, increments: bool) -> Partials:
    """The partials of L_d at (q0, x) or, in increments, at (q0, q0 + x), which L_d then has to offer."""
    return L_d.partials_increment(q0, x, s0, h, order) if increments else partials(L_d, q0, x, s0, h, order)


class PartialsEquation:
    """The step equation of any L_d; `rest` holds its partials."""

    def __init__(self, L_d: DiscreteLagrangian, state: State, h: Tensor, order: int, increments: bool):
        self.L_d, self.h, self.order, self.increments = L_d, h, order, increments
        self.q0, self.p0, self.s0 = state
        # Whether dry friction can hold a coordinate.
        made_of = capabilities(L_d)
        self.sticking = made_of is not None and made_of.sticking

    def __call__(self, x: Tensor, second: bool) -> Point:
        """See `StepEquation`."""
        order = 2 if second else self.order
        P = partials_at(self.L_d, self.q0, x, self.s0, self.h, order, self.increments)
        return Point(momentum_residual(P, self.p0), momentum_jacobian(P, self.p0) if order == 2 else None, P)

    def push(self, point: Point) -> Tensor:
        """See `StepEquation`."""
        return point.rest.c[..., None] * self.p0

    def end(self, x: Tensor, point: Point) -> End:  # noqa: ARG002  one signature for all
        """See `StepEquation`."""
        return End(momentum_plus(point.rest), point.rest.L, point.rest.c)

    def typical_increment(self) -> Tensor:
        """See `StepEquation`."""
        of_model = getattr(self.L_d, "typical_increment", None)
        h = self.h.expand(self.s0.shape)
        return torch.zeros_like(h) if of_model is None else of_model(h)


class _Frame(NamedTuple):
    """Constant matrices between features (s, c, v) and (q0, q1); the velocity's rate is left to `ModelEquation`."""

    to_q0: Tensor  # (3n, n) ½ on every row of a coordinate: D1 = (g · w) to_q0 with w = (ds, −sin, −2/h)
    to_q1: Tensor  # (3n, n) to_q0 with the sign of the velocity turned: D2
    tangent: Tensor  # (n, 3n) features' tangents along q1 are w · tangent
    bend: Tensor  # (3n, n) −¼ on the rows s and c of angles
    eye: Tensor  # (n, n)


@cached
def _frame(angles: tuple[bool, ...], dtype: torch.dtype, device: torch.device) -> _Frame:
    n = len(angles)
    eye = torch.eye(n, dtype=dtype, device=device)
    bend = torch.diag(torch.tensor(angles, dtype=dtype, device=device)) / -4
    to_q1 = torch.cat([eye, eye, -eye]) / 2
    return _Frame(torch.cat([eye, eye, eye]) / 2, to_q1, to_q1.T, torch.cat([bend, bend, 0 * eye]), eye)


class _Slopes(NamedTuple):
    """A network of (q̄, v) as a function of (q0, q1)."""

    value: Tensor  # (...)
    D1: Tensor  # (..., n)
    weighted: Tensor  # (..., 3n) D2 = weighted @ to_q1
    D12: Tensor | None  # (..., n, n)


class _Constants(NamedTuple):
    """Factors that depend only on h, the shape of the batch and the parameters."""

    h: Tensor  # (...)
    half: Tensor  # (..., 1) h/2
    rate: Tensor  # (..., 1) 1/h
    minus_2_rate: Tensor  # (..., n)
    c: Tensor  # (...) c and √c are those of a constant damping, else 1
    c_minus_1: Tensor
    minus_root: Tensor  # (..., 1)
    J: Tensor  # (..., n, n) −m/h, times √c where that is constant
    # The networks, times h and −h if folded.
    N: Sweep | None
    G: Sweep | None
    times: Tensor | None  # (...) h, if not folded into the networks


class ModelEquation:
    """Makes the step equations of a model at its present parameters; keeps factors that steps share.

    `fold` multiplies the last layers of the networks by h, which takes fewer operations if all samples have the same h.
    """

    def __init__(self, model: ContactLagrangian, fold: bool = True):
        # The capability `by_terms` has a constant mass.
        assert isinstance(model.kinetic, Kinetic)
        self.model, self.fold = model, fold
        self.config = model.config
        self.field = FieldOf(model.potential)
        self.mass = model.kinetic.mass()
        self.affine = model.damping if isinstance(model.damping, AffineDamping) else None
        self.frame = _frame(self.config.angles, self.mass.dtype, self.mass.device)
        self._constants: _Constants | None = None
        self._key: tuple[Tensor, torch.Size] | None = None

    def at(self, state: State, h: Tensor, u: Tensor | None, increments: bool, here: Field | None = None) -> StepOfModel:
        """The equation of a step; `here` is the potential at q0, where known."""
        return StepOfModel(self, state, self._at(h, state.q), u, increments, here)

    def _at(self, h: Tensor, q0: Tensor) -> _Constants:
        """The constants of a step h, kept between steps that pass the same tensor."""
        if self._key is not None and self._key[0] is h and self._key[1] == q0.shape and self._constants is not None:
            return self._constants
        rate = (1 / h)[..., None]
        g = torch.zeros_like(h)
        if isinstance(self.model.damping, LinearDamping):
            g = -self.model.damping.rate * h
        c_minus_1, root = torch.expm1(g), (g / 2).exp()[..., None]
        J = -(rate if self.affine is not None else root * rate)[..., None] * self.mass
        more = (self.config.angles, self.config.scale, self.config.speed)
        N, G = self.model.correction, None if self.affine is None else self.affine.network
        times: Tensor | float = h if self.fold else 1.0
        constants = _Constants(
            h, (h / 2)[..., None], rate, (-2 * rate).expand(q0.shape), 1.0 + c_minus_1, c_minus_1, -root,
            J.expand(*q0.shape, q0.shape[-1]),
            None if N is None else Sweep(N.network, *more, times * N.energy),
            None if G is None else Sweep(G, *more, -times),
            None if self.fold else h,
        )  # fmt: skip
        self._key, self._constants = (h, q0.shape), constants
        return constants


class StepOfModel:
    """The step equation of a model at (q0, p0, s0); see the head of this module."""

    def __init__(
        self,
        maker: ModelEquation,
        state: State,
        constants: _Constants,
        u: Tensor | None,
        increments: bool,
        here: Field | None,
    ):
        self.q0, self.p0, self.s0 = q0, p0, s0 = state
        self.maker, self.constants, self.u, self.increments = maker, constants, u, increments
        self.here = maker.field(q0) if here is None else here
        # The potential at q1, after `end`.
        self.there: Field | None = None
        # a = p0 − h/2 V0′, times c where c is constant.
        a = torch.addcmul(p0, constants.half, self.here.slope, value=-1)
        self.a = a if maker.affine is not None else constants.c[..., None] * a
        self.A = s0 - constants.half[..., 0] * self.here.V

    def __call__(self, x: Tensor, second: bool) -> Point:
        """See `StepEquation`."""
        k, maker = self.constants, self.maker
        v = (x if self.increments else x - self.q0) * k.rate
        # A model's first mass is 1.
        mv = v if v.shape[-1] == 1 else v @ maker.mass
        features = self._features(x, v) if k.N is not None or k.G is not None else None
        N = None if k.N is None or features is None else self._slopes(k.N, *features, second)
        if maker.affine is not None:
            F, J, damping = self._affine(maker.affine, v, mv, features, second)
        else:
            F, J, damping = torch.addcmul(self.a, k.minus_root, mv), k.J if second else None, None
        if N is not None:
            F = F + N.D1
            J = None if J is None or N.D12 is None else J + N.D12
        friction = maker.model.friction
        force = None
        if friction is not None:
            force, slope = friction.value_and_slope(v, self.u)
            F = F + (k.c[..., None] * k.half) * force
            J = None if J is None else J + torch.diag_embed((k.c / 2)[..., None] * slope)
        return Point(F, J, (v, mv, N, damping, force))

    def push(self, point: Point) -> Tensor:
        """See `StepEquation`."""
        damping = point.rest[3]
        return (self.constants.c if damping is None else damping[0])[..., None] * self.p0

    def end(self, x: Tensor, point: Point) -> End:
        """See `StepEquation`."""
        there = self.there = self.maker.field(self.q0 + x if self.increments else x)
        p1, L, c, _ = self.end_without_field(point)
        half = self.constants.half
        p1, L = torch.addcmul(p1, half, there.slope, value=-1), torch.addcmul(L, half[..., 0], there.V, value=-1)
        return End(p1, L, c, self._gained(point, there) if self.increments else None)

    def typical_increment(self) -> Tensor:
        """See `StepEquation`."""
        return self.maker.model.typical_increment(self.constants.h).expand(self.s0.shape)

    def _gained(self, point: Point, there: Field) -> Tensor | None:
        """p1 − p0 = (c − 1) p0 + (D1 + D2) L_d + F⁻ + F⁺ at F = 0, without the large terms that D1 and D2 cancel."""
        k, (_, _, N, damping, force) = self.constants, point.rest
        if damping is not None:
            return None
        c = k.c[..., None]
        dp = k.c_minus_1[..., None] * self.p0 - k.half * (c * self.here.slope + there.slope)
        if N is not None:
            dp = dp + N.weighted @ (self.maker.frame.to_q0 + self.maker.frame.to_q1)
        return dp if force is None else dp + (k.half * (1.0 + c)) * force

    def leap(self) -> Tensor:
        """Δ without networks of (q̄, v), forces and drag, (..., n): near the solution if these terms are weak.

        −J⁻¹a with the kinetic part −√c m/h of J alone.
        """
        k = self.constants
        a = self.a if self.maker.affine is None else self.a * -k.minus_root
        return -((a @ torch.linalg.inv_ex(self.maker.mass)[0]) * (k.h[..., None] / k.minus_root))

    def at(self, x: Tensor, point: Point) -> Point:
        """Return the point with the velocity and momentum of x, and the other entries unchanged."""
        v = (x if self.increments else x - self.q0) * self.constants.rate
        mv = v if v.shape[-1] == 1 else v @ self.maker.mass
        return Point(point.F, point.J, (v, mv, *point.rest[2:]))

    def end_without_field(self, point: Point) -> End:
        """The result of `end`, without −h/2 V′(q1) in p1 and −h/2 V(q1) in L."""
        k, maker = self.constants, self.maker
        v, mv, N, damping, force = point.rest
        half = k.half[..., 0]
        if damping is None:
            c, L, p1 = k.c.expand(self.s0.shape), k.c_minus_1 * self.A, -k.minus_root * mv
            # √c K = √c h/2 v·mv
            K = (mv * v).sum(-1) * -(k.minus_root[..., 0] * half)
        else:
            c, c_minus_1, root, alpha, D2g = damping
            L, p1 = c_minus_1 * self.A, torch.addcmul(alpha[..., None] * D2g(), root, mv)
            K = (mv * v).sum(-1) * (root[..., 0] * half)
        L = L + torch.addcmul(K, half, self.here.V, value=-1)
        if N is not None:
            L, p1 = L + N.value, p1 + N.weighted @ maker.frame.to_q1
        if force is not None:
            p1 = torch.addcmul(p1, k.half, force)
        return End(p1, L, c)

    def _features(self, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Features (..., 3n) at q̄ and v, and their slopes w."""
        mean = torch.add(self.q0, x, alpha=0.5) if self.increments else (self.q0 + x) / 2
        t = trigonometry(mean, self.maker.config.angles)
        y = torch.cat([t.s, t.c, v], -1)
        return y, torch.cat([t.ds, t.minus_sin, self.constants.minus_2_rate], -1)

    def _slopes(self, sweep: Sweep, y: Tensor, w: Tensor, second: bool) -> _Slopes:
        frame = self.maker.frame
        times = self.constants.times
        if not second:
            value, g, _ = sweep(y)
            weighted = g * w
            if times is not None:
                value, weighted = value * times, weighted * times[..., None]
            return _Slopes(value, weighted @ frame.to_q0, weighted, None)
        n = self.q0.shape[-1]
        lift = (n, *(1,) * (y.ndim - 1))
        value, g, dg = sweep(y, w * frame.tangent.reshape(*lift, 3 * n))
        assert dg is not None
        weighted = g * w
        rows = torch.addcmul((dg * w) @ frame.to_q0, (g * y) @ frame.bend, frame.eye.reshape(*lift, n))
        if times is not None:
            value, weighted, rows = value * times, weighted * times[..., None], rows * times[..., None]
        return _Slopes(value, weighted @ frame.to_q0, weighted, rows.movedim(0, -1))

    def _affine(
        self, damping: AffineDamping, v: Tensor, mv: Tensor, features: tuple[Tensor, Tensor] | None, second: bool
    ) -> tuple[Tensor, Tensor | None, tuple[Any, ...]]:
        """F and J without N and forces, where g depends on (q̄, v)."""
        k, maker = self.constants, self.maker
        drag = damping.drag
        g, D1g, D12g, more = k.h * (v @ drag - damping.rate), -drag, None, None
        if k.G is not None and features is not None:
            more = self._slopes(k.G, *features, second)
            g, D1g, D12g = g + more.value, D1g + more.D1, more.D12
        c_minus_1 = torch.expm1(g)
        c, root = 1.0 + c_minus_1, (g / 2).exp()[..., None]
        K = (mv * v).sum(-1) * k.half[..., 0]
        alpha = torch.addcmul(c * self.A, root[..., 0], K, value=0.5)
        push = c[..., None] * self.a
        pull = root * mv
        F = torch.addcmul(push - pull, alpha[..., None], D1g)
        to_q1 = lambda: drag if more is None else drag + more.weighted @ maker.frame.to_q1  # noqa: E731
        J = None
        if second:
            D2g = to_q1()
            slope = (torch.addcmul(c * self.A, root[..., 0], K, value=0.25))[..., None] * D2g + pull / 2
            J = k.J * root[..., None] + (push - pull / 2)[..., :, None] * D2g[..., None, :]
            J = J + D1g[..., :, None] * slope[..., None, :]
            J = J if D12g is None else J + alpha[..., None, None] * D12g
        return F, J, (c, c_minus_1, root, alpha, to_q1)


def model_equation(L_d: DiscreteLagrangian, fold: bool = True) -> ModelEquation | None:
    """The step equations of L_d by terms, or None if L_d has only partials; `fold` as in `ModelEquation`."""
    return ModelEquation(L_d, fold) if type(L_d) is ContactLagrangian and L_d.capabilities.by_terms else None
