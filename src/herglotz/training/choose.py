"""`choose`: the plan of a fit, each decision with its reason, from a `Look` at the data."""

from __future__ import annotations

import math

from herglotz.data.input_terms import input_terms_of
from herglotz.data.units import common_unit, size
from herglotz.training.config import FitConfig
from herglotz.training.look import Look
from herglotz.training.one_step_fit import NOISE_OF_R
from herglotz.training.plan import FORCES, SETTINGS, Plan
from herglotz.training.task import NOISY

# Random initialisations of a single layer: some end with a hundred times the error of others.
RESTARTS = 4
AS_SET = "as set, or by default"
# The objective by the first of these questions that is answered with yes (`answers`).
RULES = {
    "Are s or p fitted too?": "residual",
    "Did the user name the objective?": "as named",
    "Can friction hold a joint?": "trajectory",
    "Do named terms follow whole trajectories?": "trajectory",
    "Are positions missing?": "trajectory",
    "Does a dictionary of features explain the steps?": "as found",
    "Does the baseline's equation of motion explain the steps?": "residual",
    "Does a flexible model miss single steps?": "trajectory",
    "Are there fewer than two one-step errors an unknown?": "trajectory",
    "Else": "residual",
}
RECORDED = {"q": "", "qs": "s", "qps": "s and p"}
# Why a model has its network.
NETWORKS = {
    "none": "the named terms are the whole model",
    "plain": "a network alone, to show the collapse of the raw residual",
    "potential": "noise hides what a step's correction would learn",
    "covered": "the baseline's motions fill the holes between samples: one wide layer learns more",
    "correction": "exact steps show what the rule of order 2 misses",
}
# How an objective uses the strengths of the prior.
PRIORS = {"trajectory": "held-out blocks of time choose among them", "smoothing": "smoothing uses the weakest"}
# Why angles turn in a plan, or are positions on a line; and why a plan names no longest segments.
TURNING = {
    True: "no terms of positions on a line were better",
    False: "terms of positions on a line, as of a free spring, miss the data by less",
}
NO_LONGEST = "no search ended at shorter segments"
# Settings that the search for terms decides.
AS_FOUND = ("order", "features", "drag", "absent", "dissipation")


def answers(seen: Look, user_settings: FitConfig) -> tuple[str, ...]:
    """The reason of a yes to each of `RULES`; "" for a no."""
    c, found, probe, motion = user_settings, seen.found, seen.probe, seen.baseline_motion
    recorded, chosen = RECORDED[c.supervision], seen.settings.objective
    limit = NOISY * max(seen.base.scale)
    missed = probe and f"a flexible model misses single steps by {probe.rms:.2g}"
    return (
        recorded and f"supervision '{c.supervision}': only one-step errors use the recorded {recorded}",
        AS_SET if c.objective != "auto" else "",
        "a joint that stands still says nothing about its forces in one step" if seen.settings.sticking else "",
        f"a model of named terms follows whole trajectories to {_size(seen, found.sigma)}"
        if found and found.sigma is not None else "",
        "some positions are missing, which single steps cannot leave out" if seen.kept.observed is not None else "",
        (seen.structure or "") if c.objective == "auto" != chosen else "",
        f"the baseline's equation of motion explains every step to {motion[1]:.2g}: exact" if motion else "",
        f"{missed}, more than {limit:.2g}: noise" if probe and probe.rms > limit else "",
        f"{probe.residuals} one-step errors for {probe.unknowns} unknowns, fewer than two each"
        if probe and not probe.enough else "",
        f"{missed}, less than {limit:.2g}: exact",
    )  # fmt: skip


def choose_objective(seen: Look, user_settings: FitConfig) -> tuple[str, str]:
    """The objective of the first of `RULES` that is answered with yes, and the reason."""
    rules = zip(RULES.values(), answers(seen, user_settings), strict=True)
    objective, reason = next((objective, reason) for objective, reason in rules if reason)
    as_said = {"as named": user_settings.objective, "as found": seen.settings.objective}
    return as_said.get(objective, objective), reason


def choose(seen: Look, user_settings: FitConfig) -> Plan:
    """The plan that these data and the user's settings call for."""
    c, base, probe = seen.settings, seen.base, seen.probe
    objective, why = choose_objective(seen, user_settings)
    one_step, covered = objective in ("residual", "raw"), seen.baseline_motion is not None
    # Named terms that follow whole trajectories.
    found = None if seen.found is None or seen.found.sigma is None else seen.found
    named, longest = found is not None, 0 if found is None else found.length
    exact = "covered" if covered else "correction"
    network = "none" if named else "plain" if objective == "raw" else exact if one_step else "potential"
    restarts = c.restarts or (RESTARTS if covered else 1)
    continues = one_step and probe is not None and restarts == 1
    sigma = None if one_step or probe is None or not probe.enough else probe.rms / NOISE_OF_R
    sigma = sigma if found is None else found.sigma
    return Plan(
        **{name: getattr(c, name) for name in SETTINGS}, objective=objective, network=network,
        hold=seen.arrival.hold, delay=seen.arrival.late[0], lag=seen.arrival.late[1],
        forces={name: bool(getattr(c, name)) for name in FORCES}, turning=seen.turning, spreads=dict(base.spreads),
        start={"stiffness": base.stiffness, "tilt": base.tilt, "rate": (base.rate,), **base.start},
        outliers=seen.outliers, continues_probe=continues, sigma=sigma, fitted_before=named, restarts=restarts,
        longest=longest,
        input_terms=input_terms_of(seen.data.columns), zeros=seen.zeros, drifts=seen.drifts,
        reasons=_reasons(seen, user_settings, named, objective) | {
            "objective": why,
            "network": NETWORKS[network],
            "longest": "over longer ones the search followed or foretold nothing" if longest else NO_LONGEST,
            "continues_probe": "the probe has the same model" if continues else "another model, or no probe",
            "sigma": "error of the fit that named the terms" if named else _sigma_reason(seen, one_step, sigma),
            "restarts": _restart_reason(user_settings, covered),
        },
    )  # fmt: skip


def _reasons(seen: Look, user_settings: FitConfig, named: bool, objective: str) -> dict[str, str]:
    """The reasons of those fields of a plan that the look at the data decides."""
    changed = {name for name in AS_FOUND if getattr(seen.settings, name) != getattr(user_settings, name)}
    why = seen.structure or AS_SET
    return {name: why if name in changed else AS_SET for name in AS_FOUND} | {
        "level": _level_reason(seen, user_settings),
        "turning": TURNING[seen.turning],
        "substeps": _substeps_reason(seen) if named else AS_SET,
        "input_terms": AS_SET,
        "drifts": "no sensor was found to drift",
        "zeros": "no recording was found to differ from the others",
        **seen.why,
        "forces": seen.structure or AS_SET,
        "start": "least squares on finite differences" if not seen.base.start else "one linear problem",
        "outliers": _outlier_reason(seen),
        "fitted_before": "the search for terms fitted the same model" if named else "a first fit",
        "departures": "there is no network" if named else PRIORS.get(objective, "one-step fits use the last"),
    }


def _level_reason(seen: Look, config: FitConfig) -> str:
    if config.level != "auto":
        return AS_SET
    if seen.structure is not None and seen.settings.features:
        return seen.structure
    if seen.data.u is not None:
        return "inputs are recorded"
    return "dry or coupled friction is a force" if config.coulomb or config.coupled else "the simplest with damping"


def _substeps_reason(seen: Look) -> str:
    if seen.settings.substeps > 1:
        return "the fit needed shorter steps: halved ones change the motion"
    return "halved steps change the motion too little to be worth their time, or other terms stand in for them"


def _outlier_reason(seen: Look) -> str:
    lone = int(seen.spikes.sum())
    if seen.settings.robust != "auto":
        return f"robust '{seen.settings.robust}' was set"
    if lone:
        return f"{lone} samples left out, as spikes or as readings of a sensor that stuck; there may be more"
    return "some samples pull the least-squares start" if seen.outliers else "no single samples stand out"


def _sigma_reason(seen: Look, one_step: bool, sigma: float | None) -> str:
    rough = "few samples"
    if math.isfinite(seen.noise):
        rough = f"polynomials through nine samples miss them by {_size(seen, seen.noise)}"
    if one_step:
        return f"one-step fits need none; {rough}"
    return f"{'a one-step fit will measure it' if sigma is None else 'the error of single steps / √6'}; {rough}"


def _restart_reason(config: FitConfig, covered: bool) -> str:
    if config.restarts is not None:
        return AS_SET
    return "a single layer stalls from some initialisations" if covered else "two layers, or none, do not stall"


def _size(seen: Look, x: float) -> str:
    """A length in the unit of the data."""
    return size(x, common_unit(seen.data.units), digits=2)
