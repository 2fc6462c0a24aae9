"""`look`: sampling, noise, outliers, baseline and terms of the data, before the plan of a fit is chosen."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.holds import HOLDS, Arrival
from herglotz.data.input_terms import input_terms_of, with_input_terms
from herglotz.data.noise import roughness, spikes
from herglotz.data.sensors import measured
from herglotz.data.windows import Triples
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.training.baseline import Baseline, across_translations, estimate_baseline, outliers_pull
from herglotz.training.baseline_motion import fit_baseline_motion
from herglotz.training.config import FitConfig
from herglotz.training.hold import with_arrival
from herglotz.training.left_out import LeftOut
from herglotz.training.one_step_fit import fit_one_step, one_step_problem
from herglotz.training.plan import Plan
from herglotz.training.problems.one_step import MANY
from herglotz.training.stages import Stages
from herglotz.training.structure import (
    Structure,
    kept_structure,
    many_are_free,
    search,
    search_of_many,
    start_of_features,
    structure_is_free,
    structured,
    terms_are_free,
)
from herglotz.training.task import NOISY, Task, drag_starts_the_fit

# Memory for each number in q: states, derivatives and held-out residuals (measured: 2.5 to 5.6 kB).
BYTES_PER_NUMBER = 4000
# Iterations of the short one-step fits: the probe measures the noise, and other fits start from the rest.
PROBE = 40
# The baseline explains exact data if its error is below this multiple of the σ of exact data.
EXPLAINED = 100.0


@dataclass(frozen=True)
class Probe:
    """A short one-step fit with a flexible correction, whose remaining error `rms`, in units of q, is noise."""

    model: ContactLagrangian
    rms: float
    residuals: int
    unknowns: int

    @property
    def enough(self) -> bool:
        """Whether there are two residuals for each unknown, so that the error measures noise."""
        return self.residuals >= 2 * self.unknowns


@dataclass(frozen=True)
class Look:
    """The properties of the data that a plan depends on.

    `data` are all samples, with angles unwrapped, inputs as they act, and positions without `zeros` and `drifts` of the
    sensors. `train` is the first part of every trajectory, `unseen` the rest (None: nothing is held out), and `kept`
    the training part without single `spikes`; `outliers`: there may be more. `arrival` is what happens to recorded
    inputs before they act, and `turning` is False where angles were found to be positions on a line; `why` has the
    reasons, also of zeros and drifts. `noise` is the RMS residual of polynomials through nine samples, in units of q,
    an upper bound of the noise. `settings` are the user's, with the level and the structure that the data call for;
    `base` has sizes and starting values. `structure` says in words what was found about the terms (None: no terms were
    searched), and `found` are named terms that follow whole trajectories. `baseline_motion` are motions of a baseline
    that explains exact data, with their error; `probe` is None where the objective is known without it. `outlying` is
    the recording that stands out from a finished model.
    """

    data: Trajectories
    train: Trajectories
    unseen: Trajectories | None
    kept: Trajectories
    spikes: Tensor  # (N_train,) bool
    outliers: bool
    arrival: Arrival
    why: dict[str, str]
    zeros: tuple[float, ...]  # (B · n), recording after recording; empty: 0
    drifts: tuple[float, ...]  # (n) rates of the zeros; empty: 0
    noise: float
    settings: FitConfig
    base: Baseline
    turning: bool = True
    structure: str | None = None
    found: Structure | None = None
    baseline_motion: tuple[Triples, float] | None = None
    probe: Probe | None = None
    outlying: tuple[LeftOut, ...] = ()

    def task(self, stages: Stages) -> Task:
        """What the stages of a fit to these data share."""
        return Task(self.kept, self.base, self.settings, stages)


def look(data: Trajectories, user_settings: FitConfig, stages: Stages, plan: Plan | None = None) -> Look:
    """Measure what the choice of a plan, or a given plan, needs.

    A search for terms may find that the recording is to be read in another way: its hold, zeros of sensors, angles on a
    line. The data are then looked at again, read so, with the terms that were found.

    Raise InputError if the data cannot be used, or do not suit the settings.
    """
    seen = _seen(data, user_settings, stages, plan)
    why, zeros, drifts, turning = {}, (), (), True
    while seen.found is not None and (reading := seen.found.reading):
        found = seen.found
        if found.turning and data.u is not None:
            # The inputs of the model that was found arrive as this look has found it.
            data, why = replace(data, **seen.arrival._asdict()), seen.why | why
        data = replace(data, hold=found.hold) if found.hold else data
        data = with_input_terms(data, found.input_terms) if found.input_terms else data
        data = data if found.turning else on_a_line(data)
        why, turning = why | dict(found.why), turning and found.turning
        zeros, drifts = found.zeros or zeros, found.drifts or drifts
        # A checkpoint remembers what was found with each reading under a name of its own.
        stages = stages.labelled(stages.label + "".join(f", {name} {value}" for name, value in reading.items()))
        # Angles as positions on a line have other terms.
        seen = _seen(data, user_settings, stages, plan, zeros, drifts, found.read() if found.turning else None)
    return replace(seen, why=seen.why | why, turning=turning)


def on_a_line(data: Trajectories) -> Trajectories:
    """The same data with every angle taken for a position on a line."""
    return replace(data.unwrapped(), angles=(False,) * data.dof)


def _seen(
    data: Trajectories, user_settings: FitConfig, stages: Stages, plan: Plan | None,
    zeros: tuple[float, ...] = (), drifts: tuple[float, ...] = (), known: Structure | None = None,
) -> Look:  # fmt: skip
    """The look at sensors with these zeros and drifts; terms that are `known` are not searched."""
    settings = user_settings.resolved(data)
    zeros, drifts = (zeros, drifts) if plan is None else (plan.zeros, plan.drifts)
    recorded, (data, arrival, why) = data, _read(measured(data, zeros, drifts=drifts), settings)
    train, unseen = split(data, settings)
    _check_memory(train)
    dropped = dropped_samples(train, settings)
    kept, drag = train.keep(~dropped), drag_starts_the_fit(settings)
    outliers = settings.robust == "on" or bool(dropped.any())
    outliers = outliers or (settings.robust == "auto" and outliers_pull(kept, drag=drag))
    settings = settings if plan is None else plan.applied(settings)
    # A search for terms decides about sticking where the user does not.
    settings = replace(settings, sticking=bool(settings.sticking))
    base = estimate_baseline(kept, outliers=outliers, drag=drag, substeps=settings.substeps)
    base = across_translations(base, kept, settings.translations, outliers=outliers)
    seen = Look(
        data, train, unseen, kept, dropped, outliers, arrival, why, zeros, drifts,
        noise=roughness(kept), settings=settings, base=base,
    )  # fmt: skip
    if plan is None:
        seen = _with_terms(seen, user_settings, stages, _other_holds(recorded, arrival), known)
        probed = user_settings.objective == "auto" and _needs_probe(seen)
    else:
        seen, probed = replace(seen, base=plan.started(base)), plan.continues_probe
        if plan.network == "covered":
            seen = replace(seen, baseline_motion=_baseline_motion(seen.task(stages)))
    return replace(seen, probe=_probe(seen.task(stages))) if probed else seen


def _needs_probe(seen: Look) -> bool:
    """Whether the objective depends on the noise, which a probe measures; not where `look` looks again."""
    c, again = seen.settings, seen.found is not None and bool(seen.found.reading)
    plain = c.objective == "auto" and c.supervision == "q" and not c.sticking
    return plain and seen.baseline_motion is None and not again


def _other_holds(recorded: Trajectories, arrival: Arrival) -> tuple[str, ...]:
    """The holds that a search may try: all but the chosen one, where nothing states it and inputs are not late."""
    is_open = recorded.u is not None and not recorded.hold and not any(arrival.late)
    return tuple(hold for hold in HOLDS if hold != arrival.hold) if is_open else ()


def _read(data: Trajectories, settings: FitConfig) -> tuple[Trajectories, Arrival, dict[str, str]]:
    """The data as a fit takes them, how their recorded inputs arrive, and why."""
    data = data if settings.use_inputs else replace(data, u=None)
    data = data.unwrapped().to(dtype=settings.torch_dtype, device=settings.device)
    return with_arrival(data, split(data, settings)[0])


def read_like(data: Trajectories, seen: Look) -> Trajectories:
    """Recordings as a look has read its own: sensors, angles, and inputs as they act."""
    data = data if seen.turning else on_a_line(data)
    data = data if data.u is None else replace(data, **seen.arrival._asdict())
    data = with_input_terms(data, input_terms_of(seen.data.columns))
    return _read(measured(data, seen.zeros, drifts=seen.drifts), seen.settings)[0]


def split(data: Trajectories, settings: FitConfig) -> tuple[Trajectories, Trajectories | None]:
    """The first part of every trajectory, which is fitted, and the rest; None where nothing is held out."""
    return (data, None) if settings.train_fraction == 1 else data.split_time(settings.train_fraction)


def dropped_samples(train: Trajectories, settings: FitConfig) -> Tensor:
    """Which samples a fit leaves out because they are single spikes, (N,) bool; with `robust` "off" no sample."""
    return torch.zeros_like(train.t, dtype=torch.bool) if settings.robust == "off" else spikes(train)


def _check_memory(data: Trajectories) -> None:
    """Refuse data whose fit takes more memory than there is.

    InputError says how much a fit takes, and which thinning leaves data that can be fitted.
    """
    needed, memory = BYTES_PER_NUMBER * data.q.numel(), _physical_memory()
    if needed <= memory:
        return
    raise InputError(
        f"a fit to {data.samples} samples takes about {needed / 1e9:.3g} GB of memory, and this machine has "
        f"{memory / 1e9:.3g}; thin them (--every {math.ceil(needed / memory)}, Trajectories.thinned) or take fewer"
    )


def _physical_memory() -> float:
    """Memory of this machine in bytes; inf where the system does not say."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return math.inf


def _with_terms(
    seen: Look, user_settings: FitConfig, stages: Stages, holds: Sequence[str], known: Structure | None
) -> Look:
    """The look with named terms that follow trajectories, with a dictionary of features, or with the baseline alone."""
    kept, base, settings = seen.kept, seen.base, seen.settings
    few, many = terms_are_free(kept, user_settings), many_are_free(kept, user_settings)
    if few or many:
        plain = replace(settings, sticking=user_settings.sticking)

        def find() -> Structure:
            named = search if few else search_of_many
            return known or named(kept, base, plain, outliers=seen.outliers, holds=holds)

        found = kept_structure("terms", find, base, settings, stages)
        seen = replace(seen, structure=found.reason, found=found)
        # Where angles were found to be positions on a line, `look` looks again.
        if found.sigma is not None or not found.turning:
            return replace(seen, settings=found.config, base=found.base)
    if structure_is_free(kept, user_settings):
        of = kept_structure("structure", lambda: structured(kept, base, settings), base, settings, stages)
        seen = replace(seen, settings=of.config, base=of.base, structure=of.reason)
    elif settings.features:
        seen = replace(seen, base=start_of_features(kept, base, settings))
    return replace(seen, baseline_motion=_baseline_motion(seen.task(stages)))


def _baseline_motion(task: Task) -> tuple[Triples, float] | None:
    """Triples of the baseline's motion with their error, where the baseline explains exact data."""
    c = task.config
    more = c.features or c.known or c.terms or c.alike or c.mass_width or c.translations
    if c.objective not in ("auto", "residual") or more or c.supervision != "q" or task.data.u is not None:
        return None
    # Few motions fill no space of so many dimensions, and more motions take hours.
    if task.data.dof >= MANY:
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
