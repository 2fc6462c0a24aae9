"""`Plan`: the decisions of a fit as plain values, each with its reason."""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

from herglotz.data.units import size
from herglotz.errors import InputError
from herglotz.schema import from_plain
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.trades import listed

# Lines of the printed table have at most this many characters.
LINE_WIDTH = 80
# This pattern matches a term that is a wave of a linear form of the coordinates, with its factors.
WAVE = re.compile(r"(?:sin|cos)\((?P<form>[^()]*)\)(?P<factors>(?: [^ ()]+)*)")
# More waves of the same coordinates with the same factors are printed as one function, in the plan and in the equation.
MAX_WAVES = 6
# Starting values of the baseline; all other names in `Plan.start` are parameters of the model.
STARTS = ("stiffness", "tilt", "rate")
# Settings of a fit that a plan holds under the same name, beside the objective.
SETTINGS = ("level", "order", "features", "departures", "drag", "substeps", "absent", "dissipation")


@dataclass(frozen=True)
class Plan:
    """The decisions of a fit. Every field but the last has its reason, in words and numbers, in `reasons`.

    A plan is plain values: `metrics.json` holds it, and `fit(data, plan=Plan.from_dict(...))` follows it again.

    Parameters
    ----------
    level, objective, network, order, features, drag, dissipation, absent, substeps, departures
        As in `FitConfig`; the objective is residual, trajectory, smoothing or raw, the network one of `build_model`.
    hold, delay, lag
        Inputs between samples (zero, first or smooth; "" without inputs); their delay and the time constant of the
        actuator, in the data's unit of time.
    forces, start, fitted_before
        Settings of masses and friction (`FORCES`), and starting values of parameters, by name; whether these and
        `sigma` come from an earlier fit of the same model.
    longest
        Recorded steps of the longest segments that the earlier fit followed; 0: whole trajectories.
    sigma
        Noise of q that the first stage assumes, in its unit; None: a one-step fit measures it.
    outliers, continues_probe, restarts
        Of the one-step fit: whether Student's t is its first loss, whether it continues the short fit that measured the
        noise, and the number of its random initialisations.
    turning
        True: angles turn. False: they are positions on a line, for example of a free spring.
    spreads, input_terms
        Prior deviations of the waves of functions; terms of the recorded inputs, which act beside the inputs.
    zeros, drifts
        Zeros of the sensors, B · n numbers, if recordings differ in them (empty: 0), and their drifts, n numbers, in
        units of q per unit of time since the start of a recording.
    """

    level: str
    objective: str
    network: str
    order: int
    features: tuple[str, ...]
    hold: str
    delay: float
    lag: float
    drag: tuple[str, ...]
    substeps: int
    forces: dict[str, bool]
    start: dict[str, tuple[float, ...]]
    outliers: bool
    continues_probe: bool
    sigma: float | None
    fitted_before: bool
    restarts: int
    departures: tuple[float, ...]
    longest: int = 0
    turning: bool = True
    absent: tuple[str, ...] = ()
    spreads: dict[str, float] = field(default_factory=dict)
    dissipation: tuple[str, ...] = ()
    input_terms: tuple[str, ...] = ()
    zeros: tuple[float, ...] = ()
    drifts: tuple[float, ...] = ()
    reasons: dict[str, str] = field(default_factory=dict)

    def applied(self, settings: FitConfig) -> FitConfig:
        """The settings with the decisions of this plan."""
        return replace(
            settings, objective=self.objective, **{name: getattr(self, name) for name in SETTINGS}, **self.forces
        )

    def started(self, base: Baseline) -> Baseline:
        """The baseline with this plan's starting values."""
        rest = dict(self.start)
        stiffness, tilt, (rate,) = (rest.pop(name) for name in STARTS)
        return replace(base, stiffness=stiffness, tilt=tilt, rate=rate, start=rest, spreads=self.spreads)

    def _has_effect(self, name: str) -> bool:
        """Whether the fit depends on this decision, so that the table lists the decision."""
        one_step = self.objective in ("residual", "raw")
        needed = {
            "substeps": self.substeps > 1,
            "turning": not self.turning,
            "sigma": not one_step,
            "restarts": one_step,
            "departures": self.network not in ("none", "plain"),
        }
        return needed.get(name, name not in IF_ANY or bool(getattr(self, name)))

    def by_reason(self, unit: str = "") -> list[tuple[list[str], str]]:
        """The decisions with an effect, in words (`order of the time step: 2`), grouped by their common reason.

        `unit` is the common unit of the coordinates, if they have one.
        """
        found: dict[str, list[str]] = {}
        for name in filter(self._has_effect, WORDS):
            decision = f"{WORDS[name]}: {in_words(name, getattr(self, name), unit)}"
            found.setdefault(self.reasons.get(name, ""), []).append(decision)
        return [(decisions, reason) for reason, decisions in found.items()]

    def table(self, unit: str = "") -> str:
        """The decisions as a text table, each group with its reason below."""
        lines = []
        for decisions, reason in self.by_reason(unit):
            lines += [textwrap.fill(x, LINE_WIDTH, initial_indent="  ", subsequent_indent="    ") for x in decisions]
            lines.append(textwrap.fill(reason, LINE_WIDTH, initial_indent="      ", subsequent_indent="      "))
        return "\n".join(filter(None, lines))

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return dict(vars(self))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Plan:
        """Inverse of `to_dict`; unknown keys are an error."""
        plan = from_plain(cls, values)
        if missing := [name for name in STARTS if not plan.start.get(name)]:
            raise InputError(f"the plan's start lacks {', '.join(missing)}; take one that `fit` wrote")
        return replace(plan, start={name: tuple(x) for name, x in plan.start.items()})


# The decisions in words, in the order of the table. The starting values are too many for a table.
WORDS = {
    "level": "level",
    "objective": "fitted to",
    "network": "network",
    "order": "order of the time step",
    "features": "terms of the model",
    "hold": "inputs between samples",
    "input_terms": "terms of the inputs",
    "delay": "delay of the inputs, in the unit of time",
    "lag": "lag of the actuator, in the unit of time",
    "zeros": "what the sensors read at 0, recording after recording",
    "drifts": "what the zeros of the sensors gain in a unit of time",
    "turning": "angles turn",
    "drag": "forces beside viscous friction",
    "dissipation": "damping by s, beside −γ s in L",
    "substeps": "model steps in a recorded step",
    "forces": "masses and friction",
    "absent": "numbers that are 0",
    "outliers": "outliers expected",
    "continues_probe": "starts from the fit that measured the noise",
    "sigma": "noise assumed",
    "fitted_before": "starts from an earlier fit",
    "longest": "steps of the longest segments",
    "restarts": "random initialisations",
    "departures": "strengths of the prior that are compared",
}
# Decisions that are listed only if they are not empty, 0 or False.
IF_ANY = ("hold", "input_terms", "delay", "lag", "zeros", "drifts", "drag", "absent", "dissipation",
          "continues_probe", "fitted_before", "longest")  # fmt: skip
MEANINGS = {
    "level": {
        "conservative": "no damping",
        "linear": "one damping rate",
        "affine": "damping depends on position and velocity",
        "full": "damping depends on s too",
        "forced": "friction and inputs are forces",
    },
    "objective": {
        "residual": "single steps",
        "trajectory": "whole trajectories",
        "smoothing": "every state, with a little noise in every step",
        "raw": "the bare residual",
    },
    "network": {
        "potential": "a part of the potential",
        "correction": "a correction of the step",
        "covered": "a wide correction of the step",
        "plain": "the whole model",
    },
    "hold": {"zero": "constant", "first": "straight lines", "smooth": "polynomials"},
}
FORCES = {
    "coulomb": "dry friction",
    "sticking": "dry friction that can hold a joint still",
    "coupled": "friction between coordinates",
    "diagonal": "a mass for each coordinate, none between two",
    "alike": "one mass, and a potential of the named terms alone",
}


def in_words(name: str, value: Any, unit: str = "") -> str:
    """The value of the decision `name` in words; σ has the `unit`."""
    if name in MEANINGS:
        meaning = MEANINGS[name].get(value)
        return f"{meaning} ({value})" if meaning else str(value) or "none"
    if name == "absent":
        return listed(value) or "none"
    if name == "forces":
        return ", ".join(FORCES[force] for force, on in value.items() if on) or "masses and viscous friction alone"
    if isinstance(value, tuple):
        return ", ".join(_gathered([_plainly(x) for x in value])) or "none"
    return size(value, unit) if name == "sigma" and value is not None else _plainly(value)


def _gathered(terms: list[str]) -> list[str]:
    """The terms, with one entry for more than `MAX_WAVES` waves of the same coordinates: 22 waves of q1, q2."""
    matches = [WAVE.fullmatch(term) for term in terms]
    keys = [x and (", ".join(sorted(set(re.findall(r"[a-z]\d+", x["form"])))), x["factors"]) for x in matches]
    found, counts = {}, Counter(keys)
    for term, key in zip(terms, keys, strict=True):
        if key is None or counts[key] <= MAX_WAVES:
            found[term] = None
        else:
            coordinates, factors = key
            found[f"{counts[key]} waves of {coordinates}{' by' if factors else ''}{factors}"] = None
    return list(found)


def _plainly(value: Any) -> str:
    """A number, a flag or a name as text; None is a value that the fit still measures."""
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "to be measured" if value is None else str(value)
