"""Checks that a fitted model predicts its data, since every regular L_d satisfies the identities.

Among them are null models of dissipation: a run must follow its data better than with γ → −γ, 0, γ/2 and 2γ. A run
without dissipation is compared with the rate, of either sign, that minimises the error of the windows. Weak damping
changes twenty steps by a few per cent of the spread, less than the bound of "follows the data". The same windows with
altered dissipation show whether the data determine the rate, and whether the model's rate is right.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.noise import precision, precisions, spikes
from herglotz.data.splits import leading, leading_rows
from herglotz.data.trajectories import GAP
from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual, partials
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, solve
from herglotz.training import Run
from herglotz.training.problems.grid import segment_grid, step_inputs
from herglotz.verify.report import Check

# Recorded steps of a window: long enough for the error of one step to grow, too short for chaos.
WINDOW = 20
# Factors of the rate in the null models.
FACTORS = (-1.0, 0.0, 0.5, 2.0)
# Trial rates times the duration of a window. Such rates change the motion by a hundredth, which is linear in the rate.
TRIAL_DECAY = 0.01
# A model of rate 0 fails if a rate divides its error by more. Missing damping in exact data gives 7 to 1e3, the error
# of the integration rule 2.3.
MAX_ERROR_RATIO_WITHOUT_RATE = 5.0
# The dissipation is judged if a null model changes the error by more than this share.
MIN_RELATIVE_CHANGE = 0.05


def dissipation(run: Run, error: Callable[[Run], float], own: float) -> tuple[Check | None, str]:
    """Compare the error of the run's windows with those of its null models; None and a note if the data decide nothing.

    `error` gives the RMS of free runs over windows for any run on these data; `own` is the RMS of this run.
    """
    rates = _rates(run.model)
    if not math.isfinite(own) or not rates:
        return None, ""
    if not any(bool((x != 0).any()) for x in rates):
        return _undamped(run, error, own), ""
    nulls = {factor: error(replace(run, model=_scaled(run.model, factor))) for factor in FACTORS}
    best = min(nulls.values())
    if not abs(best - own) > MIN_RELATIVE_CHANGE * own:
        return None, "; dissipation is not judged: γ → −γ, 0, γ/2 or 2γ changes nothing that the data show"
    listed = ", ".join(f"{x:g}γ {value:.2g}" for x, value in nulls.items())
    claim = "dissipation: better than −γ, 0, γ/2, 2γ (ratio)"
    ratio = own / best if best > 0 else math.inf
    return Check("dissipation", claim, ratio, 1.0, ratio < 1, f"over spread: γ {own:.2g}, {listed}", "<"), ""


def _undamped(run: Run, error: Callable[[Run], float], own: float) -> Check | None:
    """Compare a model of rate 0 with the best rate, the minimum of the squared error as a parabola of the rate."""
    small = TRIAL_DECAY / (WINDOW * run.h)
    up, down = (error(replace(run, model=_scaled(run.model, 0.0, rate))) ** 2 for rate in (small, -small))
    bend = up + down - 2 * own**2
    if not (math.isfinite(bend) and bend > 0):
        return None
    rate = small * (down - up) / (2 * bend)
    best = error(replace(run, model=_scaled(run.model, 0.0, rate)))
    claim, ratio = "no dissipation: no rate follows better by 5 (ratio)", own / best if best > 0 else math.inf
    note = f"over spread: γ = 0 {own:.2g}, γ = {rate:.3g} {best:.2g}"
    bound = MAX_ERROR_RATIO_WITHOUT_RATE
    return Check("dissipation", claim, ratio, bound, ratio < bound, note, "<")


def _rates(model: ContactLagrangian) -> list[torch.Tensor]:
    """The dissipative parameters: the rate of the contact form, and viscous friction."""
    found = [getattr(model.damping, "rate", None), getattr(model.friction, "viscous", None)]
    return [x for x in found if x is not None]


def _scaled(model: ContactLagrangian, factor: float, more: float = 0.0) -> ContactLagrangian:
    """A copy of the model with its rates times a factor, and `more` added to the first rate."""
    model = deepcopy(model)
    with torch.no_grad():
        for rate in _rates(model):
            rate.mul_(factor)
        _rates(model)[0].add_(more)
    return model


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
