"""The learnable discrete contact Lagrangian: a sum of terms chosen by a level of the ladder."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.errors import InputError
from herglotz.mechanics import Partials
from herglotz.models.jet import Jet
from herglotz.models.terms import AffineDamping, Correction, Kinetic, LinearDamping, Potential
from herglotz.settings import from_plain

LEVELS = ("linear", "affine")


@dataclass(frozen=True)
class ModelConfig:
    """Everything that is needed to build a model; plain numbers, so that it can be stored as JSON.

    `scale` and `speed` are typical sizes of q and v (data units); `stiffness`, `tilt` and `rate` start the
    baseline.
    A width of 0 leaves that network out. Without a `baseline` the correction is the whole of A: no kinetic term, no
    potential; it is there to show why a baseline is needed (trap 2).
    """

    angles: tuple[bool, ...] = (True,)
    level: str = "linear"
    scale: tuple[float, ...] = (1.0,)
    speed: tuple[float, ...] = (1.0,)
    stiffness: tuple[float, ...] = (1.0,)
    tilt: tuple[float, ...] = (0.0,)
    rate: float = 0.1
    potential_width: int = 8
    potential_depth: int = 1
    damping_width: int = 8
    correction_width: int = 0
    correction_depth: int = 2
    baseline: bool = True
    seed: int = 0

    def __post_init__(self):
        if self.level not in LEVELS:
            raise InputError(f"unknown level '{self.level}'; choose one of {', '.join(LEVELS)}")
        if not self.baseline and not self.correction_width:
            raise InputError("a model without a baseline needs a correction network; set correction_width > 0")
        for name in ("scale", "speed", "stiffness", "tilt"):
            if len(getattr(self, name)) != len(self.angles):
                given = getattr(self, name)
                raise InputError(f"{name} needs one number a coordinate ({len(self.angles)}), got {given}")

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return len(self.angles)

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ModelConfig:
        """Inverse of `to_dict`; unknown keys are an error."""
        return from_plain(cls, values)


@dataclass(frozen=True)
class Terms:
    """The jets a model is made of at one set of points, for reports and tests."""

    g: Tensor | Jet
    K: Jet | None
    V0: Jet | None
    V1: Jet | None
    N: Jet | None


class ContactLagrangian(nn.Module):
    """L_d = (c − 1)(s0 − h/2 V0) + √c K − h/2 (V0 + V1) + N with c = e^g.

    A discrete Lagrangian for `herglotz.mechanics`: call it for the value, `partials` for closed-form derivatives.
    Every step h is allowed, and may differ from sample to sample.

    Parameters
    ----------
    config
        Which terms, their sizes and their starting values.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        make = torch.Generator().manual_seed(config.seed)
        c = config
        self.kinetic = Kinetic(c.dof)
        self.potential = Potential(
            c.angles, c.scale, c.speed, c.stiffness, c.tilt, c.potential_width, c.potential_depth, make
        )
        if c.level == "linear":
            self.damping: LinearDamping | AffineDamping = LinearDamping(c.rate)
        else:
            self.damping = AffineDamping(c.rate, c.angles, c.scale, c.speed, c.damping_width, 1, make)
        self.correction = (
            Correction(c.angles, c.scale, c.speed, c.correction_width, c.correction_depth, make, alone=not c.baseline)
            if c.correction_width
            else None
        )

    @property
    def s_enters_motion(self) -> bool:
        """Whether the positions depend on s at all (they do not at the linear level)."""
        return not self.damping.constant

    @property
    def linear_in_q1(self) -> bool:
        """Whether the step equation is linear in q1, so that one Newton step solves it (leapfrog)."""
        return self.damping.constant and self.correction is None

    def terms(self, q0: Tensor, q1: Tensor, h: Tensor, order: int) -> Terms:
        """Evaluate every term once."""
        n = q0.shape[-1]
        g = self.damping(q0, q1, h, order)
        N = None if self.correction is None else self.correction(q0, q1, h, order)
        if not self.config.baseline:
            return Terms(g, None, None, None, N)
        V = self.potential(torch.stack([q0, q1]), order)  # both ends in one network call
        return Terms(
            g=g,
            K=self.kinetic(q0, q1, h, order),
            V0=Jet(V.data[:, 0], n, order).embed(2 * n, 0),
            V1=Jet(V.data[:, 1], n, order).embed(2 * n, n),
            N=N,
        )

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float, order: int = 1) -> Partials:
        """Value and derivatives in closed form; see `herglotz.mechanics.partials`."""
        q0, q1, s0 = torch.broadcast_tensors(q0, q1, s0[..., None])
        s0 = s0[..., 0]
        h = torch.as_tensor(h, dtype=q0.dtype, device=q0.device).expand(s0.shape)
        t = self.terms(q0, q1, h, order)
        c = t.g.exp()
        if t.K is None or t.V0 is None or t.V1 is None:
            assert t.N is not None  # checked by ModelConfig
            L = t.N + (c - 1.0) * s0
        else:
            L = (c - 1.0) * (s0 - h / 2 * t.V0) + (t.g / 2).exp() * t.K - h / 2 * (t.V0 + t.V1)
            L = L if t.N is None else L + t.N
        return _partials(L, t.g, c, q0.shape[-1], s0)

    def forward(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 0) -> Tensor | Partials:
        """L_d, shape (...); with `order` 1 or 2 its `Partials` (so that functional_call reaches both)."""
        return self.partials(q0, q1, s0, h, order) if order else self.partials(q0, q1, s0, h, 1).L


def _partials(L: Jet, g: Tensor | Jet, c: Tensor | Jet, n: int, s0: Tensor) -> Partials:
    """Split the jet over (q0, q1) into the blocks of `Partials`; L_d is affine in s0, so D3 = c − 1."""
    gradient = L.gradient.movedim(0, -1)
    zero = torch.zeros_like(gradient[..., :n])
    D3 = torch.expm1(g.value if isinstance(g, Jet) else g).expand(s0.shape)
    first = {"L": L.value, "D1": gradient[..., :n], "D2": gradient[..., n:], "D3": D3}
    if L.order == 1:
        return Partials(**first)
    H = L.hessian().movedim((0, 1), (-2, -1))
    dc = c.gradient.movedim(0, -1) if isinstance(c, Jet) else torch.cat([zero, zero], -1)
    return Partials(
        **first,
        D11=H[..., :n, :n],
        D12=H[..., :n, n:],
        D22=H[..., n:, n:],
        D13=dc[..., :n],
        D23=dc[..., n:],
        D33=torch.zeros_like(D3),
    )
