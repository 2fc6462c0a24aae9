"""The paper's application: its parachute map as printed, and a parachute that falls.

The printed map (H⁺ without the near-identity part, λ = −0.01) is iterated from (q, p, s) = (100, 1, 1) as the paper
does; its points agree with 60-digit arithmetic, leave every float after k = 8, and describe no fall (erratum E9).
Beside it the parachute q̈ = λq̇² − g, λ = +0.01, from the same start, with its exact discrete Lagrangian: it lands. For
both the slope of the generating function, D2S^k(q_k), is compared with p_k: the paper's second figure.

Writes parachute.json (all numbers), parachute_map.png and parachute_fall.png into the folder.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch

from herglotz.errors import InputError
from herglotz.plots import save_figure
from herglotz.plots.parachute import physical_fall, plot_fall, plot_printed_map, printed_map


def main() -> int:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example: python train/parachute.py --out runs/parachute",
    )
    parser.add_argument("--out", type=Path, default=Path("runs/parachute"), help="folder (default runs/parachute)")
    out: Path = parser.parse_args().out
    printed, orbit = printed_map()
    fall, motion = physical_fall()
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "parachute.json").write_text(json.dumps({"printed_map": printed, "fall": fall}, indent=2) + "\n")
        save_figure(plot_printed_map(orbit), out / "parachute_map.png")
        save_figure(plot_fall(motion), out / "parachute_fall.png")
    except (OSError, InputError) as error:
        print(f"error: {out}: {error}; choose another folder", file=sys.stderr)
        return 2
    report(printed, fall)
    print(f"\nwritten: {out}/parachute.json, parachute_map.png, parachute_fall.png")
    return 0


def report(printed: dict, fall: dict) -> None:
    """What a reader should see first."""
    points, squared = printed["printed"]["points"], printed["squared"]["points"]
    slopes, slopes_squared = printed["printed"]["dS"], printed["squared"]["dS"]
    print("the map as printed, λ = −0.01, from (100, 1, 1)")
    print(f"{'k':>2} {'q':>22} {'p':>22} {'s':>22} {'D2S^k(q_k)':>22}")
    for x, dS in zip(points, ["", *slopes, *[""] * len(points)], strict=False):
        print(f"{x['k']:2} {x['q']:22.16g} {x['p']:22.16g} {x['s']:22.16g} {dS:>22}")
    last = printed["printed"]["last_finite_k"]
    print(f"   k = {last + 1} overflows float64; with s² in the s-line s_2 = {squared[2]['s']:.14g}")
    together = max(abs(a - b["p"]) for a, b in zip(slopes_squared, squared[1:], strict=False))
    apart = abs(slopes[2] - points[3]["p"])
    print(f"   D2S^k = p_k to {together:.0e} with s²; as printed they are {apart:.3g} apart at k = 3")
    print("\nthe fall, λ = +0.01, same start")
    for name in ("landing_time", "landing_velocity"):
        for how, value in fall[name].items():
            print(f"   {name.replace('_', ' '):17} {value:.16g}  ({how.replace('_', ' ')})")
    print(f"   D2S^k(q_k) = p_k to {fall['worst_dS_minus_p_relative']:.1e} over {fall['steps']} steps of {fall['h']} s")
    print(f"   discrete Hamilton–Jacobi residual {fall['worst_hamilton_jacobi_residual_relative']:.1e}, relative")


if __name__ == "__main__":
    sys.exit(main())
