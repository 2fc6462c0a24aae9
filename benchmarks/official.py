"""Measured sets by their official protocol: `python benchmarks/official.py FOLDER [--only emps,silverbox]`.

For every set that the folder holds, at any depth: fit the official training part with default settings, start each
official test from its first samples, the warm-up, and take the RMS error of one free run over all other samples. Split,
warm-up and metric are those of nonlinear_benchmarks, https://github.com/GerbenBeintema/nonlinear_benchmarks, and of
IdentiBench, https://github.com/daniel-om-weber/identibench (robot_forward, and the validation parts).

Files are known by their name: those of the benchmark itself (DATA_EMPS.mat and DATA_EMPS_PULSES.mat, SNLS80mV.mat or
.csv), folders that IdentiBench prepared (emps/train_valid/*.hdf5, emps/test/*.hdf5), or csv files with a header
(emps_estimation.csv, and emps_test.csv or another emps_*.csv; silverbox_estimation.csv, silverbox_multisine.csv,
silverbox_arrow_full.csv). .mat and .hdf5 ask for pip install 'herglotz[tables]'. A set without its tests is skipped;
--validation instead fits the first part of the training part, as IdentiBench cuts it, and predicts the rest.

Writes results/official.json and .md. A fit of named terms draws nothing and is made once; one with networks
is made with --seeds seeds.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.harness import Absent
from herglotz.data import Trajectories, load
from herglotz.errors import InputError
from herglotz.training import FitConfig, Run, fit

SILVERBOX_STEP = 1 / 610.35  # s; its file has no column of time


@dataclass(frozen=True)
class Part:
    """Samples of files, which are recordings of their own; the files are searched for below the folder."""

    pattern: str
    first: int = 0
    last: int | None = None  # None: to the end


@dataclass(frozen=True)
class Protocol:
    """An official split. Of each list the first part whose file is there is taken."""

    unit: str
    scale: float  # from the file's unit to that of the metric
    warmup: int  # samples of a test that start the model; the metric leaves them out
    train: tuple[Part, ...]
    tests: dict[str, tuple[Part, ...]]
    cut: int | None = None  # samples of the training part before IdentiBench's validation part


def silverbox(first: int, last: int, csv: str, prepared: str, length: int | None = None) -> tuple[Part, ...]:
    """A range of the Silverbox record, or the files that begin with this range."""
    whole = Part("SNLS80mV.mat", first, last), Part("SNLS80mV.csv", first, last)
    return *whole, Part(prepared), Part(f"silverbox_{csv}.csv", last=length)


PROTOCOLS = {
    "emps": Protocol(
        unit="mm", scale=1000, warmup=20, cut=18_000,
        train=(Part("DATA_EMPS.mat"), Part("emps/train_valid/*.hdf5"), Part("emps_estimation.csv")),
        tests={"pulses": (Part("DATA_EMPS_PULSES.mat"), Part("emps/test/*.hdf5"), Part("emps_[!e]*.csv"))},
    ),
    "silverbox": Protocol(
        unit="mV", scale=1000, warmup=50, cut=50_000,
        train=silverbox(40_650, 105_712, "estimation", "silverbox/train_valid/*.hdf5"),
        tests={
            "multisine": silverbox(105_712, 127_400, "multisine", "silverbox/test/test_0.hdf5"),
            "arrow full": silverbox(100, 40_575, "arrow_full", "silverbox/test/test_1.hdf5"),
            "arrow no extrapolation": silverbox(
                100, 32_100, "arrow_full", "silverbox/test/test_2.hdf5", 32_000
            ),
        },
    ),
    "robot_forward": Protocol(
        unit="unit of the file", scale=1, warmup=100,
        train=(Part("robot_forward/train/*.hdf5"),),
        tests={"test": (Part("robot_forward/test/*.hdf5"),)},
    ),
}  # fmt: skip
# What others publish by the same split, warm-up and metric, with where it stands.
FROLS = "polynomial NARX by FROLS, [IdentiBench](https://github.com/daniel-om-weber/identibench)"
PUBLISHED = {
    ("silverbox", "multisine"): f"8.50 ({FROLS})",
    ("silverbox", "arrow full"): f"16.2 ({FROLS})",
    ("silverbox", "arrow no extrapolation"): f"7.54 ({FROLS})",
}


def found(folder: Path, parts: Iterable[Part]) -> Trajectories | None:
    """The first of these parts whose files lie below the folder, each file a recording; None where there is none."""
    for part in parts:
        if files := sorted(folder.rglob(part.pattern)):
            return Trajectories.cat(cut(read(path), part.first, part.last) for path in files)
    return None


def cut(data: Trajectories, first: int = 0, last: int | None = None) -> Trajectories:
    """Some samples of one recording."""
    if last is not None and last > data.samples:
        raise InputError(f"{data.source}: has {data.samples} samples, the official split ends at {last}")
    which = torch.arange(data.samples)[first:last]
    return data.rows(which, (len(which),))


def read(path: Path) -> Trajectories:
    """A file in one of the three layouts, as positions and inputs over time; no coordinate is an angle."""
    if path.suffix == ".csv" and not path.stem.startswith("SNLS"):
        return load(path, show=False)
    t, q, u = (READERS[path.suffix](path)[name] for name in ("t", "q", "u"))
    return Trajectories.of(t - t[0], q, u=u, source=path.name)


def _csv(path: Path) -> dict[str, np.ndarray]:
    """V1 is the input of Silverbox, V2 its output; more columns are left aside."""
    with path.open(encoding="utf-8") as file:
        names = [name.strip() for name in file.readline().split(",")]
    if not {"V1", "V2"} <= set(names):
        raise InputError(f"{path}: the columns are {', '.join(names)}; V1 and V2 are needed")
    u, q = np.loadtxt(path, delimiter=",", skiprows=1, usecols=[names.index("V1"), names.index("V2")], unpack=True)
    return {"t": SILVERBOX_STEP * np.arange(len(q)), "q": q, "u": u}


def _mat(path: Path) -> dict[str, np.ndarray]:
    stored = _package("scipy.io", path).loadmat(str(path))
    known = {"t": "t", "q": "qm", "u": "vir"} if "qm" in stored else {"q": "V2", "u": "V1"}
    if absent := [name for name in known.values() if name not in stored]:
        raise InputError(f"{path}: holds no {absent[0]}; it is not the file of the benchmark")
    arrays = {key: np.asarray(stored[name], dtype=float).ravel() for key, name in known.items()}
    return {"t": SILVERBOX_STEP * np.arange(len(arrays["q"])), **arrays}


def _hdf5(path: Path) -> dict[str, np.ndarray]:
    with _package("h5py", path).File(path) as file:
        q, u = (np.stack([file[name][:] for name in sorted(file) if name[0] == kind], -1) for kind in "yu")
        return {"t": np.arange(len(q)) / float(file.attrs["fs"]), "q": q.astype(float), "u": u.astype(float)}


READERS: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {".csv": _csv, ".mat": _mat, ".hdf5": _hdf5}


def _package(name: str, path: Path) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(f"{path} is read by {name.partition('.')[0]}: pip install 'herglotz[tables]'") from error


def split(name: str, folder: Path, *, validation: bool) -> tuple[Trajectories, dict[str, Trajectories]]:
    """Training part and tests of a set. Raise Absent, which says why, where it has none."""
    protocol = PROTOCOLS[name]
    train = found(folder, protocol.train)
    if train is None:
        raise Absent(f"none of {', '.join(part.pattern for part in protocol.train)} below {folder}")
    if validation:
        if protocol.cut is None:
            raise Absent("no official validation part")
        return cut(train, last=protocol.cut), {"validation": cut(train, protocol.cut)}
    tests = {test: found(folder, parts) for test, parts in protocol.tests.items()}
    held = {test: data for test, data in tests.items() if data is not None}
    if not held:
        first = next(iter(protocol.tests.values()))
        raise Absent(f"none of {', '.join(part.pattern for part in first)}, its test; --validation needs none")
    return train, held


def score(run: Run, test: Trajectories, protocol: Protocol) -> float | None:
    """RMS error of the free run after the warm-up, in the protocol's unit; None where the run fails."""
    predicted = run.predict(test, warmup=protocol.warmup)
    if predicted.every > 1:
        raise InputError(f"{test.source}: every {predicted.every} samples were predicted, the protocol asks for all")
    return None if predicted.rms is None or predicted.failed_steps else protocol.scale * predicted.rms


def measure(name: str, train: Trajectories, tests: dict[str, Trajectories], seeds: int) -> list[dict[str, Any]]:
    """A row a seed; one row alone where nothing is drawn."""
    rows = []
    for seed in range(seeds):
        began = time.process_time()
        print(f"{name}, seed {seed}: fitting {train.samples} samples ...", flush=True)
        run = fit(train, FitConfig(train_fraction=1.0, seed=seed), progress=False)
        fitted = round(time.process_time() - began, 1)
        named = run.metrics["plan"]["network"] == "none"
        row: dict[str, Any] = {"verdict": run.metrics["verdict"].partition(":")[0], "named_terms": named}
        row |= {"equation": str(run.equation()), "cpu_seconds": fitted, "rms": {}}
        for test, data in tests.items():
            row["rms"][test] = score(run, data, PROTOCOLS[name])
            error = harness.spread([row["rms"][test]], ".3g")
            print(f"  {test}: {error} {PROTOCOLS[name].unit} ({fitted} s to fit)", flush=True)
        rows.append(row)
        if named:
            break
    return rows


def table(stored: dict[str, Any]) -> str:
    """One line a test; what others publish stands beside official tests alone."""
    lines = []
    for name, row in stored.items():
        protocol, seeds = PROTOCOLS[row["set"]], row["seeds"]
        drawn = "nothing is drawn" if seeds[0]["named_terms"] else f"{len(seeds)} seeds"
        cpu = statistics.median(one["cpu_seconds"] for one in seeds)
        for test, samples in row["tests"].items():
            published = PUBLISHED.get((name, test), "")
            shown = (
                f"{harness.spread((one['rms'][test] for one in seeds), '.3g')} {protocol.unit}",
                drawn,
                published,
                f"{cpu:.0f} s",
                seeds[0]["verdict"],
            )
            lines.append([row["set"], test, row["train"], samples, protocol.warmup, *shown, row["commit"]])
    head = ("set", "test", "training samples", "test samples", "warm-up", "RMS error", "seeds", "published", "fit, CPU",
            "verdict", "commit")  # fmt: skip
    text = "Default settings, the whole training part (`train_fraction=1`); docs/measured.md says more."
    return "\n".join(["# Official protocols", "", text, "", *harness.table(head, lines)])


def main(argv: list[str] | None = None) -> int:
    """Measure, print and store; 1 if no set could be measured."""
    parser = harness.parser(__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the measured sets lie")
    parser.add_argument("--only", help=f"with commas, some of {', '.join(PROTOCOLS)}")
    parser.add_argument("--seeds", type=int, default=5, help="seeds of fits with networks (default 5)")
    parser.add_argument("--validation", action="store_true", help="IdentiBench's validation part in place of the tests")
    arguments = parser.parse_args(argv)
    if not arguments.folder.is_dir():
        parser.error(f"{arguments.folder} is no folder")
    if arguments.seeds < 1:
        parser.error(f"--seeds must be at least 1, got {arguments.seeds}")
    path, measured = harness.json_file(arguments, "official"), 0
    rows = harness.load(path, {"rows": {}})["rows"]
    for name in harness.chosen(parser, arguments.only, PROTOCOLS, "set"):
        try:
            train, tests = split(name, arguments.folder, validation=arguments.validation)
        except Absent as reason:
            print(f"{name}: skipped, {reason}")
            continue
        for test in [] if arguments.validation else PROTOCOLS[name].tests.keys() - tests.keys():
            print(f"{name}: no {test}, whose file is absent")
        counts = {test: data.samples for test, data in tests.items()}
        kept = {"set": name, "commit": harness.commit(), "train": train.samples, "tests": counts}
        key = f"{name}, validation" if arguments.validation else name
        rows[key] = {**kept, "seeds": measure(name, train, tests, arguments.seeds)}
        harness.store(path, {**harness.conditions(), "rows": rows}, table(rows))
        measured += 1
    if measured:
        print(f"\n{table(rows)}\n\n{path}")
    return 0 if measured else 1


if __name__ == "__main__":
    sys.exit(main())
