"""The learned steppers that `work_precision.py` measures: scenes, fits, and how each stepper is timed.

A stepper is a `Timed`: a point of the table with its errors, and what `herglotz.tune.cost` times. Learned steppers come
in C: the scene's own model, the same data with terms more and less, and a few kicks for several steps of the data.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from herglotz.data import simulate
from herglotz.data.simulate import uniform
from herglotz.export import compile_c
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
# What a user knows of two links.
TOLD = {"features": ("pendulums",), "order": 4, "correction_width": 0, "mass_width": 0}


@dataclass(frozen=True)
class Setup:
    """What one scene is asked: data every h, motions of length T, and the model that is fitted."""

    name: str
    h: float
    T: float
    fit: Mapping[str, Any] = field(default_factory=dict)
    trajectories: int = 30
    steps: int = 30
    kick_steps: tuple[int, ...] = ()  # in h
    neural: tuple[tuple[int, int], ...] = ()  # width and depth of the neural ODEs
    neural_iterations: int = 0
    other: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def scene(self) -> Any:
        """The scene itself."""
        return scene(self.name)

    def inputs(self) -> Tensor | None:
        """(T/h, m) the input of each step of the data."""
        if self.scene.drive is None:
            return None
        return self.scene.drive(self.h * (torch.arange(round(self.T / self.h), dtype=torch.float64) + 0.5))


# Changes of a fit by the name of the table.
OTHERS: dict[str, Mapping[str, Any]] = {
    "level conservative": {"level": "conservative"},
    "level linear": {"level": "linear"},
    "level affine": {"level": "affine"},
    "no correction": {"correction_width": 0},
    "correction 6 × 2": {"correction_width": 6},
    "potential network": {"potential_width": 16},
    "constant mass": {"mass_width": 0},
    "structure told": TOLD,
    "linear springs": {"features": (), "alike": False, "potential_width": 0},
    "no input": {"use_inputs": False},
}


def _others(*names: str, **more: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {name: more.get(name.replace(" ", "_"), OTHERS[name]) for name in names}


SETUPS = {
    s.name: s
    for s in (
        Setup("damped_oscillator", 0.5, 12.0, {"potential_width": 0, "correction_width": 8},
              other=_others("level conservative", "level affine", "potential network", "no correction")),
        Setup("damped_pendulum", 0.5, 12.0, {"correction_width": 16, "iterations": 300}, 40, 40, (2, 3, 6),
              ((4, 1), (8, 1), (8, 2), (16, 2)), 200,
              _others("level conservative", "level affine", "no correction")),
        Setup("double_pendulum", 0.05, 2.4, {"correction_width": 16, "mass_width": 8, "iterations": 120},
              neural=((8, 1), (16, 2)), neural_iterations=120,
              other=_others("level conservative", "constant mass", "no correction", "structure told")),
        Setup("parachute", 0.1, 2.4, {"level": "affine"},
              other=_others("level conservative", "level linear", "no correction")),
        Setup("kepler", 0.1, 4.8, {"features": ("central",), "alike": True, "correction_width": 16},
              other=_others("level conservative", "potential network", "no correction",
                            potential_network={"features": (), "alike": False})),
        Setup("chain", 0.2, 4.8, {"features": ("chain",), "alike": True, "correction_width": 0}, 12, 20,
              other=_others("level conservative", "linear springs")),
        Setup("driven_pendulum", 0.25, 12.0, {"level": "forced", "correction_width": 12},
              other=_others("no input", "no correction", "correction 6 × 2")),
        Setup("rigid_body", 0.1, 4.8, {"correction_width": 12, "mass_width": 8}, 20, 24,
              other=_others("constant mass", "level conservative", "no correction")),
    )
}  # fmt: skip


def starts_of(system: Any, count: int, seed: int) -> State:
    """States uniform in the scene's ranges, s = 0."""
    make = torch.Generator().manual_seed(seed)
    q, v = (uniform(name, getattr(system, name), (count, system.dof), make) for name in ("q_range", "v_range"))
    return State(q, system.momentum(q, v, torch.zeros_like(q[..., 0])), torch.zeros(count, dtype=torch.float64))


def exact_motion(setup: Setup, start: State) -> Tensor:
    """Positions (B, checks, n) at equal times up to T, by the scene's own flow in steps h."""
    system, u, state, out = setup.scene, setup.inputs(), start, []
    steps = round(setup.T / setup.h)
    for k in range(steps):
        now = system if u is None else system.at(u[k])
        state = State(*now.flow(*state, setup.h))
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
    """The points with their costs: the least of all rounds, in turn, and how far the middle one lies above it."""
    measured = zip(timed, measure_costs([one.timing for one in timed], ROUNDS), strict=True)
    return [{**t.point, "us_per_time": c.step_us / t.h, "spread": c.spread_us / t.h} for t, c in measured]


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


def prepare(setup: Setup, seed: int = 0) -> Case:
    """Fit the model to positions, and enter it from two positions as a user must."""
    system = setup.scene
    size = {"trajectories": setup.trajectories, "steps": setup.steps, "h": setup.h}
    data = simulate(system, **size, seed=seed, keep_state=True)
    began = time.process_time()
    run = fit(replace(data, s=None, p=None), fit_config(setup, seed=seed), progress=False)
    took = {"fit": time.process_time() - began}
    first = starts_of(system, COUNT, 1000)
    u = setup.inputs()
    before = system if u is None else system.at(u[0])
    start = State(*before.flow(*first, setup.h))
    return Case(setup, run, entered(setup, run, first, start), start, exact_motion(setup, start), took, seed)


def entered(setup: Setup, run: Run, first: State, start: State) -> State:
    """The learned model's own state at `start`, from the two positions."""
    u = setup.inputs() if run.model.inputs else None
    with torch.no_grad():
        entry = run.stepper.init(first.q, start.q, None, setup.h, **({} if u is None else {"u": u[0]}))
    return State(*(x.detach() for x in entry))


def fit_config(setup: Setup, **changes: Any) -> FitConfig:
    options = {"level": "linear", "iterations": 60, **setup.fit, **changes}
    return FitConfig(train_fraction=1.0, objective="residual", departures=(2e-3,), **options)


def rolled(case: Case, stepper: Any, h: float, dtype: torch.dtype = torch.float64) -> dict[str, float | None]:
    steps, u = round(case.setup.T / h), inputs_of(case)
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
    return record(run, State(starts.q, starts.p, starts.s[:, 0]), case.setup.T).states


def _timed(case: Case, stepper: Any, h: float, kind: str, setting: str, dtype: str) -> Timed:
    """A stepper in C with its errors, to be timed."""
    number = getattr(torch, dtype)
    point = {"kind": kind, "setting": setting, "h": h, "dtype": dtype, "artefact": "C"}
    start = State(*(x.to(number).contiguous() for x in case.entry))
    timing = timed_stepping(stepper, start, h, round(case.setup.T / h))
    return Timed({**point, **rolled(case, stepper, h, number)}, timing, h)


def learned(case: Case) -> list[Timed]:
    """The scene's own model, and the same data with a term less, or with one that the scene does not need."""
    setup = case.setup
    found, first = [_own(case, "learned", "own model")], starts_of(setup.scene, COUNT, 1000)
    for label, change in setup.other.items():
        run = fit(case.run.data, fit_config(setup, **change), progress=False)
        other = replace(case, run=run, entry=entered(setup, run, first, case.start))
        found.append(_own(other, f"learned, {label}", label))
    return found


def _own(case: Case, kind: str, label: str) -> Timed:
    """The fitted model as compiled C, at the step of the data."""
    h = case.setup.h
    return _timed(case, compile_c(case.run.model, h=h), h, kind, f"{label}, h {h:.4g}, C float64", "float64")


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
                found.append(_timed(case, CompiledKicks(stepper, dtype), h, "learned kicks", label, dtype))
    case.seconds["kicks"] = time.process_time() - began
    return found
