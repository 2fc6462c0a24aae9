"""The step equation F(q1) = D1 L_d + c p0 + F⁻ = 0 of one step: of any L_d through its partials, of a model directly.

A model's L_d = (c − 1) A + √c K − h/2 (V0 + V1) + N with A = s0 − h/2 V0 and c = e^g has

    F = a c + α D1 g − √c m v + D1 N + F⁻,    a = p0 − h/2 V0′,    α = c A + √c K / 2,
    J = ∂F/∂q1 = (c a − √c m v / 2) ⊗ D2 g + α D12 g + D1 g ⊗ ∂α/∂q1 − √c m / h + D12 N + ∂F⁻/∂q1,

so V is evaluated once a step, at q0 (where the step before has left it) and at the end, and what an iteration costs
are the networks of (q̄, v), by sweeps of n tangents.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from herglotz.mechanics import (
    DiscreteLagrangian,
    Partials,
    momentum_jacobian,
    momentum_plus,
    momentum_residual,
    partials,
)
from herglotz.models import ContactLagrangian
from herglotz.models.sweep import Sweep, trigonometry
from herglotz.models.terms import AffineDamping, Kinetic, LinearDamping
from herglotz.stepping.field import Field, FieldOf


class Point(NamedTuple):
    """The step equation at one trial."""

    F: Tensor  # (..., n)
    J: Tensor | None  # (..., n, n) ∂F/∂q1, where it was asked for
    rest: Any  # what `end` and `push` go on with


class End(NamedTuple):
    """What a solved step hands on."""

    p1: Tensor  # (..., n)
    L: Tensor  # (...) s1 − s0
    c: Tensor  # (...)


class Equation(Protocol):
    """The step equation in the unknown x: q1 or, in increments, Δ = q1 − q0."""

    def __call__(self, x: Tensor, second: bool) -> Point:
        """F, and J if `second`."""
        ...

    def push(self, point: Point) -> Tensor:
        """The momentum c p0, (..., n)."""
        ...

    def end(self, x: Tensor, point: Point) -> End:
        """p1 = D2 + F⁺, L and c at a solution."""
        ...


class PartialsEquation:
    """The step equation of any L_d; `rest` holds its partials."""

    def __init__(
        self, L_d: DiscreteLagrangian, q0: Tensor, p0: Tensor, s0: Tensor, h: Tensor, order: int, increments: bool
    ):
        self.L_d, self.q0, self.p0, self.s0, self.h = L_d, q0, p0, s0, h
        self.order, self.increments = order, increments

    def __call__(self, x: Tensor, second: bool) -> Point:
        """See `Equation`."""
        order = 2 if second else self.order
        if self.increments:
            form: Any = self.L_d  # `solve_step` checked
            P: Partials = form.partials_increment(self.q0, x, self.s0, self.h, order)
        else:
            P = partials(self.L_d, self.q0, x, self.s0, self.h, order)
        return Point(momentum_residual(P, self.p0), momentum_jacobian(P, self.p0) if order == 2 else None, P)

    def push(self, point: Point) -> Tensor:
        """See `Equation`."""
        return point.rest.c[..., None] * self.p0

    def end(self, x: Tensor, point: Point) -> End:  # noqa: ARG002  one signature for all
        """See `Equation`."""
        return End(momentum_plus(point.rest), point.rest.L, point.rest.c)


class _Frame(NamedTuple):
    """Constant matrices between features (s, c, v) and (q0, q1); the velocity's rate is left to `ModelEquation`."""

    to_q0: Tensor  # (3n, n) ½ on every row of a coordinate: D1 = (g · w) to_q0 with w = (ds, −sin, −2/h)
    to_q1: Tensor  # (3n, n) the same with the velocity's sign turned: D2
    tangent: Tensor  # (n, 3n) features' tangents along q1 are w · tangent
    bend: Tensor  # (3n, n) −¼ on the rows s and c of angles
    eye: Tensor  # (n, n)


@lru_cache(maxsize=64)
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
    """What depends on h, the shape of the batch and the parameters only."""

    h: Tensor  # (...)
    half: Tensor  # (..., 1) h/2
    rate: Tensor  # (..., 1) 1/h
    minus_2_rate: Tensor  # (..., n)
    c: Tensor  # (...) and its root, where they are constant
    c_minus_1: Tensor
    minus_root: Tensor  # (..., 1)
    J: Tensor  # (..., n, n) −m/h, times √c where that is constant
    N: Sweep | None  # times h
    G: Sweep | None  # times −h


class ModelEquation:
    """Makes the step equations of one model at its present parameters; keeps what they share."""

    def __init__(self, model: ContactLagrangian):
        assert isinstance(model.kinetic, Kinetic)  # `model_equation` checked
        self.model = model
        self.config = model.config
        self.field = FieldOf(model.potential)
        self.mass = model.kinetic.mass()
        self.affine = model.damping if isinstance(model.damping, AffineDamping) else None
        self.frame = _frame(self.config.angles, self.mass.dtype, self.mass.device)
        self._constants: _Constants | None = None
        self._key: tuple[Tensor, torch.Size] | None = None

    def at(
        self,
        q0: Tensor,
        p0: Tensor,
        s0: Tensor,
        h: Tensor,
        u: Tensor | None,
        increments: bool,
        here: Field | None = None,
    ) -> StepOfModel:
        """The equation of one step; `here` is the potential at q0 where it is known."""
        return StepOfModel(self, q0, p0, s0, self._at(h, q0), u, increments, here)

    def _at(self, h: Tensor, q0: Tensor) -> _Constants:
        """The constants of a step h, kept between steps that pass the same tensor."""
        if self._key is not None and self._key[0] is h and self._key[1] == q0.shape and self._constants is not None:
            return self._constants
        rate = (1 / h)[..., None]
        g = torch.zeros_like(h)
        if isinstance(self.model.damping, LinearDamping):
            g = self.model.damping(h, h, h, 1)
        c_minus_1, root = torch.expm1(g), (g / 2).exp()[..., None]
        J = -(rate if self.affine is not None else root * rate)[..., None] * self.mass
        more = (self.config.angles, self.config.scale, self.config.speed)
        N, G = self.model.correction, None if self.affine is None else self.affine.network
        constants = _Constants(
            h, (h / 2)[..., None], rate, (-2 * rate).expand(q0.shape), 1.0 + c_minus_1, c_minus_1, -root,
            J.expand(*q0.shape, q0.shape[-1]),
            None if N is None else Sweep(N.network, *more, h * N.energy),
            None if G is None else Sweep(G, *more, -h),
        )  # fmt: skip
        self._key, self._constants = (h, q0.shape), constants
        return constants


class StepOfModel:
    """The step equation of a model at (q0, p0, s0); see the head of this module."""

    def __init__(
        self,
        maker: ModelEquation,
        q0: Tensor,
        p0: Tensor,
        s0: Tensor,
        constants: _Constants,
        u: Tensor | None,
        increments: bool,
        here: Field | None,
    ):
        self.maker, self.q0, self.p0, self.s0, self.u = maker, q0, p0, s0, u
        self.constants, self.increments = constants, increments
        self.here = maker.field(q0) if here is None else here
        self.there: Field | None = None  # the potential at q1, after `end`
        a = torch.addcmul(p0, constants.half, self.here.slope, value=-1)  # p0 − h/2 V0′
        self.a = a if maker.affine is not None else constants.c[..., None] * a
        self.A = s0 - constants.half[..., 0] * self.here.V

    def __call__(self, x: Tensor, second: bool) -> Point:
        """See `Equation`."""
        k, maker = self.constants, self.maker
        v = (x if self.increments else x - self.q0) * k.rate
        mv = v if v.shape[-1] == 1 else v @ maker.mass  # C₁₁ = 1
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
        """See `Equation`."""
        damping = point.rest[3]
        return (self.constants.c if damping is None else damping[0])[..., None] * self.p0

    def end(self, x: Tensor, point: Point) -> End:
        """See `Equation`."""
        k, maker = self.constants, self.maker
        v, mv, N, damping, force = point.rest
        there = self.there = maker.field(self.q0 + x if self.increments else x)
        half = k.half[..., 0]
        if damping is None:
            c, L, impulse = k.c.expand(self.s0.shape), k.c_minus_1 * self.A, -k.minus_root * mv
            K = (mv * v).sum(-1) * -(k.minus_root[..., 0] * half)  # √c h/2 v·mv
        else:
            c, c_minus_1, root, alpha, D2g = damping
            L, impulse = c_minus_1 * self.A, torch.addcmul(alpha[..., None] * D2g(), root, mv)
            K = (mv * v).sum(-1) * (root[..., 0] * half)
        L = L + K - half * (self.here.V + there.V)
        p1 = torch.addcmul(impulse, k.half, there.slope, value=-1)
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
        if not second:
            value, g, _ = sweep(y)
            weighted = g * w
            return _Slopes(value, weighted @ frame.to_q0, weighted, None)
        n = self.q0.shape[-1]
        lift = (n, *(1,) * (y.ndim - 1))
        value, g, dg = sweep(y, w * frame.tangent.reshape(*lift, 3 * n))
        assert dg is not None
        weighted = g * w
        rows = torch.addcmul((dg * w) @ frame.to_q0, (g * y) @ frame.bend, frame.eye.reshape(*lift, n))
        return _Slopes(value, weighted @ frame.to_q0, weighted, rows.movedim(0, -1))

    def _affine(
        self,
        damping: AffineDamping,
        v: Tensor,
        mv: Tensor,
        features: tuple[Tensor, Tensor] | None,
        second: bool,
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


def model_equation(L_d: DiscreteLagrangian) -> ModelEquation | None:
    """The step equations of L_d by terms, or None where only its partials know them."""
    if type(L_d) is not ContactLagrangian or L_d.action is not None or not L_d.config.baseline:
        return None
    if type(L_d.kinetic) is not Kinetic or type(L_d.damping) not in (LinearDamping, AffineDamping, type(None)):
        return None
    return ModelEquation(L_d)
