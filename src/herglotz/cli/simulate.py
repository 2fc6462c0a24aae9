"""`herglotz simulate`: sampled motions of a scene with a known answer."""

from __future__ import annotations

import argparse
from pathlib import Path

from herglotz.cli.common import (
    check_output_file,
    count,
    finite,
    flag,
    import_torch,
    positive,
    print_json,
    print_next,
    say,
    seed,
)
from herglotz.cli.flags import FORCE
from herglotz.errors import InputError

ABOUT = """\
Sample motions of a scene whose answer is known, from random initial positions and velocities, and write them
as .csv or .npz for `herglotz fit`. The same seed gives the same file.

Scenes:
{scenes}
example:
  herglotz simulate damped_pendulum --out pendulum.csv --steps 160 --h 0.1 --noise 0.003 --param gamma=0.2
"""


def description() -> str:
    """The text of --help, which lists the scenes: the registry of scenes is imported when help is asked for."""
    from herglotz.scenes import scene, scene_names

    return ABOUT.format(scenes="".join(f"  {name:<20}{scene(name).description}\n" for name in scene_names()))


DESCRIPTION = description
HELP = "write data of a scene with a known answer"
FLAGS = (
    flag("scene", "name of the scene", metavar="SCENE"),
    flag("--out", "file to write: .csv or .npz", required=True, type=Path, metavar="FILE"),
    flag("--trajectories", "number of motions (default %(default)s)", type=count, default=4, metavar="N"),
    flag("--steps", "steps of each, so K + 1 samples (default %(default)s)", type=count, default=100, metavar="K"),
    flag("--h", "time between samples, in the scene's unit of time (default: its own)", type=positive, metavar="H"),
    flag("--noise", "standard deviation of Gaussian noise on the positions, in their unit (default %(default)s)",
         type=finite, default=0.0, metavar="S"),
    flag("--gaps", "runs of 1 to 3 samples deleted from each motion (default %(default)s)",
         type=count, default=0, metavar="G"),
    flag("--seed", "seed of starts, noise and gaps (default %(default)s)", type=seed, default=0),
    flag("--param", "parameter of the scene, for example gamma=0.3; may come more than once",
         action="append", default=[], metavar="NAME=VALUE"),
    FORCE,
    flag("--json", "print what was written as JSON", action="store_true"),
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Simulate and write."""
    check_output_file(arguments.out, (".csv", ".npz"), arguments.force)
    parameters = parse_parameters(arguments.param)
    import_torch()

    from herglotz.data import save, simulate
    from herglotz.scenes import scene

    system = scene(arguments.scene, **parameters)
    h = system.h if arguments.h is None else arguments.h
    data = simulate(
        system, trajectories=arguments.trajectories, steps=arguments.steps, h=h, noise=arguments.noise,
        gaps=arguments.gaps, seed=arguments.seed,
    )  # fmt: skip
    save(arguments.out, data)
    if arguments.json:
        print_json(
            {
                "file": str(arguments.out), "scene": system.name, "parameters": dict(system.parameters), "h": h,
                "trajectories": len(data), "samples": data.samples, "seed": arguments.seed, "sha256": data.digest(),
            }
        )  # fmt: skip
    else:
        say(data.summary())
        print_next(["fit", arguments.out, "--out", f"runs/{arguments.out.stem}"])
    return 0


def parse_parameters(texts: list[str]) -> dict[str, float]:
    """Parse `name=value` arguments; raise InputError if one has no = or its value is not a number."""
    parameters = {}
    for text in texts:
        name, equals, value = text.partition("=")
        try:
            parameters[name.strip()] = float(value)
        except ValueError:
            equals = ""
        if not equals or not name.strip():
            raise InputError(f"--param {text!r} is not NAME=VALUE with a number; for example --param gamma=0.3")
    return parameters
