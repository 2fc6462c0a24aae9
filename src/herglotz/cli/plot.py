"""`herglotz plot`: figures of a run, or of data alone."""

from __future__ import annotations

import argparse
from pathlib import Path

from herglotz.choices import FIGURES
from herglotz.cli.common import check_output_folder, flag, import_torch
from herglotz.cli.flags import READING, columns_of
from herglotz.errors import refuse

DESCRIPTION = """\
Draw figures as png, svg or pdf. Of a RUN: trajectory, phase portrait, what was learned, training and the plan; with
--animate, animation.gif instead, of data and model moving. Of DATA: its samples. Of a SCENE, and with --theory of a
RUN: the momentum against the generating function and the Hamilton–Jacobi residual; of parachute also the paper's two
figures. (`herglotz verify RUN --plots FOLDER` draws the first two as well.)

examples:
  herglotz plot runs/pendulum
  herglotz plot runs/pendulum --animate
  herglotz plot pendulum.csv --out figures --format pdf
  herglotz plot parachute --out figures
"""


HELP = "draw a run, data or the theory of a scene"
FLAGS = (
    flag("source", "folder of a run, a data file, or a scene", metavar="RUN|DATA|SCENE", type=Path),
    flag("--theory", "figures of the generating function, of a run (a scene has no others)", action="store_true"),
    flag("--out", "folder for the figures, made if missing (default: RUN itself, or the current folder for DATA)",
         type=Path, metavar="FOLDER"),
    flag("--format", "kind of file (default %(default)s)", choices=FIGURES, default="png"),
    flag("--animate", "of a run: animation.gif, of its first trajectory", action="store_true"),
    *READING,
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Draw, and print the names of the files."""
    source: Path = arguments.source
    folder = arguments.out or (source if source.is_dir() else Path())
    check_output_folder(folder)
    import_torch()
    is_run, theory = source.is_dir(), arguments.theory
    if not source.exists():
        from herglotz.scenes import scene_names

        theory = theory or str(source) in scene_names()
    flags = ", ".join(f"--{name}" for name in columns_of(arguments))
    refuse({
        f"columns are chosen in a data file, and {source} is none: leave out {flags}": flags and (theory or is_run),
        f"--animate draws a run; {source} is none: fit it first, and leave out --theory":
            arguments.animate and (theory or not is_run),
    })  # fmt: skip
    for path in _drawn(source, folder, arguments, theory):
        print(path)
    return 0


def _drawn(source: Path, folder: Path, arguments: argparse.Namespace, theory: bool) -> list[Path]:
    """The figures of the theory, or else of a run or of data."""
    if theory:
        from herglotz.plots import save_theory_figures

        return save_theory_figures(str(source), folder, form=arguments.format)
    if not source.is_dir():
        from herglotz.data import load

        data = load(source, **columns_of(arguments))

        from herglotz.plots import plot_data
        from herglotz.plots.style import save_all

        return save_all({source.stem: plot_data(data)}, folder, arguments.format)
    from herglotz.training import load_run

    result = load_run(source)

    from herglotz.plots import save_animation, save_figures

    if not arguments.animate:
        return save_figures(result, folder, form=arguments.format)
    folder.mkdir(parents=True, exist_ok=True)
    return [save_animation(result, folder / "animation.gif").path]
