"""What a learnable model is made of: its level of the ladder, its terms and their sizes, as plain numbers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from herglotz.errors import InputError
from herglotz.models.network import ACTIVATIONS
from herglotz.settings import from_plain

LEVELS = ("conservative", "linear", "affine", "full", "forced")


@dataclass(frozen=True)
class ModelConfig:
    """Everything that is needed to build a model; plain numbers, so that it can be stored as JSON.

    `scale` and `speed` are typical sizes of q and v (data units); `stiffness`, `tilt` and `rate` start the
    baseline.
    A width of 0 leaves that network out; `mass_width` > 0 makes the mass depend on position, `action_width` counts the
    units of the full level, `coulomb` adds dry friction to the forced level's viscous one, and its `inputs` act through
    a learned matrix or through `input_map` (n · m numbers, row by row).
    Without a `baseline` the correction is the whole of A: no kinetic term, no
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
    activation: str = "tanh"
    mass_width: int = 0
    mass_depth: int = 1
    action_width: int = 4
    coulomb: bool = False
    inputs: int = 0
    input_map: tuple[float, ...] = ()

    def __post_init__(self):
        if self.level not in LEVELS:
            raise InputError(f"unknown level '{self.level}'; choose one of {', '.join(LEVELS)}")
        if self.activation not in ACTIVATIONS:
            raise InputError(f"unknown activation '{self.activation}'; choose one of {', '.join(ACTIVATIONS)}")
        if not self.baseline and not self.correction_width:
            raise InputError("a model without a baseline needs a correction network; set correction_width > 0")
        if not self.baseline and self.mass_width:
            raise InputError("a model without a baseline has no mass; set mass_width=0")
        for name in ("scale", "speed", "stiffness", "tilt"):
            if len(getattr(self, name)) != len(self.angles):
                given = getattr(self, name)
                raise InputError(f"{name} needs one number a coordinate ({len(self.angles)}), got {given}")
        if self.level == "full" and self.action_width < 1:
            raise InputError(f"the full level needs action_width >= 1, got {self.action_width}; or take level='affine'")
        if self.level != "forced" and (self.coulomb or self.inputs or self.input_map):
            raise InputError(f"coulomb and inputs are forces; set level='forced', not '{self.level}'")
        if self.inputs < 0:
            raise InputError(f"inputs counts the motors and cannot be negative, got {self.inputs}")
        if self.input_map and len(self.input_map) != self.dof * self.inputs:
            wanted = self.dof * self.inputs
            raise InputError(f"input_map needs n · inputs = {wanted} numbers, row by row; got {len(self.input_map)}")

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
