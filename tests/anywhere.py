"""The suite on other machines than this one: other instructions, threads, versions and roundings.

`python tests/anywhere.py` (or `make test-anywhere`) runs pytest once a variant and ends with a table; what follows
`--` is handed to pytest. `--only NAME ...` chooses variants. Each takes as long as `make test`.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ONE = {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
VARIANTS = {  # name: (environment, workers, versions)
    "native": (ONE, 2, None),
    "default": ({**ONE, "ATEN_CPU_CAPABILITY": "default"}, 2, None),  # SSE: what every x86-64 processor has
    "avx2": ({**ONE, "ATEN_CPU_CAPABILITY": "avx2"}, 2, None),
    "mkl-compatible": ({**ONE, "MKL_CBWR": "COMPATIBLE"}, 2, None),  # MKL without processor-specific kernels
    "two-threads": ({**ONE, "OMP_NUM_THREADS": "2"}, 1, None),
    "shake": ({**ONE, "HERGLOTZ_SHAKE": "1"}, 2, None),  # data disturbed by 1e-14 before every fit (tests/conftest.py)
    "oldest": (ONE, 2, ("numpy==1.26.*", "matplotlib==3.8.*")),  # the least that pyproject.toml allows
    "newest": (ONE, 2, ("numpy", "matplotlib")),
}
PYTHONS = {f"python3.{minor}": (ONE, 2, ()) for minor in (11, 12, 13)}  # interpreters, with the pinned versions
ABSENT = "no such interpreter here"
EVERY = {**VARIANTS, **PYTHONS}


def python(versions: tuple[str, ...] | None, name: str) -> str | None:
    """The interpreter of a virtual environment with these versions, made on its first use; None where it is absent."""
    if versions is None:
        return sys.executable
    base = shutil.which(name) if name.startswith("python") else sys.executable
    if base is None or subprocess.run([base, "-c", ""], capture_output=True, check=False).returncode:
        return None
    folder = ROOT / ".venv" / f"anywhere-{name}"
    own = folder / "bin" / "python"
    if not (folder / "installed").exists():
        pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        kept = [line for line in pinned if not (versions and line.startswith(("numpy", "matplotlib")))]
        subprocess.run([base, "-m", "venv", str(folder)], check=True)
        (folder / "constraints.txt").write_text("\n".join([*kept, ""]), encoding="utf-8")
        install = [str(own), "-m", "pip", "install", "--quiet", "-c", str(folder / "constraints.txt")]
        subprocess.run([*install, "--upgrade", *versions, "-e", f"{ROOT}[dev]"], check=True)
        (folder / "installed").touch()
    return str(own)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=EVERY, default=list(VARIANTS), help="variants to run")
    parser.add_argument("pytest", nargs="*", help="arguments of pytest, after --")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.only:
        environment, workers, versions = EVERY[name]
        began, own = time.monotonic(), python(versions, name)
        if own is None:
            rows.append((name, ABSENT, 0.0))
            continue
        command = [own, "-m", "pytest", "-q", "-n", str(workers), *arguments.pytest]
        print(f"== {name}", flush=True)
        done = subprocess.run(command, cwd=ROOT, env=os.environ | environment, check=False)
        rows.append(
            (name, "passed" if done.returncode == 0 else f"FAILED ({done.returncode})", time.monotonic() - began)
        )
    for name, outcome, seconds in rows:
        print(f"{name:16} {outcome:12} {seconds:6.0f} s")
    return int(any(outcome not in ("passed", ABSENT) for _, outcome, _ in rows))


if __name__ == "__main__":
    sys.exit(main())
