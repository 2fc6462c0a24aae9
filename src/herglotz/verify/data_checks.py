"""Checks that a fitted model predicts its data, since every regular L_d satisfies the identities."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.roughness import precision, precisions
from herglotz.data.spikes import spikes
from herglotz.data.splits import leading, leading_rows
from herglotz.data.trajectories import GAP
from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual, partials
from herglotz.stepping import State, solve
from herglotz.training import Run
from herglotz.training.problems.grid import segment_grid, step_inputs
from herglotz.verify.dissipation import WINDOW, dissipation
from herglotz.verify.report import Check

# Bound of the one-step error, relative to that of the null model, uniform motion. A fitted model reaches 1e-2 and less
# on clean data; an empty or a collapsed model has about 1 and more.
ONE_STEP = 0.5
# Bound of free runs over 20 recorded steps, relative to the spread; noise and a good model stay far below 0.1.
FOLLOW = 0.1
# Bound of the free run beyond training, relative to the spread: the mean of the unseen samples gives exactly 1.
FREE_RUN = 1.0
# One step is judged if the squared error of the null model exceeds this multiple of the squared noise.
MIN_SIGNAL_TO_NOISE = 2.0


def data_checks(run: Run) -> tuple[list[Check], dict[str, float]]:
    """Return the checks that need recorded motion, and the numbers behind them.

    One step: the RMS of J⁻¹R over the recorded triples, relative to that of the null model, uniform motion
    q2 = q1 + (h1/h0)(q1 − q0); each coordinate is in units of its own spread. Noise enters both errors. Before a model
    fails, the noise, estimated from the data alone, is subtracted from both. The check is left out if the error of the
    null model is mostly noise.

    Follow: the RMS of free runs over windows of 20 recorded steps, from the fitted states, relative to the spread. A
    collapsed model has small residuals and fails here; a failed step counts as infinite. The windows end with the
    training part, because the states beyond are those of one free run, which the last check judges.

    Dissipation: the same windows with γ → −γ, 0, γ/2 and 2γ; a model that follows the data no better fails. A model of
    rate 0 fails if some rate divides its error by 5. The check is left out if the model has no rate, or if the data do
    not show the rate.

    Free run: the RMS of prediction − data over the samples beyond the training part, relative to their spread. The
    check is left out if the fit held nothing out.

    No check counts samples that the fit treats as gross errors.
    """
    run = _without_spikes(run)
    q = run.data.unwrapped().q
    spread = _spread(q)
    model, null, floor = _one_step(run, q, spread)
    numbers = {"one_step_rms": model, "null_rms": null, "noise_rms": floor}
    checks, extra = [], ""
    if null**2 > MIN_SIGNAL_TO_NOISE * floor**2:
        ratio = model / null if math.isfinite(model) else math.inf
        # A ratio above the bound may be due to noise.
        if ratio > ONE_STEP:
            ratio = math.sqrt(max(model**2 - floor**2, 0.0) / (null**2 - floor**2))
        note = f"RMS {model:.3g}, uniform motion {null:.3g}, noise {floor:.3g}, in units of the data's spread"
        checks.append(Check.at_most("one_step", "predicts a step: |J⁻¹R| over uniform motion", ratio, ONE_STEP, note))
    else:
        extra = f"; one step is not judged: uniform motion's error ({null:.2g}) is mostly noise ({floor:.2g})"
    trained = _trained(run)
    own = _follow(trained, spread)
    nulls, more = dissipation(trained, lambda other: _follow(other, spread), own)
    exact = precision(run.data.unwrapped()) / float(spread.mean())
    numbers |= {"follow": own, "precision": exact}
    times = f", {own / exact:.2g} times the data's precision" if 0 < exact < math.inf else ""
    note = f"free runs over windows of {WINDOW} recorded steps{times}{extra}{more}"
    checks.append(Check.at_most("follow", "follows the data: RMS over spread", own, FOLLOW, note))
    checks += [] if nulls is None else [nulls]
    if run.train_lengths != run.data.lengths:
        value, note = _free_run(run)
        passed = value < FREE_RUN
        claim = "predicts beyond training: RMS over spread"
        checks.append(Check("free_run", claim, value, FREE_RUN, passed, note, "<"))
    return checks, numbers


def _without_spikes(run: Run) -> Run:
    """Return the run without incomplete samples and gross errors."""
    bad = spikes(run.data.unwrapped())
    bad = ~run.data.complete | (bad if run.config.robust != "off" else torch.zeros_like(bad))
    if not bool(bad.any()):
        return run
    kept = leading(run.data.lengths, run.train_lengths).to(bad.device) & ~bad
    trained = tuple(int(own.sum()) for own in kept.split(list(run.data.lengths)))
    return replace(run, data=run.data.keep(~bad), states=State(*(x[~bad] for x in run.states)), train_lengths=trained)


def _trained(run: Run) -> Run:
    """The run on its training part alone."""
    rows = leading_rows(run.data.lengths, run.train_lengths)
    states = State(*(x[rows] for x in run.states))
    return replace(run, data=run.data.unwrapped().rows(rows, run.train_lengths), states=states)


def _follow(run: Run, spread: Tensor) -> float:
    """Return the RMS, over the spread, of free runs that restart from the run's state every `WINDOW` recorded steps."""
    q = run.data.q
    grid = segment_grid(run.data, WINDOW, GAP * run.h)
    states = [x[grid.start_sample] for x in run.states]
    if not all(bool(torch.isfinite(x).all()) for x in states):
        return math.inf
    with torch.no_grad():
        u = step_inputs(run.model, run.data, grid)
        inputs = None if u is None else u.to(states[0].dtype)
        out = run.stepper.rollout(*states, h=grid.h.to(states[0].dtype), inputs=inputs)
    error = grid.at_samples(out.q).to(q.dtype) - q
    value = _rms(error / spread)
    return value if math.isfinite(value) else math.inf


def _one_step(run: Run, q: Tensor, spread: Tensor) -> tuple[float, float, float]:
    """Return the RMS errors of the model and of uniform motion, and the noise in both, in units of the spread."""
    t = run.data.unwrapped().triples()
    dtype = next(run.model.parameters()).dtype
    # A single step across a gap is not judged.
    keep = (t.h0 <= GAP * run.h) & (t.h1 <= GAP * run.h)
    if not bool(keep.any()):
        keep = torch.ones_like(keep)
    q0, q1, q2, h0, h1, s0 = (x[keep].to(dtype) for x in (t.q0, t.q1, t.q2, t.h0, t.h1, run.states.s[t.index]))
    with torch.no_grad():
        first, second = run.model, run.model
        if (u := step_inputs(run.model, run.data)) is not None:
            first, second = (run.model.at(u[t.index[keep] + k].to(dtype)) for k in (0, 1))
        before = partials(first, q0, q1, s0, h0)
        p = momentum_plus(before)
        after = partials(second, q1, q2, s0 + before.L, h1, 2)
        error = solve(momentum_jacobian(after, p), momentum_residual(after, p))
    r = (h1 / h0)[:, None]
    uniform = q2 - q1 - r * (q1 - q0)
    weight = (1 + (1 + r) ** 2 + r**2).mean()
    sigma = precisions(run.data.unwrapped()).to(q)
    # The precision is infinite if there are too few samples to estimate it.
    sigma = torch.where(torch.isfinite(sigma), sigma, 0.0)
    return _rms(error / spread), _rms(uniform / spread), _rms(sigma / spread) * float(weight) ** 0.5


def _free_run(run: Run) -> tuple[float, str]:
    """Return the RMS of prediction − data over the samples after the training part, over their spread."""
    q = run.data.unwrapped().q
    index = (~leading(run.data.lengths, run.train_lengths)).nonzero()[:, 0]
    note = f"{len(index)} samples the fit did not see"
    error = run.prediction[index].to(q.dtype) - q[index]
    angles = torch.tensor(run.data.angles, device=q.device)
    error = torch.where(angles, error - 2 * math.pi * torch.round(error / (2 * math.pi)), error)
    value = _rms(error / _spread(q[index]))
    return (value if math.isfinite(value) else math.inf), note


def _spread(q: Tensor) -> Tensor:
    """Return the standard deviation of each coordinate, (n,); 1 for a coordinate that never moves."""
    spread = q.std(0, correction=0)
    return torch.where(spread > 0, spread, 1.0)


def _rms(x: Tensor) -> float:
    return float(x.double().square().mean().sqrt())
