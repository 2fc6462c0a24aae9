"""The dictionary that a compiled kernel holds: every named term that coordinates of one kind may have.

A further term is one text in `features_of` (terms of L) or `drag_of` (forces); the search for terms then offers it
(`named_terms.candidates`), and the kernel is compiled anew at its first use.

One kernel serves all models of a kind of coordinates, and is compiled once. It evaluates every model whose terms are in
the dictionary, with 0 for the absent numbers; any other model has a kernel of its own. The dictionary of models with
learned functions has the waves of all functions besides, with the standard numbers of `rates`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from itertools import combinations

from herglotz.models import ModelConfig
from herglotz.models.config import POWERS
from herglotz.models.drag import AIR, parse_drag
from herglotz.models.features import expand, lengths, revolute, slides, spherical, windings
from herglotz.training.rates import RATIO, rates_of
from herglotz.training.waves import BRAKES, waves_of

# The potential of one length has powers up to this one: forces up to x⁵.
HIGHEST = 6
# These potentials of one length have a kink of the force at 0.
KINKS = ("|q1| q1", "|q1|^3")
# These are potentials of the weight of a body that turns, if its angle is taken for a position on a line.
WEIGHTS = ("cos(q1)", "sin(q1)")
# The potential of one angle has harmonics up to this one.
WAVES = 3
# A sum or a difference of two coordinates, or of their speeds.
PAIR = re.compile(r"\([qv](?P<i>\d+) [-+] [qv](?P<j>\d+)\)")
COEFFICIENTS = re.compile(r"(potential\.features\.sum|kinetic\.sum|drag|action)\.coefficient(?:\[(\d+)\])?")


def dictionary(config: ModelConfig) -> ModelConfig | None:
    """The configuration with all terms of its kind; None where the model has a part that no dictionary holds."""
    c, n = config, len(config.angles)
    if n > 3 or c.alike != (n == 1) or _has_other_parts(c):
        return None
    # Joints without coupling have a mass matrix whose other entries are 0.
    if any(c.angles) and n > 1 and c.diagonal and not c.coupled:
        c = replace(c, diagonal=False)
    # All forces by position of the inputs that the model has some of.
    inputs = {k + 1 for text in c.drag if (k := parse_drag(text, c.angles).input) is not None}
    # Waves of angles repeat, whatever the ratio of a damper between two.
    ratios = {} if any(c.angles) else ratios_of((*expand(c.features, c.angles), *c.drag))
    features = in_proportion((*features_of(c.angles), *windings(c.angles)), ratios)
    drag = (*in_proportion(drag_of(c.angles), ratios), *by_motion(c.angles, sorted(inputs)))
    distances = tuple(text for text in expand(c.features, c.angles) if text.startswith("r^"))
    whole = replace(
        c, level="forced", features=(*features, *distances), drag=drag, coulomb=True, coupled=n > 1 and any(c.angles),
        input_zero=c.inputs > 0, damping_width=0, rate=0.1, scale=(1.0,) * n, speed=(1.0,) * n, tilt=(0.0,) * n,
        stiffness=(0.0 if n == 1 else 1.0,) * n, seed=0, absent=(), dissipation=tuple(POWERS) if c.dissipation else (),
    )  # fmt: skip
    waves, braking = waves_of_kind(c.angles)
    features, drag = (tuple(dict.fromkeys(texts)) for texts in ((*whole.features, *waves), (*drag, *braking)))
    for wider in (whole, replace(whole, features=features, drag=drag)):
        if set(expand(config.features, c.angles)) <= set(wider.features) and set(config.drag) <= set(wider.drag):
            return wider
    return None


def in_proportion(terms: Iterable[str], ratios: Mapping[tuple[int, int], str]) -> tuple[str, ...]:
    """These terms, where sums and differences of two coordinates i < j have the ratio of the first as a number."""

    def weighted(pair: re.Match[str]) -> str:
        ratio = ratios.get((int(pair["i"]), int(pair["j"])))
        return pair[0] if ratio is None else f"({ratio} {pair[0][1:]}"

    return tuple(PAIR.sub(weighted, text) for text in terms)


def ratios_of(terms: Iterable[str]) -> dict[tuple[int, int], str]:
    """The ratios of coordinates, counted from 1, in these terms, as `in_proportion` writes them."""
    found = (RATIO.fullmatch(text) for text in terms)
    return {(int(x["i"]), int(x["j"])): x[0][1:].partition(" ")[0] for x in found if x is not None}


@cache
def waves_of_kind(angles: tuple[bool, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The waves of all functions of coordinates of one kind, with standard numbers: terms of L, and dissipation."""
    # Which waves there are does not depend on the intervals.
    found = waves_of(angles, lambda form: (0.1, 1.0 + 0.1 * len(form)), [1.0] * len(angles), plane=True)
    every = {name: [text for text, _ in waves] for name, waves in found.items()}
    rates = rates_of(tuple(text for texts in every.values() for text in texts))
    features, drag = ([text for name, texts in every.items() if name.startswith(BRAKES) == brakes for text in texts]
                      for brakes in (False, True))  # fmt: skip
    return rates.standard(features), rates.standard(drag)


def _has_other_parts(c: ModelConfig) -> bool:
    """Whether a model has networks, parts with given numbers, or a potential that is no named term."""
    given = c.known or c.terms or c.translations or c.input_map or c.level in ("affine", "full")
    unnamed = c.alike and c.order == 2 and (any(c.stiffness) or any(c.tilt))
    return bool(given or unnamed or c.potential_width or c.mass_width or c.correction_width)


def features_of(angles: tuple[bool, ...]) -> tuple[str, ...]:
    """The terms of L without those of the distance, which are singular at distance 0."""
    if len(angles) == 1:
        if angles[0]:
            return tuple(f"{f}({'' if k == 1 else k}q1)" for k in range(1, WAVES + 1) for f in ("cos", "sin"))
        return (*(f"q1^{k}" for k in range(2, HIGHEST + 1)), "q1", *KINKS, *WEIGHTS)
    if any(angles):
        still = [f"q{i}^{k}" for k in (3, 4) for i, angle in enumerate(angles, 1) if not angle]
        return (*revolute(angles), *still, *slides(angles), *spherical(angles))
    return tuple(name for name in lengths(angles) if not name.startswith("r^"))


def drag_of(angles: tuple[bool, ...]) -> tuple[str, ...]:
    """Friction beside viscous and dry friction; dampers between lengths are here, those between joints in `coupled`.

    v² is friction of a single coordinate alone: masses of several that depend on the position have such forces.
    """
    drag = [text for i in range(1, len(angles) + 1) for text in (f"|v{i}| v{i}", f"|v{i}|")]
    drag += ["v1^2"] if len(angles) == 1 else []
    drag += [f"load {i}" for i, angle in enumerate(angles, 1) if angle]
    drag += [text for i, angle in enumerate(angles, 1) if not angle for text in (f"q{i} v{i}", f"q{i}^2 v{i}")]
    if not any(angles) and len(angles) > 1:
        drag += [f"(v{i + 1} - v{j + 1})" for i, j in combinations(range(len(angles)), 2)]
        drag += [AIR]
    return tuple(drag)


def by_motion(angles: tuple[bool, ...], inputs: Iterable[int]) -> tuple[str, ...]:
    """Forces of these inputs, counted from 1, that depend on the motion.

    u cos q and u sin q of every angle, on the angle and on every length; u q and u q² of every length, on that length;
    and u v and u² v of every speed, which brake.
    """
    to = [(j, "" if i == j else f" on q{i}") for j, angle in enumerate(angles, 1) if angle
          for i, other in enumerate(angles, 1) if i == j or not other]  # fmt: skip
    turned = [f"{f}(q{j}){on}" for j, on in to for f in ("cos", "sin")]
    moved = [f"q{j}{power}" for j, angle in enumerate(angles, 1) if not angle for power in ("", "^2")]
    braked = [f"{power} v{j}" for j in range(1, len(angles) + 1) for power in ("", "^2")]
    factors = [f" {factor}" for factor in (*turned, *moved)] + braked
    return tuple(f"u{k}{factor}" for k in inputs for factor in factors)


def keys_of(numbers: list[str], config: ModelConfig) -> list[str]:
    """Names of numbers that do not depend on the model's other terms: a coefficient has the text of its term."""
    features = expand(config.features, config.angles)
    texts = {
        "potential.features.sum": [x for x in features if "v" not in x],
        "kinetic.sum": [x for x in features if "v" in x],
        "drag": list(config.drag),
        "action": list(config.dissipation),
    }
    found = []
    for name in numbers:
        match = COEFFICIENTS.fullmatch(name)
        if match is None:
            found.append(name.replace("kinetic.base.", "kinetic."))
        else:
            found.append(texts[match[1]][int(match[2] or 0)])
    return found
