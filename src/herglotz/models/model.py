"""The learnable discrete contact Lagrangian: a sum of terms chosen by a level of the ladder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from herglotz.errors import InputError
from herglotz.mechanics import Forces, Partials
from herglotz.models.action import ActionFlow, ActionPowers
from herglotz.models.capabilities import Capabilities, DrivenLagrangian
from herglotz.models.config import ModelConfig
from herglotz.models.drag import Drag, parse_drag
from herglotz.models.feature_potential import baseline_is_named
from herglotz.models.friction import CoupledFriction, Friction
from herglotz.models.jet import Jet, affine, coordinates
from herglotz.models.order4 import Slope, missing
from herglotz.models.term import TERMS, Term, with_force
from herglotz.models.terms import (
    AffineDamping,
    Correction,
    Kinetic,
    LinearDamping,
    Phase,
    PositionKinetic,
    Potential,
    kinetic_term,
)

# A step that stands for h → 0, in typical times scale/speed: damping is negligible, and 1/h² is finite in float32.
VANISHING_STEP = 2.0**-50


def numbers_of(model: ContactLagrangian) -> dict[str, tuple[str, int]]:
    """Name, parameter and entry of every number that a model learns: `damping.rate`, `friction.viscous[1]`.

    The order is that of the parameters. The springs and tilts of the baseline have the same names at both orders of
    the rule; at order 4 the first features stand for them, −k and b of an angle, k/2 and b of a length.
    """
    own, n = baseline_is_named(model.config), model.config.dof
    found = {}
    for parameter, value in model.named_parameters():
        for i in range(value.numel()):
            name, at, size = parameter, i, value.numel()
            if own and parameter == "potential.features.sum.coefficient":
                if i < 2 * n:
                    name, at, size = ("potential.tilt" if i % 2 else "potential.stiffness"), i // 2, n
                else:
                    at, size = i - 2 * n, size - 2 * n
            found[name if size == 1 else f"{name}[{at}]"] = parameter, i
    return found


def listed(numbers: Iterable[str]) -> str:
    """Names of numbers for an error message, without the hundreds of weights of networks."""
    return ", ".join(name for name in numbers if ".network." not in name)


@dataclass(frozen=True)
class Terms:
    """The jets of a model's terms at a set of points, for reports and tests; None for a term that the model lacks."""

    g: Tensor | Jet | None
    K: Jet | None
    V0: Jet | None
    V1: Jet | None
    N: Jet | None
    b: Jet | None  # (..., J) offsets of the full level's units, from q̄ and v


class ContactLagrangian(nn.Module):
    """L_d = (c − 1)(s0 − h/2 V0) + √c K − h/2 (V0 + V1) + N with c = e^g.

    * conservative: c = 1; nothing depends on s.
    * linear: g = −γh. forced: the same, with friction and inputs as discrete forces (`Friction`).
    * affine: g depends on position and velocity.
    * full: the map of s over a step is half a step of `ActionFlow`, e^{g/2}, + K, e^{g/2}, and the flow's other half.
    * full and forced with `dissipation`: the same with `ActionPowers`, g = −γh and the work of inputs in L. Other
      forces then have the weight 1 + D3 in place of c.

    The model is a discrete Lagrangian for `herglotz.mechanics`: a call returns the value, `partials` the closed-form
    derivatives. Every step h is allowed, and may differ from sample to sample.

    Positions do not determine L_d (gauge): s′ = f(q, s) gives the same motion. The mass's first entry is fixed at 1,
    which leaves s′ = s + b(q) — within the span of the terms — and a constant shift of s. Only priors fix these two.
    Source: traps 2, 3 and 4 of `docs/mathematics.md`.

    Parameters
    ----------
    config
        The terms, their sizes and their starting values.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = c = config
        make = torch.Generator().manual_seed(c.seed)
        potential, damping = Potential(c, make), _damping(c, make)
        correction = Correction(c, make) if c.correction_width else None
        # The kinetic term draws its weights after the others, but stands first among the parameters.
        self.kinetic = kinetic_term(c, make)
        self.potential, self.damping, self.correction = potential, damping, correction
        self.action = _action(c, make)
        self.friction = Friction(c) if c.level == "forced" else None
        self.coupling = CoupledFriction(c) if c.coupled and c.dof > 1 else None
        self.drag = Drag([parse_drag(text, c.angles) for text in c.drag], c.dof) if c.drag else None
        self.more = nn.ModuleList(TERMS[name](c) for name in c.terms)
        self.potential.more = tuple(self.named_terms)
        self._leave_out(c.absent)

    def _leave_out(self, absent: Sequence[str]) -> None:
        """Set the `absent` numbers to 0; `herglotz.training.parameter_vector` leaves them out of a fit."""
        known = numbers_of(self)
        for name in absent:
            if name not in known:
                raise InputError(f"absent: the model has no number '{name}'; its numbers are {listed(known)}")
            parameter, i = known[name]
            self.get_parameter(parameter).data.view(-1)[i] = 0.0

    @property
    def named_terms(self) -> list[Term]:
        """The terms that the configuration names."""
        return [term for term in self.more if isinstance(term, Term)]

    @property
    def forces_between(self) -> list[Term]:
        """The terms whose force may depend on every velocity."""
        known = [] if self.coupling is None else [self.coupling]
        return known + [term for term in self.named_terms if term.has_force()]

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return self.config.dof

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.config.inputs

    @property
    def s_enters_motion(self) -> bool:
        """Whether the positions depend on s, as at the affine and full levels."""
        return self.capabilities.carries_s

    @property
    def capabilities(self) -> Capabilities:
        """The terms of the model, and properties of its steps."""
        return Capabilities(
            order=self.config.order,
            baseline=self.config.baseline,
            constant_mass=type(self.kinetic) is Kinetic,
            constant_c=self.action is None and (self.damping is None or self.damping.constant),
            known_damping=type(self.damping) in (LinearDamping, AffineDamping, type(None)),
            correction=self.correction is not None,
            action_flow=self.action is not None,
            nonlinear_force=(self.friction is not None and not self.friction.linear)
            or self.drag is not None
            or not all(term.linear for term in self.forces_between),
            sticking=self.friction is not None and self.friction.sticking,
            coupling=bool(self.forces_between) or self.drag is not None,
        )

    def terms(self, phase: Phase, instant: bool = False) -> Terms:
        """Evaluate every term once; in an `instant`, the limit h → 0, the potential is 0 and not evaluated."""
        order, n = phase.order, phase.q0.shape[-1]
        g = None if self.damping is None else self.damping(phase)
        N = None if self.correction is None else self.correction(phase)
        b = self.action.offsets(phase.features) if isinstance(self.action, ActionFlow) else None
        if not self.config.baseline:
            return Terms(g, None, None, None, N, b)
        K = self.kinetic(phase)
        if instant:
            return Terms(g, K, K * 0.0, K * 0.0, N, b)
        # One call of the network serves both ends.
        V = self.potential(torch.stack([phase.q0, phase.q1]), order)
        V0, V1 = Jet(V.data[:, 0], n, order).embed(2 * n, 0), Jet(V.data[:, 1], n, order).embed(2 * n, n)
        if self.config.order == 4:
            N = self._missing(phase, V0, V1)
        return Terms(g, K, V0, V1, N, b)

    def partials(
        self,
        q0: Tensor,  # (..., n)
        q1: Tensor,  # (..., n)
        s0: Tensor,  # (...)
        h: Tensor | float,
        order: int = 1,
        u: Tensor | None = None,  # (..., m)
    ) -> Partials:
        """Value and derivatives in closed form, see `herglotz.mechanics.partials`; without u no input acts."""
        q0, q1, s0 = torch.broadcast_tensors(q0, q1, s0[..., None])
        return self._evaluate(self._phase(q0, q1, s0[..., 0], h, order), s0[..., 0], u)

    def partials_increment(
        self, q0: Tensor, delta: Tensor, s0: Tensor, h: Tensor | float, order: int = 1, u: Tensor | None = None
    ) -> Partials:
        """`partials` at (q0, q0 + Δ, s0), without the rounding of q1 − q0 in a small step."""
        q0, delta, s0 = torch.broadcast_tensors(q0, delta, s0[..., None])
        return self._evaluate(self._phase(q0, q0 + delta, s0[..., 0], h, order, delta), s0[..., 0], u)

    def velocity_derivatives(
        self,
        q: Tensor,  # (..., n)
        v: Tensor,  # (..., n)
        s: Tensor,  # (...)
    ) -> tuple[Tensor, Tensor]:
        """Return p = L_v (..., n) and L_vv (..., n, n) of the model's L(q, v, s) = lim L_d(q, q + hv, s, h)/h, h → 0.

        L_v and L_vv are the limits of D2 L_d and h D22 L_d, evaluated at one tiny h: jets divide by h without
        subtracting, so nothing cancels.
        """
        h = torch.full_like(s, VANISHING_STEP * max(self.config.scale) / max(self.config.speed))
        phase = Phase(q, q, h, 2, self.config, v * h[..., None])
        P = self._assembled(self.terms(phase, instant=True), phase, s, None)
        return P.D2, P.D22 * h[..., None, None]

    def forces(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float, u: Tensor | None = None
    ) -> tuple[Tensor, Tensor] | None:
        """F⁻ and F⁺, each (..., n), in units of momentum; None except at the level forced."""
        if self.friction is None:
            return None
        force = self._evaluate(self._phase(q0, q1, s0, h, 1), s0, u).force
        assert force is not None
        return force.minus, force.plus

    def at(self, u: Tensor) -> DrivenLagrangian:
        """The discrete Lagrangian of a step with the inputs u, (..., m)."""
        if not self.config.inputs:
            raise InputError(
                "this model has no inputs: fit a recording that has input columns, or leave the inputs out"
            )
        return DrivenLagrangian(self, u)

    def typical_increment(self, h: Tensor) -> Tensor:
        """The size of q1 − q0 at the data's top speed, shaped like h: the unit of the networks' rounding.

        Networks do not vanish near rest as the motion does, so rounding leaves a J⁻¹F of some eps of this size.
        """
        return h * max(self.config.speed)

    def forward(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 0, u: Tensor | None = None
    ) -> Tensor | Partials:
        """L_d, shape (...); with `order` 1 or 2 its `Partials`, so that functional_call reaches both."""
        if not order:
            return self.partials(q0, q1, s0, h, 1).L
        return self.partials(q0, q1, s0, h, order, u)

    def _phase(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float, order: int, delta: Tensor | None = None
    ) -> Phase:
        h = torch.as_tensor(h, dtype=q0.dtype, device=q0.device).expand(s0.shape)
        return Phase(q0, q1, h, order, self.config, delta)

    def _evaluate(self, phase: Phase, s0: Tensor, u: Tensor | None) -> Partials:
        terms, friction, own = self.terms(phase), self.friction, u
        if self.action is not None and friction is not None and u is not None:
            terms, own = self._driven(terms, phase, friction.applied(u)), None
        return self._assembled(terms, phase, s0, self._forces(phase, own, u))

    def _driven(self, t: Terms, phase: Phase, f: Tensor) -> Terms:
        """The terms with the potential −f·q of the inputs' force f (..., n), so that L has the work of the inputs."""
        assert t.V0 is not None
        assert t.V1 is not None
        n, order = self.dof, phase.order
        before, after = ((coordinates(q, order) * f).sum() for q in (phase.q0, phase.q1))
        return replace(t, V0=t.V0 - before.embed(2 * n, 0), V1=t.V1 - after.embed(2 * n, n))

    def _assembled(self, t: Terms, phase: Phase, s0: Tensor, force: Forces | None) -> Partials:
        h = phase.h
        if self.action is not None:
            P = action_partials(self._through_action(self.action, t, s0, h, phase.order))
            return P if force is None else replace(P, force=force.weighted(P))
        c = None if t.g is None else t.g.exp()
        if t.K is None or t.V0 is None or t.V1 is None:
            # ModelConfig has checked that there is a correction.
            assert t.N is not None
            L = t.N if c is None else t.N + (c - 1.0) * s0
        else:
            V = h / 2 * (t.V0 + t.V1)
            L = t.K - V if c is None or t.g is None else (c - 1.0) * (s0 - h / 2 * t.V0) + (t.g / 2).exp() * t.K - V
            L = L if t.N is None else L + t.N
        return affine_partials(L, t.g, c, s0, force)

    def _through_action(self, action: ActionFlow | ActionPowers, t: Terms, s0: Tensor, h: Tensor, order: int) -> Jet:
        """L = s1 − s0 at the full level as a jet over (q0, q1, s0), built as a sum of increments of s."""
        size = 2 * self.dof + 1
        wide = lambda jet: None if jet is None else jet.embed(size, 0)  # noqa: E731
        s = affine(s0, torch.eye(size, dtype=s0.dtype, device=s0.device)[-1], order)
        K, V0, V1, N, b = map(wide, (t.K, t.V0, t.V1, t.N, t.b))
        assert t.g is not None
        root_less_1 = (t.g / 2).expm1()  # (...) √c − 1
        root_less_1 = root_less_1.embed(size, 0) if isinstance(root_less_1, Jet) else root_less_1
        gained = s * 0.0 if V0 is None else -h / 2 * V0
        gained = action(s, gained, b, h)
        gained = gained + root_less_1 * (s + gained)
        gained = gained if K is None else gained + K
        gained = gained + root_less_1 * (s + gained)
        gained = action(s, gained, b, h, backward=True)
        gained = gained if V1 is None else gained - h / 2 * V1
        return gained if N is None else gained + N

    def _missing(self, phase: Phase, V0: Jet, V1: Jet) -> Jet:
        """The correction that turns the rule of order 2 into a rule of order 4."""
        features, kinetic, damping = self.potential.features, self.kinetic, self.damping
        # ModelConfig has checked the three: there are features, at least the baseline's.
        assert features is not None
        assert not isinstance(kinetic, PositionKinetic)
        assert not isinstance(damping, AffineDamping)
        # γ = 0 is a constant, not a function of q0: ONNX treats matrices of samples and of the model differently.
        rate = torch.zeros((), dtype=phase.q0.dtype, device=phase.q0.device) if damping is None else damping.rate
        return missing(Slope(features, kinetic, rate, phase), V0, V1, (-rate * phase.h / 2).exp())

    def _forces(self, phase: Phase, own: Tensor | None, u: Tensor | None) -> Forces | None:
        """The forces, with G `own` of the inputs, and those of u that act through the position."""
        if self.friction is None:
            return None
        assert isinstance(self.damping, LinearDamping)
        h, v = phase.h, phase.move / phase.h[..., None]
        c = torch.ones_like(h) if self.action is not None else self.damping(phase).exp()
        smooth = self.friction.dry and not self.friction.sticking
        more = None if smooth or self.drag is None else self.drag.held(phase.q0)
        forces = self.friction(v, c, h, phase.order, own, more)
        for term in self.forces_between:
            forces = with_force(forces, *term.force(v), c, h)
        if self.drag is None:
            return forces
        widths = self.friction.widths[0] if smooth else None
        return self.drag((phase.q0 + phase.q1) / 2, v, c, h, forces, widths, u)


def _damping(config: ModelConfig, generator: torch.Generator) -> LinearDamping | AffineDamping | None:
    """The exponent g of c = e^g that a level has; None where c = 1."""
    if config.level == "conservative":
        return None
    linear = config.level in ("linear", "forced") or config.dissipation
    return LinearDamping(config.rate) if linear else AffineDamping(config, generator)


def _action(config: ModelConfig, generator: torch.Generator) -> ActionFlow | ActionPowers | None:
    """The map of s beside e^g: powers by name, or the full level's network."""
    if config.dissipation:
        return ActionPowers(config)
    return ActionFlow(config, generator) if config.level == "full" else None


def affine_partials(
    L: Jet,
    g: Tensor | Jet | None,
    c: Tensor | Jet | None,
    s0: Tensor,  # (...)
    force: Forces | None,
) -> Partials:
    """Return the blocks of an L_d that is affine in s0, from its jet over (q0, q1): D3 = c − 1 with c = e^g.

    A g of None means c = 1.
    """
    D3 = s0.new_zeros(()) if g is None else torch.expm1(g.value if isinstance(g, Jet) else g)
    D3 = D3.expand(s0.shape)
    gradient = L.gradient.movedim(0, -1)
    if L.order == 1:
        return _partials(L, gradient, D3, None, force)
    H = L.hessian().movedim((0, 1), (-2, -1))
    dc = c.gradient.movedim(0, -1) if isinstance(c, Jet) else torch.zeros_like(gradient)
    return _partials(L, gradient, D3, (H, dc, torch.zeros_like(D3)), force)


def action_partials(L: Jet) -> Partials:
    """Return the blocks of an L_d from its jet over the 2n + 1 variables (q0, q1, s0)."""
    gradient = L.gradient.movedim(0, -1)
    if L.order == 1:
        return _partials(L, gradient[..., :-1], gradient[..., -1], None)
    H = L.hessian().movedim((0, 1), (-2, -1))
    return _partials(L, gradient[..., :-1], gradient[..., -1], (H[..., :-1, :-1], H[..., :-1, -1], H[..., -1, -1]))


def _partials(
    L: Jet, by_q: Tensor, D3: Tensor, second: tuple[Tensor, Tensor, Tensor] | None, force: Forces | None = None
) -> Partials:
    """Return the blocks from ∂L/∂(q0, q1), D3, and `second`: (q0, q1) twice, mixed with s0, s0 twice."""
    n = by_q.shape[-1] // 2
    first = (L.value, by_q[..., :n], by_q[..., n:], D3)
    if second is None:
        return Partials(*first, force=force)
    H, mixed, D33 = second
    blocks = {"D11": H[..., :n, :n], "D12": H[..., :n, n:], "D22": H[..., n:, n:]}
    return Partials(*first, **blocks, D13=mixed[..., :n], D23=mixed[..., n:], D33=D33, force=force)
