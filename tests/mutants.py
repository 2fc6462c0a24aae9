"""Break the geometry on purpose, one line at a time, and see whether the tests notice: `make mutants`.

Each mutant is a sign, a factor or an index that one could get wrong and still have a program that runs.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "herglotz"
TESTS = ["tests/unit/mechanics", "tests/contracts", "tests/unit/models", "tests/unit/stepping", "tests/golden"]

MUTANTS = [
    ("mechanics/legendre.py", "return -P.D1 / P.c[..., None]", "return -P.D1"),
    ("mechanics/legendre.py", "return q1, P.D2, s0 + P.L", "return q1, P.D2 / P.c[..., None], s0 + P.L"),
    ("mechanics/legendre.py", "return q1, P.D2, s0 + P.L", "return q1, P.D2, s0 - P.L"),
    ("mechanics/legendre.py", "return P.D1 + P.c[..., None] * p0", "return P.D1 + p0"),
    ("mechanics/legendre.py", "P.D12 + p0[..., :, None]", "P.D12 - p0[..., :, None]"),
    ("mechanics/tangent.py", "F_q0 = P.D11 + p0", "F_q0 = P.D11 - p0"),
    ("mechanics/tangent.py", "torch.cat([P.D12.mT, zero", "torch.cat([P.D12, zero"),
    ("mechanics/tangent.py", "zero[..., 0], P.c[..., None]], -1)", "zero[..., 0], P.D3[..., None]], -1)"),
    ("mechanics/hamiltonian.py", "return (p1 * q1).sum(-1) - L", "return (p1 * q1).sum(-1) + L"),
    ("mechanics/contact.py", "torch.cat([-p, torch.zeros_like(p)", "torch.cat([p, torch.zeros_like(p)"),
    ("mechanics/continuous.py", "-(H_q + p.detach() * H_s[..., None])", "-H_q"),
    ("mechanics/partials.py", "stack([r[1] for r in rows0], -2)", "stack([r[1] for r in rows0], -1)"),
    ("models/model.py", "(c - 1.0) * (s0 - h / 2 * t.V0)", "(c - 1.0) * s0"),
    ("models/model.py", "(t.g / 2).exp() * t.K", "t.K"),
    ("models/jet.py", "second = a * other._second + b * self._second", "second = a * other._second - b * self._second"),
    ("models/jet.py", "return self.map(t, f1, -2 * t * f1)", "return self.map(t, f1, 2 * t * f1)"),
    ("stepping/stepper.py", "return q1 - solve(J, F - F.detach())", "return q1 + solve(J, F - F.detach())"),
    ("stepping/stepper.py", "sigma=factors.cumprod(-1)", "sigma=factors"),
]


def killed(path: Path, old: str, new: str) -> bool:
    """Apply one mutant, run the tests, restore the file."""
    text = path.read_text(encoding="utf-8")
    if old not in text:
        raise SystemExit(f"{path}: no line with {old!r}; the list of mutants is out of date")
    try:
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *TESTS]
        return subprocess.run(command, cwd=ROOT, capture_output=True).returncode == 1
    finally:
        path.write_text(text, encoding="utf-8")


def main() -> int:
    """Run all mutants and print a line each."""
    survivors = 0
    for name, old, new in MUTANTS:
        dead = killed(SOURCE / name, old, new)
        survivors += not dead
        print(f"{'killed  ' if dead else 'SURVIVED'}  {name}: {old}  →  {new}", flush=True)
    print(f"{len(MUTANTS) - survivors} of {len(MUTANTS)} mutants killed")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
