"""What stands below an equation so that it can be integrated: arrival of inputs, zeros of sensors, the model's step."""

from __future__ import annotations

import math

from torch import Tensor

from herglotz.data.trajectories import GAP
from herglotz.errors import InputError
from herglotz.training.baseline import JITTER
from herglotz.training.equation_terms import is_formula, newtonian
from herglotz.training.equation_words import plain
from herglotz.training.fitted_run import FittedRun
from herglotz.training.free_run import free_runs
from herglotz.training.problems.grid import segment_grid, step_inputs

DIGITS = 7  # of the zero and the scale of a sensor
# Steps of order 2 leave three quarters of their error when they are halved: forces are of order 2 in rules of order 4.
HALVED = 4 / 3
BETWEEN = {
    "zero": "held from each sample to the next",
    "first": "straight between the samples",
    "smooth": "polynomials between the samples",
}
# The step of order 2 of masses of their own, whose friction takes the velocity and the position of the middle.
LEAPFROG = (
    "step it as the model does: m v = (p + (h/2) f(q, v)) exp(−γ h/2), q₊ = q + h v, p₊ = m v exp(−γ h/2) + "
    "(h/2) f(q₊, v), with {rate} and f the right side without −γ m v"
)


def notes_of(run: FittedRun) -> tuple[str, ...]:
    """The notes of a run, those that it has something for."""
    return tuple(filter(None, (_inputs(run), _sensors(run), _steps(run))))


def _inputs(run: FittedRun) -> str:
    if not run.model.inputs or run.decided.frequencies:
        return ""
    hold, unit = run.arrival.hold, "" if run.data.time_unit == "1" else f" {run.data.time_unit}"
    names = ", ".join(name for name, _ in run.data.input_labels)
    delay, lag = run.arrival.late
    late = [f"acting {delay:.6g}{unit} later"] if delay else []
    late += [f"through a lag T = {lag:.6g}{unit}, T f′ = {names} − f, f being what acts"] if lag else []
    return ", ".join([f"{names}: {BETWEEN.get(hold or 'zero', hold)}", *late])


def _sensors(run: FittedRun) -> str:
    """What makes a coordinate of the equation of the reading of its sensor."""
    told, names, found = run.reading, run.data.names, []
    zeros = (run.metrics.get("plan") or {}).get("zeros") or ()
    for of, numbers in (("times the scale", told.get("sensor_scales")), ("less the zero", told.get("sensor_zeros")),
                        ("less the zero", zeros)):  # fmt: skip
        values = [plain(float(x), DIGITS) for x in numbers or ()]
        each = [f"{name} {', '.join(values[i :: len(names)])}" for i, name in enumerate(names)] if values else []
        several = ", recording after recording" if len(values) > len(names) else ""
        found += [f"{of} of its sensor ({'; '.join(each)}{several})"] if values else []
    return f"a coordinate is its reading {', '.join(found)}" if found else ""


def _steps(run: FittedRun) -> str:
    """The model's step and rule, and by how much the exact motion of the equation departs from them."""
    unit = "" if run.data.time_unit == "1" else f" {run.data.time_unit}"
    what = f"the model's steps are {run.h:.4g}{unit}, its rule of order {run.model.config.order}"
    ratio = departure(run)
    if ratio is None:
        return what
    told = f"{what}; integrated exactly, the equation departs from it by {ratio:.2g} times what it misses the data by"
    if ratio <= 1:
        return told
    if not newtonian(run.model) or run.model.config.order > 2:
        return f"{told}: export it to step it (herglotz export)"
    rate = getattr(run.model.damping, "rate", None)
    return f"{told}: {LEAPFROG.format(rate=f'γ = {plain(0.0 if rate is None else float(rate.detach()), DIGITS)}')}"


def departure(run: FittedRun) -> float | None:
    """RMS of what the model's steps miss of the exact motion, over that of what the model misses of the data.

    By free runs of all recordings, with the model's steps and with halved ones. None where one breaks off, the model
    meets the data exactly, or is more than its equation.
    """
    data = run.data.unwrapped()
    if not is_formula(run.model):
        return None
    longest = longest_step(run)
    try:
        whole, halved = (free_run(run, max_step) for max_step in (longest, longest / 2))
    except InputError:
        return None
    missed, moved = ((x / data.balance).square().mean().sqrt() for x in (whole - data.q, HALVED * (halved - whole)))
    ratio = float(moved / missed)
    return ratio if math.isfinite(ratio) else None


def longest_step(run: FittedRun) -> float:
    """The longest step that the model takes along a recording."""
    return GAP * run.h if run.decided.substeps == 1 else JITTER * run.h


def free_run(run: FittedRun, max_step: float) -> Tensor:
    """Free runs of all recordings from their first states with steps of at most `max_step`, (N, n)."""
    data = run.data.unwrapped()
    grid = segment_grid(data, data.samples, max_step)
    start = run.states.joined[grid.start_sample].detach()
    nodes = free_runs(run.stepper, data, grid, start, step_inputs(run.model, data, grid))
    return grid.at_samples(nodes[..., : data.dof]).detach()
