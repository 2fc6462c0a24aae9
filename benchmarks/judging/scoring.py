"""Score what a command wrote: `python -m benchmarks.judging.scoring JOB RUN`, which prints JSON.

The run is read and asked by public names alone (`load_run`, `Run.data`, `.prediction`, `.train_lengths`, `.predict`),
so that the same judge serves other versions of the fit. A group of free runs is the unseen part of the training
recordings or one trial; its parts are the recordings or windows of it, and the error of a row is that of its worst
group.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.judging import job
from benchmarks.judging.job import Job, Trial
from herglotz.training import load_run

Array = NDArray[np.float64]
# (prediction, data) of each part, both (K, n).
Pairs = list[tuple[Array, Array]]
# The verdicts' own words, and the class of each.
CLASSES = (
    ("too little was recorded", "too little"), ("does not fit", "no fit"), ("worse than the noise", "worse"),
    ("fits to the noise", "noise"),
)  # fmt: skip


def verdict_class(sentence: str) -> str:
    """Noise, worse, no fit or too little; "other" for words that are none of these."""
    return next((name for words, name in CLASSES if words in sentence), "other" if sentence else "none")


def pairs_of(prediction: Any, data: Any, lengths: Any, first: Any) -> Pairs:
    """The parts of a free run, each from its first predicted sample on; parts without one are left out."""
    found, start = [], 0
    for length, begin in zip(lengths, first, strict=True):
        rows = slice(start + begin, start + length)
        if begin < length:
            found.append((prediction[rows].detach().double().numpy(), data[rows].double().numpy()))
        start += length
    return found


def errors(pairs: Pairs, unit: Array) -> list[float]:
    """RMS error of each part over the unit (n,) of each coordinate; inf where a sample was not reached."""
    out = []
    for prediction, data in pairs:
        miss = np.where(np.isfinite(prediction), prediction, np.inf) - data
        out.append(float(np.sqrt(np.mean(np.square(miss / unit)))))
    return out


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.inf


def scored(of: Job, folder: Path) -> dict[str, Any]:
    """Errors, their unit, and the verdict of the run in `folder`."""
    run = load_run(folder)
    said = str(run.metrics.get("verdict", ""))
    row: dict[str, Any] = {"verdict": verdict_class(said), "said": said, "groups": {}, "trouble": ""}
    if of.coordinates is not None and list(run.data.names) != list(of.coordinates):
        wrong = {"trouble": f"coordinates {', '.join(run.data.names)}", "groups": {"coordinates": [math.inf]}}
        return row | wrong | {"error": None, "relative": None, "spread": None}
    n = run.data.dof
    size = _each(of.size, n) if of.size else run.data.q.double().numpy().reshape(-1, n).std(0)
    degrees = math.pi / 180 if of.in_degrees and run.data.units[0] == "rad" else 1.0
    groups, row["trouble"], row["beyond"] = _predicted(of, run)
    groups = {name: pair for name, pair in groups.items() if pair[0]}
    row["groups"] = {name: errors(parts, unit * degrees) for name, (parts, unit) in groups.items()}
    row["relatives"] = {name: rms(errors(parts, size)) for name, (parts, _) in groups.items()}
    worst = [rms(parts) for parts in row["groups"].values()]
    spread = [float(np.sqrt(np.mean(np.square(size / (unit * degrees))))) for _, unit in groups.values()]
    row["spread"] = min(spread, default=None)
    return row | {"error": max(worst, default=None), "relative": max(row["relatives"].values(), default=None)}


def _predicted(of: Job, run: Any) -> tuple[dict[str, tuple[Pairs, Array]], str, bool]:
    """Predictions of each group with the unit of their errors, what the last one failed by, whether one left the range.

    The range is that of the positions and momenta that the model was fitted to.
    """
    groups: dict[str, tuple[Pairs, Array]] = {}
    data, n, trouble, beyond = run.data, run.data.dof, "", False
    if of.later:
        groups["later"] = pairs_of(run.prediction, data.q, data.lengths, run.train_lengths), _scale(of, None, n)
    for trial in of.trials:
        name = Path(trial.data).stem + (f" {trial.horizon:g}" if trial.horizon else "")
        try:
            found = run.predict(trial.data, **trial.settings)
            parts = pairs_of(found.prediction, found.data.q, found.data.lengths, found.train_lengths)
            beyond |= bool(getattr(found, "beyond", ()))
        # Whatever a version of the package raises is a result of this version.
        except Exception as error:
            trouble, parts = f"predict {name}: {error}", [(np.full((1, n), np.nan), np.zeros((1, n)))]
        groups[name] = parts, _scale(of, trial, n)
    return groups, trouble, beyond


def _scale(of: Job, trial: Trial | None, n: int) -> Array:
    given = of.scale if trial is None or trial.scale is None else trial.scale
    return _each(1.0 if given is None else given, n)


def _each(value: Any, n: int) -> Array:
    return np.broadcast_to(np.asarray(value, dtype=float), (n,))


def plain(value: Any) -> Any:
    """Numbers of four digits, None where they are not finite, which JSON has not."""
    if isinstance(value, float):
        return float(f"{value:.4g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: plain(x) for key, x in value.items()}
    return [plain(x) for x in value] if isinstance(value, list) else value


if __name__ == "__main__":
    print(json.dumps(plain(scored(job.read(Path(sys.argv[1])), Path(sys.argv[2])))))
