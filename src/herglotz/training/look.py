"""`look`: sampling, noise, outliers, baseline and structure of the data, before any decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.holds import HOLDS, Arrival
from herglotz.data.input_terms import with_input_terms
from herglotz.data.roughness import roughness
from herglotz.data.sensors import measured
from herglotz.data.spikes import spikes
from herglotz.data.windows import Triples
from herglotz.models import ContactLagrangian
from herglotz.training.baseline import Baseline, across_translations, estimate_baseline, outliers_pull
from herglotz.training.baseline_motion import fit_baseline_motion
from herglotz.training.config import FitConfig
from herglotz.training.hold import with_arrival
from herglotz.training.one_step_fit import fit_one_step, one_step_problem
from herglotz.training.plan import Plan
from herglotz.training.problems.one_step import MANY
from herglotz.training.smoothing_fit import SMOOTHED
from herglotz.training.stages import Stages
from herglotz.training.structure import (
    Structure,
    kept_structure,
    search,
    start_of_features,
    structure_is_free,
    structured,
    terms_are_free,
)
from herglotz.training.task import NOISY, Task, drag_starts_the_fit
from herglotz.training.trajectory_fit import check_size

PROBE = 40  # iterations of the short one-step fits: one measures the noise, other fits start from the others
EXPLAINED = 100.0  # a baseline with an error below this multiple of the σ of exact data explains the data


@dataclass(frozen=True)
class Probe:
    """A short one-step fit with a flexible correction; its remaining error is noise."""

    model: ContactLagrangian
    rms: float  # one-step error, in units of q
    residuals: int
    unknowns: int

    @property
    def enough(self) -> bool:
        """Whether there are two residuals an unknown, so that the error means something."""
        return self.residuals >= 2 * self.unknowns


@dataclass(frozen=True)
class Look:
    """The properties of the data that a plan depends on."""

    data: Trajectories  # all, angles unwrapped, with the inputs that act
    train: Trajectories  # the first part of every trajectory
    unseen: Trajectories | None  # the rest; None: nothing is held out
    kept: Trajectories  # of the first part all but single spikes
    spikes: Tensor  # (N_train,) bool
    outliers: bool  # more than single spikes are suspected
    arrival: Arrival  # what happens to recorded inputs before they act
    why_arrival: dict[str, str]  # the reason of each of its fields
    zeros: tuple[float, ...]  # (B · n) what the sensors read at 0, recording after recording; empty: 0; `data` has q
    why_zeros: str  # why they are what they are; empty: no recording was found to differ
    drifts: tuple[float, ...]  # (n) rates at which these zeros drift; empty: 0; `data` is without
    noise: float  # RMS residual of polynomials through nine samples, in units of q: the noise, or more
    settings: FitConfig  # the user's, with the level and the structure that the data call for
    base: Baseline  # sizes and starting values
    why_drifts: str = ""  # why they drift so; empty: they were not found to
    why_input_terms: str = ""  # why inputs have terms; empty: as told
    turning: bool = True  # angles turn; False: they were found to be positions on a line
    structure: str | None = None  # what was found about the terms, in words; None: it was not asked
    found: Structure | None = None  # named terms that whole trajectories were fitted with
    # Where the baseline explains exact data: its motions, their error.
    baseline_motion: tuple[Triples, float] | None = None
    probe: Probe | None = None  # None: the objective is known without it

    def task(self, stages: Stages) -> Task:
        """What the stages of a fit to these data share."""
        return Task(self.kept, self.base, self.settings, stages)

    @property
    def leaves_objective(self) -> bool:
        """Whether the objective hangs on the noise, which a probe measures."""
        c = self.settings
        return c.objective == "auto" and c.supervision == "q" and self.baseline_motion is None and not c.sticking


def look(data: Trajectories, user_settings: FitConfig, stages: Stages, plan: Plan | None = None) -> Look:
    """Measure what the choice of a plan, or a given plan, needs.

    Raise InputError if the data cannot be used, or do not suit the settings.
    """
    seen, zeros, drifts = _seen(data, user_settings, stages, plan, (), ()), (), ()
    changed: dict[str, Any] = {}  # what a look again does not say
    while (found := seen.found) is not None and (
        found.hold or found.input_terms or found.zeros or found.drifts or not found.turning
    ):
        kept = found._replace(hold="", input_terms=(), zeros=(), why_zeros="", drifts=(), why_drifts="")
        known = kept if found.turning else None
        label = stages.label
        if found.hold:
            told = f"the terms that were found with hold {seen.arrival.hold} miss the data by less with {found.hold}"
            data, label = replace(data, hold=found.hold), label + f", hold {found.hold}"
            changed["why_arrival"] = seen.why_arrival | {"hold": told}
        if found.input_terms:
            terms = ", ".join(found.input_terms)
            data, label = with_input_terms(data, found.input_terms), label + f", inputs {terms}"
            changed["why_input_terms"] = "held-out blocks of time are missed by less with them"
        if found.zeros:
            zeros, label, changed["why_zeros"] = found.zeros, label + f", zeros {found.zeros}", found.why_zeros
        if found.drifts:
            drifts, label, changed["why_drifts"] = found.drifts, label + f", drifts {found.drifts}", found.why_drifts
        if not found.turning:
            data, label, changed["turning"] = on_a_line(data), label + ", on a line", False
        stages = stages.labelled(label)
        seen = _seen(data, user_settings, stages, plan, zeros, drifts, known)
    return replace(seen, **changed)


def on_a_line(data: Trajectories) -> Trajectories:
    """The same with angles that are positions on a line."""
    return replace(data.unwrapped(), angles=(False,) * data.dof)


def _seen(
    data: Trajectories, user_settings: FitConfig, stages: Stages, plan: Plan | None, zeros: tuple[float, ...],
    drifts: tuple[float, ...], known: Structure | None = None,
) -> Look:  # fmt: skip
    """What `look` gives of sensors with these zeros (`herglotz.training.sensor_zeros`), or of known terms."""
    settings = user_settings.resolved(data)
    zeros, drifts = (zeros, drifts) if plan is None else (plan.zeros, plan.drifts)
    said, (data, arrival, why_arrival) = data, _read(measured(data, zeros, drifts=drifts), settings)
    train, unseen = split(data, settings)
    check_size(train, *([SMOOTHED] if settings.objective == "smoothing" else []))
    dropped = torch.zeros_like(train.t, dtype=torch.bool) if settings.robust == "off" else spikes(train)
    kept, drag = train.keep(~dropped), drag_starts_the_fit(settings)
    outliers = settings.robust == "on" or bool(dropped.any())
    outliers = outliers or (settings.robust == "auto" and outliers_pull(kept, drag=drag))
    settings = settings if plan is None else plan.applied(settings)
    settings = replace(settings, sticking=bool(settings.sticking))  # what is not said a search for terms asks
    base = estimate_baseline(kept, outliers=outliers, drag=drag, substeps=settings.substeps)
    base = across_translations(base, kept, settings.translations, outliers=outliers)
    seen = Look(
        data, train, unseen, kept, dropped, outliers, arrival, why_arrival, zeros, "", drifts,
        noise=roughness(kept), settings=settings, base=base,
    )  # fmt: skip
    if plan is None:
        seen = _with_terms(seen, user_settings, stages, _other_holds(said, arrival), known)
    else:
        seen = replace(seen, base=plan.started(base))
        if plan.network == "covered":
            seen = replace(seen, baseline_motion=_baseline_motion(seen.task(stages)))
    asked = user_settings.objective == "auto" and seen.leaves_objective
    if asked if plan is None else plan.continues_probe:
        seen = replace(seen, probe=_probe(seen.task(stages)))
    return seen


def _other_holds(said: Trajectories, arrival: Arrival) -> tuple[str, ...]:
    """The holds that inputs may have beside the one that was chosen, where nothing says it and they are not late."""
    open_to_choice = said.u is not None and not said.hold and not any(arrival.late)
    return tuple(hold for hold in HOLDS if hold != arrival.hold) if open_to_choice else ()


def _read(data: Trajectories, settings: FitConfig) -> tuple[Trajectories, Arrival, dict[str, str]]:
    """The data as a fit takes them, how their recorded inputs arrive, and why."""
    data = data if settings.use_inputs else replace(data, u=None)
    data = data.unwrapped().to(dtype=settings.torch_dtype, device=settings.device)
    return with_arrival(data, split(data, settings)[0])


def split(data: Trajectories, settings: FitConfig) -> tuple[Trajectories, Trajectories | None]:
    """The first part of every trajectory, which is fitted, and the rest; None where nothing is held out."""
    return (data, None) if settings.train_fraction == 1 else data.split_time(settings.train_fraction)


def _with_terms(
    seen: Look, user_settings: FitConfig, stages: Stages, holds: Sequence[str], known: Structure | None
) -> Look:
    """Named terms that follow trajectories, or terms of a dictionary of features, or those of the baseline."""
    kept, base, settings = seen.kept, seen.base, seen.settings
    if terms_are_free(kept, user_settings):
        plain = replace(settings, sticking=user_settings.sticking)
        find = lambda: known or search(kept, base, plain, outliers=seen.outliers, holds=holds)  # noqa: E731
        found = kept_structure("terms", find, base, settings, stages)
        seen = replace(seen, structure=found.reason, found=found)
        if found.sigma is not None or not found.turning:  # else `look` looks again
            return replace(seen, settings=found.config, base=found.base)
    if structure_is_free(kept, user_settings):
        of = kept_structure("structure", lambda: structured(kept, base, settings), base, settings, stages)
        seen = replace(seen, settings=of.config, base=of.base, structure=of.reason)
    elif settings.features:
        seen = replace(seen, base=start_of_features(kept, base, settings))
    return replace(seen, baseline_motion=_baseline_motion(seen.task(stages)))


def _baseline_motion(task: Task) -> tuple[Triples, float] | None:
    """Return triples of the baseline's motion with their error, where the baseline explains exact data."""
    c = task.config
    more = c.features or c.known or c.terms or c.alike or c.mass_width or c.translations
    if c.objective not in ("auto", "residual") or more or c.supervision != "q" or task.data.u is not None:
        return None
    if task.data.dof >= MANY:  # few motions fill no space of so many dimensions, and more take hours
        return None
    model = task.build("correction")
    if model.correction is None or model.s_enters_motion:
        return None
    worst = min(EXPLAINED * task.exact, NOISY * task.size)
    motion = fit_baseline_motion(task.data, task.base, worst)
    return None if motion is None else (motion.triples(task.data, task.base), max(motion.error, task.exact))


def _probe(task: Task) -> Probe:
    model = task.build("correction")
    problem = one_step_problem(task, model, task.exact, short=True)
    _, rms = fit_one_step(replace(task, hurried=True), problem, "one-step probe", PROBE)
    residuals = len(task.data.triples(task.base.max_step)) * task.data.dof
    return Probe(model, rms, residuals, len(problem.start()))
