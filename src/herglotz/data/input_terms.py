"""Further columns of u: inputs that act by their square, size or rate, or saturate, and periodic forces.

The force between the plates of a capacitor grows as V², the thrust of a propeller as |n| n, a motor pulls a one-sided
brake by |i|, a moved base drives a mass by k r + c r′, and an amplifier gives no more than its level c, as sat(u/c) or,
softly, tanh(u/c). The learned map from inputs to forces is linear in all columns. A rate is the slope of a parabola
through a value and its neighbours.

A periodic force of known frequency and unknown amplitude and phase has the inputs cos νt and sin νt: f cos(νt + φ) = f
cos φ · cos νt − f sin φ · sin νt is linear in two inputs, so that the learned map from inputs to forces is the
amplitude and the phase (f cos φ, −f sin φ). The time stands in the inputs: L_d is time-dependent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.csv_columns import is_number
from herglotz.data.smoothing import slopes
from herglotz.data.trajectories import INPUT_TERM, Trajectories
from herglotz.errors import InputError, refuse

RATE = "{0}'"
# Functions of an input by the form of its term; the rate is none.
FUNCTIONS = {"{0}^2": torch.square, "|{0}| {0}": lambda x: x.abs() * x, "|{0}|": torch.abs}
FORMS = (*FUNCTIONS, RATE)
# Functions of an input over its level.
SATURATIONS = {"sat": lambda x: x.clamp(-1, 1), "tanh": torch.tanh}
SATURATED = re.compile(r"(sat|tanh)\((.+)/([^/]+)\)")


def input_terms_of(columns: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """The names of the terms of inputs among columns, which are name, role and unit each."""
    return tuple(name for name, role, _ in columns if role == INPUT_TERM)


def all_input_terms(data: Trajectories) -> tuple[str, ...]:
    """The squares, with and without sign, sizes and rates of all recorded inputs.

    An input of one sign is its own size. None if the recording has terms of inputs already.
    """
    if data.u is None or input_terms_of(data.columns):
        return ()
    turns = ((data.u > 0).any(0) & (data.u < 0).any(0)).tolist()
    return tuple(
        form.format(name)
        for (name, _), both in zip(data.input_labels, turns, strict=True)
        for form in FORMS
        if both or "|" not in form
    )


def with_input_terms(data: Trajectories, terms: Sequence[str]) -> Trajectories:
    """The recording with these terms of its inputs as further columns of u.

    The terms of an input V are `V^2`, `|V| V`, `|V|`, `V'`, `tanh(V/c)`, and `sat(V/c)`, which is V/c between -1 and 1
    and ±1 beyond; the level c is a number in the unit of V. Raise InputError for any other term, and for an unknown
    input.
    """
    terms = tuple(term for term in terms if term not in input_terms_of(data.columns))
    if not terms:
        return data
    where, labels = data.source or "data", dict(data.input_labels)
    known = {form.format(name): (name, form) for name in labels for form in FORMS}
    known |= {term: (found[2], term) for term in terms if (found := saturation(term)) and found[2] in labels}
    inputs = f"the inputs are {', '.join(labels)}" if labels else "the data have no input: name one with --inputs NAMES"
    remedy = f"write x^2, |x| x, |x|, x', sat(x/2) or tanh(x/2) of an input x, 2 being its level > 0; {inputs}"
    for term in terms:
        refuse({f"{where}: {term!r} is no term of an input; {remedy}": term not in known})
    assert data.u is not None
    names, columns, rows = list(labels), [], []
    for term in terms:
        name, form = known[term]
        columns.append(_column(data, data.u[:, names.index(name)], form))
        rows.append((term, INPUT_TERM, _unit(labels[name], form, data.time_unit)))
    recorded = data.columns if data.columns else tuple((name, "input", unit) for name, unit in labels.items())
    return replace(data, u=torch.cat([data.u, torch.stack(columns, 1)], 1), columns=(*recorded, *rows))


def saturation(term: str) -> tuple[str, float, str] | None:
    """The kind of a saturation, its level, and its input; None for any other term."""
    match = SATURATED.fullmatch(term)
    level = float(match[3]) if match and is_number(match[3]) else 0.0
    return (match[1], level, match[2]) if match and 0 < level < math.inf else None


def _column(data: Trajectories, u: Tensor, form: str) -> Tensor:
    """(N,) values of a term of an input (N,)."""
    if found := saturation(form):
        return SATURATIONS[found[0]](u / found[1])
    return slopes(data, u) if form == RATE else FUNCTIONS[form](u)


def _unit(unit: str, form: str, time_unit: str) -> str:
    """The unit of a term of an input in this unit."""
    if saturation(form):
        return ""
    if form == "|{0}|" or unit in ("", "1", "-"):
        return unit
    return f"{unit}/{time_unit}" if form == RATE else f"{unit}^2"


def waves(t: Tensor, frequencies: Sequence[float]) -> Tensor:
    """Return cos νt and sin νt of every angular frequency ν at the times t, (N,) → (N, 2m)."""
    angle = t[:, None] * torch.tensor(frequencies, dtype=t.dtype, device=t.device)
    return torch.stack([angle.cos(), angle.sin()], -1).flatten(1)


def with_waves(data: Trajectories, frequencies: Sequence[float]) -> Trajectories:
    """The data with waves of these frequencies (rad per unit of time) as inputs; unchanged without frequencies.

    Raise InputError if a frequency is not positive, beyond half the rate of the samples (π/h), or the data hold other
    inputs.
    """
    if not frequencies:
        return data
    where = data.source or "data"
    if not all(0 < x < float("inf") for x in frequencies):
        raise InputError(f"{where}: frequencies must be positive numbers, got {tuple(frequencies)}")
    fastest = math.pi / data.typical_step
    if max(frequencies) > fastest:
        raise InputError(
            f"{where}: samples {data.typical_step:.4g} apart show no angular frequency above {fastest:.4g}, got "
            f"{max(frequencies):g}; give it in rad per unit of time"
        )
    u = waves(data.t, frequencies)
    if data.u is not None and (data.u.shape != u.shape or not torch.allclose(data.u, u)):
        raise InputError(f"{where}: holds inputs u, and frequencies would be inputs, too; leave one of them out")
    names = [f"{wave}({x:g} t)" for x in frequencies for wave in ("cos", "sin")]
    columns = data.columns if data.u is not None else (*data.columns, *((name, "input", "") for name in names))
    return replace(data, u=u, hold="smooth", columns=columns)
