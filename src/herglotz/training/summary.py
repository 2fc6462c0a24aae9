"""The result of a run in words: for the screen, a notebook and a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from textwrap import fill
from typing import Any

from herglotz.data import Trajectories
from herglotz.data.units import as_recorded, common_unit, size, span
from herglotz.training.equation import ON_SCREEN, Equation
from herglotz.training.fitted_run import FittedRun
from herglotz.training.left_out import from_then_on
from herglotz.training.plan import LINE_WIDTH
from herglotz.training.properties import by_property, inverse
from herglotz.training.recorded_range import range_in_words

MAX_FEATURES = 5
# More coordinates are not explained: they form a chain, and their order is enough.
MAX_NAMES = 4


def rows(run: FittedRun) -> list[tuple[str, str]]:
    """Names and values of the results that the run has."""
    m, data = run.metrics, run.data
    unit, degrees = common_unit(data.units), bool(data.degrees)
    kept, per = sum(run.train_lengths), "unit of time" if data.time_unit == "1" else data.time_unit
    found = [
        ("data", as_recorded(data)[0].summary()),
        ("left out", "; ".join(left_out_of(m, data))),
        ("outlier", "; ".join(outlying_of(m, data))),
        ("trained on", f"{kept} of {data.samples} samples; {m.get('objective')} objective, {_level(run)}"),
        ("recorded range", range_in_words(run.box, data)),
        ("named terms", run.decided.features and _terms(run.decided.features, data.names)),
        ("extrapolation RMS", _told(m.get("extrapolation_rms"), unit, degrees, "  free run over the unseen samples")),
        ("training RMS", _told(m.get("train_rms"), unit, degrees)),
        ("one-step RMS", _told(m.get("one_step_rms"), unit, degrees)),
        # Where s enters the motion, the same positions have other γ, p and s (gauge, trap 3 of docs/mathematics.md).
        ("damping rate", "" if run.model.s_enters_motion else _told(m.get("rate"), f"per {per}")),
        ("time", _told(m.get("seconds"), "s")),
    ]
    return [(name, value) for name, value in found if value]


def outlying_of(metrics: Mapping[str, Any], data: Trajectories) -> list[str]:
    """The recording that stands out where none was left out, with what to do."""
    unit = common_unit(data.units)
    return [
        f"{_label(one)}, counted from 0, {_why(one)}: the model {_missed(one, unit)}, "
        f"and the others by {size(one['others'], unit, digits=2)}; "
        + (f"try {inverse(own)}" if (own := one.get("properties")) else "fit once more without it")
        for one in metrics.get("outlying", ())
    ]


def _why(one: Mapping[str, Any]) -> str:
    """Why a recording may stand out."""
    return by_property(one["properties"]) if one.get("properties") else "may be of something else"


def left_out_of(metrics: Mapping[str, Any], data: Trajectories) -> list[str]:
    """The recordings that were left out whole, with what the model of the others misses them by."""
    unit = common_unit(data.units)
    return [
        f"{_label(one)}, counted from 0, whole: the model of the others {_missed(one, unit)}, "
        f"and them by {size(one['others'], unit, digits=2)}"
        for one in metrics.get("left_out", ())
    ]


def _label(one: Mapping[str, Any]) -> str:
    """The label of a recording; runs of earlier versions know its number alone."""
    return one.get("label", f"trajectory {one['recording']}")


def _missed(one: Mapping[str, Any], unit: str) -> str:
    """That a model misses a recording, by how much and from when on; without a number a step of the model fails."""
    by = "does not follow it" if one["missed"] is None else f"misses it by {size(one['missed'], unit, digits=2)}"
    return by + from_then_on(one.get("since"))


def aligned(table: Sequence[tuple[str, str]]) -> list[str]:
    """Names and values in two aligned columns, wrapped: the text of each row."""
    width = max(len(name) for name, _ in table)
    return [fill(value, LINE_WIDTH, initial_indent=f"  {name:<{width}}  ", subsequent_indent=" " * (width + 4))
            for name, value in table]  # fmt: skip


def summary(run: FittedRun) -> str:
    """A few lines of text, the verdict last."""
    lines = aligned(rows(run))
    if run.metrics.get("extrapolation_status") not in (None, "ok"):
        lines.append(fill(f"Note: {run.metrics['extrapolation_status']}", LINE_WIDTH))
    equation = run.metrics.get("equation")
    if equation:
        shown = Equation.from_dict(equation).text(ON_SCREEN)
        lines += ["Learned equation:", *(f"  {line}" for line in shown.splitlines())]
    return "\n".join([*lines, fill(f"Verdict: {run.metrics.get('verdict', 'not judged')}", LINE_WIDTH)])


def one_line(run: FittedRun) -> str:
    """The run in one line of 80 characters or little more."""
    names, verdict = ", ".join(run.data.names), run.metrics.get("verdict", "not judged").split(":")[0]
    return f"Run({_level(run)}, {names} of {run.data.source or 'data'}; {verdict})"


def _level(run: FittedRun) -> str:
    """The level of the model, or the name of an L_d of the user's."""
    own = run.metrics.get("own")
    return f"own L_d {own}" if own else f"{run.decided.level} level"


def as_html(run: FittedRun) -> str:
    """A small table for notebooks."""
    cells = [*rows(run), ("verdict", run.metrics.get("verdict", "not judged"))]
    body = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(value)}</td></tr>"
        for name, value in cells
    )
    return f"<table>{body}</table>"


def _terms(features: tuple[str, ...], names: tuple[str, ...]) -> str:
    """The named terms with the waves of functions last, and the names of the coordinates q1, q2, …."""
    symbols = [f"q{i} is {name}" for i, name in enumerate(names, 1) if name != f"q{i}" and len(names) <= MAX_NAMES]
    rest = len(features) - MAX_FEATURES
    named = sorted(features, key=lambda text: text.startswith(("sin", "cos")))
    shown = ", ".join(named[:MAX_FEATURES]) + (f" and {rest} more (metrics.json)" if rest > 0 else "")
    return shown + (f"  ({', '.join(symbols)})" if symbols else "")


def model_card(run: FittedRun, h_range: tuple[float, float]) -> str:
    """The comment of an exported file: summary, verdict, and the range of the training data."""
    steps, positions = span(h_range, run.data.time_unit), range_in_words(run.box, run.data)
    return "\n".join([
        f"Model of {run.data.source or 'a recording'} (sha256 {run.data.digest()[:16]})", summary(run),
        f"For steps of {steps}, and positions {positions}.",
        "Outside of these the model extrapolates. The first coordinate's mass is 1.",
    ])  # fmt: skip


def _told(value: float | None, unit: str, degrees: bool = False, after: str = "") -> str:
    """Three digits and a unit; "" for None."""
    return "" if value is None else size(value, unit, degrees) + after
