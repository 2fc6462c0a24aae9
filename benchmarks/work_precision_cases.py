"""A scene with its data, its fitted model and unseen starts; and how every setting of it is timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from work_precision_scenes import CHECKS, Setup, exact_motion, judged, starts_of

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.stepping import State
from herglotz.training import FitConfig, Run, fit
from herglotz.tune.reference import JITTER, draw_starts, record

COUNT = 192  # motions whose errors are taken: half to choose a setting by, half to judge it
TIMED = 16  # of them are timed
PER = 4e-3  # seconds of one timing of C, at least


@dataclass(frozen=True)
class Timed:
    """A point of the plot and how to time it: `run` makes `time` units of simulated time; `idle` what surrounds it."""

    point: dict
    run: Callable[[], Any]
    time: float
    idle: Callable[[], Any] | None = None


@dataclass(frozen=True)
class Case:
    """One scene with its data, its fitted model, unseen starts and their truth."""

    setup: Setup
    run: Run
    entry: State  # the starts in the learned model's own momenta
    start: State  # the same in the scene's
    truth: Tensor  # (B, CHECKS, n)
    seconds: dict[str, float]
    seed: int = 0


def prepare(setup: Setup, quick: bool, seed: int = 0) -> Case:
    """Fit the model to positions, and enter it from two positions as a user must."""
    system = setup.scene
    size = (10, 20) if quick else (setup.trajectories, setup.steps)
    data = simulate(system, trajectories=size[0], steps=size[1], h=setup.h, seed=seed, keep_state=True)
    began = time.process_time()
    run = fit(replace(data, s=None, p=None), fit_config(setup, quick, seed=seed), progress=False)
    seconds = {"fit": time.process_time() - began}
    first = starts_of(system, 16 if quick else COUNT, 1000)
    u = setup.inputs()
    before = system if u is None else system.at(u[0])
    start = State(*before.flow(*first, setup.h))
    return Case(setup, run, entered(setup, run, first, start), start, exact_motion(setup, start), seconds, seed)


def entered(setup: Setup, run: Run, first: State, start: State) -> State:
    """The learned model's own state at `start`, from the two positions."""
    u = setup.inputs() if run.model.inputs else None
    with torch.no_grad():
        entry = run.stepper.init(first.q, start.q, None, setup.h, **({} if u is None else {"u": u[0]}))
    return State(*(x.detach() for x in entry))


def fit_config(setup: Setup, quick: bool, **changes: Any) -> FitConfig:
    options = {"level": "linear", "iterations": 60, **setup.fit, **changes}
    iterations = options.pop("iterations")
    iterations = 10 if quick else iterations
    return FitConfig(train_fraction=1.0, objective="residual", iterations=iterations, departures=(2e-3,), **options)


def rolled(case: Case, stepper: Any, h: float, dtype: torch.dtype = torch.float64) -> dict[str, float | None]:
    steps, u = round(case.setup.T / h), inputs_of(case)
    if steps % CHECKS:
        raise InputError(f"{steps} steps do not reach the {CHECKS} times of the check")
    options = {} if u is None else {"inputs": u.to(dtype)}
    with torch.no_grad():
        start = (x.to(dtype).contiguous() for x in case.entry)
        q = stepper.rollout(*start, h=h, steps=steps, **options).q[:, 1:]
    return judged(q[:, steps // CHECKS - 1 :: steps // CHECKS], case.truth)


def inputs_of(case: Case) -> Tensor | None:
    """The inputs of the scene, where the model takes them."""
    return case.setup.inputs() if case.run.model.inputs else None


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
    return record(run, State(starts.q, starts.p, starts.s[:, 0]), case.setup.T, "own").states


def repeated(call: Callable[[], Any], keep: Any = None) -> tuple[Callable[[], Any], int]:
    """The call as often as makes it long enough to time."""
    call()
    began = time.perf_counter()
    call()
    times = max(1, round(PER / max(1e-7, time.perf_counter() - began)))

    def run(keep: Any = keep) -> None:  # noqa: ARG001
        for _ in range(times):
            call()

    return run, times


def costs(timed: list[Timed], rounds: int) -> list[dict]:
    """Processor time of each, in turn: the least of all rounds, and how far the middle one lies above it."""
    times = torch.zeros(2, len(timed), rounds, dtype=torch.float64)
    for k in range(-1, rounds):
        for i, one in enumerate(timed):
            for j, call in enumerate((one.run, one.idle)):
                if call is None:
                    continue
                began = time.process_time_ns()
                call()
                times[j, i, max(k, 0)] = (time.process_time_ns() - began) * 1e-3
    found = []
    for i, one in enumerate(timed):
        best, middle = float(times[0, i].min()), float(times[0, i].median())
        idle = min(float(times[1, i].min()), best / 2)
        found.append({**one.point, "us_per_time": (best - idle) / one.time, "spread": (middle - best) / one.time})
    return found
