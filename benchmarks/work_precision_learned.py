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
from work_precision_cases import COUNT, Case, Timed, costs, entered, fit_config, given, inputs_of, motions_of, rolled
from work_precision_headline import equation, kicks
from work_precision_rivals import classical, neural
from work_precision_scenes import CHECKS, judged, starts_of

from herglotz.errors import InputError
from herglotz.export import compile_c, export_onnx, load_onnx
from herglotz.stepping import State, Stepper
from herglotz.training import fit
from herglotz.tune.cost import timed_stepping
from herglotz.tune.distil import distil, pairs_of, widened

HEADLINE = "damped_pendulum"  # every artefact and every size is tried on this one


def points(case: Case, quick: bool, say: Callable[[str], None]) -> list[dict]:
    """Everything learned, and everything it stands beside, with errors and costs."""
    timed = list(_own(case, quick))
    say("distilling")
    timed += _distilled(case, quick)
    say("ladder")
    timed += _ladder(case, quick)
    say("kicks")
    timed += kicks(case, quick)
    timed += equation(case)
    say("classical")
    timed += classical(case)
    say("neural ODE")
    timed += neural(case, quick)
    say("timing")
    return costs(timed, 3 if quick else 9)


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


def _forms(case: Case, model: Any, h: float, kind: str, label: str, **notes: Any) -> list[Timed]:
    """A model as compiled C, in both precisions."""
    evaluations, flops = _evaluations(model, case, h)
    found = []
    for dtype in ("float64", "float32"):
        stepper = compile_c(model, h=h, dtype=dtype)
        number = getattr(torch, dtype)
        more = {"h": h, "dtype": dtype, "artefact": "C", "evaluations_per_time": evaluations, "flops_per_time": flops}
        error = rolled(case, stepper, h, number)
        point = {"kind": kind, "setting": f"{label}, h {h:.4g}, C {dtype}", **error, **more, **notes}
        found.append(_native(point, stepper, case, h, number))
    return found


def _native(point: dict, stepper: Any, case: Case, h: float, number: torch.dtype) -> Timed:
    start = State(*(x.to(number).contiguous() for x in case.entry))
    one = timed_stepping(stepper, start, h, round(case.setup.T / h))
    return Timed(point, one.run, one.steps * h, one.idle)


def _own(case: Case, quick: bool) -> list[Timed]:
    """The run's own model: C, eager, weights rounded to bfloat16, loose Newton in C, ONNX."""
    model, h = case.run.model, case.setup.h
    found = _forms(case, model, h, "learned", "own model")
    u, plain = case.setup.inputs(), {"h": h, "artefact": "eager", "dtype": "float64"}
    tolerances = (None,) if model.linear_in_q1 else (None, 1e-4)
    for tol in tolerances:
        eager = Stepper(model, tol=tol)
        point = {"kind": "learned, eager", "setting": f"own model, eager{'' if tol is None else f', tol {tol:g}'}"}
        found.append(_eager({**point, **rolled(case, eager, h), **plain}, eager, case, h, u))
        if tol is not None:
            loose = compile_c(model, h=h, tolerance=tol)
            point = {"kind": "learned, Newton tolerance", "setting": f"own model, C float64, tol {tol:g}", **plain}
            found.append(_native({**point, **rolled(case, loose, h), "artefact": "C"}, loose, case, h, torch.float64))
    rounded = copy.deepcopy(model)
    with torch.no_grad():
        for parameter in rounded.parameters():
            parameter.copy_(parameter.bfloat16())
    found += [
        t for t in _forms(case, rounded, h, "learned, bf16 weights", "bf16 weights") if "float32" in t.point["setting"]
    ]
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = export_onnx(model, Path(folder) / "a.onnx", h=h)
            onnx = load_onnx(path)
        point = {"kind": "learned, ONNX", "setting": "own model, ONNX", **plain, "artefact": "ONNX"}
        found.append(_eager({**point, **rolled(case, onnx, h)}, onnx, case, h, inputs_of(case)))
    except InputError as error:
        print(f"ONNX, {case.setup.name}: {error}")
    return found + ([] if quick else _compiled(case))


def _eager(point: dict, stepper: Any, case: Case, h: float, u: Tensor | None) -> Timed:
    steps = min(24, round(case.setup.T / h))
    start = State(*(x[:1] for x in case.entry))
    options = {} if u is None else given(stepper, u[:steps])

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
        u = inputs_of(case)
        held = [() if u is None else (u[k].expand(len(state.s), -1).contiguous(),) for k in range(steps)]
        with torch.no_grad():
            sizes = size.expand(len(state.s)).contiguous()
            for k in range(steps):
                state = State(*step(*state, sizes, *held[k])[:3])
                out.append(state.q)
            one = State(*(x[:1].contiguous() for x in case.entry))
            few = tuple(x[:1] for x in held[0])
            step(*one, sizes[:1], *few)
    except Exception as error:  # whatever the compiler says, the other forms are still measured
        print(f"torch.compile, {case.setup.name}: {type(error).__name__}: {str(error)[:200]}")
        return []
    errors = judged(torch.stack(out, 1)[:, steps // CHECKS - 1 :: steps // CHECKS], case.truth)
    point = {"kind": "learned, torch.compile", "setting": "own model, torch.compile", "h": h, "dtype": "float64"}

    def run() -> None:
        x = one
        with torch.no_grad():
            for _ in range(8):
                x = State(*step(*x, sizes[:1], *few)[:3])

    return [Timed({**point, **errors, "artefact": "torch.compile"}, run, 8 * h)]


def _distilled(case: Case, quick: bool) -> list[Timed]:
    """Larger steps: a correction of each width and depth, re-trained on motions of the fitted model."""
    setup = case.setup
    if setup.inputs() is not None or not setup.multiples:
        return []
    states, found, began = motions_of(case), [], time.process_time()
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
    first = starts_of(setup.scene, COUNT, 1000)
    for label, change in setup.other.items():
        run = fit(case.run.data, fit_config(setup, quick, **change), progress=False)
        other = replace(case, run=run, entry=entered(setup, run, first, case.start))
        kind = f"learned, {label}"
        try:
            found += [t for t in _forms(other, run.model, setup.h, kind, label) if "64" in t.point["dtype"]]
        except InputError:  # no C for these terms: PyTorch
            eager = Stepper(run.model)
            form = {"kind": kind, "setting": f"{label}, eager", "h": setup.h, "artefact": "eager", "dtype": "float64"}
            found.append(_eager({**form, **rolled(other, eager, setup.h)}, eager, other, setup.h, inputs_of(other)))
    return found
