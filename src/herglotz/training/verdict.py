"""`verdict`: whether a run is as good as its data allow, in one sentence, with a remedy where it is not.

Three errors are compared with the precision of the data, which is estimated from the data alone:

* free runs over windows of 20 recorded steps of the training part, from the fitted states;
* the same over the unseen part, from states that are fitted there with the parameters held;
* the one free run over the whole unseen part, `extrapolation_rms`.

Chaotic motion leaves every model in the long run, so the last one alone rejects nothing that is finite.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.roughness import precision
from herglotz.data.spikes import without
from herglotz.stepping import Stepper
from herglotz.training.inputs import grid_inputs
from herglotz.training.look import Look
from herglotz.training.objectives import Fitted
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.trajectory_fit import FIRST_SEGMENT, SegmentStages

FITS, WORSE, FAILS = "fits to the noise", "fits, worse than the noise", "does not fit"
AT_THE_NOISE = 1.5  # times the precision: fitted states, and the noise's own estimate, leave 10 to 30 %
EXACT_ENOUGH = 1e-4  # of the spread: exact data have no noise to be compared with
LOST = 0.1  # of the spread: what `herglotz verify` bounds windows of 20 steps by; a model with nothing in it has 1
BURIED = 3.0  # times the precision: windows that miss no more follow the data, however large the noise is
STATE_ITERATIONS = 10  # of fitting the states of unseen windows: 2n numbers a window from 20 samples need fewer


def window_errors(task: Task, fitted: Fitted, states: Tensor, data: Trajectories) -> Tensor:
    """Errors of free runs over windows of 20 recorded steps from states (N, 2n+1) at the samples, (N', n)."""
    grid, n = segment_grid(data, FIRST_SEGMENT, task.base.model_step), data.dof
    x = states[grid.start_sample]
    with torch.no_grad():
        out = Stepper(fitted.model).rollout(
            x[:, :n], x[:, n : 2 * n], x[:, 2 * n], h=grid.h, inputs=grid_inputs(fitted.model, data, grid)
        )
    return out.q.flatten(0, 1)[grid.node] - data.q[grid.sample]


def unseen_window_rms(task: Task, fitted: Fitted, data: Trajectories) -> float:
    """RMS of such errors where the fit has not been, from states that are fitted there; inf where a step fails."""
    silent, config = Stages(False, None, "", resume=False), replace(task.config, iterations=STATE_ITERATIONS)
    stages = SegmentStages(replace(task, data=data, config=config, stages=silent), fitted.model, frozen=True)
    found = stages.fit(stages.lengths[0], fitted.sigma, FREEDOM if task.config.robust != "off" else None, None)
    return math.inf if found is None else found.noise


def judged(task: Task, seen: Look, fitted: Fitted, metrics: dict[str, Any]) -> dict[str, Any]:
    """The verdict, and the errors it rests on; samples that the fit takes for gross errors have no say."""
    used = torch.ones_like(task.data.t, dtype=torch.bool) if fitted.used is None else fitted.used
    kept = without(task.data, ~used)
    spread = float((kept.q - kept.q.mean(0)).square().mean().sqrt())
    windows = _rms(window_errors(task, fitted, fitted.states[~seen.spikes][used], kept))
    unseen, free = None, None
    if seen.unseen is not None:
        unseen, free = unseen_window_rms(task, fitted, seen.unseen), metrics["extrapolation_rms"]
        free = math.inf if free is None else free
    noise = precision(kept)
    text = in_words(windows, unseen, free, noise, spread, metrics)
    numbers = {"window_rms": windows, "unseen_window_rms": unseen, "precision": noise}
    return {"verdict": text} | {k: v if v is not None and math.isfinite(v) else None for k, v in numbers.items()}


def in_words(
    windows: float, unseen: float | None, free: float | None, noise: float, spread: float, metrics: dict[str, Any]
) -> str:
    """One of the three verdicts, with numbers and, where the model does not fit, what to try."""
    limit = max(noise if math.isfinite(noise) else 0.0, EXACT_ENOUGH * spread)
    worst = max(windows, unseen or 0.0)
    lost = max(LOST * spread, BURIED * limit)
    told = f"windows of {FIRST_SEGMENT} steps miss {windows:.2g}"
    told += "" if unseen is None else f", unseen ones {unseen:.2g}, the free run {free:.2g}"
    told += f"; the data's precision is {limit:.2g}, their spread {spread:.2g}"
    broken = free is not None and not math.isfinite(free)
    if broken or not metrics.get("follows_data", True) or not worst <= lost:
        return f"{FAILS}: {told}. Try {_remedy(metrics, windows > lost)}"
    error = max(worst, free or 0.0)
    if error <= AT_THE_NOISE * limit:
        return f"{FITS}: {told}"
    return f"{WORSE} by a factor of {error / limit:.2g}: {told}"


def _remedy(metrics: dict[str, Any], training: bool) -> str:
    if not training:
        return "a simpler level, or a larger train fraction: the unseen part differs from the training part"
    if metrics["objective"] in ("residual", "raw"):
        return "--objective trajectory; or --substeps where a period has few samples; inputs that are not recorded?"
    return "--objective smoothing, another --level (herglotz select), or a --feature for a force that is missing"


def _rms(x: Tensor) -> float:
    value = float(x.double().square().mean().sqrt())
    return value if math.isfinite(value) else math.inf
