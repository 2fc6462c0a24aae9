"""`fit`: trajectories in, a trained and judged model out."""

from __future__ import annotations

import hashlib
import json
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import herglotz
from herglotz.data import Trajectories
from herglotz.data.spikes import spikes, without
from herglotz.data.splits import leading_rows
from herglotz.data.windows import Triples
from herglotz.mechanics import legendre_minus, legendre_plus
from herglotz.models import ContactLagrangian
from herglotz.training.adam import DECAY, adam
from herglotz.training.baseline import Baseline, estimate_baseline, outliers_pull
from herglotz.training.baseline_motion import fit_baseline_motion
from herglotz.training.build import build_model, dragged
from herglotz.training.config import FitConfig
from herglotz.training.inputs import step_inputs
from herglotz.training.judge import Fitted, judge, states_everywhere, with_dropped
from herglotz.training.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.matrix_free import DENSE, MatrixFree
from herglotz.training.residual import ResidualProblem
from herglotz.training.robust import FREEDOM
from herglotz.training.run import Run, box_of
from herglotz.training.smoothing_fit import SMOOTHED, fit_smoothing
from herglotz.training.stages import Stages
from herglotz.training.structure import EXACT, ROWS, kept_structure, nothing_told, start_of_features
from herglotz.training.supervision import SupervisedProblem
from herglotz.training.trajectory_fit import TrajectoryFit, check_size, fit_trajectories, make_prior

PROBE = 40  # iterations of the flexible fit that measures the noise
NOISY = 3e-4  # a one-step error above this fraction of the motion's size is noise, not the fit: 40 iterations reach it
COVERED, HEAT = 4, 30  # restarts of a single layer, and the iterations after which the best of them goes on
APART = 7919  # between the seeds of the restarts


def fit(
    data: Trajectories,
    config: FitConfig | None = None,
    *,
    out: str | Path | None = None,
    progress: bool | None = None,
    resume: bool = False,
) -> Run:
    """Train a discrete contact Lagrangian on positions.

    Angles are unwrapped; each trajectory is split in time; `config.objective` says how the first part is fitted; the
    rest is predicted by a free run from the states estimated on the first.

    Parameters
    ----------
    data
        Trajectories of positions, and of inputs u where there are any; of s and p as `config.supervision` says.
    config
        Settings; default `FitConfig()`.
    out
        Folder for the checkpoint (`checkpoint.pt`); nothing is written without it. Use `save_run` for the result.
    progress
        Show progress bars; None: on a terminal only.
    resume
        Go on from the checkpoint in `out`, if there is one.

    Returns
    -------
    Run
        Model, states, metrics and history. Always finite: a prediction that fails says so in
        `metrics["extrapolation_status"]`.

    Raises
    ------
    InputError
        If the data cannot be used or the settings are wrong.
    """
    started = time.perf_counter()
    told = config or FitConfig()
    config = told.resolved(data)
    if not config.use_inputs:
        data = replace(data, u=None)
    data = data.unwrapped().to(dtype=config.torch_dtype, device=config.device)
    train = data if config.train_fraction == 1 else data.split_time(config.train_fraction)[0]
    check_size(train, *([SMOOTHED] if config.objective == "smoothing" else []))
    dropped = torch.zeros_like(train.t, dtype=torch.bool) if config.robust == "off" else spikes(train)
    kept = without(train, dropped)
    suspect = config.robust == "on" or bool(dropped.any())
    suspect = suspect or (config.robust == "auto" and outliers_pull(kept, drag=dragged(config)))
    base = estimate_baseline(kept, outliers=suspect, drag=dragged(config), substeps=config.substeps)
    checkpoint = None if out is None else Path(out) / "checkpoint.pt"
    free = nothing_told(kept, told)
    stages = Stages(progress, checkpoint, _key(data, told if free else config), resume)
    if free:
        config, base = kept_structure(kept, base, config, NOISY, stages)
    elif config.features:
        base = start_of_features(kept, base, config)
    fitted = _fit_training_part(kept, base, config, stages, FREEDOM if suspect else None)
    fitted = replace(fitted, states=with_dropped(fitted, train, dropped))
    if fitted.used is not None:
        dropped[~dropped] = ~fitted.used
    states, status = states_everywhere(fitted, data, train.lengths, base.model_step)
    metrics = judge(fitted, data, train, dropped, states, base, config.robust != "off")
    metrics |= {
        "extrapolation_status": status,
        "outlier_samples": leading_rows(data, train.lengths)[dropped].tolist(),
        "seconds": round(time.perf_counter() - started, 3),
        "seed": config.seed,
        "level": config.level,
        "data": {"source": data.source, "sha256": data.digest(), "trajectories": len(data), "samples": data.samples},
        "versions": {
            "herglotz": herglotz.__version__,
            "torch": torch.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }
    x, n = fitted.states, data.dof
    box = box_of(x[:, :n], x[:, n : 2 * n], x[:, 2 * n])
    h = train.typical_step / config.substeps
    return Run(fitted.model, config, metrics, data, train.lengths, states, h, box, stages.history)


def _fit_training_part(
    train: Trajectories, base: Baseline, config: FitConfig, stages: Stages, freedom: float | None
) -> Fitted:
    """Measure the noise where that is asked for, then fit by the objective it calls for."""
    objective = config.objective
    if config.supervision != "q":
        objective = "residual"
    size = max(base.scale)
    exact = EXACT * size if config.dtype == "float64" else 1e-5 * size
    if objective in ("trajectory", "smoothing"):
        model = build_model(base, config, "potential")
        _, rms = _fit_residual(
            model, train, base, config, stages, "one-step start", PROBE, 0.02 * size, freedom=freedom
        )
        by = _fit_by_trajectory if objective == "trajectory" else _fit_by_smoothing
        return by(model, train, base, config, stages, rms / 6**0.5)
    model = build_model(base, config, "plain" if objective == "raw" else "correction")
    expected = _expected(model, train, base, config, exact)
    if objective == "auto" and expected is None:
        result, rms = _fit_residual(model, train, base, config, stages, "one-step probe", PROBE, sigma=exact)
        enough = len(train.triples(base.max_step)) * train.dof >= 2 * result.x.numel()
        if rms > NOISY * size or not enough:
            sigma = rms / 6**0.5 if enough else None
            rigid = build_model(base, config, "potential")
            _, rigid_rms = _fit_residual(
                rigid, train, base, config, stages, "one-step start", PROBE, 0.02 * size, freedom=freedom
            )
            return _fit_by_trajectory(rigid, train, base, config, stages, sigma or rigid_rms / 6**0.5)
    metric = "raw" if objective == "raw" else "position"
    iterations = config.iterations
    restarts = config.restarts or (1 if expected is None else COVERED)
    if restarts > 1 or expected is not None:
        network = "plain" if metric == "raw" else "correction" if expected is None else "covered"
        model, iterations = _race(network, restarts, train, base, config, stages, exact, metric, expected)
    result, rms = _fit_residual(
        model, train, base, config, stages, "one-step error", iterations, exact, metric, expected=expected
    )
    noise = max(rms / 6**0.5, exact) if metric == "position" else exact
    # The states are fitted too (parameters held), so that the free run does not start from two noisy samples.
    notes, s = {"iterations": result.iterations, "reason": result.reason}, None
    if expected is not None:
        notes["baseline_error"] = expected[1]
    if config.supervision != "q":
        assert train.s is not None
        notes["unit_of_s"] = unit = float(result.x[-1].exp())
        s = train.s / unit
    found = fit_trajectories(model, train, base, noise, config.departures, config.iterations, stages, frozen=True, s=s)
    notes["follows_data"] = found is not None
    states = _fitted_states(found) if found is not None else _states_of_pairs(model, train)
    return Fitted(model, states, "raw" if metric == "raw" else "residual", noise, notes)


def _fit_by_trajectory(
    model: ContactLagrangian, train: Trajectories, base: Baseline, config: FitConfig, stages: Stages, sigma: float
) -> Fitted:
    found = fit_trajectories(
        model, train, base, sigma, config.departures, config.iterations, stages, robust=config.robust
    )
    if found is None:  # the model keeps the parameters of the one-step fit
        notes = {"reason": "the model cannot follow the data over 20 steps", "follows_data": False}
        return Fitted(model, _states_of_pairs(model, train), "trajectory", sigma, notes)
    found.problem.flat.set(found.theta)
    notes = {"departure": found.departure, "held_out_rms": _plain(found.held_out), "reason": found.result.reason}
    notes |= {"robust": found.problem.freedom is not None, "segment_steps": found.problem.grid.longest}
    notes["follows_data"] = True
    return Fitted(model, _fitted_states(found), "trajectory", found.sigma, notes, found.problem.used)


def _fit_by_smoothing(
    model: ContactLagrangian, train: Trajectories, base: Baseline, config: FitConfig, stages: Stages, sigma: float
) -> Fitted:
    found = fit_smoothing(model, train, base, sigma, config.departures, config.iterations, stages, robust=config.robust)
    if found is None:
        notes = {"reason": "the model has no step near the data", "follows_data": False}
        return Fitted(model, _states_of_pairs(model, train), "smoothing", sigma, notes)
    found.problem.flat.set(found.theta)
    notes = {"departure": found.departure, "held_out_rms": _plain(found.held_out), "reason": found.result.reason}
    notes |= {
        "robust": found.problem.freedom is not None,
        "follows_data": found.follows_data(),
        "process": found.problem.process,
    }
    return Fitted(model, found.problem.states(found.x), "smoothing", found.problem.sigma, notes)


def _plain(held_out: dict[float, Tensor]) -> dict[str, float]:
    """RMS over the folds, by prior strength."""
    return {f"{k:g}": float(v.square().mean().sqrt()) for k, v in held_out.items()}


def _fitted_states(found: TrajectoryFit) -> Tensor:
    """The fitted trajectory at the samples, (N, 2n+1)."""
    grid, x = found.problem.grid, found.path.x.flatten(0, 1)
    out = x.new_empty(found.problem.data.samples, x.shape[-1])
    out[grid.sample] = x[grid.node]
    return out


def _states_of_pairs(model: ContactLagrangian, data: Trajectories) -> Tensor:
    """The recorded positions with the momenta that FL⁺ gives each pair and s = 0, for a model that follows no data."""
    out = data.q.new_zeros(data.samples, 2 * data.dof + 1)
    steps, u = data.steps(), step_inputs(model, data)
    i, zero = steps.index, torch.zeros_like(steps.h)
    with torch.no_grad():
        L_d = model if u is None else model.at(u[i])
        _, p, _ = legendre_plus(L_d, data.q[i], data.q[i + 1], zero, steps.h)
        first = torch.tensor(data.offsets, device=i.device)
        h = data.t[first + 1] - data.t[first]
        L_d = model if u is None else model.at(u[first])
        _, p_first, _ = legendre_minus(L_d, data.q[first], data.q[first + 1], torch.zeros_like(h), h)
    n = data.dof
    out[:, :n] = data.q
    out[i + 1, n : 2 * n] = p
    out[first, n : 2 * n] = p_first
    return out


def _race(
    network: str,
    restarts: int,
    train: Trajectories,
    base: Baseline,
    config: FitConfig,
    stages: Stages,
    sigma: float,
    metric: str,
    expected: tuple[Triples, float] | None,
) -> tuple[ContactLagrangian, int]:
    """The model that is ahead after a short fit from each draw of the weights, and the iterations left: some stall."""
    heat = min(HEAT, config.iterations // (3 * restarts))
    raced = []
    for k in range(restarts):
        model = build_model(base, replace(config, seed=config.seed + k * APART), network)
        name = f"one-step error, start {k + 1}"
        result, _ = _fit_residual(model, train, base, config, stages, name, heat, sigma, metric, expected=expected)
        raced.append((result.cost, k, model))
    return min(raced)[2], config.iterations - heat * restarts


def _fit_residual(
    model: ContactLagrangian,
    train: Trajectories,
    base: Baseline,
    config: FitConfig,
    stages: Stages,
    name: str,
    iterations: int,
    sigma: float,
    metric: str = "position",
    freedom: float | None = None,
    expected: tuple[Triples, float] | None = None,
) -> tuple[OptimiserResult, float]:
    """Minimise the one-step objective, write the result into the model, and return it with its RMS."""
    prior = make_prior(model, base, config.departures[-1])
    problem: ResidualProblem | SupervisedProblem
    if config.supervision == "q":
        problem = ResidualProblem(
            model, train, metric=metric, max_step=base.max_step, sigma=sigma, prior=prior, freedom=freedom,
            expected=expected, most=ROWS * prior.start.numel() if config.coupled and base.start else None,
        )  # fmt: skip
    else:
        momenta = config.supervision == "qps"
        problem = SupervisedProblem(
            model, train, momenta=momenta, max_step=base.max_step, sigma=sigma, prior=prior, freedom=freedom
        )
    large = isinstance(problem, ResidualProblem) and not problem.coupled and len(prior.start) > DENSE
    target = MatrixFree(problem) if large and isinstance(problem, ResidualProblem) else problem
    if config.optimiser != "lm":
        total = 20 * iterations
        decay = DECAY if config.optimiser == "adamw" else 0.0

        def optimise(x: Tensor, callback):
            return adam(
                problem, x, max_iterations=total, learning_rate=config.learning_rate, decay=decay, batch=config.batch,
                seed=config.seed, callback=callback,
            )  # fmt: skip
    else:
        total = iterations

        def optimise(x: Tensor, callback):
            return levenberg_marquardt(target, x, max_iterations=total, callback=callback)

    result = stages.run(name, problem.start(), total, optimise)
    rms = float(problem.residuals(result.x).square().mean().sqrt())
    problem.flat.set(result.x[: len(problem.flat.get())])
    return result, rms


def _expected(
    model: ContactLagrangian, train: Trajectories, base: Baseline, config: FitConfig, exact: float
) -> tuple[Triples, float] | None:
    """Triples of the baseline's motion and how well they are known, where the baseline explains exact data."""
    own = config.features or config.known or config.alike or config.mass_width or config.supervision != "q"
    if model.correction is None or not model.config.baseline or own or train.u is not None or model.s_enters_motion:
        return None
    motion = fit_baseline_motion(train, base, min(100 * exact, NOISY * max(base.scale)))
    return None if motion is None else (motion.triples(train, base), max(motion.error, exact))


def _key(data: Trajectories, config: FitConfig) -> str:
    """Identifies a fit: its data and its settings (the device does not matter)."""
    settings = json.dumps({**config.to_dict(), "device": ""}, sort_keys=True)
    return hashlib.sha256((data.digest() + settings).encode()).hexdigest()
