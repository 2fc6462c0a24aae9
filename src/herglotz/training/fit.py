"""`fit`: trajectories in, a trained and judged model out."""

from __future__ import annotations

import hashlib
import json
import platform
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import herglotz
from herglotz.data import Trajectories
from herglotz.mechanics import legendre_minus, legendre_plus
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.training.adam import adam
from herglotz.training.baseline import Baseline, estimate_baseline
from herglotz.training.config import FitConfig
from herglotz.training.grid import substeps
from herglotz.training.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.residual import ResidualProblem
from herglotz.training.run import Run, box_of
from herglotz.training.stages import Stages
from herglotz.training.trajectory_fit import TrajectoryFit, fit_trajectories, make_prior

PROBE = 40  # iterations of the flexible fit that measures the noise
NOISY = 1e-4  # a one-step error above this fraction of the motion's size is noise, not the fit
EXACT = 1e-8  # σ of exact data relative to the motion's size


@dataclass(frozen=True)
class _Fitted:
    """What a fit of the training part hands to the judgement."""

    model: ContactLagrangian
    states: Tensor  # (N_train, 2n+1) states at the training samples
    objective: str
    sigma: float
    notes: dict[str, Any]


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
        Trajectories of positions; anything else they hold is ignored.
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
    config = config or FitConfig()
    started = time.perf_counter()
    data = data.unwrapped().to(dtype=config.torch_dtype, device=config.device)
    train = data if config.train_fraction == 1 else data.split_time(config.train_fraction)[0]
    base = estimate_baseline(train)
    checkpoint = None if out is None else Path(out) / "checkpoint.pt"
    stages = Stages(progress, checkpoint, _key(data, config), resume)
    fitted = _fit_training_part(train, base, config, stages)
    states, status = _states_everywhere(fitted, data, train.lengths, base.max_step)
    metrics = _judge(fitted, data, train, states, base)
    metrics |= {
        "extrapolation_status": status,
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
    return Run(fitted.model, config, metrics, data, train.lengths, states, train.typical_step, box, stages.history)


def _fit_training_part(train: Trajectories, base: Baseline, config: FitConfig, stages: Stages) -> _Fitted:
    """Measure the noise where that is asked for, then fit by the objective it calls for."""
    objective = config.objective
    size = max(base.scale)
    exact = EXACT * size if config.dtype == "float64" else 1e-5 * size
    if objective == "trajectory":
        model = _model(base, config, "potential")
        _, rms = _fit_residual(model, train, base, config, stages, "one-step start", PROBE, sigma=0.02 * size)
        return _fit_by_trajectory(model, train, base, config, stages, rms / 6**0.5)
    model = _model(base, config, "plain" if objective == "raw" else "correction")
    if objective == "auto":
        result, rms = _fit_residual(model, train, base, config, stages, "one-step probe", PROBE, sigma=exact)
        enough = len(train.triples(base.max_step)) * train.dof >= 2 * result.x.numel()
        if rms > NOISY * size or not enough:
            sigma = rms / 6**0.5 if enough else None
            rigid = _model(base, config, "potential")
            _, rigid_rms = _fit_residual(rigid, train, base, config, stages, "one-step start", PROBE, 0.02 * size)
            return _fit_by_trajectory(rigid, train, base, config, stages, sigma or rigid_rms / 6**0.5)
    metric = "raw" if objective == "raw" else "position"
    result, rms = _fit_residual(
        model, train, base, config, stages, "one-step error", config.iterations, exact, metric=metric
    )
    noise = max(rms / 6**0.5, exact) if metric == "position" else exact
    # The states are fitted too (parameters held), so that the free run does not start from two noisy samples.
    found = fit_trajectories(model, train, base, noise, config.departures, config.iterations, stages, frozen=True)
    notes = {"iterations": result.iterations, "reason": result.reason, "follows_data": found is not None}
    states = _fitted_states(found) if found is not None else _states_of_pairs(model, train)
    return _Fitted(model, states, "raw" if metric == "raw" else "residual", noise, notes)


def _fit_by_trajectory(
    model: ContactLagrangian, train: Trajectories, base: Baseline, config: FitConfig, stages: Stages, sigma: float
) -> _Fitted:
    found = fit_trajectories(model, train, base, sigma, config.departures, config.iterations, stages)
    if found is None:  # the model keeps the parameters of the one-step fit
        notes = {"reason": "the model cannot follow the data over 20 steps", "follows_data": False}
        return _Fitted(model, _states_of_pairs(model, train), "trajectory", sigma, notes)
    found.problem.flat.set(found.theta)
    held_out = {f"{k:g}": float(v.square().mean().sqrt()) for k, v in found.held_out.items()}
    notes = {"departure": found.departure, "held_out_rms": held_out, "reason": found.result.reason}
    return _Fitted(model, _fitted_states(found), "trajectory", found.sigma, notes | {"follows_data": True})


def _fitted_states(found: TrajectoryFit) -> Tensor:
    """The fitted trajectory at the samples, (N, 2n+1)."""
    grid, x = found.problem.grid, found.path.x.flatten(0, 1)
    out = x.new_empty(found.problem.data.samples, x.shape[-1])
    out[grid.sample] = x[grid.node]
    return out


def _states_of_pairs(model: ContactLagrangian, data: Trajectories) -> Tensor:
    """The recorded positions with the momenta that FL⁺ gives each pair and s = 0, for a model that follows no data."""
    out = data.q.new_zeros(data.samples, 2 * data.dof + 1)
    steps = data.steps()
    i, zero = steps.index, torch.zeros_like(steps.h)
    with torch.no_grad():
        _, p, _ = legendre_plus(model, data.q[i], data.q[i + 1], zero, steps.h)
        first = torch.tensor(data.offsets, device=i.device)
        h = data.t[first + 1] - data.t[first]
        _, p_first, _ = legendre_minus(model, data.q[first], data.q[first + 1], torch.zeros_like(h), h)
    n = data.dof
    out[:, :n] = data.q
    out[i + 1, n : 2 * n] = p
    out[first, n : 2 * n] = p_first
    return out


def _model(base: Baseline, config: FitConfig, network: str) -> ContactLagrangian:
    """A model with the network that the objective needs: the correction, the potential's, or a plain one alone."""
    model = ContactLagrangian(
        ModelConfig(
            angles=base.angles,
            level=config.level,
            scale=base.scale,
            speed=base.speed,
            stiffness=base.stiffness,
            tilt=base.tilt,
            rate=base.rate,
            potential_width=config.potential_width if network == "potential" else 0,
            damping_width=config.damping_width,
            correction_width=config.correction_width if network != "potential" else 0,
            baseline=network != "plain",
            seed=config.seed,
            activation=config.activation,
            mass_width=config.mass_width if network != "plain" else 0,
            action_width=config.action_width,
            coulomb=config.coulomb,
        )
    )
    return model.to(dtype=config.torch_dtype, device=config.device)


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
) -> tuple[OptimiserResult, float]:
    """Minimise the one-step objective, write the result into the model, and return it with its RMS."""
    prior = make_prior(model, base, config.departures[-1])
    problem = ResidualProblem(model, train, metric=metric, max_step=base.max_step, sigma=sigma, prior=prior)
    if config.optimiser == "adam":
        total = 20 * iterations

        def optimise(x: Tensor, callback):
            return adam(problem, x, max_iterations=total, learning_rate=config.learning_rate, callback=callback)
    else:
        total = iterations

        def optimise(x: Tensor, callback):
            return levenberg_marquardt(problem, x, max_iterations=total, callback=callback)

    result = stages.run(name, problem.start(), total, optimise)
    rms = float(problem.residuals(result.x).square().mean().sqrt())
    problem.flat.set(result.x[: len(problem.flat.get())])
    return result, rms


def _states_everywhere(
    fitted: _Fitted, data: Trajectories, train_lengths: tuple[int, ...], max_step: float
) -> tuple[State, str]:
    """States at every sample: fitted ones on the training part, a free run from the last of them after it."""
    known, n = fitted.states, data.dof
    out = data.q.new_full((data.samples, 2 * n + 1), torch.nan)
    stepper, status, done = Stepper(fitted.model), "ok", 0
    for first, length, trained in zip(data.offsets, data.lengths, train_lengths, strict=True):
        out[first : first + trained] = known[done : done + trained]
        done += trained
        if trained == length:
            continue
        h, stops = _fine_steps(data.t[first + trained - 1 : first + length], max_step)
        start = out[first + trained - 1]
        with torch.no_grad():
            run = stepper.rollout(start[:n], start[n : 2 * n], start[2 * n], h=h)
        after = torch.cat([run.q, run.p, run.s[:, None]], -1)[stops]
        out[first + trained : first + length] = after
        if not bool(run.ok.all()):
            status = f"a step failed after t = {float(data.t[first + trained - 1]):g}; nothing is predicted beyond it"
    return State(out[:, :n], out[:, n : 2 * n], out[:, 2 * n]), status


def _fine_steps(t: Tensor, max_step: float) -> tuple[Tensor, Tensor]:
    """Model steps that cover the recorded times, and the node at which each of them is reached."""
    counts = torch.tensor([substeps(h, max_step) for h in t.diff().tolist()], device=t.device)
    return (t.diff() / counts).repeat_interleave(counts), counts.cumsum(0)


def _judge(fitted: _Fitted, data: Trajectories, train: Trajectories, states: State, base: Baseline) -> dict[str, Any]:
    """RMS errors in the units of q; None where there is nothing to measure or the prediction failed."""
    training = torch.zeros(data.samples, dtype=torch.bool, device=data.t.device)
    for first, trained in zip(data.offsets, train.lengths, strict=True):
        training[first : first + trained] = True
    error = states.q - data.q
    unseen = data if train is data else _test_part(data, train.lengths)
    triples = unseen.triples(base.max_step)
    problem = ResidualProblem(fitted.model, unseen, max_step=base.max_step)
    ratio = (triples.h1 / triples.h0)[:, None]
    unmoved = triples.q2 - triples.q1 - ratio * (triples.q1 - triples.q0)
    rate = getattr(fitted.model.damping, "rate", None)
    return {
        "one_step_rms": _rms(problem.residuals(problem.start())) if len(triples) else None,
        "one_step_rms_constant_velocity": _rms(unmoved) if len(triples) else None,
        "train_rms": _rms(error[training]),
        "extrapolation_rms": None if train is data else _rms(error[~training]),
        "spread": _rms(data.q - data.q.mean(0)),
        "objective": fitted.objective,
        "sigma": fitted.sigma,
        "rate": None if rate is None else float(rate.detach()),
        "parameters": sum(p.numel() for p in fitted.model.parameters()),
        **fitted.notes,
    }


def _test_part(data: Trajectories, trained: tuple[int, ...]) -> Trajectories:
    rows = [torch.arange(f + k, f + n) for f, n, k in zip(data.offsets, data.lengths, trained, strict=True)]
    index = torch.cat(rows).to(data.t.device)
    lengths = tuple(n - k for n, k in zip(data.lengths, trained, strict=True))
    return replace(data, t=data.t[index], q=data.q[index], s=None, p=None, u=None, lengths=lengths)


def _rms(x: Tensor) -> float | None:
    value = float(x.detach().square().mean().sqrt())
    return value if np.isfinite(value) else None


def _key(data: Trajectories, config: FitConfig) -> str:
    """Identifies a fit: its data and its settings (the device does not matter)."""
    settings = json.dumps({**config.to_dict(), "device": ""}, sort_keys=True)
    return hashlib.sha256((data.digest() + settings).encode()).hexdigest()
