"""Every printed formula that is wrong, measured: its residual beside the corrected formula's.

python train/errata.py                    the table
python train/errata.py --markdown FILE    the page docs/errata.md
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from paper_errata import ERRATA
from paper_errata.erratum import Erratum

PAGE = """# Errata of the paper, measured

Source: O. Esen, C. Sardón, M. Zajac, *A Discrete Hamilton–Jacobi Theory for Contact Hamiltonian Dynamics*. Labels are
those of the equations in its LaTeX source. Every number is a residual that should be 0, by the printed formula and by
the corrected one, in float64; where a row says "A | B", A belongs to the first column. This page is written by

    python train/errata.py --markdown docs/errata.md

and `tests/verification/test_errata.py` holds every corrected residual to 1e-10 and every printed one above 1e-3. The
last digits of the second column depend on the machine.
"""

FIGURES = """## The application, drawn

`python train/parachute.py` writes both figures and their numbers into `runs/parachute`. The paper's own figures are not
in its source; these plot what its text says they plot.

![the printed map and its generating function](images/parachute_map.png)

Left: q_k and p_k of the printed map. The paper reads the crossing of the two lines as the opening of the parachute and
q = 0 as the landing; there is no time step in the map, and q goes on to −9e22 at k = 8. Right: D2S^k(q_k), the paper's
test of its equation, for the map as printed and with s_k² in place of s_k. Only the second is a contact map, and only
there is D2S^k(q_k) = p_k for every k drawn; as printed they agree at k = 1 alone.

![a fall with the corrected sign](images/parachute_fall.png)

λ = +0.01, the same start, the exact discrete Lagrangian at h = 0.2 s: height and velocity to the ground, and D2S^k(q_k)
on the momentum of the stepper.
"""


def markdown(errata: list[Erratum]) -> str:
    parts = [PAGE]
    for e in errata:
        where = e.label[0].upper() + e.label[1:]
        parts.append(f"## {e.number}\n\n{where}.\n\n*Printed:* {e.printed}.\n\n*Right:* {e.right}.\n")
        rows = [f"| {r.setting.replace('|', chr(92) + '|')} | {r.printed:.3g} | {r.corrected:.1e} |" for r in e.rows]
        parts.append("\n".join(["| measured | printed | corrected |", "|---|---|---|", *rows]) + "\n")
    return "\n".join([*parts, FIGURES])


def table(errata: list[Erratum]) -> str:
    lines = [f"{'':4}{'printed':>10}{'corrected':>11}  measured"]
    lines += [f"{e.number:4}{r.printed:10.3g}{r.corrected:11.1e}  {r.setting}" for e in errata for r in e.rows]
    return "\n".join(lines)


def main() -> int:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the page instead of printing the table")
    arguments = parser.parse_args()
    errata = [make() for make in ERRATA]
    if arguments.markdown:
        arguments.markdown.write_text(markdown(errata), encoding="utf-8")
    else:
        print(table(errata))
    return 0


if __name__ == "__main__":
    sys.exit(main())
