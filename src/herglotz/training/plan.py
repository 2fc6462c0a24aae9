"""`Plan`: the decisions of a fit as plain values, each with its reason."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field, fields, replace
from typing import Any

from herglotz.errors import InputError
from herglotz.settings import from_plain
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig

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
    reasons: dict[str, str] = field(default_factory=dict)

    def applied(self, settings: FitConfig) -> FitConfig:
        """The settings with what this plan decides."""
        return replace(
            settings, level=self.level, objective=self.objective, order=self.order, features=self.features,
            departures=self.departures, drag=self.drag, substeps=self.substeps, **self.forces,
        )  # fmt: skip

    def started(self, base: Baseline) -> Baseline:
        """The first look's sizes with this plan's starting values."""
        own = {name: self.start[name] for name in STARTS}
        rest = {name: values for name, values in self.start.items() if name not in STARTS}
        return replace(base, stiffness=own["stiffness"], tilt=own["tilt"], rate=own["rate"][0], start=rest)

    def by_reason(self) -> list[tuple[list[str], str]]:
        """Decisions in words (`order: 2`) with the reason that they share, in the order of `DECISIONS`."""
        found: dict[str, list[str]] = {}
        for name in DECISIONS:
            words = f"{name.replace('_', ' ')}: {show(getattr(self, name))}"
            found.setdefault(self.reasons.get(name, ""), []).append(words)
        return [(decisions, reason) for reason, decisions in found.items()]

    def table(self, width: int = 80) -> str:
        """The decisions, those of one reason together, and the reason below them, for people."""
        lines = []
        for decisions, reason in self.by_reason():
            lines.append(textwrap.fill("; ".join(decisions), width, initial_indent="  ", subsequent_indent="  "))
            lines.append(textwrap.fill(reason, width, initial_indent="      ", subsequent_indent="      "))
        return "\n".join(filter(None, lines))

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Plan:
        """Inverse of `to_dict`; unknown keys are an error."""
        start = {name: tuple(x) for name, x in values.get("start", {}).items()}
        try:
            return from_plain(cls, {**values, "start": start})
        except TypeError as error:
            raise InputError(f"the plan is incomplete ({error}); take one that `fit` wrote") from None


# The decisions that `table` prints; the starting values are too many.
DECISIONS = tuple(f.name for f in fields(Plan) if f.name not in ("start", "reasons"))


def show(value: Any) -> str:
    """One decision in words."""
    if isinstance(value, dict):
        return ", ".join(name for name, on in value.items() if on) or "none"
    if isinstance(value, tuple):
        return ", ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in value) or "none"
    if value is None:
        return "to be measured"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value) or "none"
