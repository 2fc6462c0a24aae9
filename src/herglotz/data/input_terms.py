"""Inputs that act by their square, size or rate, or saturate: further columns of u, computed from recorded inputs.

The force between the plates of a capacitor grows as V², a motor pulls a one-sided brake by |i|, a moved base drives a
mass by k r + c r′, and an amplifier gives no more than its level c, as sat(u/c) or, softly, tanh(u/c). The learned map
from inputs to forces is linear in all columns. A rate is the slope of a parabola through a value and its neighbours.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.column_table import INPUT_TERM
from herglotz.data.csv_columns import is_number
from herglotz.data.smoothing import slopes
from herglotz.data.trajectories import Trajectories
from herglotz.errors import refuse

FORMS = ("{}^2", "|{}|", "{}'")
# Functions of an input over its level.
SATURATIONS = {"sat": lambda x: x.clamp(-1, 1), "tanh": torch.tanh}
SATURATED = re.compile(r"(sat|tanh)\((.+)/([^/]+)\)")


def input_terms_of(columns: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """The names of the terms of inputs among columns, which are name, role and unit each."""
    return tuple(name for name, role, _ in columns if role == INPUT_TERM)


def all_input_terms(data: Trajectories) -> tuple[str, ...]:
    """The squares, sizes and rates of all recorded inputs; none if the recording has terms of inputs already."""
    if data.u is None or input_terms_of(data.columns):
        return ()
    return tuple(form.format(name) for name, _ in data.input_labels for form in FORMS)


def with_input_terms(data: Trajectories, terms: Sequence[str]) -> Trajectories:
    """The recording with these terms of its inputs as further columns of u.

    The terms of an input V are `V^2`, `|V|`, `V'`, `tanh(V/c)`, and `sat(V/c)`, which is V/c between -1 and 1 and ±1
    beyond; the level c is a number in the unit of V. Raise InputError for any other term, and for an unknown input.
    """
    terms = tuple(term for term in terms if term not in input_terms_of(data.columns))
    if not terms:
        return data
    where, labels = data.source or "data", dict(data.input_labels)
    known = {form.format(name): (name, form) for name in labels for form in FORMS}
    known |= {term: (found[2], term) for term in terms if (found := saturation(term)) and found[2] in labels}
    inputs = f"the inputs are {', '.join(labels)}" if labels else "the data have no input: name one with --inputs NAMES"
    remedy = f"write x^2, |x|, x', sat(x/2) or tanh(x/2) of an input x, 2 being its level > 0; {inputs}"
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
    if form != "{}'":
        return u.square() if form == "{}^2" else u.abs()
    return slopes(data, u)


def _unit(unit: str, form: str, time_unit: str) -> str:
    """The unit of a term of an input in this unit."""
    if saturation(form):
        return ""
    if form == "|{}|" or not unit:
        return unit
    return f"{unit}^2" if form == "{}^2" else f"{unit}/{time_unit}"
