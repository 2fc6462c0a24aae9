"""`herglotz predict`: score a trained model on another recording."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.choices import WARMUP
from herglotz.cli.common import (
    check_output_file,
    count,
    existing,
    flag,
    import_torch,
    positive,
    print_json,
    print_table,
    say,
)
from herglotz.cli.flags import FORCE, READING, columns_of
from herglotz.errors import InputError

if TYPE_CHECKING:
    from herglotz.training import Run
    from herglotz.training.predict import Prediction

DESCRIPTION = """\
Score a trained model on a recording it has not seen: another start, other steps, its own inputs. The state is
estimated from the first K samples of each trajectory, the model held; from there the model runs on alone, driven by
the inputs recorded beside the positions. Printed: the RMS error of each coordinate; the same from the best start, which
is fitted to the whole recording: what no other start makes smaller; and the share of the samples that the free run did
not reach because a step failed.

A recorded step that is longer than those the model was fitted to is crossed in equal model steps. A recording that is
sampled faster is thinned, its inputs averaged: K counts the samples that are left. A note says where the free run
leaves the range of positions and momenta that the model was fitted to: which, how far, since when.

--out FILE writes the predicted positions and velocities (and momenta with --momenta), and FILE.png beside it: data,
free run and their difference.
Where the recordings of the fit differ in what their sensors read at 0, those zeros that suit the first samples best
are taken off this recording, and so are drifts of the zeros that the fit found; --sensor-zeros says zeros instead,
beside the model's own, that do not drift. With --windows W --horizon T, W windows spread over the recording are
scored instead, each K samples and then a free run over the time T: for motions that no model follows for long.

examples:
  herglotz predict runs/pendulum another.csv
  herglotz predict runs/motor night_shift.csv --warmup 50 --out predicted.csv
  herglotz predict runs/double_pendulum long.csv --windows 20 --horizon 0.5 --json
"""


HELP = "score a run on another recording"
FLAGS = (
    flag("source", "folder that `herglotz fit` or `select` wrote", metavar="RUN", type=Path),
    flag("data", "recording of the same coordinates, in the same units", metavar="DATA", type=existing),
    flag("--warmup", f"samples that the state is estimated from, at least 3 (default {WARMUP}, or half of the shortest "
         "recording if that is shorter)", type=count, metavar="K"),
    flag("--windows", "score W windows (with --horizon)", type=count, metavar="W"),
    flag("--horizon", "time of the free run in a window, in the data's unit of time", type=positive, metavar="T"),
    flag("--out", "write the predicted motion: .csv or .npz, and a .png", type=Path, metavar="FILE"),
    flag("--momenta", "write the momenta besides", action="store_true"),
    FORCE,
    flag("--json", "print the numbers as JSON, and nothing else", action="store_true"),
    *READING,
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Predict, write, draw, report."""
    out: Path | None = arguments.out
    if out is not None:
        check_output_file(out, (".csv", ".npz"), arguments.force)
    import_torch()

    from herglotz.training import load_run
    from herglotz.training.fitted_run import as_recorded
    from herglotz.training.predict import longer_warmup, missed_from_best_start

    result = load_run(arguments.source)
    data = as_recorded(result, arguments.data, **columns_of(arguments))
    _tell_of_names(data.names, result.data.names)
    if data.input_labels and not result.model.inputs:
        names = ", ".join(name for name, _ in data.input_labels)
        say(f"herglotz: note: the run has no input: {names} left aside", sys.stderr)
    if data.time_unit != result.data.time_unit:
        raise InputError(
            f"{arguments.data}: time is in {data.time_unit}, the run was fitted in {result.data.time_unit}; convert it"
        )
    found = result.predict(
        data, warmup=arguments.warmup, windows=arguments.windows, horizon=arguments.horizon,
        same_zeros=arguments.sensor_zeros is not None,
    )  # fmt: skip
    written = [] if out is None else _write(found, out, arguments.momenta)
    best = None if arguments.windows else missed_from_best_start(result, found.data)
    if arguments.json:
        named = None if best is None else dict(zip(found.data.names, best, strict=True))
        print_json({**found.metrics(), "rms_from_best_start": named})
    else:
        _report(found, arguments, best)
        if written:
            print(f"Written: {', '.join(map(str, written))}")
    _tell_of_limits(found, result, drifting=arguments.sensor_zeros is None)
    if best is not None and (count := longer_warmup(found, best)) is not None:
        why = f"the start that {found.warmup} samples tell misses, and not the model"
        say(f"herglotz: note: {why}; try --warmup {count}", sys.stderr)
    return 0


def _tell_of_names(names: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Say on stderr which coordinates of a recording the run does not have."""
    others = [name for name in names if name not in known]
    if len(names) == len(known) == 1 and others:
        say(f"herglotz: note: {names[0]} is taken for {known[0]}, the run's only coordinate", sys.stderr)
    elif others:
        say(f"herglotz: note: the run has no coordinate {', '.join(others)}: left aside", sys.stderr)


def _tell_of_limits(found: Prediction, result: Run, *, drifting: bool) -> None:
    """Say on stderr what the errors assume or leave out."""
    from herglotz.training.recorded_range import warning

    if drifting and (drifts := (result.metrics.get("plan") or {}).get("drifts")):
        names, time = zip(found.data.names, found.data.units, strict=True), found.data.time_unit
        rates = ", ".join(f"{name} {x:.4g} {unit}/{time}" for (name, unit), x in zip(names, drifts, strict=True))
        still = f"with --sensor-zeros {' '.join('0' * len(drifts))} they stand still"
        say(f"herglotz: note: its sensors are taken to drift as those of the fit did: {rates}; {still}", sys.stderr)
    if found.failed_steps > 0:
        share = f"{100 * found.failed_steps:.3g} % of the predicted samples were not reached: a step failed"
        say(f"herglotz: note: {share}; the RMS is over the others", sys.stderr)
    if found.beyond:
        say(f"herglotz: note: {warning(found.beyond, found.data.time_unit)}", sys.stderr)


def _report(found: Prediction, arguments: argparse.Namespace, best: tuple[float, ...] | None) -> None:
    from herglotz.data.units import size

    numbers = found.metrics()
    what = "window" if arguments.windows else "trajectory" if len(found.data) == 1 else "trajectories"
    say(
        f"{arguments.source} on {arguments.data}: {len(found.data)} {what}{'s' if arguments.windows else ''}, state "
        f"from {found.warmup} samples of each, {numbers['predicted_samples']} samples predicted"
    )
    each = numbers["rms_per_coordinate"] or dict.fromkeys(found.data.names)
    degrees = found.data.degrees
    rows = [
        (f"RMS {name}", "not reached" if (error := each[name]) is None else size(error, unit, name in degrees, 4))
        for name, unit in zip(found.data.names, found.data.units, strict=True)
    ]
    if best is not None:
        every = zip(best, found.data.names, found.data.units, strict=True)
        rows.append(("from best start", ", ".join(size(x, unit, name in degrees, 4) for x, name, unit in every)))
    rows.append(("failed steps", f"{100 * found.failed_steps:.3g} %"))
    if found.zeros:
        zeros = zip(found.data.names, found.zeros, found.data.units, strict=True)
        rows.append(("sensors at 0", ", ".join(f"{name} {size(x, unit, name in degrees)}" for name, x, unit in zeros)))
    for name, turns in zip(found.data.names, zip(*found.turns, strict=True), strict=False):
        if any(turns):
            rows.append(("whole turns", f"{name} {', '.join(f'{k:+d}' for k in turns)}, added as the warm-up asks"))
    rows += [("steps", steps)] if (steps := _steps(found)) else []
    print_table(rows)


def _steps(found: Prediction) -> str:
    """How recorded steps were crossed, and whether they are those of the training data; empty if one by one."""
    said = f"at most {found.most_substeps} model steps in a recorded step" if found.most_substeps > 1 else ""
    if found.every > 1:
        said = f"every {found.every} samples of the recording are one step"
    outside = f"{100 * found.outside:.3g} % are outside of the steps of the training data" if found.outside > 0 else ""
    return "; ".join(filter(None, (said, outside)))


def _write(found: Prediction, out: Path, momenta: bool) -> list[Path]:
    """Write the predicted motion as far as no step failed, and the figure; return the files."""
    from herglotz.data import save
    from herglotz.data.units import in_degrees
    from herglotz.plots import save_figure
    from herglotz.plots.motion import plot_prediction

    motion: Any = found.motion()
    if motion is not None and not momenta:
        motion = replace(motion, p=None)
    written = [] if motion is None else [out]
    if motion is not None:
        save(out, in_degrees(motion, found.data.degrees) if out.suffix.lower() == ".csv" else motion)
    picture = out.with_suffix(".png")
    save_figure(plot_prediction(found), picture)
    return [*written, picture]
