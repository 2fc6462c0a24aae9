"""A user's own L_d in place of a model, with the attributes that fits, exports and files read."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from types import SimpleNamespace
from typing import Any, cast

import torch
from torch import Tensor, nn

from herglotz.errors import InputError
from herglotz.mechanics import ClosedForm, DiscreteLagrangian, Driven, Forced, Partials
from herglotz.mechanics.partials import check_function, functional_partials
from herglotz.models.capabilities import Capabilities, DrivenLagrangian

# The terms of a user's L_d are unknown: every step iterates, and s may enter the motion.
UNKNOWN = Capabilities(
    order=2, baseline=False, constant_mass=False, constant_c=False, known_damping=False, correction=True,
    action_flow=True, nonlinear_force=False, sticking=False, coupling=False,
)  # fmt: skip


@dataclass(frozen=True)
class OwnConfig:
    """The description of a user's L_d, in the names of `ModelConfig`.

    `name` is that of the class or function. The level is "forced" for an L_d with forces, whose map is no contact map.
    """

    name: str
    angles: tuple[bool, ...]  # (n,)
    scale: tuple[float, ...]  # (n,) typical sizes of q
    speed: tuple[float, ...]  # (n,) typical sizes of q̇
    inputs: int = 0
    level: str = "full"
    baseline: bool = False
    absent: tuple[str, ...] = ()
    order: int = 2

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return len(self.angles)

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)


class OwnLagrangian(nn.Module):
    """L_d(q0, q1, s0, h) of a module or function, with the attributes of `ContactLagrangian`.

    Derivatives come from the module's own `partials`, or from `functional_partials`. A module with `at(u)` takes
    inputs, a module with `forces` has forces F⁻ and F⁺ (Lagrange–d'Alembert–Herglotz).

    Parameters
    ----------
    L_d
        A module whose parameters are all float32 or all float64, or a function of tensors.
    dof
        Number n of coordinates.
    inputs
        Number m of inputs; L_d then has `at(u)`.
    angles, scale, speed
        (n,) which coordinates are angles in rad, and typical sizes of q and q̇, in the data's units.

    Raise InputError if L_d is no function, or lacks `at(u)`.
    """

    friction = damping = kinetic = correction = None
    potential = SimpleNamespace(network=None, features=None)
    named_terms = ()
    capabilities = UNKNOWN
    # A fit may find that the motion does not depend on s (`herglotz.training.own_fit`).
    s_enters_motion = True

    def __init__(
        self,
        L_d: DiscreteLagrangian,
        dof: int,
        *,
        inputs: int = 0,
        angles: tuple[bool, ...] = (),
        scale: tuple[float, ...] = (),
        speed: tuple[float, ...] = (),
    ):
        super().__init__()
        check_own(L_d, inputs)
        self.L_d = L_d
        forced = isinstance(L_d, Forced) or (inputs and isinstance(cast(Driven, L_d).at(torch.zeros(inputs)), Forced))
        one, none = (1.0,) * dof, (False,) * dof
        self.config = OwnConfig(
            _name_of(L_d), angles or none, scale or one, speed or one, inputs, "forced" if forced else "full"
        )
        # A function without parameters gets an empty parameter, which carries the dtype.
        if next(self.parameters(), None) is None:
            self.register_parameter("nothing", nn.Parameter(torch.empty(0, dtype=torch.float64), requires_grad=False))

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return self.config.dof

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.config.inputs

    def at(self, u: Tensor) -> DrivenLagrangian:
        """The discrete Lagrangian of a step with the inputs u, (..., m)."""
        check_own(self.L_d, 1)
        return DrivenLagrangian(self, u)

    def forward(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 0, u: Tensor | None = None
    ) -> Tensor | Partials:
        """L_d, shape (...); with `order` 1 or 2 its `Partials`, so that functional_call reaches both."""
        if order:
            return self.partials(q0, q1, s0, h, order, u)
        return self._driven(u)(q0, q1, s0, h)

    def partials(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float, order: int = 1, u: Tensor | None = None
    ) -> Partials:
        """L_d with its derivatives up to this order, as `herglotz.mechanics.partials` returns them."""
        L_d, h = self._driven(u), torch.as_tensor(h, dtype=q0.dtype, device=q0.device)
        if isinstance(L_d, ClosedForm):
            return L_d.partials(q0, q1, s0, h, order)
        return functional_partials(L_d, q0, q1, s0, h, order)

    def partials_increment(
        self, q0: Tensor, delta: Tensor, s0: Tensor, h: Tensor, order: int = 1, u: Tensor | None = None
    ) -> Partials:
        """`partials` at (q0, q0 + Δ, s0); L_d subtracts q0 again, which rounds short steps in float32."""
        return self.partials(q0, q0 + delta, s0, h, order, u)

    def forces(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, u: Tensor | None = None
    ) -> tuple[Tensor, Tensor] | None:
        """F⁻ and F⁺, each (..., n), in units of momentum; None for an L_d without forces."""
        L_d = self._driven(u)
        return L_d.forces(q0, q1, s0, h) if isinstance(L_d, Forced) else None

    def typical_increment(self, h: Tensor) -> Tensor:
        """The size of q1 − q0 at the typical speed, shaped like h."""
        return h * max(self.config.speed)

    def _driven(self, u: Tensor | None) -> DiscreteLagrangian:
        """The user's L_d of a step with the inputs u; without inputs the L_d itself."""
        return self.L_d if u is None else cast(Driven, self.L_d).at(u)


def check_own(L_d: Any, inputs: int) -> None:
    """Raise InputError if L_d is no discrete Lagrangian, or has inputs and no `at(u)`."""
    check_function(L_d, "model")
    if inputs and not isinstance(L_d, Driven):
        raise InputError(
            f"{_name_of(L_d)} takes no inputs, and the data have some: give it a method `at(u)` that returns the L_d "
            "of a step with input u (..., m), or leave the inputs out (inputs=())"
        )


def _name_of(L_d: Any) -> str:
    """The name of a function or of a module's class."""
    return getattr(L_d, "__name__", type(L_d).__name__)


def own_name(model: Any) -> str | None:
    """The name of a user's L_d; None for a model of the package."""
    return model.config.name if isinstance(model, OwnLagrangian) else None


def refuse_own(model: Any, what: str, instead: str) -> None:
    """Raise InputError if the model is a user's L_d, whose terms are unknown: `what` is made of a model's terms."""
    if isinstance(model, OwnLagrangian):
        raise InputError(
            f"there is no {what} of {model.config.name}, an L_d of your own, whose terms herglotz does not know; "
            f"{instead}"
        )
