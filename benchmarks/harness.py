"""What all benchmarks share: flags, the machine, C files, one JSON file that runs add to, tables and pictures.

Every command writes `NAME.json`, what was measured, and `NAME.md`, the table made from it. What an earlier run measured
is kept, so that parts can be run alone and an interrupted run goes on where it stopped. Nothing here imports torch
before torch is used: the memory of the judge must not count for a fit.
"""

from __future__ import annotations

import argparse
import ctypes
import io
import json
import math
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DATA = ROOT.parent / "shared" / "data"  # measured recordings; data/README.md says where to get them
DIGITS = 6  # significant ones of a stored number: more than any table shows
COLOURS, DPI = 32, 100  # of pictures: enough for lines and text, half the size


def parser(text: str | None, *, quick: bool = False) -> argparse.ArgumentParser:
    """Flags of a command: `--out`, and `--quick` where there is a short form; torch is set to one thread.

    Small matrices on several threads only wait for one another; OMP_NUM_THREADS sets another number.
    """
    import torch

    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    made = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, help="the JSON file, or a folder for it (default benchmarks/results)")
    if quick:
        made.add_argument("--quick", action="store_true", help="a test run: shorter, fewer sizes; default runs/quick")
    return made


def json_file(arguments: argparse.Namespace, name: str) -> Path:
    """The JSON file that `--out` means: itself, or `name`.json in a folder, which is made."""
    out = arguments.out or (ROOT / "runs" / "quick" if getattr(arguments, "quick", False) else RESULTS)
    path = out if out.suffix == ".json" else out / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def chosen(made: argparse.ArgumentParser, given: str | None, known: Iterable[str], what: str) -> list[str]:
    """Names given with commas, all where none are given; an unknown one ends the command."""
    known = list(known)
    names = [name.strip() for name in given.split(",")] if given else known
    if unknown := [name for name in names if name not in known]:
        made.error(f"unknown {what} {unknown[0]!r}; choose from {', '.join(known)}")
    return names


def commit() -> str:
    """Short name of the commit that is measured."""
    words = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False).stdout.strip()


def conditions(*packages: str) -> dict[str, Any]:
    """Commit, machine with its load, and versions of torch, python and these packages."""
    import torch

    machine = {"processor": processor(), "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    versions = {"python": platform.python_version()} | {name: _version(name) for name in ("torch", *packages)}
    return {"commit": commit(), "machine": machine | {"load": os.getloadavg()}, "versions": versions}


def processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), platform.machine())


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def compiled(source: str, header: str, text: str, *flags: str) -> ctypes.CDLL:
    """A C file of this folder as a library; `text` is the header that it includes by the name `header`."""
    from herglotz.codegen.c_compiler import compiler

    with tempfile.TemporaryDirectory(prefix="herglotz-bench-") as folder:
        Path(folder, header).write_text(text)
        library = Path(folder, "library.so")
        files = [f"-I{folder}", str(Path(__file__).with_name(source)), "-o", str(library), "-lm"]
        subprocess.run([*compiler(), *flags, "-shared", "-fPIC", *files], check=True)
        return ctypes.CDLL(str(library))


def seconds(run: Callable[[], Any], clock: Callable[[], float] = time.process_time) -> float:
    """Processor time of all threads: what another program takes from this one does not count."""
    import torch

    begin = clock()
    with torch.no_grad():
        run()
    return clock() - begin


class Absent(ValueError):
    """Data that a row needs are not here."""


def there(path: Path) -> Path:
    """The path of a measured set. Raise Absent where it is not here; data/README.md says where to get it."""
    if not path.exists():
        raise Absent(f"no {path.name} in {path.parent.name}")
    return path


def load(path: Path, empty: dict[str, Any]) -> dict[str, Any]:
    """What earlier runs stored, or `empty`."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else empty


def store(path: Path, result: dict[str, Any], text: str | None = None) -> None:
    """Write the JSON, and the table beside it; each file appears whole or not at all."""
    _write(path, (_json(result, 0) + "\n").encode())
    if text is not None:
        _write(path.with_suffix(".md"), (text.rstrip("\n") + "\n").encode())


def _write(path: Path, content: bytes) -> None:
    part = path.with_name(f"{path.name}.part")
    part.write_bytes(content)
    part.replace(path)


def _json(value: Any, depth: int) -> str:
    """Numbers in `DIGITS` digits, null for what is not finite, one line for what lies deeper."""
    inside = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    alike = bool(inside) and all(isinstance(x, dict) for x in inside)
    opened = depth < 2 and value if isinstance(value, dict) else alike
    return _lines(value, depth + 1) if opened else json.dumps(_rounded(value), ensure_ascii=False)


def _lines(value: Any, depth: int) -> str:
    """A dictionary or a list, each of its values on a line of its own."""
    if isinstance(value, dict):
        pairs = (f"{json.dumps(k, ensure_ascii=False)}: {_json(v, depth)}" for k, v in value.items())
        return "{\n" + ",\n".join(pairs) + "}"
    return "[\n" + ",\n".join(_json(v, 9) for v in value) + "]"


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    return [_rounded(x) for x in value] if isinstance(value, list | tuple) else value


def table(head: Sequence[str], rows: Iterable[Iterable[Any]]) -> list[str]:
    """Lines of a markdown table."""
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    return lines + [f"| {' | '.join(str(x).replace('|', '/') for x in row)} |" for row in rows]


def spread(values: Iterable[float | None], form: str = ".1e", without: str = "failed") -> str:
    """Median and range over the seeds, the median alone of one seed, and how many are None, which are `without`."""
    values = list(values)
    known = [x for x in values if x is not None]
    if not known:
        return without
    text, lost = f"{statistics.median(known):{form}}", len(values) - len(known)
    text += "" if len(known) == 1 else f" ({min(known):{form}} – {max(known):{form}})"
    return f"{text}, {lost} {without}" if lost else text


def by_seed(
    path: Path,
    jobs: Mapping[str, Callable[[int], dict[str, Any]]],  # name → what measures it with a seed
    names: Iterable[str],
    seeds: int,
    text: Callable[[dict[str, Any]], str],  # the rows → the table
) -> dict[str, Any]:
    """Measure some rows with every seed; each is stored when it is done, beside those of earlier runs. All rows."""
    rows = load(path, {"rows": {}})["rows"]
    for name in names:
        found = []
        for seed in range(seeds):
            began = time.process_time()
            found.append({**jobs[name](seed), "cpu_seconds": round(time.process_time() - began, 1)})
            print(name, seed, json.dumps({k: x for k, x in found[-1].items() if not isinstance(x, dict)}), flush=True)
        rows[name] = {"commit": commit(), "seeds": found}
        kept = {key: rows[key] for key in jobs if key in rows}
        store(path, {**conditions(), "rows": kept}, text(kept))
    return rows


def picture(figure: Any, path: Path) -> None:
    """Write a figure as PNG of few colours."""
    from PIL import Image

    whole, small = io.BytesIO(), io.BytesIO()
    figure.savefig(whole, format="png", dpi=DPI)
    image = Image.open(whole).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    image.save(small, format="png", optimize=True)
    _write(path, small.getvalue())
