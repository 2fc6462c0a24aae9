"""Learned steppers, in every form, at their own step and at larger ones, with terms more and less."""

from __future__ import annotations

import copy
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from work_precision_cases import COUNT, TIMED, Case, Timed, costs, fit_config, repeated
from work_precision_rivals import classical, neural
from work_precision_scenes import CHECKS, errors_of, starts_of

from herglotz.errors import InputError
from herglotz.export import compile_c, export_onnx, load_onnx
from herglotz.stepping import State, Stepper
from herglotz.training import fit
from herglotz.tune.cost import timed_stepping
from herglotz.tune.distil import distil, pairs_of, widened
from herglotz.tune.kicks import can_kick, fit_kicks
from herglotz.tune.kicks_c import CompiledKicks
from herglotz.tune.reference import draw_starts, record

HEADLINE = "damped_pendulum"  # every artefact and every size is tried on this one


def points(case: Case, quick: bool, say: Callable[[str], None]) -> list[dict]:
    """Everything learned, and everything it stands beside, with errors and costs."""
    timed = list(_own(case))
    say("distilling")
    timed += _distilled(case, quick)
    say("ladder")
    timed += _ladder(case, quick)
    say("kicks")
    timed += _kicks(case, quick)
    say("classical")
    timed += classical(case)
    say("neural ODE")
    timed += neural(case, quick)
    say("timing")
    return costs(timed, 3 if quick else 9)


def _rolled(case: Case, stepper: Any, h: float, dtype: torch.dtype = torch.float64) -> dict[str, float | None]:
    steps, u = round(case.setup.T / h), _inputs(case)
    if steps % CHECKS:
        raise InputError(f"{steps} steps do not reach the {CHECKS} times of the check")
    options = {} if u is None else {"inputs": u.to(dtype)}
    with torch.no_grad():
        start = (x.to(dtype).contiguous() for x in case.entry)
        q = stepper.rollout(*start, h=h, steps=steps, **options).q[:, 1:]
    return errors_of(q[:, steps // CHECKS - 1 :: steps // CHECKS], case.truth)


def _inputs(case: Case) -> Tensor | None:
    """The inputs of the scene, where the model takes them."""
    return case.setup.inputs() if case.run.model.inputs else None


def _evaluations(model: Any, case: Case, h: float) -> tuple[float, float]:
    """Evaluations of the model's terms, and flops, per unit of time, by the eager stepper's own count of iterations.

    2 flops a weight, and each evaluation carries the gradient and the Hessian in n directions: 1 + n + n(n + 1)/2
    numbers for one. An explicit step evaluates the potential's slope once.
    """
    state, u, count, steps = case.entry, _inputs(case), 0, 6
    with torch.no_grad():
        for k in range(steps):
            step = Stepper(model).step(state, h, None, None if u is None else u[k])
            count, state = count + step.iterations + 1, step.state
    n = model.dof
    explicit = model.linear_in_q1
    each = 1.0 if explicit else count / steps
    weights = sum(p.numel() for p in model.parameters())
    return each / h, each / h * 2 * weights * (1 + n if explicit else 1 + n + n * (n + 1) / 2)


def _forms(case: Case, model: Any, h: float, kind: str, label: str, **notes: Any) -> list[Timed]:
    """A model as compiled C, in both precisions."""
    evaluations, flops = _evaluations(model, case, h)
    found = []
    for dtype in ("float64", "float32"):
        stepper = compile_c(model, h=h, dtype=dtype)
        number = getattr(torch, dtype)
        more = {"h": h, "dtype": dtype, "artefact": "C", "evaluations_per_time": evaluations, "flops_per_time": flops}
        error = _rolled(case, stepper, h, number)
        point = {"kind": kind, "setting": f"{label}, h {h:.4g}, C {dtype}", **error, **more, **notes}
        found.append(_native(point, stepper, case, h, number))
    return found


def _native(point: dict, stepper: Any, case: Case, h: float, number: torch.dtype) -> Timed:
    start = State(*(x.to(number).contiguous() for x in case.entry))
    one = timed_stepping(stepper, start, h, round(case.setup.T / h))
    return Timed(point, one.run, one.steps * h, one.idle)


def _own(case: Case) -> list[Timed]:
    """The run's own model: C, eager, weights rounded to bfloat16, loose Newton in C, ONNX."""
    model, h = case.run.model, case.setup.h
    found = _forms(case, model, h, "learned", "own model")
    u, plain = case.setup.inputs(), {"h": h, "artefact": "eager", "dtype": "float64"}
    tolerances = (None,) if model.linear_in_q1 else (None, 1e-4)
    for tol in tolerances:
        eager = Stepper(model, tol=tol)
        point = {"kind": "learned, eager", "setting": f"own model, eager{'' if tol is None else f', tol {tol:g}'}"}
        found.append(_eager({**point, **_rolled(case, eager, h), **plain}, eager, case, h, u))
        if tol is not None:
            loose = compile_c(model, h=h, tolerance=tol)
            point = {"kind": "learned, Newton tolerance", "setting": f"own model, C float64, tol {tol:g}", **plain}
            found.append(_native({**point, **_rolled(case, loose, h), "artefact": "C"}, loose, case, h, torch.float64))
    rounded = copy.deepcopy(model)
    with torch.no_grad():
        for parameter in rounded.parameters():
            parameter.copy_(parameter.bfloat16())
    found += [
        t for t in _forms(case, rounded, h, "learned, bf16 weights", "bf16 weights") if "float32" in t.point["setting"]
    ]
    if case.setup.name == HEADLINE:
        with tempfile.TemporaryDirectory() as folder:
            path = export_onnx(model, Path(folder) / "a.onnx", h=h)
            onnx = load_onnx(path)
        point = {"kind": "learned, ONNX", "setting": "own model, ONNX", **plain, "artefact": "ONNX"}
        found.append(_eager({**point, **_rolled(case, onnx, h)}, onnx, case, h, None))
        found += _compiled(case)
    return found


def _eager(point: dict, stepper: Any, case: Case, h: float, u: Tensor | None) -> Timed:
    steps = min(24, round(case.setup.T / h))
    start = State(*(x[:1] for x in case.entry))
    options = {} if u is None else {"inputs": u[:steps]}

    def run() -> None:
        with torch.no_grad():
            stepper.rollout(*start, h=h, steps=steps, **options)

    return Timed(point, run, steps * h)


def _compiled(case: Case) -> list[Timed]:
    """`torch.compile` of the exported step; left out where it cannot be had."""
    from herglotz.export import StepModule

    model, h = copy.deepcopy(case.run.model), case.setup.h
    try:
        step = torch.compile(StepModule(model))
        state, out, size = case.entry, [], torch.tensor(h, dtype=torch.float64)
        steps = round(case.setup.T / h)
        with torch.no_grad():
            sizes = size.expand(len(state.s)).contiguous()
            for _ in range(steps):
                state = State(*step(*state, sizes)[:3])
                out.append(state.q)
            one = State(*(x[:1].contiguous() for x in case.entry))
            step(*one, sizes[:1])
    except Exception as error:  # whatever the compiler says, the other forms are still measured
        print(f"torch.compile: {type(error).__name__}: {str(error)[:200]}")
        return []
    errors = errors_of(torch.stack(out, 1)[:, steps // CHECKS - 1 :: steps // CHECKS], case.truth)
    point = {"kind": "learned, torch.compile", "setting": "own model, torch.compile", "h": h, "dtype": "float64"}

    def run() -> None:
        x = one
        with torch.no_grad():
            for _ in range(8):
                x = State(*step(*x, sizes[:1])[:3])

    return [Timed({**point, **errors, "artefact": "torch.compile"}, run, 8 * h)]


def _motions(case: Case) -> State:
    """Motions of the fitted model itself, to distil from."""
    made = record(case.run, draw_starts(case.run, 60, 5), case.setup.T, "own")
    return made.states


def _distilled(case: Case, quick: bool) -> list[Timed]:
    """Larger steps: a correction of each width and depth, re-trained on motions of the fitted model."""
    setup = case.setup
    if setup.inputs() is not None or not setup.multiples:
        return []
    states, found, began = _motions(case), [], time.process_time()
    sizes = ((8, 1), (8, 2), (16, 2)) if setup.name == HEADLINE else ((8, 1), (12, 2))
    for m in setup.multiples[:1] if quick else setup.multiples:
        if round(setup.T / setup.h) % (m * CHECKS):
            continue
        before, after = pairs_of(states, m, 200 if quick else 600, 0)
        for width, depth in sizes[:1] if quick else sizes:
            start = widened(case.run.model, width, depth)
            model, _ = distil(start, before, after, m * setup.h, iterations=5 if quick else 50)
            model.requires_grad_(False)
            found += _forms(
                case, model, m * setup.h, "learned, distilled", f"{width} × {depth}", width=width, depth=depth
            )
        found += _forms(case, case.run.model, m * setup.h, "learned, no re-training", "own model at a larger step")
    case.seconds["distil"] = time.process_time() - began
    return found


def _ladder(case: Case, quick: bool) -> list[Timed]:
    """The same data with a term less, or with one that the scene does not need."""
    found, setup = [], case.setup
    if quick:
        return []
    first, u = starts_of(setup.scene, COUNT, 1000), setup.inputs()
    for label, change in setup.other.items():
        run = fit(case.run.data, fit_config(setup, quick, **{"iterations": 25, **change}), progress=False)
        options = {"u": u[0]} if u is not None and run.model.inputs else {}
        with torch.no_grad():
            entry = run.stepper.init(first.q, case.start.q, None, setup.h, **options)
        other = replace(case, run=run, entry=State(*(x.detach() for x in entry)))
        found += [t for t in _forms(other, run.model, setup.h, f"learned, {label}", label) if "64" in t.point["dtype"]]
    return found


def _kicks(case: Case, quick: bool) -> list[Timed]:
    """Steps of several h as a few learned kicks and drifts."""
    setup = case.setup
    if not setup.kick_steps or not can_kick(case.run.model):
        return []
    states, found, began = _motions(case), [], time.process_time()
    for m in setup.kick_steps[:1] if quick else setup.kick_steps:
        if round(setup.T / setup.h) % (m * CHECKS):
            continue
        before, after = pairs_of(states, m, 1000, 0)
        h = m * setup.h
        least = max(2, round(1.5 * h))
        for kicks in range(least, least + (1 if quick else 4)):
            stepper = fit_kicks(case.run.model, before, after, h, kicks=kicks, iterations=30 if quick else 150)
            for dtype in ("float64", "float32"):
                compiled, number = CompiledKicks(stepper, dtype), getattr(torch, dtype)
                point = {"kind": "learned kicks", "setting": f"{kicks} kicks, h {h:.4g}, C {dtype}", "dtype": dtype}
                counts = {"evaluations_per_time": kicks / h, "flops_per_time": kicks * 70 / h, "h": h, "artefact": "C"}
                steps = round(setup.T / h)
                start = State(*(x[:TIMED].to(number) for x in case.entry))
                outputs = [torch.empty(len(start.s), steps + 1, dtype=number) for _ in range(3)]
                call = repeated(compiled.call(start, steps, outputs), keep=outputs)
                found.append(
                    Timed(
                        {**point, **_rolled(case, compiled, h, number), **counts},
                        call[0],
                        call[1] * len(start.s) * setup.T,
                    )
                )
    case.seconds["kicks"] = time.process_time() - began
    return found
