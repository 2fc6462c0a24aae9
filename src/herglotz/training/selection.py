"""`select`: fit the levels, compare their held-out errors, keep the one with fewest parameters that is not beaten."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories, as_trajectories
from herglotz.data.anything import split_options
from herglotz.data.units import common_unit
from herglotz.errors import InputError, did_you_mean, refuse, tell
from herglotz.models import LEVELS
from herglotz.threads import one_thread
from herglotz.training.config import FitConfig
from herglotz.training.cross_validation import beaten
from herglotz.training.evaluate import unseen_errors
from herglotz.training.fit import fit
from herglotz.training.run import Run
from herglotz.training.run_folder import reading_told
from herglotz.training.stages import Progress
from herglotz.training.structure import structure_is_free, terms_are_free

# Not "full": from positions alone its latent s0 is found at some seeds and missed at others.
CANDIDATES = tuple(level for level in LEVELS if level != "full")
# "auto", the default of `fit`, is the richest and comes last.
LADDER = (*LEVELS, "auto")
# Least number of blocks of held-out time over all trajectories.
BLOCKS = 5
# Steps of a timed rollout: enough to make the cost of the call small.
TIMED_STEPS = 20


@dataclass(frozen=True)
class Candidate:
    """One level, fitted from one seed or several.

    `errors` are held-out RMS errors of free runs, in units of q, inf for a failed run; `step_us` is the processor time
    of one step of one trajectory, in µs.
    """

    level: str
    runs: tuple[Run, ...]
    errors: Tensor  # (seeds, blocks)
    step_us: float

    @property
    def error(self) -> float:
        """Median over the seeds of the held-out RMS."""
        return float(self.of_seeds.median())

    @property
    def of_seeds(self) -> Tensor:
        """Held-out RMS of each seed, (seeds,)."""
        return self.errors.square().mean(1).sqrt()

    @property
    def median_seed(self) -> int:
        """The place of the run with the median held-out RMS (the lower of two)."""
        return int(self.of_seeds.argsort()[(len(self.runs) - 1) // 2])

    @property
    def best(self) -> Run:
        """The run of the median seed, which represents the level."""
        return self.runs[self.median_seed]

    @property
    def parameters(self) -> int:
        """Number of trained parameters."""
        return self.best.metrics["parameters"]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON; None for an error that is not finite."""
        seeds = [x if x < float("inf") else None for x in self.of_seeds.tolist()]
        return {
            "level": self.level,
            "held_out_rms": self.error if self.error < float("inf") else None,
            "held_out_rms_of_seeds": seeds,
            "parameters": self.parameters,
            "step_us": self.step_us,
            "fit_seconds": [run.metrics["seconds"] for run in self.runs],
        }


@dataclass(frozen=True)
class Selection:
    """The table of the ladder, and the chosen level.

    Parameters
    ----------
    candidates
        One per level: its runs, and their errors over the held-out blocks, in units of q.
    chosen
        The chosen candidate; `run` is its representative fit.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate

    @property
    def run(self) -> Run:
        """The representative run of the chosen level."""
        return self.chosen.best

    def table(self) -> str:
        """Level × held-out error × spread × parameters × cost as text, in 80 columns; → marks the chosen level."""
        unit = common_unit(self.run.data.units)
        lines = [f"Free runs over the held-out time{unit and f', in {unit}'}; the arrow marks the chosen level:"]
        lines += [f"  {'level':<13}{'held-out RMS':>12}{'min … max':>20}{'parameters':>12}{'µs/step':>9}{'fit, s':>8}"]
        for c in self.candidates:
            low, high = float(c.of_seeds.min()), float(c.of_seeds.max())
            seconds = sum(run.metrics["seconds"] for run in c.runs) / len(c.runs)
            mark, spread = "→" if c is self.chosen else " ", f"{low:.3g} … {high:.3g}"
            lines.append(
                f"{mark} {c.level:<13}{c.error:>12.3g}{spread:>20}{c.parameters:>12}{c.step_us:>9.0f}{seconds:>8.1f}"
            )
        return "\n".join(lines)

    def to_json(self) -> str:
        """The table as JSON."""
        rows = [c.to_dict() for c in self.candidates]
        return json.dumps({"chosen": self.chosen.level, "levels": rows}, indent=2, allow_nan=False) + "\n"


@one_thread()
def select(
    data: Any,
    levels: Sequence[str] | None = None,
    seeds: int = 3,
    config: FitConfig | None = None,
    *,
    out: str | Path | None = None,
    progress: Progress = None,
    resume: bool = False,
    **settings: Any,
) -> Selection:
    """Fit every level on the first part of each trajectory; score free runs over the rest.

    The held-out time is divided into blocks (at least five in all); the score of a fit is the RMS over its blocks. The
    best level beats another by the rule of the prior's strengths (`cross_validation.beaten`). Levels that are beaten at
    the first seed are fitted once, the others from every seed. The level with the fewest trained parameters is chosen
    among those that the best level does not beat; of equals, the first. The median seeds are compared, and a level is
    not beaten whose error is inside the best level's own range over seeds.

    Parameters
    ----------
    data
        Trajectories of positions, or anything else that `fit` takes.
    levels
        Levels of `herglotz.models.LEVELS`, and "auto", the default of `fit`. None: those of `levels_for`.
    seeds
        Fits per level, with seeds config.seed, config.seed + 1, …; one if the level is beaten at the first seed, or if
        nothing is random (no network, no batch).
    config
        All other settings of the fits; `train_fraction` must be below 1.
    out
        Folder for one checkpoint per fit, from which `resume` continues after an interruption.
    progress, resume
        As for `fit`.
    **settings
        Single settings of `FitConfig`, which replace those of `config` (`iterations=20`), and options of reading, as
        for `fit`.

    Returns
    -------
    Selection
        Every fit with its errors; `run` is the chosen one, and `table()` shows why.

    Raises
    ------
    InputError
        If a level or a setting is unknown, nothing is held out, or no level has a finite held-out error.
    """
    reading, changes = split_options(settings)
    refuse({
        "model: select compares levels of our own models; fit(data, model=...) fits yours": "model" in changes,
        "level: say which levels to compare, levels=['linear', 'affine']": "level" in changes,
    })  # fmt: skip
    config = (config or FitConfig()).changed(changes)
    check_levels(levels)
    refuse({
        f"seeds must be >= 1, got {seeds}": seeds < 1,
        "train fraction 1 holds nothing out to compare levels on; use 0.667, say": config.train_fraction == 1,
    })  # fmt: skip
    data = as_trajectories(data, **reading)
    levels = levels_for(data, config) if levels is None else levels
    ladder, done = [level for level in LADDER if level in levels], 0
    began, silent = time.monotonic(), progress is False or (progress is None and not sys.stderr.isatty())

    def one(level: str, seed: int, planned: int) -> Run:
        """A fit, of as many as are planned."""
        nonlocal done
        folder = None if out is None else Path(out) / "fits" / f"{level}-{seed}"
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        run = fit(data, replace(config, level=level, seed=seed), out=folder, progress=progress, resume=resume)
        done += 1
        if not silent:
            rms, left = run.metrics.get("extrapolation_rms"), (time.monotonic() - began) / done * (planned - done)
            error = "fails" if rms is None else f"{rms:.3g}"
            text = f"fit {done} of {planned}: {run.decided.level}, seed {seed}: held-out RMS {error}"
            tell(f"{text}; about {left:.0f} s left")
        return replace(run, reading=reading_told(reading, data.names))

    runs = {level: [one(level, config.seed, len(ladder))] for level in ladder}
    errors = {level: block_errors(first) for level, (first,) in runs.items()}
    best = min(errors.values(), key=lambda x: float(x.square().mean()))
    again = [
        level
        for level, (first,) in runs.items()
        if (first.model.config.networks or config.batch) and (errors[level] is best or not beaten(errors[level], best))
    ]
    for level in again:
        runs[level] += [one(level, config.seed + k, len(ladder) + len(again) * (seeds - 1)) for k in range(1, seeds)]
    candidates = [
        Candidate(level, tuple(own), torch.stack([block_errors(run) for run in own]), step_cost(own[0]))
        for level, own in runs.items()
    ]
    return Selection(tuple(candidates), _simplest(candidates))


def check_levels(levels: Sequence[str] | None) -> None:
    """Raise unless every level is known and there is at least one; None stands for `levels_for`."""
    unknown = [level for level in levels or () if level not in LADDER]
    names, near = ", ".join(LADDER), did_you_mean("".join(unknown[:1]), LADDER)
    refuse({
        f"unknown level {', '.join(map(repr, unknown))}; choose some of {names}{near}": unknown,
        f"no level is named; choose some of {names}": levels is not None and not levels,
    })  # fmt: skip


def levels_for(data: Trajectories, config: FitConfig) -> tuple[str, ...]:
    """The default levels of `select`.

    All but "full". If the settings name forces, only "forced"; if inputs are recorded and used, "forced" and "auto",
    which adds dry friction. "auto" as well if `fit` searches for terms or for a structure that no level has
    (`herglotz.training.structure`).
    """
    if data.u is not None and config.use_inputs and not config.coulomb:
        return ("forced", "auto")
    if config.coulomb or config.coupled or config.input_map:
        return ("forced",)
    left = replace(config, level="auto")
    return (*CANDIDATES, "auto") if structure_is_free(data, left) or terms_are_free(data, left) else CANDIDATES


def block_errors(run: Run) -> Tensor:
    """RMS of the run's free prediction over each block of held-out time, (blocks,), in units of q; inf if it failed."""
    errors = unseen_errors(run)
    pieces = -(-BLOCKS // len(errors))
    blocks = [part for x in errors for part in x.tensor_split(min(pieces, len(x))) if len(part)]
    if not blocks:
        raise InputError("the data leave no sample to hold out; record longer, or lower the train fraction")
    rms = torch.stack([x.square().mean().sqrt() for x in blocks])
    return rms.nan_to_num(nan=torch.inf, posinf=torch.inf).cpu()


def _simplest(candidates: list[Candidate]) -> Candidate:
    best = min(candidates, key=lambda c: c.error)
    if not best.error < float("inf"):
        raise InputError("no level predicts the held-out part: every free run failed; check the data and their step")

    def as_good(c: Candidate) -> bool:
        within = c is best or c.error <= float(best.of_seeds.max())
        return within or not beaten(c.errors[c.median_seed], best.errors[best.median_seed])

    return min(filter(as_good, candidates), key=lambda c: c.parameters)


def step_cost(run: Run) -> float:
    """Processor time of a step of the eager stepper for one trajectory, in µs, the best of three measurements."""
    q, p, s = (x[:1] for x in run.states)
    costs = []
    with torch.no_grad():
        for _ in range(3):
            began = time.process_time()
            run.stepper.rollout(q, p, s, h=run.h, steps=TIMED_STEPS)
            costs.append((time.process_time() - began) / TIMED_STEPS)
    return 1e6 * min(costs)
