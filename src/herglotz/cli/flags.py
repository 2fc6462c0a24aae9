"""Flags that several commands share, and functions that read them; settings of a fit among them.

A flag of a setting that is not given leaves the setting to --config, or to `FitConfig`.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from herglotz.choices import DTYPES, HOLDS, LEVELS, OBJECTIVES, OPTIMISERS, ROBUST, SUPERVISION
from herglotz.cli.common import Flag, check_output_folder, count, existing, finite, flag, positive, say, seed
from herglotz.errors import InputError

if TYPE_CHECKING:
    from herglotz.data import Trajectories
    from herglotz.training import FitConfig


def settings_of(arguments: argparse.Namespace) -> FitConfig:
    """The settings of --config, or the defaults, replaced by the flags that are given.

    Raise InputError if the file is no `config.json` of a run, or a setting is wrong.
    """
    from herglotz.training import FitConfig

    config = FitConfig() if arguments.config is None else _read(arguments.config)[0]
    names = {field.name for field in fields(FitConfig)}
    given = {name: x for name, x in vars(arguments).items() if name in names}
    return config.changed(given)


def data_of(arguments: argparse.Namespace, columns: dict[str, Any]) -> tuple[Trajectories, dict[str, Any]]:
    """The recording, and how it was read: as --config read its data, replaced by the flags that are given.

    Raise InputError if the file is no `config.json` of a run, or the recording cannot be read that way.
    """
    from herglotz.data import load

    before = {} if arguments.config is None else _read(arguments.config)[1]
    given = {name: x for name in ("hold", "every") if (x := getattr(arguments, name, None)) is not None}
    reading = before | columns | given
    if before:
        kept = ", ".join(f"{name} {_in_words(x)}" for name, x in before.items() if reading[name] is x)
        say(f"herglotz: note: read as {arguments.config} says: {kept or 'nothing, flags stand over it'}", sys.stderr)
    data = load(arguments.data, **{name: x for name, x in reading.items() if name != "every"})
    every = reading.get("every", 1)
    if every != 1 and (count := int((~data.complete).sum())):
        say(f"herglotz: note: --every counts complete samples: {count} that miss a position are left out", sys.stderr)
    # Each sample may be asked for where some miss a position, which has no weight in a fit.
    return data if every == 1 else data.thinned(every), reading


def _in_words(value: Any) -> str:
    return (",".join(map(str, value)) or "none") if isinstance(value, list) else str(value)


def _read(path: Path) -> tuple[FitConfig, dict[str, Any]]:
    """The settings in the config.json of a run, and how the data of that run were read."""
    from herglotz.data.files import read_bytes
    from herglotz.training import FitConfig
    from herglotz.training.run_folder import reading_in

    file = path / "config.json" if path.is_dir() else path
    content = read_bytes(file)
    try:
        values: Any = json.loads(content)
        reading = reading_in(values, "config.json")
        return FitConfig.from_dict({**values, "device": "cpu"}), reading
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        line = " ".join(str(error).split())[:200]
        raise InputError(f"--config {file}: {line}; give the config.json of a run, or the run's folder") from None


def _duration(text: str) -> float | None:
    """None for auto, 0 for none, or a time that is not negative (argparse type)."""
    known = {"auto": None, "none": 0.0}
    if text in known:
        return known[text]
    if (value := finite(text)) < 0:
        raise argparse.ArgumentTypeError(f"must be a time >= 0, none or auto, got {text}")
    return value


def setting(name: str, text: str, *, field: str | None = None, **options: Any) -> Flag:
    """A flag for one field of `FitConfig`; the namespace has no such name if the flag is not given."""
    dest = field or name.removeprefix("--").replace("-", "_")
    return flag(name, text, dest=dest, default=argparse.SUPPRESS, **options)


# Settings of another run, and the part of the data to train on.
DATA = (
    flag("--config", "settings that another run was told, and how its data were read: its folder or its config.json; "
         "flags that are given stand over them. On the same data it is the same fit", type=existing, metavar="FILE"),
    setting("--train-fraction", "part of every trajectory, in time, to train on, 0 < F <= 1 (default 0.667)",
            type=finite, metavar="F"),
)  # fmt: skip
# Seed, device, precision and output.
MACHINE = (
    setting("--seed", "seed of the initial weights (default 0)", type=seed),
    setting("--device", "cpu or cuda (default cpu)", metavar="D"),
    setting("--dtype", "precision (default float64)", choices=DTYPES),
    flag("--json", "print the numbers as JSON, and nothing else", action="store_true"),
)  # fmt: skip
# Terms of the model.
MODEL = (
    "model",
    setting("--level", "auto: forced with dry friction where inputs u are recorded, else linear; for two or three "
            "joints what the data show. conservative: no damping. linear: one damping rate. affine: damping depends on "
            "position and velocity. full: on s as well. forced: one rate, and friction of each joint (default auto)",
            choices=("auto", *LEVELS)),
    setting("--order", "of the rule; 4: from the features alone, without networks (default 2)",
            type=int, choices=(2, 4)),
    setting("--sticking", "dry friction that can hold a joint still (forced); default: where driven data show it",
            action=argparse.BooleanOptionalAction),
    setting("--term", "a term of herglotz.models.TERMS; may be repeated",
            field="terms", action="append", metavar="NAME"),
    setting("--coupled", "friction of differences of speeds: hinges (forced)", action="store_true"),
    setting("--drag", "a force beside viscous friction, its coefficient learned: '|v1| v1', 'q1^2 v1', '(v1 - v2)' of "
            "a damper between two, '|v| v' of air, a constant one, 'load 1', dry friction by position, 'q1^2 sgn(v1)', "
            "'cos(q1) sgn(v1)', an input by position, 'u1 cos(q1)', or one that brakes, 'u1^2 v1' (forced); may be "
            "given again",
            action="append", metavar="TEXT"),
    setting("--dissipation", "a power of s in L beside -gamma s, its coefficient learned: 's^2' or 's^3' (full, "
            "forced); may be given again", action="append", metavar="POWER"),
    setting("--diagonal", "a mass for each coordinate, none between two: bodies", action="store_true"),
    setting("--absent", "a number of the model that is 0 and not learned, 'potential.tilt[0]'; may be given again",
            action="append", metavar="NUMBER"),
    setting("--alike", "one mass for all, a potential of features alone: chains", action="store_true"),
)  # fmt: skip
# The objective; samples, steps and iterations; the prior.
OPTIMISER = (
    "objective and optimiser",
    setting("--objective", "residual: one-step error, for exact data. trajectory: whole trajectories, for noisy data. "
            "smoothing: every state, and a little noise in every step, for pushes and chaos. auto: trajectory where "
            "named terms follow the data, else the first or the second, by the noise. raw: a plain network on |R|, "
            "which collapses, for demonstration (default auto)",
            choices=OBJECTIVES),
    setting("--optimiser", "lm: Levenberg–Marquardt. adam, adamw: for residual and raw only (default lm)",
            choices=OPTIMISERS),
    setting("--batch", "triples of samples in a step of adam or adamw (default: all)", type=count, metavar="B"),
    setting("--robust", "a loss that outliers cannot pull, and spikes left out. auto: where the data show outliers "
            "(default auto)", choices=ROBUST),
    setting("--find-zeros", "look for zeros of the sensors that differ between recordings, kept where held-out blocks "
            "of time ask for them, or do not (default: where the named terms that were found miss several recordings "
            "by more than the noise)", action=argparse.BooleanOptionalAction),
    setting("--find-input-terms", "try squares, sizes, rates and saturations of inputs where the named terms miss the "
            "data by more than the noise, or do not (default: tried)", action=argparse.BooleanOptionalAction),
    setting("--supervision", "what the one-step objective is fitted to: positions, s beside them, or momenta as well, "
            "where they are recorded (default q)", choices=SUPERVISION),
    setting("--restarts", "random initialisations of the one-step fit; the best after 30 iterations is kept (default: "
            "4 for a correction of one layer, else 1)", type=count, metavar="R"),
    setting("--substeps", "model steps in a recorded step, for samples far apart; with --objective trajectory (default "
            "1)", type=count, metavar="M"),
    flag("--every", "use every M-th sample only; inputs are averaged over the steps (default 1)",
         type=count, metavar="M"),
    setting("--iterations", "bound on the iterations of the one-step objectives (default 400)",
            type=count, metavar="K"),
    setting("--departures", "prior strengths on the networks that held-out blocks choose from; one fixes it (default: "
            "2e-4 to 6e-3)", type=positive, nargs="+", metavar="TAU"),
)  # fmt: skip
DURATION_HELP = (
    "in the data's unit; none, or auto, as without this flag: what the file says or else what explains the data best"
)
# Knowledge of the system.
EXPERT = (
    "what is known (expert)",
    setting("--feature", "what L = K - V may hold beside its terms, its coefficient learned: 'cos(q1 - q2) v1 v2' (of "
            "K), 'cos(2q1)' or '|q1| q1' (of V), or a list by name (chain, sites, central, pendulums, harmonics, "
            "revolute, lengths); may be given again", field="features", action="append", metavar="TEXT"),
    setting("--known", "what is known of L = K - V, with its numbers (the first mass is 1): --known='-9.81 cos(q1)' is "
            "a pendulum's V: no velocity is in it. May be given again", action="append", metavar="TEXT"),
    setting("--frequency", "angular frequency, in rad per unit of time, of a periodic force whose amplitude and phase "
            "are learned; for a recording without inputs. May be given again",
            field="frequencies", type=positive, action="append", metavar="NU"),
    setting("--translation", "a symmetry that the model is to have, named by what moves together: 'q1 + q2 + q3', or "
            "'q1' alone; what herglotz verify RUN --symmetries finds. May be given again",
            field="translations", action="append", metavar="TEXT"),
    setting("--ignore-inputs", "fit as if no input u were recorded", field="use_inputs", action="store_false"),
    setting("--input-map", "the map from inputs to forces, row by row, where it is known (default: learned); the first "
            "mass is 1", type=finite, nargs="+", metavar="G"),
    flag("--hold", "what the inputs do between samples: nothing, straight lines or polynomials (default: what the file "
         "says, or what explains the data best)", choices=HOLDS),
    setting("--input-delay", f"time by which inputs act later, {DURATION_HELP}", type=_duration, metavar="T"),
    setting("--actuator-lag", f"time constant of the actuator, {DURATION_HELP}", type=_duration, metavar="T"),
)  # fmt: skip


# Values of `progress` of `herglotz.training.fit`.
Progress = Literal[False, "lines", "iterations"] | None


def names(text: str) -> list[str]:
    """Return [] for `none`, and [a, b] for `a,b` (argparse type)."""
    return [] if text.strip().lower() == "none" else [name.strip() for name in text.split(",") if name.strip()]


# How a file is read: roles of columns, angles, and zeros and scales of sensors.
EACH = "a number for each coordinate, or for each of every recording: positions are scale * (reading - zero)"
READING = (
    "how DATA is read (default: by the names of its columns, printed as a table)",
    flag("--time", "column of the time", metavar="NAME"),
    flag("--coordinates", "exactly these, with commas", type=names, metavar="NAMES"),
    flag("--inputs", "forces, torques, ...: exactly these, or none", type=names, metavar="NAMES"),
    flag("--drop", "columns to leave aside", type=names, metavar="NAMES"),
    flag("--group", "column that numbers the trajectories (default: by its name, or by its values where time starts "
         "anew)", metavar="NAME"),
    flag("--angles", "coordinates that are angles in radians, with commas, or none (default: those with the unit rad "
         "or deg)", type=names, metavar="NAMES"),
    flag("--degrees", "coordinates in degrees whose header does not say so, or none (default: with a warning, those "
         "without a unit whose name is that of an angle and whose motion cannot be one in rad)",
         type=names, metavar="NAMES"),
    flag("--polar", "positions of a body on a circle that become one angle: x,y (centre and radius by least squares), "
         "x,y,X,Y with the centre in numbers or columns, x,y,X,Y,r keeps the distance r; x,-y where y grows "
         "downwards, -Y of the centre's column too; again for the next body of a chain; none to leave positions "
         "as they are",
         action="append", metavar="X,Y"),
    flag("--input-terms", "terms of inputs that act beside them, with commas: V^2, |V| V, |V|, V', sat(V/2) or "
         "tanh(V/2) of an input V, 2 being the level at which it saturates (default: those that the data ask for)",
         type=names, metavar="TERMS"),
    flag("--sensor-zeros", f"what the sensors read where the coordinates are 0, {EACH}",
         type=finite, nargs="+", metavar="X"),
    flag("--sensor-scales", f"what one unit of each reading is worth, {EACH}", type=finite, nargs="+", metavar="X"),
)  # fmt: skip
PROGRESS = (
    flag("--quiet", "no progress: neither a bar nor lines", action="store_true"),
    flag("--verbose", "a line for every iteration, with its cost", action="store_true"),
)
FORCE = flag("--force", "overwrite the file that --out names", action="store_true")
TRUST = flag("--trust-code", "open a .pt2 or .h file that was not written by this user on this machine: that runs the "
             "code in it", action="store_true")  # fmt: skip
# Flags of the commands that fit.
RUN = (
    flag("data", "file with time and positions, or a folder of them", metavar="DATA", type=existing),
    flag("--out", "folder for the result; made if missing", required=True, type=Path, metavar="RUN"),
    flag("--resume", "go on after an interruption, with the same flags", action="store_true"),
    *DATA,
)


def columns_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `load` that the flags of `READING` give."""
    names = [one[0][0].removeprefix("--").replace("-", "_") for one in READING if not isinstance(one, str)]
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def progress(arguments: argparse.Namespace) -> Progress:
    """None for a bar (at a terminal), "lines" for a line a stage, "iterations" for --verbose, False for --quiet."""
    if arguments.quiet:
        return False
    return "iterations" if arguments.verbose else None if sys.stderr.isatty() else "lines"


def check_run_folder(out: Path, resume: bool) -> None:
    """Raise InputError unless a run can be written to this folder without losing an earlier fit."""
    check_output_folder(out)
    if (out / "model.pt").exists() and not resume:
        raise InputError(f"--out {out}: already holds a run; choose another folder, delete it, or add --resume")
    if (out / "checkpoint.pt").exists() and not resume:
        raise InputError(f"--out {out}: holds a fit that was interrupted; add --resume to go on, or delete the folder")
