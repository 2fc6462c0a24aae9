"""The learned steppers that `work_precision.py` measures: scenes, fits, and how each stepper is timed.

A stepper is a `Timed`: a point of the table with its errors, and what `herglotz.tune.cost` times. Here are the kicks
for several steps of the data; the learned equation stands beside the rivals, whose C it shares.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories, simulate
from herglotz.data.simulate import uniform
from herglotz.scenes import scene
from herglotz.stepping import State
from herglotz.training import FitConfig, Run, fit
from herglotz.tune.cost import Timed as Timing, measure_costs, timed_stepping
from herglotz.tune.distil import pairs_of
from herglotz.tune.kick_composition import CompiledKicks, can_kick, fit_kicks
from herglotz.tune.search import JITTER, draw_starts, record

CHECKS = 4  # times at which errors are taken
COUNT = 192  # motions whose errors are taken: half to choose a setting by, half to judge it
ROUNDS = 9  # of timings of each setting, in turn


@dataclass(frozen=True)
class Setup:
    """What one scene is asked: data every h, motions of length T, and the model that is fitted."""

    name: str
    h: float
    T: float
    fit: Mapping[str, Any]
    neural: tuple[tuple[int, int], ...]  # width and depth of the neural ODEs
    neural_iterations: int
    trajectories: int = 30
    steps: int = 30
    kick_steps: tuple[int, ...] = ()  # in h

    @property
    def scene(self) -> Any:
        """The scene itself."""
        return scene(self.name)


# Of the double pendulum it is told what a user knows of two links.
SETUPS = {
    s.name: s
    for s in (
        Setup("damped_pendulum", 0.5, 12.0, {"correction_width": 16, "iterations": 300},
              ((4, 1), (8, 1), (8, 2), (16, 2)), 200, 40, 40, (2, 3, 6)),
        Setup("double_pendulum", 0.05, 2.4, {"features": ("pendulums",), "order": 4, "correction_width": 0,
              "mass_width": 0, "iterations": 120}, ((8, 1), (16, 2)), 120),
    )
}  # fmt: skip


def starts_of(system: Any, count: int, seed: int) -> State:
    """States uniform in the scene's ranges, s = 0."""
    make = torch.Generator().manual_seed(seed)
    q, v = (uniform(name, getattr(system, name), (count, system.dof), make) for name in ("q_range", "v_range"))
    return State(q, system.momentum(q, v, torch.zeros_like(q[..., 0])), torch.zeros(count, dtype=torch.float64))


def exact_motion(setup: Setup, start: State) -> Tensor:
    """Positions (B, checks, n) at equal times up to T, by the scene's own flow in steps h."""
    state, out = start, []
    steps = round(setup.T / setup.h)
    for k in range(steps):
        state = State(*setup.scene.flow(*state, setup.h))
        if (k + 1) % (steps // CHECKS) == 0:
            out.append(state.q)
    return torch.stack(out, 1)


def errors_of(q: Tensor, truth: Tensor) -> dict[str, float | None]:
    """Of the largest |q − truth| of each motion: the median, and what 95 % keep; None where a step failed."""
    e = (q.double() - truth).abs().flatten(1).amax(1).nan_to_num(nan=math.inf)
    found = {"median": float(e.median()), "q95": float(e.quantile(0.95, interpolation="higher"))}
    return {k: v if math.isfinite(v) else None for k, v in found.items()}


def judged(q: Tensor, truth: Tensor) -> dict[str, float | None]:
    """Errors of the second half of the motions, and, to choose a setting by, of the first."""
    half = len(q) // 2
    choice = {f"choice_{k}": v for k, v in errors_of(q[:half], truth[:half]).items()}
    return {**errors_of(q[half:], truth[half:]), **choice}


@dataclass(frozen=True)
class Timed:
    """A point of the plot and how to time it: one step of the timing makes `h` units of simulated time."""

    point: dict
    timing: Timing
    h: float


def costs(timed: list[Timed]) -> list[dict]:
    """The points with their costs: the least of all rounds, in turn."""
    measured = zip(timed, measure_costs([one.timing for one in timed], ROUNDS), strict=True)
    return [{**t.point, "us_per_time": c.step_us / t.h} for t, c in measured]


@dataclass(frozen=True)
class Case:
    """One scene with its data, its fitted model, unseen starts and their truth."""

    setup: Setup
    data: Trajectories  # with the states, which the neural ODEs get
    run: Run
    entry: State  # the starts in the learned model's own momenta
    start: State  # the same in the scene's
    truth: Tensor  # (B, CHECKS, n)
    seconds: dict[str, float]
    seed: int = 0


def prepare(setup: Setup, seed: int = 0) -> Case:
    """Fit the model to positions, and enter it from two positions as a user must."""
    system = setup.scene
    size = {"trajectories": setup.trajectories, "steps": setup.steps, "h": setup.h}
    data = simulate(system, **size, seed=seed, keep_state=True)
    began = time.process_time()
    options = {"train_fraction": 1.0, "objective": "residual", "departures": (2e-3,), "level": "linear", "seed": seed}
    run = fit(replace(data, s=None, p=None), FitConfig(**options, **setup.fit), progress=False)
    took = {"fit": time.process_time() - began}
    first = starts_of(system, COUNT, 1000)
    start = State(*system.flow(*first, setup.h))
    with torch.no_grad():
        entry = State(*(x.detach() for x in run.stepper.init(first.q, start.q, None, setup.h)))
    return Case(setup, data, run, entry, start, exact_motion(setup, start), took, seed)


def motions_of(case: Case) -> State:
    """Motions of the fitted model itself, to distil from: from near every recorded state, and from near the first ones.

    Motions of a damped scene spend most of their time near rest; where they begin is where large steps are worst.
    """
    run = case.run
    make = torch.Generator().manual_seed(case.seed)
    rows = (torch.tensor(run.data.offsets) + 1).repeat(3)
    first = []
    for name, x in zip("qps", run.states, strict=True):
        x = x.detach().double()[rows].reshape(len(rows), -1)
        size = (torch.tensor(run.box[f"{name}_high"]) - torch.tensor(run.box[f"{name}_low"])).double()
        first.append(x + JITTER * size * (2 * torch.rand(x.shape, generator=make, dtype=torch.float64) - 1))
    anywhere = draw_starts(run, 40, case.seed + 5)
    starts = State(*(torch.cat([a.reshape(len(a), -1), b]) for a, b in zip(anywhere, first, strict=True)))
    return record(run, State(starts.q, starts.p, starts.s[:, 0]), case.setup.T).states


def _timed(case: Case, stepper: CompiledKicks, h: float, setting: str, dtype: str) -> Timed:
    """A stepper in C with its errors, to be timed."""
    steps, number = round(case.setup.T / h), getattr(torch, dtype)
    start = State(*(x.to(number).contiguous() for x in case.entry))
    with torch.no_grad():
        q = stepper.rollout(*start, h=h, steps=steps).q[:, 1:]
    errors = judged(q[:, steps // CHECKS - 1 :: steps // CHECKS], case.truth)
    return Timed({"kind": "learned kicks", "setting": setting, **errors}, timed_stepping(stepper, start, h, steps), h)


def kicks(case: Case) -> list[Timed]:
    """Steps of several h as a few learned kicks and drifts."""
    setup = case.setup
    if not setup.kick_steps or not can_kick(case.run.model):
        return []
    states, found, began = motions_of(case), [], time.process_time()
    for m in setup.kick_steps:
        if round(setup.T / setup.h) % (m * CHECKS):
            continue
        before, after = pairs_of(states, m, 1000, case.seed)
        h = m * setup.h
        least = max(2, round(1.5 * h))
        for count in range(least, least + (5 if m > 3 else 4)):
            stepper = fit_kicks(case.run.model, before, after, h, kicks=count, iterations=150)
            for dtype in ("float64", "float32"):
                label = f"{count} kicks, h {h:.4g}, C {dtype}"
                found.append(_timed(case, CompiledKicks(stepper, dtype), h, label, dtype))
    case.seconds["kicks"] = time.process_time() - began
    return found
