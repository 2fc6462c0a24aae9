"""The settings of a learnable model: level of the ladder, terms and sizes, as plain numbers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from herglotz.choices import LEVELS as LEVELS
from herglotz.errors import InputError, refuse
from herglotz.models.drag import parse_drag
from herglotz.models.features import expand, parse
from herglotz.models.network import ACTIVATIONS
from herglotz.models.term import check_terms
from herglotz.models.translations import check_translations
from herglotz.schema import from_plain

# Powers of s that L may have beside −γ s, by name.
POWERS = {"s^2": 2, "s^3": 3}


@dataclass(frozen=True)
class ModelConfig:
    """All settings of a model, as plain numbers that JSON stores.

    Parameters
    ----------
    angles
        (n,) whether each coordinate is an angle in rad.
    level
        Level of the ladder: conservative, linear, affine, full or forced.
    scale, speed
        (n,) typical sizes of q and v, in the units of the data.
    stiffness, tilt, rate
        Starting values of the baseline: kᵢ and bᵢ of V (n,), in units of 1/time² and of the coordinate over time² at a
        first mass of 1, and the damping rate γ, in units of 1/time (`docs/trajectory.md`, section 4).
    potential_width, potential_depth
        Units and layers of the network in V; a width of 0 leaves a network out.
    damping_width
        Units of the network in the damping, at the levels affine and full.
    correction_width, correction_depth
        Units and layers of the correction N of a step.
    baseline
        Without a baseline the correction is all of L_d, to show why a baseline is needed (trap 2).
    seed, activation
        Seed of the networks' first weights; activation, one of `herglotz.models.network.ACTIVATIONS`.
    mass_width, mass_depth
        Units and layers of the network in a mass that depends on position; 0: a constant mass.
    action_width
        Units of the network in s, at the level full.
    dissipation
        Powers of s that L has beside −γ s, "s^2" and "s^3", at the forced level and, in place of networks, at the level
        full.
    coulomb, sticking
        Dry friction of each joint beside viscous friction (forced); set-valued: a joint can stand still.
    inputs, input_map, input_zero
        Number m of inputs; the map to forces, n · m numbers row by row in units of force (mass 1) over input, learned
        if left out; whether each input has a learned zero.
    features, known
        Terms of L with learned coefficients, and known terms, as text (`herglotz.models.features`).
    alike, diagonal
        One mass for all coordinates and a potential of features alone; a diagonal mass matrix.
    coupled, drag
        Friction of velocity differences; further forces such as "|v1| v1", "u1 cos(q1)" and "u1^2 v1" of an input
        (`herglotz.models.drag`). Both need the forced level.
    order
        Order of the rule, 2 or 4; at 4 L_d has the error term of the rule, from the features
        (`herglotz.models.order4`). Forces stay of order 2.
    terms
        Further parts of V and of the forces, by their names in `herglotz.models.TERMS`.
    translations
        Symmetries of L_d, named by the coordinates that move together ("q1 + q2"): L_d does not depend on where these
        coordinates are, and the rest of the baseline is not learned (`herglotz.models.translations`).
    absent
        Numbers of the model that are fixed at 0, as `numbers_of` names them: "potential.tilt[0]".

    Raises
    ------
    InputError
        If a value is out of range, lengths differ, or settings exclude one another.
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
    dissipation: tuple[str, ...] = ()
    coulomb: bool = False
    sticking: bool = False
    inputs: int = 0
    input_map: tuple[float, ...] = ()
    input_zero: bool = False
    features: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    alike: bool = False
    diagonal: bool = False
    coupled: bool = False
    drag: tuple[str, ...] = ()
    order: int = 2
    terms: tuple[str, ...] = ()
    translations: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()

    def __post_init__(self):
        for name, value in vars(self).items():
            if isinstance(value, list):
                # A configuration can then be a key.
                object.__setattr__(self, name, tuple(value))
        self._check_sizes()
        self._check_forces()
        self._check_structure()
        self._check_features()
        check_terms(self)
        check_translations(self)

    def _check_sizes(self) -> None:
        n = len(self.angles)
        activations = ", ".join(ACTIVATIONS)
        refuse({
            f"unknown level '{self.level}'; choose one of {', '.join(LEVELS)}": self.level not in LEVELS,
            f"unknown activation '{self.activation}'; choose one of {activations}": self.activation not in ACTIVATIONS,
            "a model without a baseline needs a correction network; set correction_width > 0":
                not self.baseline and not self.correction_width,
            "a model without a baseline has no mass; set mass_width=0": not self.baseline and self.mass_width,
            "a model without a baseline has no powers of s; leave dissipation out":
                not self.baseline and self.dissipation,
            **{f"{name} needs one number a coordinate ({n}), got {getattr(self, name)}": len(getattr(self, name)) != n
               for name in ("scale", "speed", "stiffness", "tilt")},
            f"the full level needs action_width >= 1, got {self.action_width}; or take level='affine'":
                self.level == "full" and self.action_width < 1,
            f"dissipation names the powers of s in L, {', '.join(POWERS)}; got {', '.join(self.dissipation)}":
                not set(self.dissipation) <= set(POWERS),
            f"dissipation is of L in s; set level='full' or 'forced', not '{self.level}'":
                self.dissipation and self.level not in ("full", "forced"),
            "set-valued friction stands in no model with powers of s; leave sticking or dissipation out":
                self.dissipation and self.sticking,
        })  # fmt: skip

    def _check_forces(self) -> None:
        forced, wanted = self.level == "forced", self.dof * self.inputs
        instead = f"set level='forced', not '{self.level}'"
        drag = {text: parse_drag(text, self.angles) for text in (self.drag if forced else ())}
        dry = [text for text, f in drag.items() if f.dry]
        beyond = [text for text, f in drag.items() if f.input is not None and f.input >= self.inputs]
        refuse({
            f"drag '{', '.join(dry)}' is of dry friction; set coulomb=True": dry and not self.coulomb,
            f"drag '{', '.join(beyond)}': the model has {self.inputs} input{'' if self.inputs == 1 else 's'}, counted "
            "from u1; name one that it has, or give it more inputs": beyond,
            f"coulomb and inputs are forces; {instead}":
                not forced and (self.coulomb or self.inputs or self.input_map),
            "sticking is of dry friction; set coulomb=True": self.sticking and not self.coulomb,
            f"coupled is friction between joints; {instead}": self.coupled and not forced,
            f"drag is a friction force; {instead}": self.drag and not forced,
            "input_zero is the zero of inputs; set inputs to their number": self.input_zero and not self.inputs,
            f"inputs counts the motors and cannot be negative, got {self.inputs}": self.inputs < 0,
            f"input_map needs n · inputs = {wanted} numbers, row by row; got {len(self.input_map)}":
                self.input_map and len(self.input_map) != wanted,
        })  # fmt: skip

    def _check_structure(self) -> None:
        refuse({
            f"order must be 2 or 4, got {self.order}": self.order not in (2, 4),
            "order 4 is for features, without networks, at the levels conservative, linear and forced":
                self.order == 4 and (self.networks or self.dissipation),
            "a model without a baseline has no features; leave features, known, alike, diagonal out":
                not self.baseline and (self.features or self.known or self.alike or self.diagonal),
            "a mass that depends on position is not diagonal; set mass_width=0 or diagonal=False":
                self.diagonal and self.mass_width,
        })  # fmt: skip

    def _check_features(self) -> None:
        products = {text: parse(text, self.angles) for text in expand((*self.features, *self.known), self.angles)}
        for text, feature in products.items():
            constant = not any(p.power or p.degree or any(p.form) or p.velocities for p in feature)
            refuse({
                f"feature '{text}': a constant moves nothing at the level '{self.level}'; leave it out":
                    constant and self.level not in ("affine", "full"),
                f"feature '{text}': order 4 takes at most two velocities a product; set order=2":
                    self.order == 4 and max(len(p.velocities) for p in feature) > 2,
                f"feature '{text}': order 4 takes no power beside a wave; set order=2":
                    self.order == 4 and any(p.degree for p in feature),
            })  # fmt: skip
        alone = "alike" if self.alike else "translations" if self.translations else ""
        if self.order == 4 and alone and all(feature[0].velocities for feature in products.values()):
            raise InputError(f"order 4 with {alone} needs features of the position; name some, or set order=2")

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return len(self.angles)

    @property
    def networks(self) -> bool:
        """Whether any part is a network, whose starting weights are drawn."""
        widths = self.potential_width or self.mass_width or self.correction_width
        in_s = self.level == "affine" or (self.level == "full" and not self.dissipation)
        return bool(widths) or not self.baseline or in_s

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ModelConfig:
        """Inverse of `to_dict`; unknown keys are an error."""
        return from_plain(cls, values)
