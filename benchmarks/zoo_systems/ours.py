"""Our fit of a system of the zoo, in a process of its own, with a bound on its processor time."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.prediction import trained
from benchmarks.zoo_systems.report import USABLE, relative
from benchmarks.zoo_systems.systems import Recording, ZooSystem
from herglotz.data import Trajectories, save
from herglotz.training import load_run

EXTRAPOLATES = "predict: the motion leaves the range that the model was fitted to"
WALL = 30  # times the processor time that a fit may wait on a busy machine


@dataclass(frozen=True)
class OurFit:
    """What came of `herglotz fit`."""

    predictions: dict[str, tuple[Array, Array]] | None  # None: there is no run
    said: str  # why the fit called itself a failure; empty if it did not
    cpu: float  # s of processor time
    metrics: dict[str, Any]
    code: int | None = None  # exit code; None: out of time


def fit_ours(of: ZooSystem, folder: Path, limit: float) -> OurFit:
    """Write the training data, fit with default flags, predict both parts."""
    folder.mkdir(parents=True, exist_ok=True)
    save(folder / "train.csv", trajectories(of, of.train))
    save(folder / "unseen.csv", trajectories(of, of.test))
    code, message, cpu = _run_fit(folder, limit)
    said = "" if code == 0 else "too slow" if code is None else f"exit code {code}: {message}"
    if not (folder / "run" / "metrics.json").is_file():
        return OurFit(None, said or "no run", cpu, {}, code)
    run = load_run(folder / "run")
    said = said or complaint(run.metrics)
    found = {"later": _later(of, run)}
    try:
        test = run.predict(trajectories(of, of.test), warmup=of.warmup)
        thinned = trajectories(of, of.test).thinned(test.every)
        free = test.free.numpy()
        found["unseen"] = test.prediction.numpy()[free] / unit(of), thinned.q.numpy()[free] / unit(of)
        if test.beyond and relative(of, {"later": found["later"]}) <= USABLE:
            said = said or EXTRAPOLATES
    except Exception as error:
        said, found["unseen"] = said or f"predict: {error}", (np.full((1, of.mechanism.n), np.nan),) * 2
    return OurFit(found, said, cpu, run.metrics, code)


def complaint(metrics: dict[str, Any]) -> str:
    """What the metrics say against the fit; empty if nothing."""
    verdict = str(metrics.get("verdict", ""))
    if verdict.startswith("does not fit"):
        return verdict
    if metrics.get("follows_data") is False:
        return "follows_data: false"
    status = metrics.get("extrapolation_status", "ok")
    return "" if status == "ok" else str(status)


def trajectories(of: ZooSystem, data: Recording) -> Trajectories:
    """A recording in the units of the files."""
    B, N, n = data.q.shape
    angles = of.mechanism.angles
    return Trajectories.of(
        np.tile(data.t * of.time_unit, B), data.q.reshape(-1, n) * unit(of), (N,) * B,
        names=[f"theta{i}" if a else f"x{i}" for i, a in enumerate(angles)],
        units=["rad" if a else "m" for a in angles], angles=angles,
        u=data.u.reshape(-1, 1) if of.driven else None, source=f"zoo {of.seed}, system {of.index}",
    )  # fmt: skip


def unit(of: ZooSystem) -> Array:
    """(n,) what natural 1 is in the files."""
    return np.where(of.mechanism.angles, 1.0, of.length_unit)


def _later(of: ZooSystem, run: Any) -> tuple[Array, Array]:
    """The run's own free run over the part of the training recordings that it did not see."""
    first, n = trained(of.train), of.mechanism.n
    shape = of.train.q.shape
    q = run.prediction.detach().double().numpy().reshape(shape)[:, first:] / unit(of)
    return q.reshape(-1, n), of.train.q[:, first:].reshape(-1, n)


def _run_fit(folder: Path, limit: float) -> tuple[int | None, str, float]:
    """Exit code (None: out of time), last line of stderr, processor time."""
    command = [sys.executable, "-m", "herglotz", "fit", str(folder / "train.csv"), "--out", str(folder / "run")]
    before = _children()
    bound = lambda: resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit) + 5))  # noqa: E731
    try:
        done = subprocess.run(
            [*command, "--no-plots", "--json"], capture_output=True, text=True, timeout=WALL * limit,
            preexec_fn=bound, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False,
        )  # fmt: skip
        code, message = done.returncode, (done.stderr.strip().splitlines() or [""])[-1]
    except subprocess.TimeoutExpired:
        code, message = -1, ""
    return None if code < 0 else code, message, _children() - before


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
