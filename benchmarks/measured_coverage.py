"""How often the truth lies inside the bands: measured coverage of the Laplace posterior and of ensembles of seeds.

* coverage_simulated: trained on 12 × 61 positions of the damped pendulum, h = 0.2, noise 0.01 rad; judged on 20
  held-out trajectories from unseen starts, each of which shows its first 20 samples and is predicted for 100 more.
  `measured`: noisy samples inside the band of a measurement; `true`: noiseless positions inside the narrower band of
  the model.
* coverage_real: the measured pendulum, first two thirds → the samples of the last third.

Every seed is another data set (simulated) or another draw of the weights (measured); an ensemble has three fits.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data import load, simulate
from herglotz.plots.style import (
    ACCENT,
    INK,
    MODEL,
    MUTED,
    SERIES,
    SHADE,
    UNSEEN,
    captions,
    label,
    new_figure,
    save_figure,
    styled,
)  # fmt: skip
from herglotz.scenes import scene
from herglotz.training import Bands, FitConfig, Run, ensemble_bands, fit, laplace

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95, 0.99)
NOMINAL, LOW, HIGH = 0.9, 0.80, 0.97
TRAINED, STEPS, HELD_OUT, SEEN, AHEAD = 12, 60, 20, 20, 100
MEMBERS = 3
CURVES = {
    "simulated, Laplace": ("coverage_simulated", "laplace_measured"),
    "simulated, ensemble": ("coverage_simulated", "ensemble_measured"),
    "measured, Laplace": ("coverage_real", "laplace_measured"),
    "measured, ensemble": ("coverage_real", "ensemble_measured"),
}
REAL = "schmidt_lipson_2009/real_pend_h_1.txt"


def shares(bands: Bands, q: Tensor, rows: Tensor, *, measured: bool = True) -> list[float]:
    """Share of these rows of q inside the central intervals of every level."""
    found = []
    for level in LEVELS:
        low, high = bands.interval(level, measured=measured)
        found.append(float(((q >= low) & (q <= high))[rows].double().mean()))
    return found


def row(curves: dict[str, list[float]]) -> dict[str, Any]:
    """The nominal 90 % of every curve as a figure, and the curves."""
    at = LEVELS.index(NOMINAL)
    return {**{name: curve[at] for name, curve in curves.items()}, "curves": curves}


def members(run: Run) -> list[Run]:
    """The run and fits of other seeds to its data."""
    others = (replace(run.config, seed=run.config.seed + 100 * k) for k in range(1, MEMBERS))
    return [run, *(fit(run.data, config, progress=False) for config in others)]


def simulated(seed: int, folder: Path) -> dict[str, Any]:  # noqa: ARG001  one signature for all
    pendulum = scene("damped_pendulum")
    data = simulate(pendulum, trajectories=TRAINED, steps=STEPS, h=0.2, noise=0.01, seed=seed)
    run = fit(data, FitConfig(train_fraction=1.0, seed=seed), progress=False)
    settings: dict[str, Any] = {"trajectories": HELD_OUT, "steps": SEEN + AHEAD - 1, "h": 0.2, "seed": seed + 500}
    test, clean = (simulate(pendulum, noise=noise, **settings).unwrapped() for noise in (0.01, 0.0))
    rows = torch.arange(test.samples) % (SEEN + AHEAD) >= SEEN
    every = {"laplace": laplace(run).predict(test, SEEN), "ensemble": ensemble_bands(members(run), test, SEEN)}
    found = row(
        {f"{name}_measured": shares(bands, test.q, rows) for name, bands in every.items()}
        | {f"{name}_true": shares(bands, clean.q, rows, measured=False) for name, bands in every.items()}
    )
    if seed == 0:
        bands, first = every["laplace"], slice(0, SEEN + AHEAD)
        lines = {"t": test.t, "q": test.q[:, 0], "model": bands.q[:, 0], "std": bands.std[:, 0]}
        rounded = {name: [float(f"{v:.6g}") for v in x[first].tolist()] for name, x in lines.items()}
        found["example"] = {**rounded, "sigma": bands.sigma}
    return found


def real(seed: int, folder: Path) -> dict[str, Any]:
    run = fit(load(folder / REAL), FitConfig(seed=seed), progress=False)
    q, rows = run.data.unwrapped().q, torch.arange(run.data.samples) >= run.train_lengths[0]
    return row(
        {
            "laplace_measured": shares(laplace(run).bands(), q, rows),
            "ensemble_measured": shares(ensemble_bands(members(run)), q, rows),
        }
    )


def draw(rows: dict[str, Any], path: Path) -> None:
    """One held-out motion with its band, and the share inside against the nominal one, for every seed."""
    example = rows["coverage_simulated"]["seeds"][0]["example"]
    t, q, model, std = (torch.tensor(example[name]) for name in ("t", "q", "model", "std"))
    t = t - t[0]
    measured = 1.645 * (std.square() + example["sigma"] ** 2).sqrt()
    with styled():
        figure = new_figure(9.0, 4.2, "Bands that keep their word: nine samples in ten lie inside")
        grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1), height_ratios=(1, 1))
        top = figure.add_subplot(grid[0, 0])
        bottom, right = figure.add_subplot(grid[1, 0], sharex=top), figure.add_subplot(grid[:, 1])
        begun = float(t[SEEN - 1] + t[SEEN]) / 2
        for ax in (top, bottom):
            ax.axvspan(begun, float(t[-1]), color=SHADE, lw=0, zorder=0)
        top.plot(t, model, color=MODEL, zorder=2)
        top.plot(t, q, ".", color=INK, ms=3, zorder=3)
        top.set(ylabel="angle (rad)", title=f"An unseen start: {SEEN} noisy samples, then {AHEAD} predicted")
        bottom.fill_between(t, -1e3 * measured, 1e3 * measured, color=MODEL, alpha=0.18, lw=0)
        bottom.fill_between(t, -1645 * std, 1645 * std, color=MODEL, alpha=0.45, lw=0)
        bottom.plot(t, 1e3 * (q - model), ".", color=UNSEEN, ms=3)
        bottom.set(ylabel="measured − model (mrad)", xlabel="time (s)", xlim=(0, float(t[-1])))
        captions(bottom, [("dark: model", MODEL), ("light: with a sample's noise", MUTED)])
        right.plot([0.45, 1], [0.45, 1], color=MUTED, lw=0.8)
        right.plot([NOMINAL] * 2, [LOW, HIGH], color=ACCENT, lw=7, alpha=0.3)
        entries = []
        for (name, key), color in zip(CURVES.items(), SERIES, strict=False):
            for k, seed in enumerate(rows.get(key[0], {"seeds": []})["seeds"]):
                right.plot(LEVELS, seed["curves"][key[1]], "-o", ms=2.5, lw=0.8, color=color, alpha=0.75)
                entries += [(name, color)] if k == 0 else []
        for line, entry in enumerate(entries):
            captions(right, [entry], row=line)
        label(right, NOMINAL, LOW, f"target at {NOMINAL:g}", ACCENT, ha="center", va="top", xytext=(0, -4))
        right.set(xlabel="nominal", ylabel="share of held-out samples inside", title="Every line a seed")
        save_figure(figure, path)
