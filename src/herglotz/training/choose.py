"""`choose`: the decisions of a fit from a `Look` at the data, each with its reason."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from herglotz.data.input_terms import input_terms_of
from herglotz.data.units import common_unit, size
from herglotz.training.config import FitConfig
from herglotz.training.look import Look
from herglotz.training.one_step_fit import NOISE_OF_R
from herglotz.training.plan import Plan
from herglotz.training.task import NOISY

RESTARTS = 4  # random initialisations of a single layer: some stall at a hundred times the error of others
AS_SET = "as set, or by default"
HALVED = "the fit needed shorter steps: halved ones change the motion"
KEPT_STEPS = "halved steps change the motion too little to be worth their time, or other terms stand in for them"
AS_FOUND = ("order", "features", "drag", "absent", "dissipation")  # what the search for terms sets


class Rule(NamedTuple):
    """One question about the objective; the first question that is answered decides."""

    question: str
    objective: str  # that a yes leads to
    answer: Callable[[Look, FitConfig], str | None]  # the reason where the answer is yes


def _supervised(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    which = {"q": None, "qs": "s", "qps": "s and p"}[config.supervision]
    return which and f"supervision '{config.supervision}': only one-step errors use the recorded {which}"


def _named(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    return None if config.objective == "auto" else AS_SET


def _sticking(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    return "a joint that stands still says nothing about its forces in one step" if seen.settings.sticking else None


def _terms(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    if seen.found is None or seen.found.sigma is None:
        return None
    miss = size(seen.found.sigma, common_unit(seen.data.units), digits=2)
    return f"a model of named terms follows whole trajectories to {miss}"


def _missing(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    return None if seen.kept.observed is None else "some positions are missing, which single steps cannot leave out"


def _structured(seen: Look, config: FitConfig) -> str | None:
    return seen.structure if config.objective == "auto" != seen.settings.objective else None


def _explained(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    if seen.baseline_motion is None:
        return None
    return f"the baseline's equation of motion explains every step to {seen.baseline_motion[1]:.2g}: exact"


def _noisy(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    limit = NOISY * max(seen.base.scale)
    if seen.probe is None or not seen.probe.rms > limit:
        return None
    return f"a flexible model misses single steps by {seen.probe.rms:.2g}, more than {limit:.2g}: noise"


def _few(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    if seen.probe is None or seen.probe.enough:
        return None
    return f"{seen.probe.residuals} one-step errors for {seen.probe.unknowns} unknowns, fewer than two each"


def _exact(seen: Look, config: FitConfig) -> str | None:  # noqa: ARG001
    assert seen.probe is not None
    limit = NOISY * max(seen.base.scale)
    return f"a flexible model misses single steps by {seen.probe.rms:.2g}, less than {limit:.2g}: exact"


RULES = (
    Rule("Are s or p fitted too?", "residual", _supervised),
    Rule("Did the user name the objective?", "as named", _named),
    Rule("Can friction hold a joint?", "trajectory", _sticking),
    Rule("Do named terms follow whole trajectories?", "trajectory", _terms),
    Rule("Are positions missing?", "trajectory", _missing),
    Rule("Does a dictionary of features explain the steps?", "as found", _structured),
    Rule("Does the baseline's equation of motion explain the steps?", "residual", _explained),
    Rule("Does a flexible model miss single steps?", "trajectory", _noisy),
    Rule("Are there fewer than two one-step errors an unknown?", "trajectory", _few),
    Rule("Else", "residual", _exact),
)


def choose(seen: Look, user_settings: FitConfig) -> Plan:
    """Return the plan that these data and the user's settings call for."""
    c, base, probe = seen.settings, seen.base, seen.probe
    objective, why = choose_objective(seen, user_settings)
    one_step, covered = objective in ("residual", "raw"), seen.baseline_motion is not None
    named = seen.found is not None and seen.found.sigma is not None
    network, why_network = _network(objective, covered, named)
    restarts = c.restarts or (RESTARTS if covered else 1)
    continues = one_step and probe is not None and restarts == 1
    sigma = None if one_step or probe is None or not probe.enough else probe.rms / NOISE_OF_R
    sigma = seen.found.sigma if named and seen.found is not None else sigma
    own = {"stiffness": base.stiffness, "tilt": base.tilt, "rate": (base.rate,)}
    return Plan(
        level=c.level, objective=objective, network=network, order=c.order, features=c.features, drag=c.drag,
        substeps=c.substeps, hold=seen.arrival.hold, delay=seen.arrival.late[0], lag=seen.arrival.late[1],
        forces={"coulomb": c.coulomb, "sticking": bool(c.sticking), "coupled": c.coupled, "diagonal": c.diagonal,
                "alike": c.alike},
        absent=c.absent, turning=seen.turning, spreads=dict(base.spreads),
        start={**own, **base.start},
        outliers=seen.outliers, continues_probe=continues, sigma=sigma, fitted_before=named, restarts=restarts,
        departures=c.departures, dissipation=c.dissipation,
        input_terms=input_terms_of(seen.data.columns), zeros=seen.zeros, drifts=seen.drifts,
        reasons=_reasons(seen, user_settings, named=named, one_step=one_step) | {
            "objective": why,
            "network": why_network,
            "continues_probe": "the probe has the same model" if continues else "another model, or no probe",
            "sigma": "error of the fit that named the terms" if named else _sigma_reason(seen, one_step, sigma),
            "restarts": _restart_reason(user_settings, covered),
        },
    )  # fmt: skip


def _reasons(seen: Look, user_settings: FitConfig, *, named: bool, one_step: bool) -> dict[str, str]:
    """Why the fields of a plan are as they are, where the look at the data says it."""
    prior = "one-step fits use the last" if one_step else "held-out blocks of time choose among them"
    found = {name for name in AS_FOUND if getattr(seen.settings, name) != getattr(user_settings, name)}
    why = seen.structure or AS_SET
    return {name: why if name in found else AS_SET for name in AS_FOUND} | {
        "level": _level_reason(seen, user_settings),
        "turning": "terms of positions on a line, as of a free spring, miss the data by less",
        "substeps": (HALVED if seen.settings.substeps > 1 else KEPT_STEPS) if named else AS_SET,
        "input_terms": AS_SET,
        "drifts": "no sensor was found to drift",
        "zeros": "no recording was found to differ from the others",
        **seen.why,
        "forces": seen.structure or AS_SET,
        "start": "least squares on finite differences" if not seen.base.start else "one linear problem",
        "outliers": _outlier_reason(seen),
        "fitted_before": "the search for terms fitted whole trajectories" if named else "a first fit",
        "departures": "there is no network" if named else prior,
    }


def choose_objective(seen: Look, user_settings: FitConfig) -> tuple[str, str]:
    """Return the objective of the first of `RULES` that is answered, and its reason."""
    for rule in RULES:
        reason = rule.answer(seen, user_settings)
        if reason is not None:
            told = {"as named": user_settings.objective, "as found": seen.settings.objective}
            return told.get(rule.objective, rule.objective), reason
    raise AssertionError("the last rule has no condition")


def _network(objective: str, covered: bool, named: bool) -> tuple[str, str]:
    if named:
        return "none", "the named terms are the whole model"
    if objective == "raw":
        return "plain", "a network alone, to show the collapse of the raw residual"
    if objective != "residual":
        return "potential", "noise hides what a step's correction would learn"
    if covered:
        return "covered", "the baseline's motions fill the holes between samples: one wide layer learns more"
    return "correction", "exact steps show what the rule of order 2 misses"


def _level_reason(seen: Look, config: FitConfig) -> str:
    if config.level != "auto":
        return AS_SET
    if seen.structure is not None and seen.settings.features:
        return seen.structure
    if seen.data.u is not None:
        return "inputs are recorded"
    return "dry or coupled friction is a force" if config.coulomb or config.coupled else "the simplest with damping"


def _outlier_reason(seen: Look) -> str:
    lone = int(seen.spikes.sum())
    if seen.settings.robust != "auto":
        return f"robust '{seen.settings.robust}' was set"
    if lone:
        return f"{lone} samples left out, as spikes or as readings of a sensor that stuck; there may be more"
    return "some samples pull the least-squares start" if seen.outliers else "no single samples stand out"


def _sigma_reason(seen: Look, one_step: bool, sigma: float | None) -> str:
    noise = size(seen.noise, common_unit(seen.data.units), digits=2)
    rough = f"polynomials through nine samples miss them by {noise}" if math.isfinite(seen.noise) else "few samples"
    if one_step:
        return f"one-step fits need none; {rough}"
    return f"{'a one-step fit will measure it' if sigma is None else 'the error of single steps / √6'}; {rough}"


def _restart_reason(config: FitConfig, covered: bool) -> str:
    if config.restarts is not None:
        return AS_SET
    return "a single layer stalls from some initialisations" if covered else "two layers, or none, do not stall"
