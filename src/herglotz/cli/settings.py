"""The flags that are settings of a fit; a flag that is not given leaves the setting to --config, or to `FitConfig`."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.cli.common import count, existing, finite, positive, say, seed
from herglotz.errors import InputError

if TYPE_CHECKING:
    from herglotz.data import Trajectories
    from herglotz.training import FitConfig

# Copies, so that help does not import PyTorch; a test compares them.
SUPERVISION = ("q", "qs", "qps")
ROBUST = ("auto", "on", "off")
HOLDS = ("zero", "first", "smooth")
LEVELS = ("conservative", "linear", "affine", "full", "forced")
OBJECTIVES = ("auto", "residual", "trajectory", "smoothing", "raw")
OPTIMISERS = ("lm", "adam", "adamw")
DTYPES = ("float64", "float32")


def settings_of(arguments: argparse.Namespace) -> FitConfig:
    """The settings: those of --config, or the defaults, with the flags that were given over them.

    Raises
    ------
    InputError
        If the file is no `config.json` of a run, or a setting is wrong.
    """
    from herglotz.training import FitConfig

    config = FitConfig() if arguments.config is None else _read(arguments.config)[0]
    names = {field.name for field in fields(FitConfig)}
    given = {name: x for name, x in vars(arguments).items() if name in names}
    return config.changed({name: tuple(x) if isinstance(x, list) else x for name, x in given.items()})


def data_of(arguments: argparse.Namespace, columns: dict[str, Any]) -> tuple[Trajectories, dict[str, Any]]:
    """The recording and how it was read: as --config says of its own data, with the flags that were given over it.

    Raises
    ------
    InputError
        If the file is no `config.json` of a run, or the recording cannot be read that way.
    """
    from herglotz.data import load

    before = {} if arguments.config is None else _read(arguments.config)[1]
    given = {name: x for name in ("hold", "every") if (x := getattr(arguments, name, None)) is not None}
    told = before | columns | given
    if before:
        told_before = ", ".join(f"{name} {_in_words(x)}" for name, x in before.items() if told[name] is x)
        say(
            f"herglotz: note: read as {arguments.config} says: {told_before or 'nothing, flags stand over it'}",
            sys.stderr,
        )
    data = load(arguments.data, **{name: x for name, x in told.items() if name not in ("hold", "every")})
    return replace(data, hold=told.get("hold", data.hold)).thinned(told.get("every", 1)), told


def _in_words(value: Any) -> str:
    return (",".join(map(str, value)) or "none") if isinstance(value, list) else str(value)


def _read(path: Path) -> tuple[FitConfig, dict[str, Any]]:
    """The settings in a run's config.json, and how its data were read."""
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


def add_data_settings(parser: argparse._ActionsContainer) -> None:
    """Add --config and --train-fraction."""
    parser.add_argument(
        "--config", type=existing, metavar="FILE",
        help="settings that another run was told, and how its data were read: its folder or its config.json; flags "
        "that are given stand over them. On the same data it is the same fit",
    )  # fmt: skip
    _setting(
        parser, "--train-fraction", type=finite, metavar="F",
        help="part of every trajectory, in time, to train on, 0 < F <= 1 (default 0.667)",
    )  # fmt: skip


def add_machine_flags(parser: argparse._ActionsContainer) -> None:
    """Add --seed, --device, --dtype and --json."""
    _setting(parser, "--seed", type=seed, help="seed of the initial weights (default 0)")
    _setting(parser, "--device", metavar="D", help="cpu or cuda (default cpu)")
    _setting(parser, "--dtype", choices=DTYPES, help="precision (default float64)")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON, and nothing else")


def add_model_flags(parser: argparse._ActionsContainer) -> None:
    """What the Lagrangian may hold."""
    _setting(
        parser, "--level", choices=("auto", *LEVELS),
        help="auto: forced with dry friction where inputs u are recorded, else linear; for two or three joints what "
        "the data show. conservative: no damping. linear: one damping rate. affine: damping depends on position and "
        "velocity. full: on s as well. forced: one rate, and friction of each joint (default auto)",
    )  # fmt: skip
    _setting(
        parser, "--order", type=int, choices=(2, 4),
        help="of the rule; 4: from the features alone, without networks (default 2)",
    )  # fmt: skip
    _setting(
        parser, "--sticking", action=argparse.BooleanOptionalAction,
        help="dry friction that can hold a joint still (forced); default: where driven data show it",
    )  # fmt: skip
    _setting(
        parser, "--term", field="terms", action="append", metavar="NAME",
        help="a term of herglotz.models.TERMS; may be repeated",
    )  # fmt: skip
    _setting(parser, "--coupled", action="store_true", help="friction of differences of speeds: hinges (forced)")
    _setting(
        parser, "--drag", action="append", metavar="TEXT",
        help="a friction force beside the viscous one, its coefficient learned: '|v1| v1', 'q1^2 v1', '(v1 - v2)' of a "
        "damper between two, '|v| v' of air, or a constant one, 'load 1' (forced); may be given again",
    )  # fmt: skip
    _setting(parser, "--diagonal", action="store_true", help="a mass for each coordinate, none between two: bodies")
    _setting(
        parser, "--absent", action="append", metavar="NUMBER",
        help="a number of the model that is 0 and not learned, 'potential.tilt[0]'; may be given again",
    )  # fmt: skip
    _setting(parser, "--alike", action="store_true", help="one mass for all, a potential of features alone: chains")


def add_optimiser_flags(parser: argparse._ActionsContainer) -> None:
    """How it is fitted."""
    _setting(
        parser, "--objective", choices=OBJECTIVES,
        help="residual: one-step error, for exact data. trajectory: whole trajectories, for noisy data. smoothing: "
        "every state, and a little noise in every step, for pushes and chaos. auto: the first or the "
        "second, by the noise. raw: a plain network on |R|, which collapses, for demonstration (default auto)",
    )  # fmt: skip
    _setting(
        parser, "--optimiser", choices=OPTIMISERS,
        help="lm: Levenberg–Marquardt. adam, adamw: for residual and raw only (default lm)",
    )  # fmt: skip
    _setting(
        parser, "--batch", type=count, metavar="B", help="triples of samples in a step of adam or adamw (default: all)"
    )
    _setting(
        parser, "--robust", choices=ROBUST,
        help="a loss that outliers cannot pull, and spikes left out. auto: where the data show outliers "
        "(default auto)",
    )  # fmt: skip
    _setting(
        parser, "--find-zeros", action="store_true",
        help="look for zeros of the sensors that differ between recordings, kept where free runs over held-out time "
        "ask for them (default: all recordings agree, or --sensor-zeros says it)",
    )  # fmt: skip
    _setting(
        parser, "--supervision", choices=SUPERVISION,
        help="what the one-step objective is fitted to: positions, s beside them, or momenta as well, where they are "
        "recorded (default q)",
    )  # fmt: skip
    _setting(
        parser, "--restarts", type=count, metavar="R",
        help="random initialisations of the one-step fit; the best after 30 iterations is kept (default: 4 for a "
        "correction of one layer, else 1)",
    )  # fmt: skip
    _add_amount_flags(parser)


def _add_amount_flags(parser: argparse._ActionsContainer) -> None:
    """How many samples, steps and iterations, and how strong a prior."""
    _setting(
        parser, "--substeps", type=count, metavar="M",
        help="model steps in a recorded step, for samples far apart; with --objective trajectory (default 1)",
    )  # fmt: skip
    parser.add_argument(
        "--every", type=count, metavar="M",
        help="use every M-th sample only; inputs are averaged over the steps (default 1)",
    )  # fmt: skip
    _setting(
        parser, "--iterations", type=count, metavar="K",
        help="bound on the iterations of the one-step objectives (default 400)",
    )  # fmt: skip
    _setting(
        parser, "--departures", type=positive, nargs="+", metavar="TAU",
        help="prior strengths on the networks that held-out blocks choose from; one fixes it (default: 2e-4 to 6e-3)",
    )  # fmt: skip


def add_expert_flags(parser: argparse._ActionsContainer) -> None:
    """What the user knows of the system."""
    _setting(
        parser, "--feature", field="features", action="append", metavar="TEXT",
        help="what L = K - V may hold beside its terms, its coefficient learned: 'cos(q1 - q2) v1 v2' (of K), "
        "'cos(2q1)' (of V), or a list by name (chain, sites, central, pendulums, harmonics, revolute, lengths); may be "
        "given again",
    )  # fmt: skip
    _setting(
        parser, "--known", action="append", metavar="TEXT",
        help="what is known of L = K - V, with its numbers (the first mass is 1): --known='-9.81 cos(q1)' is a "
        "pendulum's V: no velocity is in it. May be given again",
    )  # fmt: skip
    _setting(
        parser, "--frequency", field="frequencies", type=positive, action="append", metavar="NU",
        help="angular frequency, in rad per unit of time, of a periodic force whose amplitude and phase are learned; "
        "for a recording without inputs. May be given again",
    )  # fmt: skip
    _setting(
        parser, "--translation", field="translations", action="append", metavar="TEXT",
        help="a symmetry that the model is to have, named by what moves together: 'q1 + q2 + q3', or 'q1' alone; what "
        "herglotz verify RUN --symmetries finds. May be given again",
    )  # fmt: skip
    _setting(
        parser, "--ignore-inputs", field="use_inputs", action="store_false", help="fit as if no input u were recorded"
    )
    _setting(
        parser, "--input-map", type=finite, nargs="+", metavar="G",
        help="the map from inputs to forces, row by row, where it is known (default: learned); the first mass is 1",
    )  # fmt: skip
    parser.add_argument(
        "--hold", choices=HOLDS,
        help="what the inputs do between samples: nothing, straight lines or polynomials (default: what the file says, "
        "or what explains the data best)",
    )  # fmt: skip

    for flag, what in (
        ("--input-delay", "time by which inputs act later"),
        ("--actuator-lag", "time constant of the actuator"),
    ):
        _setting(
            parser, flag, type=_duration, metavar="T",
            help=f"{what}, in the data's unit; none, or auto, as without this flag: what the file says or else what "
            "explains the data best",
        )  # fmt: skip


def _duration(text: str) -> float | None:
    """None for auto, 0 for none, or a time that is not negative (argparse type)."""
    known = {"auto": None, "none": 0.0}
    if text in known:
        return known[text]
    if (value := finite(text)) < 0:
        raise argparse.ArgumentTypeError(f"must be a time >= 0, none or auto, got {text}")
    return value


def _setting(parser: argparse._ActionsContainer, flag: str, *, field: str | None = None, **options: Any) -> None:
    """A flag of one field of `FitConfig`, in the namespace only where it is given."""
    dest = field or flag.removeprefix("--").replace("-", "_")
    parser.add_argument(flag, dest=dest, default=argparse.SUPPRESS, **options)
