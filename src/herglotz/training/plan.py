"""`Plan`: the decisions of a fit as plain values, each with its reason."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field, fields, replace
from typing import Any

from herglotz.data.units import size
from herglotz.errors import InputError
from herglotz.schema import from_plain
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.trades import listed

COLUMNS = 80  # of a table for people
STARTS = ("stiffness", "tilt", "rate")  # of the baseline; `start` holds all other parameters


@dataclass(frozen=True)
class Plan:
    """The decisions of a fit. Every field but the last has its reason, in words and numbers, in `reasons`.

    A plan is plain values: `metrics.json` holds it, and `fit(data, plan=Plan.from_dict(...))` follows it again.
    """

    level: str  # of the ladder of models
    objective: str  # residual, trajectory, smoothing or raw
    network: str  # correction, covered (one wide layer), potential, plain or none
    order: int  # of the rule, 2 or 4
    features: tuple[str, ...]  # what L may hold beside its terms
    hold: str  # of the inputs between samples: zero, first or smooth; "" without inputs
    delay: float  # with which recorded inputs act, in the data's unit of time
    lag: float  # time constant of the actuator
    drag: tuple[str, ...]  # friction forces beside the viscous one
    substeps: int  # model steps in a recorded one
    forces: dict[str, bool]  # coulomb, sticking, coupled; diagonal: which masses and friction there are
    start: dict[str, tuple[float, ...]]  # starting values of parameters by name
    outliers: bool  # the first one-step fit takes Student's t
    continues_probe: bool  # the one-step fit goes on from the short one that measured the noise
    sigma: float | None  # noise of q that the first stage assumes; None: a one-step fit measures it
    fitted_before: bool  # starting values and sigma are those of an earlier fit of the same model
    restarts: int  # random initialisations of the one-step fit
    departures: tuple[float, ...]  # strengths of the prior that held-out blocks choose from
    turning: bool = True  # angles turn; False: they are positions on a line, as of a free spring
    absent: tuple[str, ...] = ()  # numbers of the model that are 0 and not learned
    spreads: dict[str, float] = field(default_factory=dict)  # prior deviations of the waves that make functions
    dissipation: tuple[str, ...] = ()  # powers of s in L beside −γ s
    input_terms: tuple[str, ...] = ()  # of recorded inputs, which act beside them
    zeros: tuple[float, ...] = ()  # of the sensors, B · n numbers, where recordings differ in them; empty: 0
    drifts: tuple[float, ...] = ()  # of these zeros, n numbers, in units of q per time since a recording began
    reasons: dict[str, str] = field(default_factory=dict)

    def applied(self, settings: FitConfig) -> FitConfig:
        """The settings with what this plan decides."""
        return replace(
            settings, level=self.level, objective=self.objective, order=self.order, features=self.features,
            departures=self.departures, drag=self.drag, substeps=self.substeps, absent=self.absent,
            dissipation=self.dissipation, **self.forces,
        )  # fmt: skip

    def started(self, base: Baseline) -> Baseline:
        """The first look's sizes with this plan's starting values."""
        own = {name: self.start[name] for name in STARTS}
        rest = {name: values for name, values in self.start.items() if name not in STARTS}
        return replace(
            base, stiffness=own["stiffness"], tilt=own["tilt"], rate=own["rate"][0], start=rest, spreads=self.spreads
        )

    def _has_effect(self, name: str) -> bool:
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
        """Decisions in words (`order of the time step: 2`) that have an effect, with the reason that they share.

        `unit` is that of the coordinates, where they have one in common.
        """
        found: dict[str, list[str]] = {}
        for name in filter(self._has_effect, DECISIONS):
            taken = in_words(name, getattr(self, name), unit)
            found.setdefault(self.reasons.get(name, ""), []).append(f"{WORDS[name]}: {taken}")
        return [(decisions, reason) for reason, decisions in found.items()]

    def table(self, unit: str = "") -> str:
        """The decisions, those of one reason together, and the reason below them, for people."""
        lines = []
        for decisions, reason in self.by_reason(unit):
            lines += [textwrap.fill(x, COLUMNS, initial_indent="  ", subsequent_indent="    ") for x in decisions]
            lines.append(textwrap.fill(reason, COLUMNS, initial_indent="      ", subsequent_indent="      "))
        return "\n".join(filter(None, lines))

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Plan:
        """Inverse of `to_dict`; unknown keys are an error."""
        plan = from_plain(cls, values)
        if missing := [name for name in STARTS if not plan.start.get(name)]:
            raise InputError(f"the plan's start lacks {', '.join(missing)}; take one that `fit` wrote")
        return replace(plan, start={name: tuple(x) for name, x in plan.start.items()})


WORDS = {  # what a decision is called; the starting values are too many to be told
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
    "drag": "friction beside the viscous one",
    "dissipation": "damping by s, beside −γ s in L",
    "substeps": "model steps in a recorded step",
    "forces": "masses and friction",
    "absent": "numbers that are 0",
    "outliers": "outliers expected",
    "continues_probe": "starts from the fit that measured the noise",
    "sigma": "noise assumed",
    "fitted_before": "starts from an earlier fit",
    "restarts": "random initialisations",
    "departures": "strengths of the prior that are compared",
}
DECISIONS = tuple(WORDS)
IF_ANY = ("hold", "input_terms", "delay", "lag", "zeros", "drifts", "drag", "absent", "dissipation",
          "continues_probe", "fitted_before")  # fmt: skip  # told if not 0
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
FORCES = {  # of `Plan.forces`
    "coulomb": "dry friction",
    "sticking": "dry friction that can hold a joint still",
    "coupled": "friction between coordinates",
    "diagonal": "a mass for each coordinate, none between two",
    "alike": "one mass, and a potential of the named terms alone",
}


def in_words(name: str, value: Any, unit: str = "") -> str:
    """One decision in words."""
    if name in MEANINGS:
        meaning = MEANINGS[name].get(value)
        return f"{meaning} ({value})" if meaning else str(value) or "none"
    if name == "absent":
        return listed(value) or "none"
    if name == "forces":
        return ", ".join(FORCES[force] for force, on in value.items() if on) or "masses and viscous friction alone"
    if isinstance(value, tuple):
        return ", ".join(_plainly(x) for x in value) or "none"
    return size(value, unit) if name == "sigma" and value is not None else _plainly(value)


def _plainly(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "to be measured" if value is None else str(value)
