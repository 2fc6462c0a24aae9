"""Our fit of a system of the zoo: a job of the judge, run by the command line and scored as the judge scores it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.judging import job
from benchmarks.judging.job import Job, Trial
from benchmarks.judging.running import environment, limited
from benchmarks.judging.scoring import rms, scored
from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.report import USABLE
from benchmarks.zoo_systems.systems import Recording, ZooSystem
from herglotz.data import Trajectories, save

EXTRAPOLATES = "predict: the motion leaves the range that the model was fitted to"
KEPT = ("level", "objective", "train_rms", "extrapolation_rms", "follows_data", "verdict", "departure", "parameters")


def job_of(folder: Path, of: ZooSystem) -> Job:
    """Write both recordings of a system; the job is to fit one and to predict the other, over the noise."""
    save(folder / "train.csv", trajectories(of, of.train))
    save(folder / "unseen.csv", trajectories(of, of.test))
    scale, size = ((x * unit(of)).tolist() for x in (of.floor, of.size))
    trials = [Trial("unseen.csv", of.warmup)]
    best = max(1.0, float(np.round(of.attainable or 1.0, 3)))
    return Job("train.csv", trials, scale=scale, unit="over noise", size=size, attainable=best, facts=of.facts())


def fit_ours(of: ZooSystem, folder: Path, limit: float) -> dict[str, Any]:
    """Errors over the noise and over the size of the motion, time, exit code, `KEPT` metrics, and `said`.

    `said` is why the fit or its prediction called itself a failure; empty if neither did.
    """
    folder.mkdir(parents=True, exist_ok=True)
    job.write(folder, job_of(folder, of))
    asked, run = job.read(folder), folder / "run"
    command = [sys.executable, "-m", "herglotz", "fit", asked.train, "--out", str(run), "--no-plots", "--json"]
    done = limited(command, limit, environment(None), folder)
    said = "" if done.code == 0 else "too slow" if done.code is None else f"exit code {done.code}: {done.last}"
    found = {"score": None, "relative": None, "cpu_s": done.cpu, "exit": done.code}
    if not (run / "metrics.json").is_file():
        return found | {"said": said or "no run"}
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    row = scored(asked, run)
    said = said or complaint(metrics) or row["trouble"]
    if row["beyond"] and row["relatives"]["later"] <= USABLE:
        said = said or EXTRAPOLATES
    errors = {"score": row["error"], "relative": row["relative"]}
    errors |= {f"score_{part}": rms(each) for part, each in row["groups"].items()}
    found |= {name: x if np.isfinite(x) else None for name, x in errors.items()}
    return found | {"said": said} | {name: metrics[name] for name in KEPT if name in metrics}


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
