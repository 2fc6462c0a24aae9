"""Named terms: the candidates of a search, and parameter values by the names of terms."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.models.drag import AIR
from herglotz.models.feature_potential import baseline_features, baseline_is_named
from herglotz.models.features import Product, lengths, parse, revolute
from herglotz.models.translations import differences, directions, unchanged
from herglotz.training.baseline import JITTER, Baseline
from herglotz.training.config import FitConfig
from herglotz.training.dictionary import KINKS, WEIGHTS, drag_of, features_of, in_proportion
from herglotz.training.parameter_vector import ParameterVector

# Minimum ratio of the smaller to the larger excursion from 0. Below it the data say nothing about a kink at 0.
MIN_EXCURSION_RATIO = 0.1
# A turn back shorter than 1/50 of a recording says little about dry friction.
PARTS_OF_RECORDING = 50
# Minimum distance over RMS distance. Closer to 0 the powers of r are no candidates.
MIN_DISTANCE_RATIO = 0.02
# These parameters hold the coefficients of features without and with velocities, of forces, and of powers of s.
STILL, MOVING, DRAG = "potential.features.sum.coefficient", "kinetic.sum.coefficient", "drag.coefficient"
IN_S = "action.coefficient"
# The parameter of dry friction, which is one term for all coordinates.
DRY = "friction.coulomb"
# The potential of a constant force on a length.
CONSTANT = "q1"


@dataclass(frozen=True)
class NamedTerms:
    """Terms of L and of the forces beside masses, stiffness, tilt and viscous friction.

    `dissipation` are powers of s in L, `absent` the numbers of the model that are 0. `one_rate`: several coordinates
    have one damping rate, by the contact form, and no forces. `springs`: each coordinate has the baseline's spring (not
    with translations). `apart`: joints have no constant mass and no viscous friction between them.
    """

    features: tuple[str, ...] = ()
    drag: tuple[str, ...] = ()
    dissipation: tuple[str, ...] = ()
    dry: bool = False
    one_rate: bool = False
    springs: bool = True
    apart: bool = False
    absent: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all terms."""
        return (*self.features, *self.drag, *self.dissipation, *((DRY,) if self.dry else ()))

    def joined(self, other: NamedTerms) -> NamedTerms:
        """These terms and the terms of `other`, each once."""
        return self._each(lambda name, own: dict.fromkeys(own + getattr(other, name)))

    def only(self, names: Collection[str]) -> NamedTerms:
        """The terms with one of these names."""
        return replace(self._each(lambda _, own: (x for x in own if x in names)), dry=self.dry and DRY in names)

    def _each(self, chosen: Callable[[str, tuple[str, ...]], Iterable[str]]) -> NamedTerms:
        """The terms with `chosen(kind, terms)` in place of the features, the drag and the powers of s."""
        kinds = ("features", "drag", "dissipation")
        return replace(self, **{name: tuple(chosen(name, getattr(self, name))) for name in kinds})


def candidates(
    data: Trajectories, translations: Sequence[str] = (), ratios: Mapping[tuple[int, int], str] | None = None
) -> NamedTerms:
    """The candidate terms for these coordinates; with translations only terms of L that they leave unchanged.

    `ratios` are those of coordinates of different units that move in proportion (`coupled_pairs.proportions`).
    """
    if translations:
        return _unmoved(data, directions(translations, data.angles))
    angles = data.angles
    features = tuple(_of_one(data)) if len(angles) == 1 else features_of(angles)
    # The length |v| of a velocity needs one unit.
    one_unit = len(set(data.units)) == 1
    gone = set() if one_unit else {AIR}
    # Over a motion one way |v| and v are one force, and so are v² and |v| v.
    one_way = [i for i in range(data.dof) if moves_one_way(data, i)]
    gone |= {form.format(i + 1) for i in one_way for form in ("|v{}|", "v{}^2")}
    drag = tuple(text for text in drag_of(angles) if text not in gone)
    features, drag = (in_proportion(texts, ratios or {}) for texts in (features, drag))
    return NamedTerms((*features, *special(data)), drag, dry=True)


def special(data: Trajectories) -> tuple[str, ...]:
    """Powers of the distance, kinks at 0 and weights: terms that are nearly collinear with the others."""
    return (*distances(data), *kinks(data), *weights(data))


def _of_one(data: Trajectories) -> list[str]:
    """Potentials of one coordinate, those of the baseline first; `special` ones are left out.

    With inputs no constant force on a length is a candidate, because the zero of the input gives this force.
    """
    own = own_terms(data.angles)
    every = (*own, *(name for name in features_of(data.angles) if name not in {*own, *KINKS, *WEIGHTS}))
    return [name for name in every if data.u is None or name != CONSTANT]


def turns_one_way(data: Trajectories, i: int) -> bool:
    """True if an angle never turns back for 1/50 of a recording: dry friction is then a constant force."""
    return data.angles[i] and moves_one_way(data, i)


def moves_one_way(data: Trajectories, i: int) -> bool:
    """True if a coordinate moves back for less than 1/50 of the recorded time, whatever its noise."""
    signs = []
    for one in data:
        lag = max(1, one.samples // PARTS_OF_RECORDING)
        signs.append((one.q[lag:, i] - one.q[:-lag, i]).sign())
    forth = torch.cat(signs)
    return float((forth * forth.sum().sign() <= 0).double().mean()) < 1 / PARTS_OF_RECORDING


def _unmoved(data: Trajectories, moved: Sequence[tuple[float, ...]]) -> NamedTerms:
    """Terms that are unchanged along the directions; no forces, which would change the momenta along the directions."""
    zero = (0.0,) * data.dof
    pairs = [f"{form}^{power}" for form in differences(data.angles, moved) for power in range(1, 5)]
    every = (*baseline_features(data.angles, zero, zero)[0], *pairs, *candidates(data).features)
    still = tuple(dict.fromkeys(text for text in every if unchanged(text, data.angles, moved)))
    return NamedTerms(still, one_rate=True, springs=False)


def distances(data: Trajectories) -> tuple[str, ...]:
    """Potentials of the distance r = |q|, if the coordinates have one unit of length and stay away from r = 0."""
    if any(data.angles) or data.dof < 2 or len(set(data.units)) > 1:
        return ()
    r = data.q.norm(dim=1)
    away = float(r.min()) > MIN_DISTANCE_RATIO * float(r.square().mean().sqrt())
    return tuple(name for name in lengths(data.angles) if name.startswith("r^")) if away else ()


def kinks(data: Trajectories) -> tuple[str, ...]:
    """Potentials of one length with a kink of the force at 0: |x| x (a spring stiffer on one side) and |x|³.

    A motion on one side of 0 cannot distinguish them from powers.
    """
    away, beyond = sorted((abs(float(data.q.min())), abs(float(data.q.max()))))
    crossed = float(data.q.min()) < 0 < float(data.q.max()) and away > MIN_EXCURSION_RATIO * beyond
    return KINKS if data.dof == 1 and not any(data.angles) and crossed else ()


def weights(data: Trajectories) -> tuple[str, ...]:
    """Potentials of the weight of a body that turns about a pivot, if one angle is taken for a position on a line.

    Of a pendulum with a torsion spring the potential has a square beside the cosine.
    """
    return WEIGHTS if data.angles == (False,) and data.units == ("rad",) else ()


def central(data: Trajectories, every: NamedTerms) -> list[NamedTerms]:
    """Families with one power of the distance each, and the friction and the forces across the velocity of `every`.

    Over most motions the powers of r are nearly collinear: a linear problem with all of them determines none.
    """
    across = tuple(x for x in every.features if "v" in x)
    of_r = distances(data) if every.springs else ()
    return [every.joined(NamedTerms((name,))).only((name, *across, *every.drag, DRY)) for name in of_r]


def chains(data: Trajectories) -> list[NamedTerms]:
    """Smaller families for joints: planar chains of links, in relative and in absolute angles, and joints with springs.

    In relative angles the mass M_ij depends on sums of the angles after joint i < j, the weight on sums of all angles
    up to a joint. In absolute angles M_ij depends only on q_i − q_j. If the chain hangs on slides, the mass between a
    slide and a joint depends on the angle of a link; in absolute angles there is no other coupling by mass or friction.
    Joints that only springs connect have potentials of q_i − q_j and no mass between them.
    """
    if data.dof < 2 or not any(data.angles):
        return []
    joints = [i for i, angle in enumerate(data.angles) if angle]
    across, every = _by_slides(data.angles)
    absolute = _where(lambda f: _form(f) == _difference(f), every) + _where(_of_own, across)
    if across and len(joints) == 1:
        return [NamedTerms(absolute, dry=True, apart=True)]
    between = _where(lambda f: _of_neighbours(f, joints), every) + _where(lambda f: _row(f, joints), across)
    turning = [NamedTerms(between, dry=True), NamedTerms(absolute, dry=True, apart=bool(across))]
    return turning if across else [*turning, NamedTerms(_where(_of_springs, every), dry=True, apart=True)]


def _where(rule: Callable[[Product], bool], terms: Sequence[tuple[str, Product]]) -> tuple[str, ...]:
    """The names of the terms that fulfil a rule."""
    return tuple(name for name, f in terms if rule(f))


def _of_springs(f: Product) -> bool:
    """True for a potential of the difference of two angles."""
    return not f.velocities and sorted(_form(f).values()) == [-1.0, 1.0]


def _by_slides(angles: Sequence[bool]) -> tuple[list[tuple[str, Product]], list[tuple[str, Product]]]:
    """The dictionary of joints in two parts: terms with the speeds of a slide and a joint, and of joints alone."""
    every = [(name, parse(name, angles)[0]) for name in revolute(angles)]
    across = [(name, f) for name, f in every if len({angles[i] for i in f.velocities}) == 2]
    return across, [(name, f) for name, f in every if all(angles[i] for i in f.velocities)]


def _form(f: Product) -> dict[int, float]:
    """The linear form of a term by coordinate, without zeros."""
    return {i: w for i, w in enumerate(f.form) if w}


def _row(f: Product, joints: Sequence[int]) -> bool:
    """True if the angle is the sum of all relative angles up to a joint: the absolute angle of a link."""
    return list(_form(f).items()) == [(i, 1.0) for i in joints[: len(_form(f))]]


def _of_own(f: Product) -> bool:
    """True if the only angle is that of the joint whose speed stands beside the speed of a slide."""
    return len(_form(f)) == 1 and set(_form(f)) <= set(f.velocities) and set(_form(f).values()) == {1.0}


def _of_neighbours(f: Product, joints: Sequence[int]) -> bool:
    """True if a chain has this term in relative angles: a sum of neighbouring angles."""
    on = [joints.index(i) for i in _form(f)]
    row = set(_form(f).values()) == {1.0} and on == list(range(on[0], on[-1] + 1))
    return row and on[0] == (joints.index(min(f.velocities)) + 1 if f.velocities else 0)


def _difference(f: Product) -> dict[int, float]:
    """The form q_i − q_j for the two speeds i < j of a term; {} without two speeds."""
    i, j = sorted(f.velocities) if len(set(f.velocities)) == 2 else (0, 0)
    return {} if i == j else {i: 1.0, j: -1.0}


def own_terms(angles: Sequence[bool]) -> dict[str, tuple[str, float]]:
    """The baseline's terms of a single coordinate as features, each with its parameter and factor; else {}."""
    if len(angles) > 1:
        return {}
    if angles[0]:
        return {"cos(q1)": ("potential.stiffness", -1.0), "sin(q1)": ("potential.tilt", 1.0)}
    return {"q1^2": ("potential.stiffness", 0.5), CONSTANT: ("potential.tilt", 1.0)}


def settings_of(terms: NamedTerms, data: Trajectories, config: FitConfig, order: int, substeps: int) -> FitConfig:
    """The settings of a model with these terms, beside the drag of the settings."""
    driven = data.u is not None and config.use_inputs
    forced = bool(terms.drag) or terms.dry or driven or (data.dof > 1 and not terms.one_rate)
    lengths, still = not any(data.angles), any("v" not in name for name in terms.features)
    # A model of order 4 without any potential would get the baseline's spring.
    order = order if still or (data.dof > 1 and not config.translations) else 2
    several, apart = data.dof > 1, lengths or terms.apart
    level = "forced" if forced else "full" if terms.dissipation else "linear"
    return replace(
        config, level=level, features=terms.features, coulomb=terms.dry,
        drag=tuple(dict.fromkeys((*terms.drag, *config.drag))),
        diagonal=several and apart, coupled=forced and several and not apart, order=2 if terms.dissipation else order,
        substeps=substeps, objective="trajectory", absent=terms.absent, dissipation=terms.dissipation,
        alike=data.dof == 1,
    )  # fmt: skip


def started(base: Baseline, data: Trajectories, values: dict, config: FitConfig) -> Baseline:
    """The baseline with starting `values`, by the name of a term or of a parameter, for a model of these settings."""
    rest = {name: x for name, x in values.items() if isinstance(x, tuple) and not name.startswith("potential.")}
    rate = rest.pop("damping.rate", (0.0,))[0]
    # Viscous friction of the first mass, which is 1, acts as the rate.
    if data.dof == 1 or config.level == "linear":
        rate += rest.pop("friction.viscous", (0.0,))[0]
    for parameter, names in holders(config.features, config.drag, config.dissipation).items():
        rest[parameter] = tuple(values.get(name, 0.0) for name in names)
    zero, rest = (0.0,) * data.dof, {own: x for name, x in rest.items() if x and (own := _name_in(config, name))}
    stiffness, tilt = values.get("potential.stiffness", zero), values.get("potential.tilt", zero)
    step = base.max_step if config.substeps == 1 else JITTER * data.typical_step / config.substeps
    return replace(base, stiffness=stiffness, tilt=tilt, rate=rate, start=rest, model_step=step)


def holders(features: Sequence[str], drag: Sequence[str] = (), dissipation: Sequence[str] = ()) -> dict[str, list[str]]:
    """The terms whose coefficients each of four parameters holds, in the order of the parameter."""
    still, moving = ([x for x in features if ("v" in x) == moves] for moves in (False, True))
    return {STILL: still, MOVING: moving, DRAG: list(drag), IN_S: list(dissipation)}


def by_term(start: Mapping[str, Tensor], terms: Mapping[str, Sequence[str]]) -> dict:
    """Values of parameters as plain numbers; coefficients by the names of their `terms`, as `holders` returns them."""
    values: dict = {name: tuple(x.reshape(-1).tolist()) for name, x in start.items()}
    for parameter, names in terms.items():
        values |= zip(names, values.pop(parameter, ()), strict=True)
    return values


def _name_in(config: FitConfig, name: str) -> str:
    """The name of a parameter in a model of these settings; "" if the model lacks the parameter."""
    if name.startswith("kinetic.") and name != MOVING:
        name = name.replace("kinetic.base.", "kinetic.")
        if config.diagonal and name == "kinetic.off_diagonal":
            return ""
        return name.replace("kinetic.", "kinetic.base.") if any("v" in x for x in config.features) else name
    if name.startswith("friction."):
        dry = name.removeprefix("friction.") in ("coulomb", "breakaway", "log_smooth", "log_stribeck")
        gone = (
            config.level != "forced"
            or (dry and not config.coulomb)
            or (config.sticking and name == "friction.log_smooth")
        )
        return "" if gone else name
    return "" if name == "coupling.viscous" and not config.coupled else name


def values_of(parameters: ParameterVector, theta: Tensor) -> dict:
    """Values by the name of a term, or as tuples by the name of a parameter."""
    named, config = parameters.unflatten(theta), parameters.model.config
    # As features the baseline's coefficients are −k, b for an angle and k/2, b for a length.
    if baseline_is_named(config):
        own, named[STILL] = named[STILL][: 2 * config.dof], named[STILL][2 * config.dof :]
        factor = own.new_tensor([-1.0 if angle else 2.0 for angle in config.angles])
        named |= {"potential.stiffness": own[::2] * factor, "potential.tilt": own[1::2]}
    return by_term(named, holders(config.features, config.drag, config.dissipation))


def places(parameters: ParameterVector) -> dict[str, list[int]]:
    """Places in the parameter vector of the coefficients of each term; dry friction has one per coordinate."""
    config, found = parameters.model.config, {}
    for parameter, names in holders(config.features, config.drag, config.dissipation).items():
        found |= zip(names, ([i] for i in parameters.index(parameter).tolist()), strict=True)
    if config.coulomb:
        found[DRY] = parameters.index(DRY).tolist()
    return found


def shapes_of_dry(parameters: ParameterVector) -> Tensor:
    """Places of the numbers that shape dry friction; with a force of 0 they have no effect."""
    return torch.cat([parameters.index(name) for name in ("friction.breakaway", "friction.log")])
