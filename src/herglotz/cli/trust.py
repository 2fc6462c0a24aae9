"""`herglotz trust`: how far to trust a fitted model, and which parameters its data do not determine."""

from __future__ import annotations

import argparse
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from herglotz.cli.common import (
    COLUMNS,
    check_output_folder,
    finite,
    flag,
    import_torch,
    print_json,
    print_table,
    warn_of_misfit,
)

if TYPE_CHECKING:
    from herglotz.training import Bands, Laplace, Run
    from herglotz.training.quantities import Quantity

DESCRIPTION = """\
Measure how far a run can be trusted: standard deviations of its physical parameters, bands on its prediction with the
share of held-out samples that really lie inside, and the parameters that the data cannot tell apart.
Draws bands.png in RUN.

examples:
  herglotz trust runs/pendulum
  herglotz trust runs/pendulum --level 0.95 --json
  herglotz trust runs/seed0 --with runs/seed1 runs/seed2
"""


HELP = "how far to trust a run"
FLAGS = (
    flag("source", "folder that `herglotz fit` or `select` wrote", metavar="RUN", type=Path),
    flag("--with", "fits of the same data from other seeds: bands of the ensemble instead of one run's",
         dest="others", type=Path, nargs="+", default=[], metavar="RUN"),
    flag("--level", "of the bands, in (0, 1) (default %(default)s)", type=finite, default=0.9),
    flag("--out", "folder for bands.png (default: RUN)", type=Path, metavar="FOLDER"),
    flag("--json", "print the numbers as JSON, and nothing else", action="store_true"),
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Measure, draw, report."""
    import_torch()

    from herglotz.training import ensemble_bands, laplace, load_run
    from herglotz.training.quantities import quantities

    result = load_run(arguments.source)
    folder = arguments.out or arguments.source
    check_output_folder(folder)

    from herglotz.plots import plot_bands, save_figure

    posterior = laplace(result)
    bands = ensemble_bands([result, *map(load_run, arguments.others)]) if arguments.others else posterior.bands()
    physical = quantities(posterior, result)
    numbers = _numbers(result, posterior, bands, arguments.level) | {"parameters": _by_name(physical)}
    folder.mkdir(parents=True, exist_ok=True)
    save_figure(plot_bands(result, bands, arguments.level), folder / "bands.png")
    warn_of_misfit(result, "what is said here of its parameters means little")
    if arguments.json:
        print_json(numbers)
    else:
        _report(numbers, physical, result, folder / "bands.png")
    return 0


def _numbers(result: Run, posterior: Laplace, bands: Bands, level: float) -> dict[str, Any]:
    from herglotz.plots.motion import trained_mask
    from herglotz.training import traded

    inside = bands.inside(result.data.unwrapped().q, level)
    held_out = ~trained_mask(result)
    return {
        "level": level,
        "inside_training": float(inside[~held_out].double().mean()),
        "inside_held_out": float(inside[held_out].double().mean()) if bool(held_out.any()) else None,
        "noise": dict(zip(result.data.names, bands.sigma.tolist(), strict=True)),
        "held_out_over_noise": posterior.inflation,
        "traded": [{"index": t.index, "parts": dict(t.parts), "words": str(t)} for t in traded(posterior)],
        "effective_parameters": posterior.effective_parameters(),
        "all_parameters": len(posterior.theta),
    }


def _by_name(found: list[Quantity]) -> dict[str, list[list[float]]]:
    """Value and standard deviation of every entry of each physical parameter, by its name."""
    numbers: dict[str, list[list[float]]] = {}
    for x in found:
        numbers.setdefault(x.name, []).append([x.value, x.std])
    return numbers


def _report(numbers: dict[str, Any], physical: list[Quantity], result: Run, figure: Path) -> None:
    from herglotz.data.units import size
    from herglotz.training.equation import ON_SCREEN
    from herglotz.training.uncertainty import determined

    data = result.data
    noises = zip(numbers["noise"].items(), data.units, strict=True)
    percent = f"{100 * numbers['level']:g} % band"
    rows = [(f"{percent}, training", f"{100 * numbers['inside_training']:.1f} % of the samples inside")]
    if numbers["inside_held_out"] is not None:
        rows.append((f"{percent}, held out", f"{100 * numbers['inside_held_out']:.1f} % of the samples inside"))
    worse = f"{numbers['held_out_over_noise']:.2f}"
    noise = ", ".join(dict.fromkeys(size(x, unit, name in data.degrees) for (name, x), unit in noises))
    rows.append(("noise of a sample", f"{noise}; held-out blocks miss {worse} times as much"))
    rows.append(("parameters the data fix", determined(numbers["effective_parameters"], numbers["all_parameters"])))
    print_table(rows)
    # The equation has the coefficients of named terms with their standard deviations.
    if result.metrics.get("equation"):
        print("Learned equation:")
        print(*(f"  {line}" for line in result.equation().text(ON_SCREEN).splitlines()), sep="\n")
    print("Value ± standard deviation (the first mass is 1):")
    for x in physical:
        print(fill(f"{x.words}: {x}", COLUMNS, initial_indent="  ", subsequent_indent="      "))
    if numbers["traded"]:
        print("What these data cannot tell apart (record other motions, or give one of them):")
        for trade in numbers["traded"]:
            print(fill(trade["words"], COLUMNS, initial_indent="  ", subsequent_indent="      "))
    else:
        print("None of these parameters can be traded for another of them.")
    print(f"Figure: {figure}")
