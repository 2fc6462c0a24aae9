"""`herglotz rollout`: step a model and write the motion."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.cli.common import (
    check_output_file,
    count,
    existing,
    finite,
    flag,
    import_torch,
    positive,
    print_json,
    say,
)
from herglotz.cli.flags import FORCE, TRUST
from herglotz.errors import InputError, check_start
from herglotz.formats import endings

if TYPE_CHECKING:
    import torch

    from herglotz.data import Trajectories
    from herglotz.data.holds import Arrival
    from herglotz.export import ExportedStepper
    from herglotz.export.step import Box
    from herglotz.stepping import Rollout, State, Stepper
    from herglotz.training.recorded_range import Beyond

DESCRIPTION = """\
Step a model K times and write t, positions and velocities as .csv or .npz; with --momenta also the action s and the
momenta p, of which the first mass is 1. It starts from the last state that the fit trained on, or from --q0 and --v0.

examples:
  herglotz rollout runs/pendulum --steps 200 --out future.csv
  herglotz rollout runs/driven --steps 200 --inputs torque.csv --out motion.csv
  herglotz rollout runs/pendulum --steps 200 --h 0.05 --q0 1.2 --v0 -0.5 --out motion.csv
"""


@dataclass(frozen=True)
class Source:
    """A model that can be stepped, with the start, the labels and the box that its run or file holds.

    limits, h_range
        Lowest and highest q, p, s, and steps, of the fit; empty and None if they are not known. `box` is a function
        of states that says which leave the limits.
    arrival
        Delay and lag of the inputs of the fit.
    degrees
        Names of the coordinates that were recorded in degrees.
    columns
        Name, role and unit of each column of the fit's table.
    frequencies
        Angular frequencies of the periodic inputs of the model.
    """

    stepper: Stepper | ExportedStepper
    start: State | None
    t0: float
    h: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[bool, ...]
    time_unit: str
    limits: Mapping[str, Sequence[float]]
    box: Box | None
    h_range: tuple[float, float] | None
    arrival: Arrival
    inputs: int
    degrees: tuple[str, ...]
    columns: Sequence[Sequence[str]]
    frequencies: tuple[float, ...] = ()


HELP = "step a model and write the motion"
FLAGS = (
    flag("source", f"folder of a run, or an exported model: {', '.join(endings())}",
         metavar="RUN|FILE", type=Path),
    flag("--steps", "number of steps, at least 2", required=True, type=count, metavar="K"),
    flag("--out", "file to write: .csv or .npz", required=True, type=Path, metavar="FILE"),
    flag("--h", "step, in the data's unit of time (default: the model's)", type=positive),
    flag("--q0", "initial position, one number a coordinate", type=finite, nargs="+"),
    flag("--v0", "initial velocity, one number a coordinate (with --q0), in the model's units: rad for degrees",
         type=finite, nargs="+"),
    flag("--p0", "initial momentum, one number a coordinate, in the place of --v0", type=finite, nargs="+"),
    flag("--s0", "initial action (default 0 with --q0, else the fitted one)", type=finite),
    flag("--trajectory", "trajectory of the run whose last fitted state to start from, counted from 0 (default "
         "%(default)s)", type=count, default=0, metavar="B"),
    flag("--u", "constant input of a driven model, one number an input (default: no input acts)",
         type=finite, nargs="+", metavar="U"),
    flag("--inputs", "times and inputs (positions may stand beside them) that drive the model, each at its own time: K "
         "samples from the start's time on (with --q0: from the first), at their own steps unless --h",
         type=existing, metavar="FILE"),
    flag("--momenta", "write the action s and the momenta p besides", action="store_true"),
    flag("--t0", "time of the start (default: of the fitted state; 0 with --q0)", type=finite, metavar="T"),
    FORCE,
    TRUST,
    flag("--json", "print a summary as JSON", action="store_true"),
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Read the model, step the model, write the motion."""
    check_output_file(arguments.out, (".csv", ".npz"), arguments.force)
    if arguments.steps < 2:
        raise InputError(f"--steps must be at least 2, got {arguments.steps}")
    check_start(*(x is not None for x in (arguments.q0, arguments.v0, arguments.p0)), dash="--")
    import_torch()

    import torch

    from herglotz.data import save
    from herglotz.data.units import in_degrees
    from herglotz.training.recorded_range import quantities_outside

    source = read_source(arguments.source, arguments.trajectory, arguments.trust_code)
    start, t0 = _start(arguments, source)
    u, times = _driven(arguments, source, t0)
    h = times.diff().to(start.q.dtype) if arguments.inputs else (arguments.h or source.h)
    began = time.perf_counter()
    with torch.no_grad():
        inputs = None if u is None else u.to(start.q.dtype)
        found = source.stepper.rollout(*start, h=h, steps=arguments.steps, inputs=inputs)
    seconds = time.perf_counter() - began
    _check(found, float(times.diff().mean()))
    motion = _motion(source, found, times, arguments)
    out: Path = arguments.out
    save(out, in_degrees(motion, source.degrees) if out.suffix.lower() == ".csv" else motion)
    outside = None if source.box is None else source.box(found.q, found.p, found.s)
    left = None if outside is None or not bool(outside.any()) else int(outside.nonzero()[0])
    far = quantities_outside(source.limits, motion, motion.t, motion.q, found.p.double())
    if arguments.json:
        left_by = {"beyond": [asdict(each) for each in far]}
        print_json(_numbers(motion, found, seconds, left) | left_by | {"file": str(out)})
    else:
        _report(source, found, times, f"{out}: {arguments.steps} steps")
    _warn(source, times, left, far, "" if arguments.h else f"; --h {source.h:g} takes the model's own")
    if source.inputs and u is None:
        _note("the model is driven: without --inputs FILE or --u all of its inputs are 0")
    return 0


def _motion(source: Source, found: Rollout, times: torch.Tensor, arguments: argparse.Namespace) -> Trajectories:
    from herglotz.data import Trajectories

    s, p = (x.double() if arguments.momenta else None for x in (found.s, found.p))
    return Trajectories.of(
        times, found.q.double(), names=source.names, units=source.units, angles=source.angles, s=s, p=p,
        v=_velocity(source, found, times), time_unit=source.time_unit, source=str(arguments.source),
        columns=tuple((name, "coordinate", "deg") for name in source.degrees),
    )  # fmt: skip


def _velocity(source: Source, found: Rollout, times: torch.Tensor) -> torch.Tensor | None:
    """The velocities (K + 1, n); None, with a note on stderr, if the file or the model has none."""
    import torch

    from herglotz.stepping import StepError

    # The velocity of a state is that of the step that made the state.
    h = times.diff().to(found.q.dtype)
    try:
        with torch.no_grad():
            return source.stepper.velocity(found.states, torch.cat([h[:1], h])).double()
    except (InputError, StepError) as error:
        return _note(f"no velocities are written: {error}")


def _numbers(motion: Trajectories, found: Rollout, seconds: float, left: int | None) -> dict[str, Any]:
    last, times, v = found.final, motion.t, motion.v
    return {
        "steps": len(times) - 1,
        "t0": float(times[0]),
        "h": float(times.diff().mean()),
        "seconds": seconds,
        "largest_residual": float(found.residual.max()),
        "outside_from_step": left,
        "final": {
            "q": last.q.tolist(),
            "v": None if v is None else v[-1].tolist(),
            "p": last.p.tolist(),
            "s": float(last.s),
            "sigma": float(found.sigma[-1]),
        },
    }


def _report(source: Source, found: Rollout, times: torch.Tensor, what: str) -> None:
    from herglotz.data.units import size

    each = zip(source.names, source.units, found.final.q.tolist(), strict=True)
    end = ", ".join(f"{name} = {size(x, unit, name in source.degrees, 6)}" for name, unit, x in each)
    h = float(times.diff().mean())
    say(f"{what} of {h:g} {source.time_unit}; at t = {float(times[-1]):g}: {end}")


def _warn(source: Source, times: torch.Tensor, left: int | None, far: Sequence[Beyond], remedy: str = "") -> None:
    """Say on stderr where the motion leaves the range of the fit, and whether its steps do, with a remedy."""
    from herglotz.training.recorded_range import other_steps

    # `far` leaves out a motion that is only just beyond the limits of q and p.
    if left is not None and source.box is not None and (far or source.box.by_s):
        states = "(q, p, s)" if source.box.by_s else "(q, p)"
        each = "".join(f"; {one.words(source.time_unit)}" for one in far)
        _note(f"from step {left} on, the motion leaves the range of states {states} that the model was fitted to{each}")
    if words := other_steps(times, source.h_range or (0.0, math.inf), source.time_unit):
        _note(words + remedy)


def _note(text: str) -> None:
    say(f"herglotz: note: {text}", sys.stderr)


def read_source(path: Path, trajectory: int, trust_code: bool = False) -> Source:
    """Read a run or an exported model.

    Raise InputError if the file cannot be read, or the run has no such trajectory.
    """
    import torch

    from herglotz.export.step import Box, s_matters
    from herglotz.stepping import State

    if path.is_dir() or path.suffix.lower() not in endings():
        from herglotz.training import load_run

        fitted = load_run(path)
        model, data = fitted.model, fitted.data
        return Source(
            fitted.stepper, *fitted.last_fitted(trajectory), fitted.h, data.names, data.units, data.angles,
            data.time_unit, fitted.box, Box.of(fitted.box, model), fitted.h_range, fitted.arrival, model.inputs,
            data.degrees, data.columns, fitted.config.frequencies,
        )  # fmt: skip

    from herglotz.data.checks import unnamed
    from herglotz.data.holds import Arrival
    from herglotz.export import load_exported

    stepper = load_exported(path, trust_code=trust_code)
    m, n = stepper.metadata, stepper.dof
    stored = m.get("start")
    start = stored and State(*(torch.tensor(stored[name], dtype=stepper.dtype) for name in "qps"))
    names = tuple(m.get("names") or unnamed(n))
    angles = tuple(m.get("angles") or [False] * n)
    units = tuple(m.get("units") or ["rad" if angle else "1" for angle in angles])
    box = None if m["box"] is None else Box(m["box"], angles, stepper.dtype, by_s=s_matters(m))
    # Steps outside of h_range give a note, as for a run; the stepper itself would refuse them.
    h_range, stepper.metadata["h_range"] = m.get("h_range"), None
    t0 = (stored or {}).get("t", 0.0)
    return Source(
        stepper, start, t0, stepper.h, names, units, angles, m.get("time_unit", "s"), m["box"] or {}, box, h_range,
        Arrival(**m.get("arrival", {})), stepper.inputs, tuple(m.get("degrees", ())), m.get("columns", ()),
    )  # fmt: skip


def _start(arguments: argparse.Namespace, source: Source) -> tuple[State, float]:
    """Return the state to start from, in the model's dtype, and its time."""
    import torch

    from herglotz.stepping import State

    like, n = source.start, len(source.names)
    if arguments.q0 is None:
        if like is None:
            raise InputError(f"{arguments.source}: records no state to start from; give --q0 and --v0")
        s = like.s if arguments.s0 is None else torch.full_like(like.s, arguments.s0)
        return State(like.q, like.p, s), source.t0 if arguments.t0 is None else arguments.t0
    second = "v0" if arguments.p0 is None else "p0"
    for name in ("q0", second):
        given = getattr(arguments, name)
        if len(given) != n:
            raise InputError(f"--{name} needs {n} number(s), one a coordinate ({', '.join(source.names)}), got {given}")
    dtype = getattr(source.stepper, "dtype", None) or (torch.float64 if like is None else like.q.dtype)
    values = (arguments.q0, getattr(arguments, second), arguments.s0 or 0.0)
    state = State(*(torch.tensor(x, dtype=dtype) for x in values))
    if second == "v0":
        state = source.stepper.init_qv(*state, arguments.h or source.h)
    return state, arguments.t0 or 0.0


def _driven(arguments: argparse.Namespace, source: Source, t0: float) -> tuple[torch.Tensor | None, torch.Tensor]:
    """Return the inputs (K, m), None without inputs, and the times (K + 1,)."""
    import torch

    from herglotz.data.driving import driven, even_times, input_recording
    from herglotz.data.input_terms import waves

    steps, path = arguments.steps, arguments.inputs
    if path is None:
        times = even_times(t0, arguments.h or source.h, steps)
        if arguments.u is not None and len(arguments.u) != source.inputs:
            raise InputError(f"--u needs {source.inputs or 'no'} number(s), one an input, got {len(arguments.u)}")
        if arguments.u is None:
            middle = 0.5 * (times[1:] + times[:-1])
            return waves(middle, source.frequencies) if source.frequencies else None, times
        return torch.tensor(arguments.u, dtype=torch.float64).expand(steps, -1), times
    if arguments.u is not None:
        raise InputError("--u and --inputs both give the inputs; leave one out")
    found = input_recording(path, arguments.trajectory, source.time_unit, source.arrival, source.columns)
    if arguments.q0 is not None and arguments.t0 is None:
        t0 = float(found.t[0])
    return driven(found, t0, steps, arguments.h)


def _check(found: Rollout, h: float) -> None:
    """Raise InputError if a step failed: a motion that ends early is not written."""
    if not bool(found.ok):
        k = int((found.status != 0).nonzero()[0])
        raise InputError(f"step {k + 1} of h = {h:g} has no solution; take a smaller --h or another start")
