"""The terms that a model may be made of by name, and their values by name while terms come and go."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
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
from herglotz.training.dictionary import HIGHEST, WAVES, drag_of, features_of
from herglotz.training.parameter_vector import ParameterVector

SIDE = 0.1  # of the way to the farther side of 0: motion that goes less far on the other tells nothing of a bend there
BACK = 50  # a turn back that is shorter than this part of a recording says next to nothing of dry friction
NEAR = 0.02  # of the RMS distance: powers of r are candidates where the data stay farther from 0
STILL, MOVING, DRAG = "potential.features.sum.coefficient", "kinetic.sum.coefficient", "drag.coefficient"
IN_S = "action.coefficient"
DRY = "friction.coulomb"
CONSTANT = "q1"  # the potential of a constant force on a length


@dataclass(frozen=True)
class NamedTerms:
    """Terms of L and of the forces beside masses, stiffness, tilt and viscous friction."""

    features: tuple[str, ...] = ()
    drag: tuple[str, ...] = ()
    dissipation: tuple[str, ...] = ()  # powers of s in L
    dry: bool = False
    one_rate: bool = False  # of several coordinates: damped alike, by the contact form alone, and no forces
    springs: bool = True  # the baseline's own of every coordinate; translations leave them out
    apart: bool = False  # joints have no constant mass and no viscous friction between them
    absent: tuple[str, ...] = ()  # numbers of the model that are 0

    @property
    def names(self) -> tuple[str, ...]:
        """All of them, each once."""
        return (*self.features, *self.drag, *self.dissipation, *((DRY,) if self.dry else ()))

    def joined(self, other: NamedTerms) -> NamedTerms:
        """These and the other ones, each once."""
        own = ("features", "drag", "dissipation")
        every = {name: tuple(dict.fromkeys(getattr(self, name) + getattr(other, name))) for name in own}
        return replace(self, **every)

    def only(self, names: Collection[str]) -> NamedTerms:
        """Those of them that are among `names`."""
        every = {name: getattr(self, name) for name in ("features", "drag", "dissipation")}
        kept = {name: tuple(x for x in own if x in names) for name, own in every.items()}
        return replace(self, **kept, dry=self.dry and DRY in names)


def candidates(data: Trajectories, translations: Sequence[str] = ()) -> NamedTerms:
    """The terms that these coordinates are tried with: with translations those of L that do not see them."""
    if translations:
        return _unmoved(data, directions(translations, data.angles))
    angles = data.angles
    features = tuple(_of_one(data)) if len(angles) == 1 else features_of(angles)
    one_unit = len(set(data.units)) == 1  # else there is no length of a velocity
    drag = tuple(text for text in drag_of(angles) if one_unit or text != AIR)
    return NamedTerms((*features, *special(data)), drag, dry=True)


def special(data: Trajectories) -> tuple[str, ...]:
    """Powers of the distance, and bends at 0: what the other terms are much alike to where it is not the law."""
    return (*distances(data), *kinks(data))


def _of_one(data: Trajectories) -> list[str]:
    """Potentials of one coordinate; a constant force on a driven length is the zero of its input already."""
    waves = [f"{f}({k}q1)" for k in range(2, WAVES + 1) for f in ("cos", "sin")]
    powers = [f"q1^{k}" for k in range(3, HIGHEST + 1)]
    every = [*own_terms(data.angles), *(waves if data.angles[0] else powers)]
    return [name for name in every if data.u is None or name != CONSTANT]


def turns_one_way(data: Trajectories, i: int) -> bool:
    """Whether an angle never turns back for a fiftieth of a recording: dry friction is then a constant force, too."""
    signs = []
    for one in data:
        lag = max(1, one.samples // BACK)
        signs.append((one.q[lag:, i] - one.q[:-lag, i]).sign())
    seen = torch.cat(signs)
    return data.angles[i] and bool((seen == seen[0]).all()) and float(seen[0]) != 0


def _unmoved(data: Trajectories, moved: Sequence[tuple[float, ...]]) -> NamedTerms:
    """What the directions leave alone: no forces beside L, whose momenta along them would not be kept."""
    zero = (0.0,) * data.dof
    pairs = [f"{form}^{power}" for form in differences(data.angles, moved) for power in range(1, 5)]
    every = (*baseline_features(data.angles, zero, zero)[0], *pairs, *candidates(data).features)
    still = tuple(dict.fromkeys(text for text in every if unchanged(text, data.angles, moved)))
    return NamedTerms(still, one_rate=True, springs=False)


def distances(data: Trajectories) -> tuple[str, ...]:
    """Potentials of the distance r = |q|, where the coordinates have one unit of length and stay away from r = 0."""
    if any(data.angles) or data.dof < 2 or len(set(data.units)) > 1:
        return ()
    r = data.q.norm(dim=1)
    away = float(r.min()) > NEAR * float(r.square().mean().sqrt())
    return tuple(name for name in lengths(data.angles) if name.startswith("r^")) if away else ()


def kinks(data: Trajectories) -> tuple[str, ...]:
    """Potentials of one length whose force bends at 0: |x| of a spring that is stiffer on one side, and x |x|.

    On one side of 0 they are powers.
    """
    away, beyond = sorted((abs(float(data.q.min())), abs(float(data.q.max()))))
    crossed = float(data.q.min()) < 0 < float(data.q.max()) and away > SIDE * beyond
    return ("|q1| q1", "|q1|^3") if data.dof == 1 and not any(data.angles) and crossed else ()


def central(data: Trajectories, every: NamedTerms) -> list[NamedTerms]:
    """One power of the distance each, with the friction and the forces across the velocity of `every`.

    Powers of r are so much alike over most motions that a linear problem of all of them says little of each.
    """
    across = tuple(x for x in every.features if "v" in x)
    of_r = distances(data) if every.springs else ()
    return [every.joined(NamedTerms((name,))).only((name, *across, *every.drag, DRY)) for name in of_r]


def chains(data: Trajectories) -> list[NamedTerms]:
    """Fewer terms for joints: those of a planar chain of links, by the angles between neighbours and by absolute ones.

    Between neighbours the mass of speeds i and j turns with sums of the angles behind the first of the two, and weight
    with the sums of all angles up to a joint; by absolute angles the mass turns with q_i − q_j alone. Where the chain
    hangs on slides, the mass of a slide and a joint turns with the angle of a link; by absolute angles no other mass
    and no friction is shared. Joints that springs alone connect have potentials of q_i − q_j, and no mass between them.
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
    return tuple(name for name, f in terms if rule(f))


def _of_springs(f: Product) -> bool:
    """Whether it is a potential of the difference of two angles."""
    return not f.velocities and sorted(_form(f).values()) == [-1.0, 1.0]


def _by_slides(angles: Sequence[bool]) -> tuple[list[tuple[str, Product]], list[tuple[str, Product]]]:
    """The dictionary of joints: terms of the speeds of a slide and a joint, and those of joints alone."""
    every = [(name, parse(name, angles)[0]) for name in revolute(angles)]
    across = [(name, f) for name, f in every if len({angles[i] for i in f.velocities}) == 2]
    return across, [(name, f) for name, f in every if all(angles[i] for i in f.velocities)]


def _form(f: Product) -> dict[int, float]:
    return {i: w for i, w in enumerate(f.form) if w}


def _row(f: Product, joints: Sequence[int]) -> bool:
    """Whether the angle is a sum of all joints up to one: that of a link, by the angles between neighbours."""
    return list(_form(f).items()) == [(i, 1.0) for i in joints[: len(_form(f))]]


def _of_own(f: Product) -> bool:
    """Whether the angle is that of the one joint whose speed a term has beside a slide's."""
    return len(_form(f)) == 1 and set(_form(f)) <= set(f.velocities) and set(_form(f).values()) == {1.0}


def _of_neighbours(f: Product, joints: Sequence[int]) -> bool:
    """Whether a chain has this term by the angles between neighbours: a sum of neighbouring angles."""
    on = [joints.index(i) for i in _form(f)]
    row = set(_form(f).values()) == {1.0} and on == list(range(on[0], on[-1] + 1))
    return row and on[0] == (joints.index(min(f.velocities)) + 1 if f.velocities else 0)


def _difference(f: Product) -> dict[int, float]:
    """q_i − q_j of the two speeds of a term."""
    i, j = sorted(f.velocities) if len(set(f.velocities)) == 2 else (0, 0)
    return {} if i == j else {i: 1.0, j: -1.0}


def own_terms(angles: Sequence[bool]) -> dict[str, tuple[str, float]]:
    """The baseline's terms of one coordinate as features: the parameter of each, and its factor; of more none."""
    if len(angles) > 1:
        return {}
    if angles[0]:
        return {"cos(q1)": ("potential.stiffness", -1.0), "sin(q1)": ("potential.tilt", 1.0)}
    return {"q1^2": ("potential.stiffness", 0.5), CONSTANT: ("potential.tilt", 1.0)}


def settings_of(terms: NamedTerms, data: Trajectories, config: FitConfig, order: int, substeps: int) -> FitConfig:
    """The settings of a model that is made of these terms."""
    driven = data.u is not None and config.use_inputs
    forced = bool(terms.drag) or terms.dry or driven or (data.dof > 1 and not terms.one_rate)
    lengths, still = not any(data.angles), any("v" not in name for name in terms.features)
    own = data.dof > 1 and not config.translations  # the baseline's potential
    order = order if still or own else 2  # of a potential: without one it would add a spring
    several, apart = data.dof > 1, lengths or terms.apart
    level = "forced" if forced else "full" if terms.dissipation else "linear"
    return replace(
        config, level=level, features=terms.features, drag=terms.drag, coulomb=terms.dry,
        diagonal=several and apart, coupled=forced and several and not apart, order=2 if terms.dissipation else order,
        substeps=substeps, objective="trajectory", absent=terms.absent, dissipation=terms.dissipation,
        alike=data.dof == 1,  # the potential holds features alone
    )  # fmt: skip


def started(base: Baseline, data: Trajectories, values: dict, of: FitConfig) -> Baseline:
    """The baseline with values by the name of a term or of a parameter as starts, for a model of these settings."""
    rest = {name: x for name, x in values.items() if isinstance(x, tuple) and not name.startswith("potential.")}
    rate = rest.pop("damping.rate", (0.0,))[0]
    if data.dof == 1 or of.level == "linear":  # viscous friction of the first mass, 1, is the rate
        rate += rest.pop("friction.viscous", (0.0,))[0]
    for parameter, names in holders(of.features, of.drag, of.dissipation).items():
        rest[parameter] = tuple(values.get(name, 0.0) for name in names)
    zero, rest = (0.0,) * data.dof, {own: x for name, x in rest.items() if x and (own := _name_in(of, name))}
    stiffness, tilt = values.get("potential.stiffness", zero), values.get("potential.tilt", zero)
    step = base.max_step if of.substeps == 1 else JITTER * data.typical_step / of.substeps
    return replace(base, stiffness=stiffness, tilt=tilt, rate=rate, start=rest, model_step=step)


def holders(features: Sequence[str], drag: Sequence[str] = (), dissipation: Sequence[str] = ()) -> dict[str, list[str]]:
    """The terms whose coefficients each of four parameters holds, in its order."""
    still, moving = ([x for x in features if ("v" in x) == moves] for moves in (False, True))
    return {STILL: still, MOVING: moving, DRAG: list(drag), IN_S: list(dissipation)}


def by_term(start: Mapping[str, Tensor], held: Mapping[str, Sequence[str]]) -> dict:
    """Values of parameters as plain numbers, those of coefficients by the names of their terms (`holders`)."""
    values: dict = {name: tuple(x.reshape(-1).tolist()) for name, x in start.items()}
    for parameter, names in held.items():
        values |= zip(names, values.pop(parameter, ()), strict=True)
    return values


def _name_in(of: FitConfig, name: str) -> str:
    """The name that a parameter has in a model of these settings; "" where it has none."""
    if name.startswith("kinetic.") and name != MOVING:
        name = name.replace("kinetic.base.", "kinetic.")
        if of.diagonal and name == "kinetic.off_diagonal":
            return ""
        return name.replace("kinetic.", "kinetic.base.") if any("v" in x for x in of.features) else name
    if name.startswith("friction."):
        dry = name.removeprefix("friction.") in ("coulomb", "breakaway", "log_smooth", "log_stribeck")
        gone = of.level != "forced" or (dry and not of.coulomb) or (of.sticking and name == "friction.log_smooth")
        return "" if gone else name
    return "" if name == "coupling.viscous" and not of.coupled else name


def values_of(parameters: ParameterVector, theta: Tensor) -> dict:
    """Values by the name of a term or, as a tuple, of a parameter."""
    named, of = parameters.unflatten(theta), parameters.model.config
    if baseline_is_named(of):  # −k, b of each angle; k/2, b of the others
        own, named[STILL] = named[STILL][: 2 * of.dof], named[STILL][2 * of.dof :]
        turn = own.new_tensor([-1.0 if angle else 2.0 for angle in of.angles])
        named |= {"potential.stiffness": own[::2] * turn, "potential.tilt": own[1::2]}
    return by_term(named, holders(of.features, of.drag, of.dissipation))


def places(parameters: ParameterVector) -> dict[str, list[int]]:
    """Where in the vector of parameters the coefficients of each term stand; dry friction has one a coordinate."""
    of, at = parameters.model.config, {}
    for parameter, names in holders(of.features, of.drag, of.dissipation).items():
        at |= zip(names, ([i] for i in parameters.index(parameter).tolist()), strict=True)
    if of.coulomb:
        at[DRY] = parameters.index(DRY).tolist()
    return at


def shapes_of_dry(parameters: ParameterVector) -> Tensor:
    """Places of the numbers that shape dry friction: where its force is 0 they have no effect."""
    return torch.cat([parameters.index(name) for name in ("friction.breakaway", "friction.log")])
