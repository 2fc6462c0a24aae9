"""`write_report`: whether to trust a run, and how to use the run, as one HTML file and as Markdown."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from herglotz.data import Trajectories
from herglotz.data.files import folder_at, write_atomically
from herglotz.data.trajectories import column_rows
from herglotz.data.units import as_recorded, common_unit, size, span
from herglotz.errors import InputError
from herglotz.models import refuse_own
from herglotz.plots import plot_bands, plot_learned, plot_sizes, plot_training, plot_trajectory
from herglotz.plots.motion import plot_prediction
from herglotz.progress import ProgressBar
from herglotz.report.html import Block, Code, Document, Picture, Section, Slider, Table, as_html, as_markdown
from herglotz.threads import one_thread
from herglotz.training import Laplace, Plan, Run, laplace, traded
from herglotz.training.evaluate import unseen_errors
from herglotz.training.quantities import quantities
from herglotz.training.recorded_range import range_in_words, warning
from herglotz.training.selection import step_cost
from herglotz.training.summary import rows as summary_rows
from herglotz.training.uncertainty import determined
from herglotz.verify import verify

MEANING = {
    "fits to the noise": "The error of free runs of the model is not larger than the noise of the data, or than a "
    "ten-thousandth of their spread, in held-out time too. Within the range of the data you can trust the model.",
    "fits, worse": "The model follows the data, but its error is larger than the noise of the data: a term is missing. "
    "Use the model where this error is acceptable.",
    "does not fit": "The model does not follow the data. Do not use the model; the sentence below says what to try.",
}
USE = """\
herglotz export {run} --out model.h --format c    # C: one header, <math.h> alone
herglotz export {run} --out model.pt2              # PyTorch alone: torch.export.load("model.pt2").module()
herglotz export {run} --out model.onnx --format onnx
herglotz verify model.h --against {run}           # the file steps as the run does

/* C */
#include "model.h"                          /* the example at its top compiles with cc -O3 */

# Python
import herglotz as hz
run = hz.load_run("{run}")
motion = run.rollout(200)                   # numpy: motion.t, motion.q, motion.v
print(run.predict("another.csv").rms)"""


@one_thread()
def write_report(run: Run, folder: str | Path, against: Trajectories | None = None, *, name: str = "RUN") -> list[Path]:
    """Write report.html and report.md into a folder.

    Parameters
    ----------
    run
        What `fit` returned.
    folder
        Where to write; made if missing.
    against
        Another recording, on which the model is scored (`Run.predict`).
    name
        The folder of the run in the commands of the report.

    Returns
    -------
    list of Path
        Both files; the HTML file loads nothing from a network.

    Raises
    ------
    InputError
        If the folder or a file cannot be written, or the columns of `against` are not those of the run.
    """
    refuse_own(run.model, "report", "run.verify(), run.summary() and run.plot() show what was reached")
    document = describe(run, against, name)
    folder = folder_at(folder)
    written = {folder / "report.html": as_html(document), folder / "report.md": as_markdown(document)}
    for path, text in written.items():
        write_atomically(path, text.encode())
    return list(written)


def describe(run: Run, against: Trajectories | None, name: str) -> Document:
    """The contents of the report."""
    verdict = str(run.metrics.get("verdict", "not judged"))
    meaning = next((words for start, words in MEANING.items() if verdict.startswith(start)), "The run has no verdict.")
    posterior = cache(lambda: _posterior(run))
    parts: dict[str, Callable[[], tuple[Block, ...]]] = {
        "The learned equation": lambda: _equation(run, posterior()),
        "Walk through the free run": lambda: (*_sliders(run),),
        "Data": lambda: _data(run),
        "Plan of the fit, with reasons": lambda: _plan(run),
        "Errors on held-out time": lambda: _errors(run),
        **({} if against is None else {"Another recording": lambda: _against(run, against)}),
        "What the data leave open": lambda: _open(run, posterior()),
        "Verification": lambda: _verification(run),
        "Speed": lambda: _speed(run),
        "How to use it": lambda: (Code(USE.format(run=name)),),
        "Where it comes from": lambda: _origin(run),
    }
    sections = []
    with ProgressBar(total=len(parts), disable=not sys.stderr.isatty(), leave=False, unit="section") as progress:
        for title, made in parts.items():
            progress.set_description(title)
            sections.append(Section(title, made()))
            progress.update()
    return Document(f"herglotz: model of {run.data.source or 'a recording'}", verdict, meaning, tuple(sections))


def _posterior(run: Run) -> Laplace | str:
    """The posterior, or the reason why no posterior exists."""
    try:
        return laplace(run)
    except InputError as error:
        return f"No standard deviations: {error}."


def _equation(run: Run, posterior: Laplace | str) -> tuple[Block, ...]:
    mass = "The first coordinate's mass is 1: positions alone do not fix the unit of force."
    blocks: list[Block] = [Code(str(run.equation())), mass]
    if isinstance(posterior, str):
        return (*blocks, posterior, Picture(plot_learned(run), "Potential and force of the model."))
    found = quantities(posterior, run)
    blocks.append(Table(("quantity", "value ± standard deviation"), tuple((x.words, str(x)) for x in found)))
    caption = "What was learned, with bands of two standard deviations; shaded is the range of the training data."
    return (*blocks, Picture(plot_learned(run, posterior), caption))


def _sliders(run: Run) -> list[Block]:
    (data, factor), trained = as_recorded(run.data.unwrapped()), max(run.train_lengths[0] - 1, 0)
    rows = slice(0, data.lengths[0])
    found: list[Block] = [
        "Grey: recorded. Blue: the model on the training part. Orange: its free run, never corrected."
    ]
    predicted = run.prediction.detach() * factor
    for i, (name, unit) in enumerate(zip(data.names, data.units, strict=True)):
        model = [x if math.isfinite(x) else None for x in predicted[rows, i].tolist()]
        values = {
            "t": data.t[rows].tolist(), "data": data.q[rows, i].tolist(), "model": model, "trained": trained,
            "name": name, "unit": "" if unit == "1" else unit, "time_unit": data.time_unit,
        }  # fmt: skip
        found.append(Slider(values, f"{name} of trajectory 0"))
    return found[:5]


def _data(run: Run) -> tuple[Block, ...]:
    data, m = run.data, run.metrics
    unit, degrees = common_unit(data.units), bool(data.degrees)
    h = data.steps().h
    precision = m.get("precision")
    rows = [
        ("recording", as_recorded(data)[0].summary()),
        ("steps", f"{span((float(h.min()), float(h.max())), data.time_unit)}, median {data.typical_step:.4g}"),
        ("precision, found in the data", "not found" if precision is None else size(precision, unit, degrees)),
        ("range that was trained on", range_in_words(run.box, data) or "not known"),
        ("gross errors left out", f"{m.get('outliers', 0)} in training, {m.get('outliers_unseen', 0)} beyond"),
        ("sha256", data.digest()),
    ]
    table = Table(("", ""), tuple(rows))
    if not data.columns:
        return (table,)
    return (table, Table(("column", "is taken for", "unit"), tuple(column_rows(data))))


def _plan(run: Run) -> tuple[Block, ...]:
    if "plan" not in run.metrics:
        return ("The run holds no plan.",)
    plan = Plan.from_dict(run.metrics["plan"])
    rows = tuple(("; ".join(taken), why) for taken, why in plan.by_reason(common_unit(run.data.units)))
    blocks: list[Block] = [Table(("decided", "because"), rows)]
    if run.metrics.get("compared"):
        blocks.append(Picture(plot_sizes(run), "What smaller and larger models miss held-out time by."))
    if run.history:
        blocks.append(Picture(plot_training(run), "The cost of every stage; each stage minimises its own."))
    return tuple(blocks)


def _errors(run: Run) -> tuple[Block, ...]:
    data = run.data
    # NaN if a trajectory has no held-out samples.
    errors = [error.square().mean(0).sqrt().tolist() for error in unseen_errors(run)]
    each = [_of_each(run, dict(zip(data.names, row, strict=True))) for row in errors]
    rows = [(data.label(b).removeprefix("trajectory "), *(value for _, value in row)) for b, row in enumerate(each)]
    table = Table(("trajectory", *(f"RMS {name}" for name in data.names)), tuple(rows[:20]))
    about = [row for row in summary_rows(run) if "RMS" in row[0]]
    return (
        Table(("", ""), tuple(about)), "Free run from the last training sample to the end, of each trajectory:", table,
        Picture(plot_trajectory(run), "Data, fit and free run; shaded is what the model never saw."),
    )  # fmt: skip


def _of_each(run: Run, errors: dict[str, float | None]) -> list[tuple[str, str]]:
    """The RMS of each coordinate as text, in the unit of the recording."""
    units, degrees = dict(zip(run.data.names, run.data.units, strict=True)), run.data.degrees
    return [
        (f"RMS {name}", "not reached" if error is None else size(error, units[name], name in degrees))
        for name, error in errors.items()
    ]


def _against(run: Run, data: Trajectories) -> tuple[Block, ...]:
    found = run.predict(data)
    rows = _of_each(run, found.metrics()["rms_per_coordinate"] or {})
    rows.append(("steps that failed", f"{100 * found.failed_steps:.3g} %"))
    left = warning(found.beyond, data.time_unit)
    rows += [("beyond the recorded range", left)] if left else []
    return (
        as_recorded(data)[0].summary(),
        Table(("", ""), tuple(rows)),
        Picture(plot_prediction(found), "Free run on the recording."),
    )


def _open(run: Run, posterior: Laplace | str) -> tuple[Block, ...]:
    if isinstance(posterior, str):
        return (posterior,)
    worth = determined(posterior.effective_parameters(), len(posterior.theta))
    blocks: list[Block] = [f"Parameters that the data determine: {worth}."]
    trades = [str(trade) for trade in traded(posterior)]
    if trades:
        blocks.append("What these data cannot tell apart (record other motions, or give one of them):")
        blocks += trades
    else:
        blocks.append("None of the physical parameters can be traded for another of them.")
    caption = "Data minus model, with the 90 % bands of the model (dark) and of a measured value (light)."
    return (*blocks, Picture(plot_bands(run, posterior.bands()), caption))


def _verification(run: Run) -> tuple[Block, ...]:
    report = verify(run)
    rows = tuple((check.statement, *check.verdict) for check in report.checks)
    text = "Identities hold for every discrete contact Lagrangian: they prove the stepper. The last rows judge the fit."
    return (
        f"{'Verified' if report.passed else 'NOT verified'}. {text}",
        Table(("claim", "measured", "bound", ""), rows),
    )


def _speed(run: Run) -> tuple[Block, ...]:
    text = "For a control loop or many runs, step it in C: export it, or hz.compile(run.stepper)."
    return (f"One step of one trajectory in PyTorch takes {step_cost(run):.0f} µs of processor time here. {text}",)


def _origin(run: Run) -> tuple[Block, ...]:
    versions = run.metrics.get("versions", {})
    rows: list[tuple[str, str]] = [(name, str(value)) for name, value in versions.items()]
    settings: dict[str, Any] = run.config.to_dict()
    default = type(run.config)().to_dict()
    changed = ", ".join(f"{k}={v}" for k, v in settings.items() if v != default[k]) or "all by default"
    return (Table(("", ""), (*rows, ("settings", changed), ("seed", str(run.config.seed)))),)
