"""The metadata of exported files: one description for all formats, written and checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

import torch

import herglotz
from herglotz.data.files import PathLike
from herglotz.data.holds import Arrival, check_arrival
from herglotz.data.trajectories import INPUT_TERM
from herglotz.errors import InputError, refuse
from herglotz.models import ContactLagrangian, OwnLagrangian
from herglotz.schema import check_entries

# The version of the format: 1 held a single step; 2 added rollouts and starts from positions, 3 a step's Jacobian.
FORMAT = 3
# The name of the metadata in a .pt2 archive.
METADATA = "metadata.json"
# The key of the metadata in an ONNX or AOTInductor model.
KEY = "herglotz"
# The programs of an AOTInductor package: our names → names in the package.
AOTI = {"rollout": "model", "init": "init", "legendre": "legendre"}
BOX_KEYS = tuple(f"{name}_{end}" for name in "qps" for end in ("low", "high"))
REMEDY = "export the model again"
# Further functions that a C header may hold, from files of `export/runtime`.
EXTRAS = ("adjoint", "filter")
# Newton's tolerance in machine epsilons of Δ = q1 − q0. The error of Δ enters p divided by h, and adds up.
TOLERANCE = 4


class _Needed(TypedDict):
    """The entries of every file."""

    format: int
    model: dict[str, Any]
    weights_sha256: str
    level: str
    dof: int
    inputs: int
    dtype: Literal["float32", "float64"]
    h: float
    angles: list[bool]
    units: list[str]
    box: dict[str, list[float]] | None
    newton_iterations: int
    newton_tolerance: float


class _State(TypedDict):
    """A state to start from."""

    q: list[float]
    p: list[float]
    s: float


class _Start(_State, total=False):
    """A state to start from and its time."""

    t: float


class _Arrival(TypedDict, total=False):
    """The hold, delay and lag of recorded inputs (`data.holds.Arrival`)."""

    hold: str
    delay: float | None
    lag: float | None


class Metadata(_Needed, total=False):
    """The further entries of some files.

    * input_low, input_high: the range of the inputs that the model was fitted to
    * unrolled: the file is a single step whose iterations follow one another without a loop
    * columns: name, role and unit of each
    * extras: some of `EXTRAS`
    * noise: of a filter, standard deviations of position, momentum and theta, and adaptation
    * parameters: numbers that are set at run time, each with default, low and high
    * between: parameters that move several numbers of the model, each with the values of these numbers at 1
    """

    input_zero: list[float]
    input_low: list[float]
    input_high: list[float]
    h_range: list[float] | None
    names: list[str]
    time_unit: str
    degrees: list[str]
    start: _Start | None
    metrics: dict[str, Any]
    card: str
    arrival: _Arrival
    unrolled: bool
    columns: list[tuple[str, str, str]]
    name: str
    extras: list[str]
    noise: dict[str, Any]
    parameters: dict[str, tuple[float, float | None, float | None]]
    between: dict[str, dict[str, float]]


def describe(
    model: ContactLagrangian,
    h: float,
    box: Mapping[str, Sequence[float]] | None,
    units: Sequence[str],
    newton_iterations: int,
    extra: Mapping[str, Any],
) -> dict[str, Any]:
    """The metadata of a file: plain entries, checked, ready for JSON.

    Raise InputError if h, box, units or further entries are not usable.
    """
    _refuse_unusable(model, h, units, newton_iterations)
    dtype, n = next(model.parameters()).dtype, model.config.dof
    entries: dict[str, Any] = {
        "format": FORMAT,
        "herglotz_version": herglotz.__version__,
        "torch_version": str(torch.__version__),
        "model": model.config.to_dict(),
        "weights_sha256": weights_digest(model),
        "level": model.config.level,
        "dof": n,
        "inputs": model.inputs,
        "input_zero": _input_zero(model),
        "dtype": str(dtype).removeprefix("torch."),
        "h": float(h),
        "units": list(units),
        "angles": list(model.config.angles),
        "box": None if box is None else _box(box, n),
        "newton_iterations": newton_iterations,
        "newton_tolerance": TOLERANCE * torch.finfo(dtype).eps,
    }
    if taken := sorted(set(extra) & set(entries)):
        raise InputError(f"metadata may not replace {', '.join(taken)}; use another name")
    entries.update(extra)
    if (span := entries.get("h_range")) is not None and not (len(span) == 2 and 0 < span[0] <= h <= span[1]):
        given = ", ".join(f"{x:g}" for x in span)
        raise InputError(f"h_range must be (low, high) with 0 < low <= h = {h:g} <= high, got [{given}]")
    return entries


def _refuse_unusable(model: object, h: float, units: Sequence[str], newton_iterations: int) -> None:
    if not isinstance(model, ContactLagrangian | OwnLagrangian):
        name = type(model).__name__
        raise InputError(f"export takes a model, got a {name}; of an L_d of your own, OwnLagrangian(L_d, dof=n)")
    dtype, n = next(model.parameters()).dtype, model.config.dof
    wrong_dtype = dtype not in (torch.float32, torch.float64)
    refuse({
        f"export needs a float32 or float64 model, got {dtype}; convert it with .double()": wrong_dtype,
        f"h must be a finite number > 0, got {h}": not 0 < float(h) < float("inf"),
        f"units needs one entry a coordinate ({n}), got {list(units)}": units and len(units) != n,
        f"newton_iterations must be at least 2, got {newton_iterations}; 30 suits most models": newton_iterations < 2,
    })  # fmt: skip


def input_labels(entries: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and unit of each input, as in the table that was fitted; u1, u2, ..., without a unit, if none is known."""
    found = [(name, unit) for name, role, unit in entries.get("columns") or () if role in ("input", INPUT_TERM)]
    return found if len(found) == entries["inputs"] else [(f"u{j + 1}", "") for j in range(entries["inputs"])]


def _input_zero(model: ContactLagrangian) -> list[float]:
    """The inputs at which no force acts."""
    zero = getattr(model.friction, "input_zero", None)
    return [0.0] * model.inputs if zero is None else zero.detach().double().tolist()


def weights_digest(model: torch.nn.Module) -> str:
    """The sha256 (hex) of names, dtypes, shapes and values of a module's state."""
    sha = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        sha.update(f"{name} {value.dtype} {tuple(value.shape)};".encode())
        sha.update(value.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()


def to_json(entries: Mapping[str, Any]) -> str:
    """The entries as text; raise InputError if an entry is not a plain finite number, text, list or dictionary."""
    try:
        return json.dumps(entries, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"metadata cannot be written as JSON ({error}); use plain finite numbers and text") from None


def from_json(text: str | None, path: PathLike) -> dict[str, Any]:
    """The entries of a file that one of the exporters wrote.

    Raise InputError if the text is not such metadata, or of another format version.
    """
    try:
        entries = json.loads(text or "")
    except (ValueError, RecursionError):
        # No JSON, a number of thousands of digits, or brackets nested thousands deep.
        entries = None
    if not isinstance(entries, dict) or "format" not in entries:
        raise InputError(f"{path}: has no herglotz metadata; write it with herglotz.export")
    check_metadata(entries, path)
    return entries


def check_metadata(entries: dict[str, Any], path: PathLike) -> None:
    """Refuse the metadata of another format version, and impossible entries."""
    if entries["format"] != FORMAT:
        raise InputError(
            f"{path}: is of format {entries['format']}, this herglotz reads {FORMAT}; export the model again"
        )
    check_entries(Metadata, entries, f"{path}: metadata", REMEDY)
    n, where = entries["dof"], f"{path}: metadata"
    span, start, arrival = entries.get("h_range"), entries.get("start"), entries.get("arrival", {})
    good = {
        "dof": n >= 1,
        "h": 0 < entries["h"] < float("inf"),
        # An int of C holds the number of inputs.
        "inputs": 0 <= entries["inputs"] < 2**31,
        "angles": len(entries["angles"]) == n,
        "units": len(entries["units"]) in (0, n),
        "names": len(entries.get("names") or ()) in (0, n),
        "input_zero": len(entries.get("input_zero") or ()) in (0, entries["inputs"]),
        "h_range": span is None or (len(span) == 2 and 0 <= span[0] <= span[1]),
        "start": start is None or len(start["q"]) == len(start["p"]) == n,
        "arrival": set(arrival) <= set(Arrival._fields),
        "extras": set(entries.get("extras", ())) <= set(EXTRAS),
    }
    wrong = [name for name, fine in good.items() if not fine]
    if wrong:
        raise InputError(f"{where}: {wrong[0]} cannot be {entries.get(wrong[0])} with dof {n}; {REMEDY}")
    check_arrival(f"{where}: arrival", Arrival(**arrival))
    if entries["box"] is not None:
        _box(entries["box"], n)


def _box(box: Mapping[str, Sequence[float]], dof: int) -> dict[str, list[float]]:
    """The box with plain numbers, checked: q and p have n entries each, s has 1, and low ≤ high."""
    if set(box) != set(BOX_KEYS):
        raise InputError(f"box needs exactly the keys {', '.join(BOX_KEYS)}; got {', '.join(sorted(box)) or 'none'}")
    plain = {key: [float(x) for x in torch.as_tensor(box[key], dtype=torch.float64).reshape(-1)] for key in BOX_KEYS}
    for key, values in plain.items():
        size = 1 if key.startswith("s") else dof
        if len(values) != size:
            raise InputError(f"box {key} needs {size} numbers, got {values}")
    for name in "qps":
        low, high = plain[f"{name}_low"], plain[f"{name}_high"]
        if not all(a <= b for a, b in zip(low, high, strict=True)):
            raise InputError(f"box {name}_low must not exceed {name}_high, got {low} and {high}")
    return plain
