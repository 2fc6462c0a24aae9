"""The suite on other machines than this one: other instructions, threads, versions and roundings.

`python tests/anywhere.py` (or `make test-anywhere`) runs pytest folder by folder for every variant and ends with a
table. It can be stopped and started again: what passed with the same sources is not run twice. `--only NAME ...`
chooses variants, `--folders` folders, `--minutes` when to stop, `--again` forgets what passed; what follows `--` is
handed to pytest.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "build" / "anywhere.json"
ONE = {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
# A variant runs the folders whose tests it can change; `make test` is the variant without any change.
# Sums so large that a second thread shares them, and fits, which carry a last digit far:
ROUNDED = ("extremes", "learned", "unit", "unit/stepping", "unit/training", "unit/trust", "unit/tune")
FITTED = (*ROUNDED, "unit/benchmarks", "unit/cli", "unit/models", "unit/verify")
# What numpy and matplotlib are used for: files, figures, and C through ctypes:
ARRAYS = ("unit", "unit/benchmarks", "unit/cli", "unit/data", "unit/export", "unit/plots", "unit/tune")


class Variant(NamedTuple):
    """Another machine."""

    environment: dict[str, str]
    workers: int = 2
    versions: tuple[str, ...] | None = None  # of packages, in an environment of their own
    folders: tuple[str, ...] | None = None  # in tests/; None: all


VARIANTS = {
    # What every x86-64 processor has: SSE in torch, and in MKL, without kernels for one make of processor.
    "least": Variant({**ONE, "ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE"}),
    "avx2": Variant({**ONE, "ATEN_CPU_CAPABILITY": "avx2"}),
    "two-threads": Variant({**ONE, "OMP_NUM_THREADS": "2"}, workers=1, folders=ROUNDED),
    # Data disturbed by 1e-14 before every fit (tests/conftest.py).
    "shake": Variant({**ONE, "HERGLOTZ_SHAKE": "1"}, folders=FITTED),
    # The least that pyproject.toml allows; this matplotlib calls what later versions of pyparsing warn of.
    "oldest": Variant(ONE, versions=("numpy==1.26.*", "matplotlib==3.8.*", "pyparsing<3.3"), folders=ARRAYS),
    "newest": Variant(ONE, versions=("numpy", "matplotlib"), folders=ARRAYS),
}
if torch.backends.cpu.get_cpu_capability() == "AVX2":
    del VARIANTS["avx2"]  # `make test` is it
PYTHONS = {f"python3.{minor}": Variant(ONE, versions=()) for minor in (11, 12, 13)}  # with the pinned versions
EVERY = {**VARIANTS, **PYTHONS}
COUNTED = ("passed", "failed", "error", "skipped", "xfailed")


def folders() -> list[str]:
    """The folders that hold tests, those of a few seconds first."""
    found = {path.parent.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("test_*.py")}
    last = ("tests/unit/export", "tests/learned", "tests/unit/training")
    return [*sorted(found - set(last)), *(x for x in last if x in found)]


def sources() -> str:
    """A hash of the package and its tests: results of other sources are forgotten."""
    total = hashlib.sha256()
    for path in sorted(path for room in ("src", "tests") for path in (ROOT / room).rglob("*.*")):
        if path.is_file() and "__pycache__" not in path.parts:
            total.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return total.hexdigest()


def python(versions: tuple[str, ...] | None, name: str) -> str:
    """The interpreter of a virtual environment with these versions; made on its first use."""
    if versions is None:
        return sys.executable
    base = name if name.startswith("python") else sys.executable
    folder = RESULTS.parent / f"anywhere-{name}"
    own = folder / "bin" / "python"
    if not (folder / "installed").exists():
        pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        kept = [line for line in pinned if not (versions and line.startswith(("numpy", "matplotlib")))]
        pyenv = os.environ | {"PYENV_VERSION": name.removeprefix("python")}  # its shims know but one version at a time
        subprocess.run([base, "-m", "venv", str(folder)], check=True, env=pyenv if base == name else None)
        (folder / "constraints.txt").write_text("\n".join([*kept, ""]), encoding="utf-8")
        install = [str(own), "-m", "pip", "install", "--quiet", "-c", str(folder / "constraints.txt")]
        subprocess.run([*install, "--upgrade", *versions, "-e", f"{ROOT}[dev]"], check=True)
        (folder / "installed").touch()
    return str(own)


def run(variant: str, folder: str, options: list[str]) -> dict[str, Any]:
    """One folder in one variant: the counts of pytest, and which tests failed."""
    environment, workers, versions, _ = EVERY[variant]
    paths = sorted(str(path.relative_to(ROOT)) for path in (ROOT / folder).glob("test_*.py"))
    spread = ["-n", str(workers), "--dist", "worksteal"] if workers > 1 else []
    command = [python(versions, variant), "-m", "pytest", "-q", "-rfE", *spread, *paths, *options]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines() or [done.stderr[-200:]]
    counts = {name: int(n) for n, name in re.findall(rf"(\d+) ({'|'.join(COUNTED)})", lines[-1])}
    failed = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
    if done.returncode not in (0, 5) and not failed:  # 5: every test of the folder is left out
        failed = [lines[-1]]
    return {"counts": counts, "failed": failed}


def wanted(variant: str, folders: list[str]) -> list[str]:
    """Those of the folders that this variant can change."""
    own = EVERY[variant].folders
    return [folder for folder in folders if own is None or folder.removeprefix("tests/") in own]


def table(results: dict[str, dict[str, Any]], folders: list[str]) -> str:
    """One row a variant: sums of the counts, folders done, and the tests that failed below."""
    rows, below = [f"{'variant':16}" + "".join(f"{name:>9}" for name in COUNTED) + "  folders"], []
    for variant, found in results.items():
        sums = [sum(x["counts"].get(name, 0) for x in found.values()) for name in COUNTED]
        rows.append(
            f"{variant:16}" + "".join(f"{n:9}" for n in sums) + f"  {len(found)} of {len(wanted(variant, folders))}"
        )
        below += [f"{variant}: {line}" for x in found.values() for line in x["failed"]]
    return "\n".join(rows + below)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=EVERY, default=list(VARIANTS), help="variants to run")
    parser.add_argument("--folders", nargs="+", default=folders(), help="folders to run, such as tests/unit/data")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no folder after so long")
    parser.add_argument("--again", action="store_true", help="forget what passed")
    parser.add_argument("pytest", nargs="*", help="arguments of pytest, after --")
    arguments = parser.parse_args()
    key = sources() + " ".join(arguments.pytest)
    stored = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() and not arguments.again else {}
    results = stored["results"] if stored.get("key") == key else {}
    stop = time.monotonic() + 60 * arguments.minutes
    for variant in arguments.only:
        found = results.setdefault(variant, {})
        for folder in wanted(variant, arguments.folders):
            if time.monotonic() > stop or (folder in found and not found[folder]["failed"]):
                continue
            found[folder] = run(variant, folder, arguments.pytest)
            print(f"{variant}: {folder}: {found[folder]['counts']}", flush=True)
            RESULTS.parent.mkdir(exist_ok=True)
            RESULTS.write_text(json.dumps({"key": key, "results": results}, indent=1), encoding="utf-8")
    print(table(results, arguments.folders))
    complete = all(set(wanted(variant, arguments.folders)) <= set(results[variant]) for variant in arguments.only)
    return int(not complete or any(x["failed"] for found in results.values() for x in found.values()))


if __name__ == "__main__":
    sys.exit(main())
