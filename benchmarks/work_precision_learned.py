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
from work_precision_cases import COUNT, Case, Timed, costs, entered, fit_config, inputs_of, motions_of, rolled
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
    options = {} if u is None else {"inputs": u[:steps]}

    def run() -> None:
        with torch.no_grad():
            stepper.rollout(*start, h=h, steps=steps, **options)

    return Timed(point, run, steps * h)


class FixedNewton(torch.nn.Module):
    """A fixed number of iterations in place of a loop that ends when all are solved, which dynamo cannot trace."""

    def __init__(self, newton: Any, turns: int):
        super().__init__()
        self.newton, self.turns, self.equation = newton, turns, newton.equation

    def start(self, *arguments: Any, **options: Any) -> tuple[Tensor, ...]:
        """Newton's own."""
        return self.newton.start(*arguments, **options)

    def forward(self, problem: Any, carry: Any, constants: Any) -> tuple[Tensor, ...]:
        """Δ, its step, merit, done and the values; what is not done then gets its status from `StepModule`."""
        for _ in range(self.turns + 1):  # the first evaluates the guess
            carry = self.newton.iterate(problem, carry, constants)
        _, done, x, delta, merit, _, _, *values = carry
        return x, delta, merit, done, *values


def _turns(case: Case) -> int:
    """The most iterations that any start needs anywhere on its motion."""
    state, u, most = case.entry, inputs_of(case), 1
    with torch.no_grad():
        for k in range(round(case.setup.T / case.setup.h)):
            step = Stepper(case.run.model).step(state, case.setup.h, None, None if u is None else u[k])
            state, most = step.state, max(most, step.iterations)
    return most


def _compiled(case: Case) -> list[Timed]:
    """`torch.compile` of the exported step, compiled once, for one motion; left out where it cannot be had."""
    from herglotz.export import StepModule

    model, h = copy.deepcopy(case.run.model).requires_grad_(False), case.setup.h
    module, turns = StepModule(model), _turns(case)
    if not model.linear_in_q1:
        module.newton = FixedNewton(module.newton, turns)
    steps, u = round(case.setup.T / h), inputs_of(case)
    size = torch.tensor([h], dtype=torch.float64)
    held = [() if u is None else (u[k : k + 1].clone(),) for k in range(steps)]
    try:
        step = torch.compile(module)
        ends = []
        with torch.no_grad():
            for i in range(len(case.entry.s)):
                x, q = State(*(y[i : i + 1].clone() for y in case.entry)), []
                for k in range(steps):
                    x = State(*step(*x, size, *held[k])[:3])
                    q.append(x.q)
                ends.append(torch.stack(q[steps // CHECKS - 1 :: steps // CHECKS], 1))
    except Exception as error:  # whatever the compiler says, the other forms are still measured
        print(f"torch.compile, {case.setup.name}: {type(error).__name__}: {str(error)[:200]}")
        return []
    start = State(*(y[:1].clone() for y in case.entry))
    label = "own model, torch.compile" + ("" if model.linear_in_q1 else f", {turns} iterations")
    point = {"kind": "learned, torch.compile", "setting": label, "h": h, "dtype": "float64"}

    def run() -> None:
        x = start
        with torch.no_grad():
            for k in range(min(8, steps)):
                x = State(*step(*x, size, *held[k])[:3])

    errors = judged(torch.cat(ends), case.truth)
    return [Timed({**point, **errors, "artefact": "torch.compile"}, run, min(8, steps) * h)]


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
