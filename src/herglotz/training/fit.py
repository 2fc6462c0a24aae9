"""`fit`: trajectories in, a trained and evaluated model out."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from herglotz.data import Trajectories, as_trajectories
from herglotz.data.anything import split_options
from herglotz.data.checks import check_sizes
from herglotz.data.files import locked, remove_leftovers
from herglotz.data.gaps import complete
from herglotz.data.holds import Arrival
from herglotz.data.input_terms import with_input_terms, with_waves
from herglotz.data.splits import trained_whole
from herglotz.errors import InputError, refuse, tell
from herglotz.models import refuse_own
from herglotz.stepping.state import state_of
from herglotz.threads import one_thread
from herglotz.training.choose import choose
from herglotz.training.config import FitConfig
from herglotz.training.disagreeing import look_at_agreeing, outlying
from herglotz.training.distributed import is_first
from herglotz.training.equation import departure, equation_of, notes_of
from herglotz.training.equation_words import Joint
from herglotz.training.evaluate import evaluate
from herglotz.training.feedback import pushes
from herglotz.training.look import look, on_a_line
from herglotz.training.objectives import OBJECTIVES
from herglotz.training.own_fit import fit_own
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.plan import Plan
from herglotz.training.run import Run
from herglotz.training.run_folder import FILES, LOG, MANIFEST, reading_told
from herglotz.training.stages import Progress, Stages, log_result, tensorboard_log
from herglotz.training.summary import left_out_of, outlying_of
from herglotz.training.uncertainty import Laplace, joint_of, laplace
from herglotz.training.verdict import changes_with_time

# Changes of the data below this multiple of the σ of exact data are rounding.
ROUNDING = 3.0


@one_thread()
@torch.inference_mode(mode=False)
def fit(
    data: Any,
    config: FitConfig | None = None,
    *,
    model: Any = None,
    plan: Plan | Run | None = None,
    out: str | Path | None = None,
    progress: Progress = None,
    resume: bool = False,
    tensorboard: str | Path | None = None,
    **settings: Any,
) -> Run:
    """Train a discrete contact Lagrangian on positions.

    Angles are unwrapped, and each trajectory is split in time. A first look at the first part chooses a plan, which the
    fit follows; a free run from the last state of the first part predicts the rest.

    Parameters
    ----------
    data
        Trajectories of positions, with inputs u if any, and with s and p for `config.supervision`. Or anything that
        `herglotz.data.as_trajectories` reads: a path, a DataFrame, arrays.
    config
        Settings; default `FitConfig()`.
    model
        Your own L_d to train in place of the package's model: a `torch.nn.Module` L_d(q0, q1, s0, h), with `at(u)` for
        inputs, and derivatives by `partials` or by autograd. Its parameters are made float64 (or `dtype`) and trained,
        both in place. Only settings of the fit apply (`herglotz.training.own_fit.TAKEN`).
    plan
        A plan to follow instead of choosing one, or a run with a plan: the same terms, from the same starting values.
        This is how two loads of one machine are fitted (`herglotz.export.between`). To change a plan, start from
        `Plan.from_dict(run.metrics["plan"])`.
    out
        Folder for the checkpoint (`checkpoint.pt`); nothing is written without it. Use `save_run` for the result.
    progress
        True: show a bar; None: only on a terminal; "lines": one line on stderr after every stage; "iterations": also
        after every iteration.
    resume
        Continue from the checkpoint in `out`, if there is one.
    tensorboard
        Folder for a log that TensorBoard shows while the fit runs (extra `herglotz[tensorboard]`).
    **settings
        Single settings of `FitConfig`, which replace those of `config` (`level="affine"`), and options of reading
        (`h=0.01`, `time="t"`, `angles="theta"`, `group="run"`; see `herglotz.data.as_trajectories`).

    Returns
    -------
    Run
        Model, states, metrics and history. All metrics are finite; `metrics["extrapolation_status"]` reports a failed
        prediction.

    Raises
    ------
    InputError
        If the data cannot be used, the settings are wrong, the plan has other coordinates, TensorBoard is missing, or
        another process fits into `out`.

    Examples
    --------
    >>> run = hz.fit("motion.csv", level="affine")
    >>> run = hz.fit(df, time="t", angles="theta", group="run")
    >>> run = hz.fit([a, b], h=0.01)
    """
    if not isinstance(config, FitConfig | None):
        raise InputError(f"config must be a FitConfig, got {type(config).__name__}; times go to time=: fit(q, time=t)")
    reading, changes = split_options(settings)
    config = (config or FitConfig()).changed(changes)
    data = with_waves(as_trajectories(data, **reading), config.frequencies)
    plan = _planned(plan, data)
    data = weighed(data, config.objective if plan is None else plan.objective, config.supervision)
    as_read = data
    if model is not None:
        return _fit_own(data, model, config, progress, reading, plan or out or resume or tensorboard)
    data = data if plan is None or plan.turning else on_a_line(data)
    data = data if plan is None else with_input_terms(data, plan.input_terms)
    data = told_arrival(data, config, None if plan is None else Arrival(plan.hold, plan.delay, plan.lag))
    check_sizes(data.source or "data", data.q, data.names)
    if short := trained_whole(data.lengths, config.train_fraction):
        tell(f"{data.source or 'data'}: {short}")
    checkpoint = None if out is None else Path(out) / "checkpoint.pt"
    with tensorboard_log(tensorboard) as log, nullcontext() if out is None else locked(out):
        # Only the first process holds the lock.
        if checkpoint is not None and is_first():
            remove_leftovers(checkpoint.parent, (checkpoint.name, *FILES, MANIFEST, LOG))
        run = _fit(data, config, plan, Stages(progress, checkpoint, _key(data, config, plan), resume, log))
        # Later recordings have no angles either if the fit found positions on a line.
        line = {"angles": False} if any(as_read.angles) and not any(run.data.angles) else {}
        run = replace(run, reading=reading_told({**reading, **line}, data.names))
        if log is not None:
            log_result(log, run.metrics, {"summary": run.summary(), "equation": str(run.equation())})
        return run


def _planned(given: Plan | Run | None, data: Trajectories) -> Plan | None:
    """The given plan, or the plan of the given run."""
    if isinstance(given, Run):
        refuse_own(given.model, "plan", "leave plan= out, and give the module: model=net")
    plan = Plan.from_dict(given.metrics["plan"]) if isinstance(given, Run) and "plan" in given.metrics else given
    if plan is None:
        return None
    if not isinstance(plan, Plan):
        raise InputError(f"plan must be a Plan, or a run that followed one, got {type(given).__name__}")
    if (count := len(plan.start["stiffness"])) != data.dof:
        raise InputError(f"{data.source or 'data'}: the plan has {count} coordinates, the data have {data.dof}")
    return plan


def weighed(data: Trajectories, objective: str, supervision: str) -> Trajectories:
    """The data that an objective can use: trajectory fits use every position, others only complete samples."""
    return data if supervision == "q" and objective in ("auto", "trajectory") else complete(data)


def _fit_own(
    data: Trajectories, model: Any, config: FitConfig, progress: Progress, reading: dict[str, Any], other: Any
) -> Run:
    """A fit of the user's own L_d."""
    refuse({"model= is fitted without plan, out, resume and tensorboard; leave them out": other})
    started = time.perf_counter()
    run = fit_own(data, model, config, Stages(progress))
    run.metrics["seconds"] = round(time.perf_counter() - started, 3)
    _tell_outlying(run.metrics, data)
    return replace(run, reading=reading_told(reading, data.names))


def told_arrival(data: Trajectories, config: FitConfig, planned: Arrival | None) -> Trajectories:
    """The data with the input timing of the settings, else of the data, else of the plan."""
    if data.u is None:
        return data
    # The phase of a periodic force is learned.
    if config.frequencies:
        return replace(data, delay=0.0, lag=0.0)
    wanted = Arrival(data.hold, config.input_delay, config.actuator_lag)
    known = [x for x in (wanted, data.arrival, planned) if x]
    hold, delay, lag = (next((x for x in each if x not in ("", None)), each[0]) for each in zip(*known, strict=True))
    return replace(data, hold=hold, delay=delay, lag=lag)


def _fit(data: Trajectories, config: FitConfig, plan: Plan | None, stages: Stages) -> Run:
    """The run of a fit: look, plan, objective, evaluation, then the equation and the verdict in words."""
    started = time.perf_counter()
    with stages.bar:
        seen, left_out = (look(data, config, stages, plan), ()) if plan else look_at_agreeing(data, config, stages)
        found = {"left_out": [one.as_dict() for one in left_out]}
        for words in left_out_of(found, data):
            tell(f"{data.source or 'data'}: warning: left out is {words}")
        plan = plan or choose(seen, config)
        seen = replace(seen, settings=plan.applied(seen.settings))
        task = seen.task(stages)
        fitted = OBJECTIVES[plan.objective](task, seen, plan)
        suspects = () if left_out else outlying(seen, fitted.model, fitted.sigma)
        seen = replace(seen, outlying=() if suspects and changes_with_time(task, fitted, seen, suspects) else suspects)
        found["outlying"] = [one.as_dict() for one in seen.outlying]
        _tell_outlying(found, data)
        run = evaluate(task, seen, plan, fitted, config)
    if seen.found is not None and plan.network == "none":
        run.metrics["compared"] = list(seen.found.compared)
    run.metrics.update(found)
    posterior = _posterior(run, plan)
    joint = _joint(posterior, ROUNDING * task.exact)
    printed = run if posterior is None or joint is None else _of_short_steps(run, posterior)
    run.metrics["equation"] = equation_of(printed, joint, notes_of(run, printed)).as_dict()
    run.metrics["verdict"] = ". ".join(filter(None, (run.metrics["verdict"], pushes(run, joint))))
    run.metrics["seconds"] = round(time.perf_counter() - started, 3)
    return run


def _tell_outlying(metrics: Mapping[str, Any], data: Trajectories) -> None:
    """Print a warning for each recording that may be of something else."""
    for words in outlying_of(metrics, data):
        tell(f"{data.source or 'data'}: warning: {words}")


def _posterior(run: Run, plan: Plan) -> Laplace | None:
    """The posterior of all numbers, if named terms were fitted to trajectories; else None.

    The posterior needs a model that follows whole trajectories.
    """
    if plan.network == "none" and run.metrics["follows_data"]:
        with suppress(InputError):
            return laplace(run)
    return None


def _joint(posterior: Laplace | None, least: float) -> Joint | None:
    """The joint posterior, if positions are precise only to `least`, in units of q; None if no posterior is joint."""
    if posterior is not None:
        with suppress(InputError):
            return joint_of(posterior, least)
    return None


def _of_short_steps(run: Run, posterior: Laplace) -> Run:
    """The run with the numbers to which those of its model tend as steps get shorter, for the equation.

    A rule of order 2 with steps h fits a stiffness k that is too small by the share h² k/12, which is many standard
    deviations of a long recording. The run is returned unchanged if the exact motion of the new numbers is no nearer to
    the motion of the model, or farther from it than the data are: the equation then has the numbers of the model, and
    states the rule of the step.
    """
    if (limit := posterior.of_short_steps()) is None:
        return run
    model, first = deepcopy(run.model), list(run.data.offsets)
    ParameterVector(model).set(limit[0])
    states = run.states.joined.detach().clone()
    states[first, : limit[1].shape[1]] = limit[1].to(states)
    printed = replace(run, model=model, states=state_of(states))
    found, own = departure(run, printed), departure(run)
    return printed if found is not None and own is not None and found.moved <= min(own.moved, own.missed) else run


def _key(data: Trajectories, config: FitConfig, plan: Plan | None) -> str:
    """A hash that identifies a fit: its data, its settings except the device, and a given plan."""
    settings = {**config.to_dict(), "device": "", "plan": None if plan is None else plan.to_dict()}
    return hashlib.sha256((data.digest() + json.dumps(settings, sort_keys=True)).encode()).hexdigest()
