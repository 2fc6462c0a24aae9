"""A finished fit on disk: four files, and a manifest with their checksums."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, Literal, TypedDict, get_type_hints

import numpy as np
import torch
from torch import Tensor

import herglotz
from herglotz.data.files import MANIFEST, read_bytes, refuse_weights, write_atomically
from herglotz.data.npz_format import npz_bytes, trajectories_of
from herglotz.errors import InputError, refuse
from herglotz.formats import FORMATS
from herglotz.models import ContactLagrangian, ModelConfig, refuse_own
from herglotz.schema import check_entries, matches
from herglotz.stepping import State
from herglotz.training.config import FitConfig
from herglotz.training.equation import Equation
from herglotz.training.plan import Plan
from herglotz.training.run import Run

# Version of the folder's format; a change that older versions cannot read increments it.
FORMAT = 1
FILES = ("model.pt", "config.json", "metrics.json", "fit.npz")
# Costs for the reader of the folder; the package does not read this file.
LOG = "history.csv"
REMEDY = "fit again, or restore the folder as `herglotz fit` wrote it"


class Manifest(TypedDict):
    """Entries of manifest.json, with the sha256 of every file of the run."""

    format: int
    herglotz: str
    files: dict[str, str]


class StoredModel(TypedDict):
    """Entries of model.pt."""

    format: int
    model: dict[str, Any]
    parameters: dict[str, Tensor]
    states: dict[str, Tensor]
    train_lengths: list[int]
    h: float
    box: dict[str, list[float]]
    history: list[dict[str, Any]]
    data_digest: str


class Metrics(TypedDict, total=False):
    """Entries of metrics.json that later commands read, if present."""

    plan: Plan
    equation: Equation
    verdict: str
    level: str | None
    objective: str | None
    sigma: float | None
    rate: float | None
    departure: float | None
    seconds: float
    parameters: int
    outliers: int
    outlier_samples: list[int]
    follows_data: bool
    extrapolation_rms: float | None
    train_rms: float | None
    one_step_rms: float | None
    extrapolation_status: str | None
    tuned: dict[str, Any] | None


def save_run(run: Run, folder: str | Path) -> None:
    """Write model.pt, config.json, metrics.json, fit.npz, manifest.json with the sha256 of these, and history.csv.

    Each file is written atomically; a folder from an interrupted write does not match its manifest.

    Parameters
    ----------
    run
        The result of `fit`.
    folder
        Where to write; created if missing.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    refuse_own(
        run.model, "folder",
        "keep the weights by torch.save(net.state_dict(), path), and steps without the code of the module by "
        'run.export("model.pt2")',
    )  # fmt: skip
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    model = {
        "format": FORMAT,
        "model": run.model.config.to_dict(),
        "parameters": {k: v.detach().cpu() for k, v in run.model.state_dict().items()},
        "states": {k: v.detach().cpu() for k, v in run.states._asdict().items()},
        "train_lengths": list(run.train_lengths),
        "h": run.h,
        "box": run.box,
        "history": run.history,
        "data_digest": run.data.digest(),
    }
    buffer = BytesIO()
    torch.save(model, buffer)
    contents = {
        "model.pt": buffer.getvalue(),
        "config.json": _json_bytes(run.config.to_dict() | ({"reading": run.reading} if run.reading else {})),
        "metrics.json": _json_bytes(_finite(run.metrics)),
        "fit.npz": npz_bytes(run.data),
    }
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    contents[MANIFEST] = _json_bytes({"format": FORMAT, "herglotz": herglotz.__version__, "files": digests})
    contents[LOG] = _log(run.history)
    for name, content in contents.items():
        write_atomically(folder / name, content)


def load_run(folder: str | Path) -> Run:
    """Read what `save_run` wrote.

    Parameters
    ----------
    folder
        The folder of a run.

    Returns
    -------
    Run
        On the cpu.

    Raises
    ------
    InputError
        If a file is missing, damaged or changed, or belongs to another run or format.
    """
    folder = Path(folder)
    if folder.is_file():
        refuse_weights(folder)
        raise InputError(f"{folder}: is a file, and no run; {_remedy_of_a_file(folder)}")
    if not (folder / "model.pt").is_file():
        what = "no model.pt in this folder" if folder.is_dir() else "no such folder"
        raise InputError(f"{folder}: {what}; give the folder that `herglotz fit --out` wrote")
    contents = _bound(folder)
    path = folder / "model.pt"
    try:
        stored = torch.load(BytesIO(contents["model.pt"]), weights_only=True)
    # torch raises many kinds of errors for a damaged file.
    except Exception as error:
        raise InputError(f"{path}: cannot be read ({type(error).__name__}); {REMEDY}") from None
    check_entries(StoredModel, stored, str(path), REMEDY)
    if stored["format"] != FORMAT:
        raise InputError(f"{path}: is of format {stored['format']}, not {FORMAT}; {REMEDY}")
    settings = _json(folder / "config.json", contents["config.json"])
    reading = reading_in(settings, str(folder / "config.json"))
    metrics = _json(folder / "metrics.json", contents["metrics.json"])
    check_entries(Metrics, metrics, str(folder / "metrics.json"), REMEDY)
    try:
        config = FitConfig.from_dict({**settings, "device": "cpu"})
        model = ContactLagrangian(ModelConfig.from_dict(stored["model"])).to(config.torch_dtype)
        model.load_state_dict(stored["parameters"])
        states = State(**stored["states"])
    # Settings or parameters may be those of another version.
    except (InputError, RuntimeError, TypeError) as error:
        line = " ".join(str(error).split())
        raise InputError(f"{folder}: its settings and parameters are of no model ({line[:200]}); {REMEDY}") from None
    data = trajectories_of(contents["fit.npz"], folder / "fit.npz")
    run = Run(
        model, config, metrics, data, tuple(stored["train_lengths"]), states, float(stored["h"]), stored["box"],
        stored["history"], reading,
    )  # fmt: skip
    _check_sizes(run, stored["data_digest"], folder)
    return run


def _remedy_of_a_file(path: Path) -> str:
    """What to do with a file that was given in place of the folder of a run."""
    if path.suffix.lower() in {form.ending for form in FORMATS.values()}:
        return f"a model that was exported is opened by herglotz.export.load_exported, and by herglotz verify {path}"
    return f"fit data first: herglotz fit {path} --out RUN"


def _bound(folder: Path) -> dict[str, bytes]:
    """Contents of the four files, checked against the sha256 in the manifest."""
    path = folder / MANIFEST
    if not path.is_file():
        raise InputError(
            f"{folder}: has no {MANIFEST}: the fit was interrupted while it was written (the same command with "
            "--resume writes it again), or is of an older version of herglotz (fit again)"
        )
    manifest = _json(path, read_bytes(path))
    check_entries(Manifest, manifest, str(path), REMEDY)
    if manifest["format"] > FORMAT:
        raise InputError(
            f"{folder}: is of format {manifest['format']}, written by herglotz {manifest['herglotz']}; this version "
            f"reads formats up to {FORMAT}: install that one or a later one"
        )
    contents = {}
    for name in FILES:
        contents[name] = read_bytes(folder / name)
        if hashlib.sha256(contents[name]).hexdigest() != manifest["files"].get(name):
            raise InputError(
                f"{folder / name}: is not the file that this run wrote ({MANIFEST} has another sha256): it was damaged "
                f"or changed, or is of another run; {REMEDY}"
            )
    return contents


def _check_sizes(run: Run, digest: str, folder: Path) -> None:
    """Refuse states, lengths, box, outlier samples, zeros of sensors and data that do not fit together."""
    N, n, path = run.data.samples, run.model.config.dof, folder / "model.pt"
    shapes = {"q": (N, n), "p": (N, n), "s": (N,)}
    bad = [name for name, x in run.states._asdict().items() if tuple(x.shape) != shapes[name]]
    if bad or run.data.dof != n or run.data.digest() != digest:
        raise InputError(f"{path}: states or data are not those of the fit in {folder / 'fit.npz'}; {REMEDY}")
    trained = run.train_lengths
    if len(trained) != len(run.data) or not all(0 <= a <= b for a, b in zip(trained, run.data.lengths, strict=True)):
        raise InputError(f"{path}: train_lengths {trained} do not fit the data's lengths {run.data.lengths}; {REMEDY}")
    sizes = {f"{name}_{end}": 1 if name == "s" else n for name in "qps" for end in ("low", "high")}
    if {name: len(x) for name, x in run.box.items()} != sizes or not run.h > 0:
        raise InputError(f"{path}: box and h are not those of a model with dof {n}; {REMEDY}")
    outliers, zeros = run.metrics.get("outlier_samples", ()), run.metrics.get("plan", {}).get("zeros", ())
    if not all(0 <= k < N for k in outliers) or len(zeros) not in (0, len(run.data) * n):
        what = "outlier_samples or the plan's zeros are not those of the run's data"
        raise InputError(f"{folder / 'metrics.json'}: {what}; {REMEDY}")


def _log(history: list[dict[str, Any]]) -> bytes:
    """Stage, iteration and cost as csv."""
    buffer = StringIO()
    writer = csv.DictWriter(buffer, ["stage", "iteration", "cost"], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(history)
    return buffer.getvalue().encode()


def _finite(values: Any) -> Any:
    """The same without numbers that JSON has not: None in the place of each, which says that it is not known."""
    if isinstance(values, Mapping):
        return {name: _finite(x) for name, x in values.items()}
    if isinstance(values, list | tuple):
        return [_finite(x) for x in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def _json_bytes(values: dict[str, Any]) -> bytes:
    return (json.dumps(values, indent=2, allow_nan=False) + "\n").encode()


def _json(path: Path, content: bytes) -> dict[str, Any]:
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {REMEDY}") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: must hold named entries, got a {type(values).__name__}; {REMEDY}")
    return values


class Reading(TypedDict, total=False):
    """Options of reading a recording: those of `herglotz.data.load`, then those of `herglotz fit`."""

    time: str
    group: str
    coordinates: str | list[str]
    inputs: str | list[str]
    drop: str | list[str]
    angles: str | list[str]
    degrees: str | list[str]
    polar: str | list[str]
    input_terms: str | list[str]
    sensor_zeros: list[float]
    sensor_scales: list[float]
    hold: Literal["zero", "first", "smooth"]
    every: int


def reading_in(settings: dict[str, Any], where: str) -> dict[str, Any]:
    """Remove the options of reading from the settings in config.json and return them; {} if there are none.

    Raise InputError if an entry is unknown or has a wrong type.
    """
    reading = settings.pop("reading", {})
    check_entries(Reading, reading, f"{where}: reading", REMEDY)
    unknown = ", ".join(sorted(set(reading) - set(Reading.__annotations__)))
    refuse({f"{where}: reading has no {unknown}; {REMEDY}": unknown})
    return reading


def reading_told(options: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """The options of `as_trajectories` that apply to a file: names and numbers, no arrays of times.

    `names` are the coordinates of the data, to which `angles=True` refers.
    """
    plain = {name: list(x) if np.ndim(x) == 1 else x for name, x in options.items()}
    if isinstance(angles := plain.get("angles"), bool):
        plain["angles"] = list(names) if angles else []
    for sensor in {"sensor_zeros", "sensor_scales"} & plain.keys():
        plain[sensor] = [float(x) for x in np.atleast_1d(plain[sensor])]
    return {name: plain[name] for name, hint in get_type_hints(Reading).items() if matches(plain.get(name), hint)}
