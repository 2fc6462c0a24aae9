"""Notes below an equation that an integration needs: timing of inputs, zeros of sensors, the model's step and rule."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

from herglotz.data.trajectories import GAP
from herglotz.data.units import common_unit, size
from herglotz.errors import InputError
from herglotz.models import refuse_own
from herglotz.training.baseline import JITTER
from herglotz.training.equation_terms import is_formula, newtonian
from herglotz.training.equation_words import plain
from herglotz.training.feedback import acting_inputs
from herglotz.training.fitted_run import FittedRun
from herglotz.training.free_run import run_on

# Digits of the zero and the scale of a sensor.
DIGITS = 7
# Richardson: halved steps remove three quarters of an error of order 2. Forces are of order 2 in rules of order 4 too.
HALVED = 4 / 3
BETWEEN = {
    "zero": "held from each sample to the next",
    "first": "straight between the samples",
    "smooth": "polynomials between the samples",
}
# The rule of the model, printed if an exact integration departs from its steps (`models/terms.py`, `models/order4.py`).
RULE = (
    "step it as the model does: c p + ∂L_d/∂q + c (h/2) f = 0, p₊ = ∂L_d/∂q₊ + (h/2) f, s₊ = s + L_d with {parts}, "
    "c = exp(h ∂L/∂s) and L_d = {L_d}; K, ∂L/∂s and f are taken at q̄ = (q + q₊)/2 and v = (q₊ − q)/h{dry}"
)
# L_d of the rules of order 2 and 4.
OF_ORDER = {
    2: "(c − 1)(s − (h/2) V(q)) + √c h K − (h/2)(V(q) + V(q₊))",
    4: "(c − 1) s + √c (h K + (h³/24)(K_qq[v, v] + 2γ K_q v + γ² K − eᵀM⁻¹e)) − (h/6)(c V(q) + 4 √c V(q̄) + V(q₊)), "
    "e = K_q − V_q − K_qv v − γ K_v, M = K_vv",
}
# The rule with powers of s in L.
BY_POWERS = (
    "step it as the model does: c p + ∂L_d/∂q + c (h/2) f = 0, p₊ = ∂L_d/∂q₊ + (h/2) f, c = 1 + ∂L_d/∂s, f the forces; "
    "L_d is what s gains from − (h/2) V(q), half a step of s′ = −β sᵖ of each power of s, half a step of s′ = −γ s, "
    "h K, and the same backwards with V(q₊); K and f are taken at q̄ = (q + q₊)/2 and v = (q₊ − q)/h"
)
DRY = ", but dry friction, of q and v, acts by h in place of h/2 in the first of them, and not in the second"


def notes_of(run: FittedRun) -> tuple[str, ...]:
    """The notes of a run; empty ones are left out."""
    refuse_own(run.model, "the equation", "herglotz.theory.ContinuousEquation evaluates that of any L_d")
    return tuple(filter(None, (_inputs(run), _sensors(run), _steps(run))))


def _inputs(run: FittedRun) -> str:
    if not run.model.inputs or run.decided.frequencies:
        return ""
    hold, unit = run.arrival.hold, "" if run.data.time_unit == "1" else f" {run.data.time_unit}"
    every, acting = [name for name, _ in run.data.input_labels], set(acting_inputs(run.model))
    if idle := ", ".join(name for k, name in enumerate(every) if k not in acting):
        idle = f"{idle}: without effect of its own, and still an argument of the model's steps"
    if not acting:
        return idle
    names = ", ".join(name for k, name in enumerate(every) if k in acting)
    delay, lag = run.arrival.late
    late = [f"acting {delay:.6g}{unit} later"] if delay else []
    late += [f"through a lag T = {lag:.6g}{unit}, T f′ = {names} − f, f being what acts"] if lag else []
    late += ["taken as exact in the deviations above"] if late else []
    acts = ", ".join([f"{names}: {BETWEEN.get(hold or 'zero', hold)}", *late])
    return f"{acts}; {idle}" if idle else acts


def _sensors(run: FittedRun) -> str:
    """How the reading of a sensor becomes a coordinate of the equation."""
    names, found, plan = run.data.names, [], run.metrics.get("plan") or {}
    for of, numbers in (
        ("times the scale", run.reading.get("sensor_scales")),
        ("less the zero", run.reading.get("sensor_zeros")),
        ("less the zero", plan.get("zeros")),
        ("less t since its recording began times the drift", plan.get("drifts")),
    ):
        values = [plain(float(x), DIGITS) for x in numbers or ()]
        each = [f"{name} {', '.join(values[i :: len(names)])}" for i, name in enumerate(names)] if values else []
        several = ", recording after recording" if len(values) > len(names) else ""
        found += [f"{of} of its sensor ({'; '.join(each)}{several})"] if values else []
    return f"a coordinate is its reading {', '.join(found)}" if found else ""


def _steps(run: FittedRun) -> str:
    """The model's step and rule, and the distance of the exact motion of the equation from the model's motion."""
    time, model = "" if run.data.time_unit == "1" else f" {run.data.time_unit}", run.model
    what = f"the model's steps are {run.h:.7g}{time}, its rule of order {model.config.order}"
    found = departure(run)
    if found is None:
        return what
    unit = common_unit(run.data.units)
    by = f"{size(found.moved, unit, bool(run.data.degrees))}, " if unit or run.data.dof == 1 else ""
    ratio = f"{found.moved / found.missed:.2g} times what it misses the data by"
    told = f"{what}; integrated exactly, the equation departs from it by {by}{ratio}"
    if found.moved <= found.missed:
        return told
    if model.config.dissipation:
        return f"{told}: {BY_POWERS}"
    parts = "L = K − V + s ∂L/∂s, f the forces"
    if newtonian(model):
        rate = 0.0 if model.damping is None else float(model.damping.rate.detach())  # type: ignore[operator]
        loads = ", constants on angles among them" if any(text.startswith("load") for text in model.config.drag) else ""
        parts = f"L = K − V − γ s, γ = {plain(rate, DIGITS)}, V of the forces by position alone, f the others "
        parts += f"without −γ m v{loads}"
    dry = DRY if model.friction is not None and model.friction.sticking else ""
    return f"{told}: {RULE.format(parts=parts, L_d=OF_ORDER[model.config.order], dry=dry)}"


class Departure(NamedTuple):
    """RMS over all coordinates, each over its balance.

    `moved` is the distance of the model's motion from the exact motion of its equation, `missed` that from the data.
    """

    moved: float
    missed: float


def departure(run: FittedRun) -> Departure | None:
    """Errors of free runs of all recordings; the exact motion is extrapolated from whole and halved steps.

    None if a run fails or leaves the world, the model fits the data exactly, or the equation is not the whole model.
    """
    data = run.data.unwrapped()
    if not is_formula(run.model) or _is_lost(run):
        return None
    longest = longest_step(run)
    try:
        whole, halved = (free_run(run, max_step) for max_step in (longest, longest / 2))
    except InputError:
        return None
    changes = whole - data.q, HALVED * (halved - whole)
    missed, moved = (float((x / data.balance).square().mean().sqrt()) for x in changes)
    return Departure(moved, missed) if missed > 0 and math.isfinite(moved) and math.isfinite(missed) else None


def _is_lost(run: FittedRun) -> bool:
    """Whether the free run misses the data by more than an unrelated motion of the same spread would, √2 of it."""
    q = run.data.q / run.data.balance
    missed = (run.prediction.detach().to(q) / run.data.balance - q).square().mean()
    return not bool(missed <= 2 * (q - q.mean(0)).square().mean())


def longest_step(run: FittedRun) -> float:
    """The longest model step along a recording."""
    return GAP * run.h if run.decided.substeps == 1 else JITTER * run.h


def free_run(run: FittedRun, max_step: float) -> Tensor:
    """Positions of free runs of all recordings from their first states, with steps up to `max_step`, (N, n)."""
    data, states = run.data.unwrapped(), run.states.joined.detach().clone()
    run_on(run.stepper, data, states, (1,) * len(data), max_step)
    return states[:, : data.dof].detach()
