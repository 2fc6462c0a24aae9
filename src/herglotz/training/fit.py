"""`fit`: trajectories in, a trained and evaluated model out."""

from __future__ import annotations

import hashlib
import json
import math
import time
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from herglotz.data import Trajectories, as_trajectories
from herglotz.data.anything import split_options
from herglotz.data.lock import locked
from herglotz.data.units import DEGREES
from herglotz.errors import InputError
from herglotz.threads import one_thread
from herglotz.training.choose import choose
from herglotz.training.config import FitConfig
from herglotz.training.equation import Equation, equation_of
from herglotz.training.evaluate import evaluate
from herglotz.training.look import Look, look
from herglotz.training.objectives import OBJECTIVES
from herglotz.training.plan import Plan
from herglotz.training.run import Run
from herglotz.training.stages import Progress, Stages
from herglotz.training.task import Task
from herglotz.training.uncertainty import laplace

INNER = 0.75  # of the training part that rivals are fitted to; they run free over the rest


@one_thread()
def fit(
    data: Any,
    config: FitConfig | None = None,
    *,
    plan: Plan | None = None,
    out: str | Path | None = None,
    progress: Progress = None,
    resume: bool = False,
    **settings: Any,
) -> Run:
    """Train a discrete contact Lagrangian on positions.

    Angles are unwrapped; each trajectory is split in time; the first part is looked at, a plan is chosen and followed;
    the rest is predicted by a free run from the states estimated on the first.

    Parameters
    ----------
    data
        Trajectories of positions, and of inputs u where there are any; of s and p as `config.supervision` says. Or what
        `herglotz.data.as_trajectories` reads: a path, a DataFrame, arrays.
    config
        Settings; default `FitConfig()`.
    plan
        Follow this plan instead of choosing one: `Plan.from_dict(run.metrics["plan"])` repeats a fit's decisions.
    out
        Folder for the checkpoint (`checkpoint.pt`); nothing is written without it. Use `save_run` for the result.
    progress
        Show one bar; None: on a terminal only; "lines": one line on stderr after every stage; "iterations": after every
        iteration, too.
    resume
        Go on from the checkpoint in `out`, if there is one.
    **settings
        Single settings of `FitConfig`, over those of `config` (`level="affine"`), and how data are to be read
        (`h=0.01`, `time="t"`, `angles="theta"`, `group="run"`; see `herglotz.data.as_trajectories`).

    Returns
    -------
    Run
        Model, states, metrics and history. Always finite: a prediction that fails says so in
        `metrics["extrapolation_status"]`.

    Raises
    ------
    InputError
        If the data cannot be used, the settings are wrong, or another process is fitting into `out`.

    Examples
    --------
    >>> run = hz.fit("motion.csv", level="affine")
    >>> run = hz.fit(df, time="t", angles="theta", group="run")
    >>> run = hz.fit([a, b], h=0.01)
    """
    reading, changes = split_options(settings)
    config = (config or FitConfig()).changed(changes)
    data = as_trajectories(data, **reading)
    with nullcontext() if out is None else locked(out):
        return _fit(data, config, plan, out, progress, resume)


def _fit(
    data: Trajectories,
    config: FitConfig,
    plan: Plan | None,
    out: str | Path | None,
    progress: Progress,
    resume: bool,
) -> Run:
    started = time.perf_counter()
    checkpoint = None if out is None else Path(out) / "checkpoint.pt"
    stages = Stages(progress, checkpoint, _key(data, config, plan), resume)
    with stages.bar:
        seen = look(data, config, stages, plan)
        if plan is None and seen.found is not None and seen.found.doubt:
            seen, plan = held_out_winner(data, config, stages, seen)
        plan = plan or choose(seen, config)
        task = Task(seen.kept, seen.base, seen.settings, stages)
        run = evaluate(task, seen, plan, OBJECTIVES[plan.objective](task, seen, plan))
    run.metrics["equation"] = _equation(run, plan).as_dict()
    if degrees := [name for name, _, unit in data.columns if name in data.names and unit in DEGREES]:
        run.metrics["degrees"] = degrees  # the model has radians; errors are told in degrees too
    run.metrics["seconds"] = round(time.perf_counter() - started, 3)
    return run


def _equation(run: Run, plan: Plan) -> Equation:
    """The learned equation, with standard deviations where named terms were fitted to trajectories."""
    covariance = None
    if plan.network == "none" and run.metrics["follows_data"]:
        with suppress(InputError):  # whole trajectories cannot be followed: no deviations
            posterior = laplace(run)
            covariance = posterior.covariance[: len(posterior.theta), : len(posterior.theta)]
    return equation_of(run, covariance)


def held_out_winner(data: Trajectories, config: FitConfig, stages: Stages, seen: Look) -> tuple[Look, Plan]:
    """Named terms or networks: the plan whose free run over the last quarter of the training part errs less."""
    other = look(data, config, stages, named=False)
    plans = [choose(seen, config), choose(other, config)]

    def errors() -> dict[str, Any]:
        inner = replace(config, train_fraction=INNER)
        runs = [fit(seen.train, inner, plan=plan, progress=False) for plan in plans]
        return {"rms": [run.metrics["extrapolation_rms"] for run in runs]}

    rms = [math.inf if x is None else x for x in stages.keep("held-out free runs", errors)["rms"]]
    best = rms.index(min(rms))
    why = f"free runs over the last quarter of the training part miss {rms[0]:.2g} with named terms, {rms[1]:.2g} with "
    why += f"networks ({plans[1].objective})"
    plan = replace(plans[best], reasons={**plans[best].reasons, "objective": why, "network": why})
    return (seen, other)[best], plan


def _key(data: Trajectories, config: FitConfig, plan: Plan | None) -> str:
    """Identifies a fit: its data, its settings and a given plan (the device does not matter)."""
    settings = {**config.to_dict(), "device": "", "plan": None if plan is None else plan.to_dict()}
    return hashlib.sha256((data.digest() + json.dumps(settings, sort_keys=True)).encode()).hexdigest()
