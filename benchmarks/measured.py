"""Outliers, unknown forces, a motor, bands and measured data: `python benchmarks/measured.py [--seeds 5]`.

Writes results/measured.json and .md, and coverage.png. Settings are the defaults unless a set says otherwise
(measured_sets.py says what each is). Further sets are rows of the judge. Sets that are absent are skipped
(`--data FOLDER` says where they are). Rows that were run before are kept, each with its commit, so that parts can be
run alone. Seconds of one core for each seed: outliers 2, disturbed 25, real_pendulum 4, real_pendulum_network 4,
air_track 2, driven_pendulum 65, coverage_simulated 27, coverage_real about 90.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness, measured_sets as sets
from benchmarks.judging import recorded
from herglotz.plots import style

COVERED = (0.80, 0.97)  # share of samples inside a band of nominal 0.9 that counts as kept
TARGETS: dict[tuple[str, str], tuple[float, float]] = {  # lowest and highest value that meets it
    ("outliers", "over_clean"): (0.0, 2.0),
    ("real_pendulum", "extrapolation_rms"): (0.0, 0.013),
    ("real_pendulum_network", "extrapolation_rms"): (0.0, 0.013),
    ("air_track", "extrapolation_rms"): (0.0, 0.50),
    ("driven_pendulum", "over_authors_1.0s"): (0.0, 1.0),
    ("driven_pendulum", "over_authors_2.0s"): (0.0, 1.0),
    ("coverage_simulated", "laplace_measured"): COVERED,
    ("coverage_simulated", "ensemble_measured"): COVERED,
    ("coverage_real", "laplace_measured"): COVERED,
    ("coverage_real", "ensemble_measured"): COVERED,
}
# A set: its files, and what measures it.
ROWS: dict[str, tuple[tuple[str, ...], Callable[..., dict[str, Any]]]] = {
    "outliers": ((), sets.outliers),
    "disturbed": ((), sets.disturbed),
    "real_pendulum": ((recorded.PENDULUM,), sets.extrapolation(recorded.PENDULUM)),
    "real_pendulum_network": ((recorded.PENDULUM,), sets.extrapolation(recorded.PENDULUM, "trajectory")),
    "air_track": ((recorded.AIR_TRACK,), sets.extrapolation(recorded.AIR_TRACK)),
    "driven_pendulum": (recorded.ONE_MOTOR, sets.driven_pendulum),
    "coverage_simulated": ((), sets.coverage_simulated),
    "coverage_real": ((recorded.PENDULUM,), sets.coverage_real),
}
CURVES = {
    "simulated, Laplace": ("coverage_simulated", "laplace_measured"),
    "simulated, ensemble": ("coverage_simulated", "ensemble_measured"),
    "measured, Laplace": ("coverage_real", "laplace_measured"),
    "measured, ensemble": ("coverage_real", "ensemble_measured"),
}


def table(stored: dict[str, Any]) -> str:
    """Median and spread of every figure."""
    rows = []
    for name, row in stored.items():
        for key, value in row["seeds"][0].items():
            values = (
                [] if isinstance(value, dict | list) else [x for seed in row["seeds"] if (x := seed[key]) is not None]
            )
            if not values:  # curves
                continue
            low, high = TARGETS.get((name, key), (0.0, 0.0))
            target = "" if not high else f"{low:g} … {high:g}" if low else f"≤ {high:g}"
            span, median = f"{min(values):.4g} … {max(values):.4g}", f"{statistics.median(values):.4g}"
            rows.append([name, row["commit"], key, len(values), median, span, target])
    head = ("set", "commit", "figure", "seeds", "median", "min … max", "target")
    return "\n".join(["# Outliers, unknown forces, a motor, bands and measured data", "", *harness.table(head, rows)])


def draw(rows: dict[str, Any], path: Path) -> None:
    """One held-out motion with its band, and the share inside against the nominal one, for every seed."""
    example = rows["coverage_simulated"]["seeds"][0]["example"]
    t, q, model, std = (torch.tensor(example[name]) for name in ("t", "q", "model", "std"))
    t = t - t[0]
    measured = 1.645 * (std.square() + example["sigma"] ** 2).sqrt()
    with style.styled():
        figure = style.new_figure(9.0, 4.2, "Bands that keep their word: nine samples in ten lie inside")
        grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1), height_ratios=(1, 1))
        top = figure.add_subplot(grid[0, 0])
        bottom, right = figure.add_subplot(grid[1, 0], sharex=top), figure.add_subplot(grid[:, 1])
        begun = float(t[sets.SEEN - 1] + t[sets.SEEN]) / 2
        for ax in (top, bottom):
            ax.axvspan(begun, float(t[-1]), color=style.SHADE, lw=0, zorder=0)
        top.plot(t, model, color=style.MODEL, zorder=2)
        top.plot(t, q, ".", color=style.INK, ms=3, zorder=3)
        top.set(ylabel="angle (rad)", title=f"An unseen start: {sets.SEEN} noisy samples, then {sets.AHEAD} predicted")
        bottom.fill_between(t, -1e3 * measured, 1e3 * measured, color=style.MODEL, alpha=0.18, lw=0)
        bottom.fill_between(t, -1645 * std, 1645 * std, color=style.MODEL, alpha=0.45, lw=0)
        bottom.plot(t, 1e3 * (q - model), ".", color=style.UNSEEN, ms=3)
        bottom.set(ylabel="measured − model (mrad)", xlabel="time (s)", xlim=(0, float(t[-1])))
        style.captions(bottom, [("dark: model", style.MODEL), ("light: with a sample's noise", style.MUTED)])
        right.plot([0.45, 1], [0.45, 1], color=style.MUTED, lw=0.8)
        right.plot([sets.NOMINAL] * 2, COVERED, color=style.ACCENT, lw=7, alpha=0.3)
        entries = []
        for (name, key), color in zip(CURVES.items(), style.SERIES, strict=False):
            for k, seed in enumerate(rows.get(key[0], {"seeds": []})["seeds"]):
                right.plot(sets.LEVELS, seed["curves"][key[1]], "-o", ms=2.5, lw=0.8, color=color, alpha=0.75)
                entries += [(name, color)] if k == 0 else []
        for line, entry in enumerate(entries):
            style.captions(right, [entry], row=line)
        below: dict[str, Any] = {"ha": "center", "va": "top", "xytext": (0, -4)}
        style.label(right, sets.NOMINAL, COVERED[0], f"target at {sets.NOMINAL:g}", style.ACCENT, **below)
        right.set(xlabel="nominal", ylabel="share of held-out samples inside", title="Every line a seed")
        harness.picture(figure, path)


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds (default 5)")
    parser.add_argument("--only", help=f"with commas, some of {', '.join(ROWS)}")
    parser.add_argument("--data", type=Path, default=harness.DATA, help="folder of measured sets")
    arguments = parser.parse_args(argv)
    path, names = harness.json_file(arguments, "measured"), []
    for name in harness.chosen(parser, arguments.only, ROWS, "set"):
        try:
            for file in ROWS[name][0]:
                harness.there(arguments.data / file)
            names.append(name)
        except harness.Absent as reason:
            print(f"{name}: skipped, {reason}")
    jobs = {name: (lambda seed, one=measure: one(seed, arguments.data)) for name, (_, measure) in ROWS.items()}
    rows = harness.by_seed(path, jobs, names, arguments.seeds, table)
    if "coverage_simulated" in rows:
        draw(rows, path.with_name("coverage.png"))


if __name__ == "__main__":
    main()
