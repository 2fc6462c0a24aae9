"""The ways to step that `work_precision.py` compares, without the rivals: scenes, fits, and how each way is timed.

A way is a `Timed`: a point of the plot with its errors, and what `herglotz.tune.cost` times. Learned steppers
come in every form, at the step of the data and at larger ones, with terms more and less; rules and compositions on the
true Lagrangian are timed in PyTorch.
"""

from __future__ import annotations

import copy
import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data import simulate
from herglotz.data.simulate import uniform
from herglotz.errors import InputError
from herglotz.export import compile_c, export_aoti, export_onnx, load_onnx, load_pt2
from herglotz.scenes import scene
from herglotz.stepping import State, Stepper, kahan_li, suzuki, yoshida
from herglotz.training import FitConfig, Run, fit
from herglotz.tune.cost import Timed as Timing
from herglotz.tune.cost import measure_costs, timed_stepping
from herglotz.tune.distil import distil, pairs_of, widened
from herglotz.tune.kick_composition import can_kick, fit_kicks
from herglotz.tune.kick_composition_c import CompiledKicks
from herglotz.tune.reference import JITTER, draw_starts, record

CHECKS = 4  # times at which errors are taken
COUNT = 192  # motions whose errors are taken: half to choose a setting by, half to judge it
RULE_MOTIONS = 4  # motions of a rule in PyTorch, which share their time
PATIENCE = 1.5  # seconds of a rule after which no finer step of it is tried
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
    multiples: tuple[int, ...] = (2, 4)  # steps of distilled models, in h
    kick_steps: tuple[int, ...] = ()  # in h
    neural: tuple[tuple[int, int], ...] = ((8, 1),)  # width and depth of the neural ODEs
    neural_iterations: int = 60
    rules: tuple[int, ...] = (1, 2, 4)  # steps of analytic rules in one h
    # What a term of the model brings, or costs where it is not needed: the same data fitted without it, or with it.
    other: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def scene(self) -> Any:
        """The scene itself."""
        return scene(self.name)

    @property
    def held(self) -> int | None:
        """Number of steps h over which an input is held one after the other; None without inputs."""
        return round(self.T / self.h) if self.scene.drive is not None else None

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
        Setup("damped_oscillator", 0.5, 12.0, {"potential_width": 0, "correction_width": 8}, kick_steps=(2, 6),
              other=_others("level conservative", "level affine", "potential network", "no correction")),
        Setup("damped_pendulum", 0.5, 12.0, {"correction_width": 16, "iterations": 300}, 40, 40, (2, 3), (2, 3, 6),
              ((4, 1), (8, 1), (8, 2), (16, 2)), 200, (1, 2, 4, 8),
              _others("level conservative", "level affine", "no correction")),
        Setup("double_pendulum", 0.05, 2.4, {"correction_width": 16, "mass_width": 8, "iterations": 120},
              multiples=(2, 3), neural=((8, 1), (16, 2)), neural_iterations=120,
              other=_others("level conservative", "constant mass", "no correction", "structure told")),
        Setup("parachute", 0.1, 2.4, {"level": "affine"},
              other=_others("level conservative", "level linear", "no correction")),
        Setup("kepler", 0.1, 4.8, {"features": ("central",), "alike": True, "correction_width": 16},
              other=_others("level conservative", "potential network", "no correction",
                            potential_network={"features": (), "alike": False})),
        Setup("chain", 0.2, 4.8, {"features": ("chain",), "alike": True, "correction_width": 0}, 12, 20, (2,),
              neural_iterations=30, other=_others("level conservative", "linear springs")),
        Setup("driven_pendulum", 0.25, 12.0, {"level": "forced", "correction_width": 12},
              other=_others("no input", "no correction", "correction 6 × 2")),
        Setup("rigid_body", 0.1, 4.8, {"correction_width": 12, "mass_width": 8}, 20, 24, neural=((12, 1),),
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


def costs(timed: list[Timed], rounds: int) -> list[dict]:
    """The points with their costs: the least of all rounds, in turn, and how far the middle one lies above it."""
    measured = zip(timed, measure_costs([one.timing for one in timed], rounds), strict=True)
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


def prepare(setup: Setup, quick: bool, seed: int = 0) -> Case:
    """Fit the model to positions, and enter it from two positions as a user must."""
    system = setup.scene
    size = (10, 20) if quick else (setup.trajectories, setup.steps)
    data = simulate(system, trajectories=size[0], steps=size[1], h=setup.h, seed=seed, keep_state=True)
    began = time.process_time()
    run = fit(replace(data, s=None, p=None), fit_config(setup, quick, seed=seed), progress=False)
    took = {"fit": time.process_time() - began}
    first = starts_of(system, 16 if quick else COUNT, 1000)
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
    return record(run, State(starts.q, starts.p, starts.s[:, 0]), case.setup.T).states


ORDERS = {"left": 1, "right": 1, "midpoint": 2, "midpoint_heun": 2, "trapezoid_heun": 2, "strang": 2, "lobatto4": 4,
          "lobatto6": 6, "strang_exponential": 2}  # fmt: skip
COMPOSED = ((yoshida, 4), (suzuki, 4), (kahan_li, 6))  # with their orders


class Counted:
    """A discrete Lagrangian that counts its evaluations, with those of the Lagrangians that an input makes of it."""

    def __init__(self, L_d: Any, owner: Counted | None = None):
        self.L_d, self.count, self.owner = L_d, 0, owner or self
        if hasattr(L_d, "partials"):
            self.partials = lambda *x, **options: self._counted(L_d.partials, *x, **options)
        if hasattr(L_d, "at"):
            self.at = lambda u: Counted(L_d.at(u), self.owner)

    def __call__(self, *arguments: Tensor) -> Tensor:
        """The Lagrangian itself."""
        return self._counted(self.L_d, *arguments)

    def _counted(self, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        self.owner.count += 1
        return call(*arguments, **options)


def analytic(setup: Setup, quick: bool) -> list[dict]:
    """Every rule and composition of a scene at several steps."""
    system = setup.scene
    start = starts_of(system, RULE_MOTIONS, 1)
    truth = exact_motion(setup, start)
    found = []
    for kind, label, L_d, make in _methods(setup):
        for parts in setup.rules[-2:] if quick else setup.rules:
            one, seconds = _measured(setup, L_d, make, parts, start, truth)
            order = ORDERS.get(kind, int(kind[-1]) if kind[-1].isdigit() else None)
            found.append({"kind": kind, "setting": f"{label}, h {setup.h / parts:.4g}", "order": order, **one})
            if seconds > PATIENCE:
                break
    return found


def _methods(setup: Setup) -> list[tuple[str, str, Any, Any]]:
    """Kind, label, L_d and stepper of every rule and composition."""
    system, driven = setup.scene, setup.held is not None
    rules = {name: system.L_d_rules[name] for name in ORDERS if name in system.L_d_rules}
    if driven:  # rules that take no input for each step are left out
        rules = {name: L_d for name, L_d in rules.items() if hasattr(L_d, "at")}
    if system.exact:
        rules["exact"] = system.L_d
    methods: list[tuple[str, str, Any, Any]] = [(r, r, L_d, Stepper) for r, L_d in rules.items()]
    for make, order in COMPOSED if "strang" in rules and not driven else ():
        name = f"{make.__name__}{order}"
        methods.append((name, f"{name}(strang)", rules["strang"], partial(make, order=order)))
    return methods


def _measured(setup: Setup, L_d: Any, make: Any, parts: int, start: State, truth: Tensor) -> tuple[dict, float]:
    counted = Counted(L_d)
    steps, u = round(setup.T / setup.h) * parts, setup.inputs()
    options = {} if u is None else {"inputs": u.repeat_interleave(parts, 0)}
    with torch.no_grad():
        began = time.process_time()
        q = make(counted).rollout(*start, h=setup.h / parts, steps=steps, **options).q[:, 1:]
        seconds = time.process_time() - began
    cost = {"us_per_time": 1e6 * seconds / setup.T, "spread": 0.0, "evaluations_per_time": counted.count / setup.T}
    form = {"artefact": "eager", "dtype": "float64", "batch": RULE_MOTIONS, "h": setup.h / parts}
    return {**errors_of(q[:, steps // CHECKS - 1 :: steps // CHECKS], truth), **cost, **form}, seconds


def learned(case: Case, quick: bool) -> list[Timed]:
    """Everything learned of one scene."""
    return [*_own(case, quick), *_distilled(case, quick), *_other_terms(case, quick), *kicks(case, quick)]


def _evaluations(model: Any, case: Case, h: float) -> tuple[float, float]:
    """Evaluations of the model's terms, and flops, per unit of time, by the eager stepper's own count of iterations.

    2 flops a weight, and each evaluation carries the gradient and the Hessian in n directions: 1 + n + n(n + 1)/2
    numbers for one. An explicit step evaluates the potential's slope once.
    """
    state, u, count, steps = case.entry, inputs_of(case), 0, 6
    with torch.no_grad():
        for k in range(steps):
            step = Stepper(model).step(state, h, None, None if u is None else u[k])
            count, state = count + step.iterations + 1, step.state
    n = model.dof
    explicit = model.linear_in_q1
    each = 1.0 if explicit else count / steps
    weights = sum(p.numel() for p in model.parameters())
    return each / h, each / h * 2 * weights * (1 + n if explicit else 1 + n + n * (n + 1) / 2)


def _timed(
    case: Case, stepper: Any, h: float, kind: str, setting: str, artefact: str = "C", dtype: str = "float64"
) -> Timed:
    """A stepper with its errors, to be timed."""
    number = getattr(torch, dtype)
    point = {"kind": kind, "setting": setting, "h": h, "dtype": dtype, "artefact": artefact}
    start = State(*(x.to(number).contiguous() for x in case.entry))
    timing = timed_stepping(stepper, start, h, round(case.setup.T / h))
    return Timed({**point, **rolled(case, stepper, h, number)}, timing, h)


def _forms(
    case: Case, model: Any, h: float, kind: str, label: str, dtypes: Sequence[str] = ("float64", "float32")
) -> list[Timed]:
    """A model as compiled C, with its work counted."""
    evaluations, flops = _evaluations(model, case, h)
    found = []
    for dtype in dtypes:
        stepper = compile_c(model, h=h, dtype=dtype)
        one = _timed(case, stepper, h, kind, f"{label}, h {h:.4g}, C {dtype}", dtype=dtype)
        one.point.update(evaluations_per_time=evaluations, flops_per_time=flops)
        found.append(one)
    return found


def _own(case: Case, quick: bool) -> list[Timed]:
    """The run's own model: C, eager, weights rounded to bfloat16, loose Newton in C, ONNX and AOTInductor."""
    model, h = case.run.model, case.setup.h
    found = _forms(case, model, h, "learned", "own model")
    found.append(_timed(case, Stepper(model), h, "learned, eager", "own model, eager", "eager"))
    if not model.linear_in_q1:
        label, loose = "own model, eager, tol 0.0001", Stepper(model, tol=1e-4)
        found.append(_timed(case, loose, h, "learned, eager", label, "eager"))
        loose = compile_c(model, h=h, tolerance=1e-4)
        found.append(_timed(case, loose, h, "learned, Newton tolerance", "own model, C float64, tol 0.0001"))
    rounded = copy.deepcopy(model)
    with torch.no_grad():
        for parameter in rounded.parameters():
            parameter.copy_(parameter.bfloat16())
    found += _forms(case, rounded, h, "learned, bf16 weights", "bf16 weights", ("float32",))
    formats = (("ONNX", "a.onnx", export_onnx, load_onnx), ("AOTInductor", "a.pt2", export_aoti, load_pt2))
    for name, file, write, read in formats[:1] if quick else formats:  # AOTInductor compiles for a minute
        try:
            with tempfile.TemporaryDirectory() as folder:
                stepper = read(write(model, Path(folder) / file, h=h))
            found.append(_timed(case, stepper, h, f"learned, {name}", f"own model, {name}", name))
        except (InputError, RuntimeError) as error:
            print(f"{name}, {case.setup.name}: {error}")
    return found


def _distilled(case: Case, quick: bool) -> list[Timed]:
    """Larger steps: a correction of each width and depth, re-trained on motions of the fitted model."""
    setup = case.setup
    if setup.inputs() is not None or not setup.multiples:
        return []
    states, found, began = motions_of(case), [], time.process_time()
    sizes = ((8, 1), (8, 2), (16, 2)) if setup.name == "damped_pendulum" else ((8, 1), (12, 2))
    for m in setup.multiples[:1] if quick else setup.multiples:
        if round(setup.T / setup.h) % (m * CHECKS):
            continue
        before, after = pairs_of(states, m, 200 if quick else 600, 0)
        for width, depth in sizes[:1] if quick else sizes:
            start = widened(case.run.model, width, depth)
            model, _ = distil(start, before, after, m * setup.h, iterations=5 if quick else 50)
            model.requires_grad_(False)
            found += _forms(case, model, m * setup.h, "learned, distilled", f"{width} × {depth}")
        found += _forms(case, case.run.model, m * setup.h, "learned, no re-training", "own model at a larger step")
    case.seconds["distil"] = time.process_time() - began
    return found


def _other_terms(case: Case, quick: bool) -> list[Timed]:
    """The same data with a term less, or with one that the scene does not need."""
    found, setup = [], case.setup
    if quick:
        return []
    first = starts_of(setup.scene, COUNT, 1000)
    for label, change in setup.other.items():
        run = fit(case.run.data, fit_config(setup, quick, **change), progress=False)
        other = replace(case, run=run, entry=entered(setup, run, first, case.start))
        kind = f"learned, {label}"
        try:
            found += _forms(other, run.model, setup.h, kind, label, ("float64",))
        except InputError:  # no C for these terms: PyTorch
            found.append(_timed(other, Stepper(run.model), setup.h, kind, f"{label}, eager", "eager"))
    return found


def kicks(case: Case, quick: bool) -> list[Timed]:
    """Steps of several h as a few learned kicks and drifts."""
    setup = case.setup
    if not setup.kick_steps or not can_kick(case.run.model):
        return []
    states, found, began = motions_of(case), [], time.process_time()
    for m in setup.kick_steps[:1] if quick else setup.kick_steps:
        if round(setup.T / setup.h) % (m * CHECKS):
            continue
        before, after = pairs_of(states, m, 1000, case.seed)
        h = m * setup.h
        least = max(2, round(1.5 * h))
        for count in range(least, least + (1 if quick else 5 if m > 3 else 4)):
            stepper = fit_kicks(case.run.model, before, after, h, kicks=count, iterations=30 if quick else 150)
            for dtype in ("float64", "float32"):
                label = f"{count} kicks, h {h:.4g}, C {dtype}"
                one = _timed(case, CompiledKicks(stepper, dtype), h, "learned kicks", label, dtype=dtype)
                one.point.update(evaluations_per_time=count / h, flops_per_time=count * 70 / h)
                found.append(one)
    case.seconds["kicks"] = time.process_time() - began
    return found
