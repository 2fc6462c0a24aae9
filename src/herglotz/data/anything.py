"""Recordings in the form that the user has: files, DataFrames, dicts, Series, arrays, lists of these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Number
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.column_roles import name_and_unit
from herglotz.data.csv_columns import Names, Wanted, as_names
from herglotz.data.extra_formats import Table
from herglotz.data.gaps import with_missing
from herglotz.data.marks import without_marks
from herglotz.data.polar import named_by
from herglotz.data.readers import angles_like, as_meant, finished, load
from herglotz.data.sensors import calibrated
from herglotz.data.sheet import from_frame, plain, seconds
from herglotz.data.simulate import OF_AN_L_D
from herglotz.data.trajectories import Trajectories
from herglotz.data.units import in_radians_and_seconds
from herglotz.errors import InputError, refuse, tell

# With more coordinates a sample than this an array is taken for transposed: so few samples determine no model.
MAX_COORDINATES_PER_SAMPLE = 4
# The coordinates of arrays, which no header names.
NO_HEADER = Wanted(coordinates=())
COLUMNS_ARE_FIXED = (
    "trajectories have their columns already; angles, degrees, polar, input_terms and sensors alone change them"
)
OPTIONS = ("h", "time", "coordinates", "inputs", "drop", "group", "angles", "degrees", "polar", "input_terms",
           "sensor_zeros", "sensor_scales")  # fmt: skip


def as_trajectories(
    data: Any,
    *,
    h: float | None = None,
    time: Any = None,
    coordinates: Names | None = None,
    inputs: Any = None,
    drop: Names = (),
    group: str | None = None,
    angles: Names | bool | None = None,
    degrees: Names | None = None,
    polar: Names | None = None,
    input_terms: Names | None = None,
    sensor_zeros: Sequence[float] | None = (),
    sensor_scales: Sequence[float] | None = (),
    like: Trajectories | None = None,
) -> Trajectories:
    """Make trajectories of a path, a DataFrame, a Series, an array (N,) or (N, n), or a list of these.

    A dict of columns or a structured array is read like a DataFrame, and the role of each column is printed on stderr,
    as by `load`. Every entry of a list is a recording; a list of numbers is a single recording of a single coordinate.
    Angles come unwrapped, as from `load`. The index of a Series is the time, unless `h` or `time` is given; the index
    of a DataFrame is a column, unless the index merely counts the rows.

    Parameters
    ----------
    data
        Any of the forms above, or `Trajectories`.
    h
        Time between the samples of arrays, in s or the unit of your choice: the model has the same.
    time
        Of a table the name of the column; of an array the times (N,): numbers, dates or durations.
    coordinates
        Of a table the columns; of an array the names of the columns, `name` or `name[unit]`.
    inputs
        Of a table the columns, () for none; of an array the inputs (N,) or (N, m).
    drop, group
        Of a table the columns that are left aside; the column that numbers the trajectories.
    angles
        Coordinates that are angles in rad; True for all, () for none; left out: those in rad or deg.
    degrees, polar, input_terms, like
        As in `load`.
    sensor_zeros, sensor_scales
        q = scale · (reading − zero), zeros in the units of the readings: n numbers, or n for each recording; None or ()
        for none.

    Returns
    -------
    Trajectories
        In float64, times in s; coordinates in deg became rad.

    Raises
    ------
    InputError
        If arrays come without times, or as `load` and `read_csv` do.
    """
    names: dict[str, Any] = {"coordinates": coordinates, "inputs": inputs, "drop": drop, "group": group}
    # Arrays and indices of names, such as a DataFrame's columns.
    names |= {k: x.tolist() for k, x in names.items() if hasattr(x, "tolist") and np.asarray(x).dtype.kind in "OU"}
    meant = {"angles": angles, "degrees": degrees, "polar": polar, "input_terms": input_terms, "like": like}
    sensors = (sensor_zeros, sensor_scales)
    if fields := getattr(getattr(data, "dtype", None), "names", None):
        # A structured array, as numpy.genfromtxt makes.
        data = {name: data[name] for name in fields}
    refuse({f"a function is no recording; {OF_AN_L_D}": isinstance(data, FunctionType)})
    if isinstance(data, (str, Path)):
        columns = {k: v for k, v in {"time": time, **names}.items() if v is not None}
        return load(data, **meant, sensor_zeros=sensor_zeros, sensor_scales=sensor_scales, **columns)
    if isinstance(data, Trajectories):
        refuse({COLUMNS_ARE_FIXED: drop or any(x is not None for x in (h, time, coordinates, inputs, group))})
        changed = any(x is not None for x in (degrees, polar, input_terms))
        found = as_meant(data, NO_HEADER, **meant) if changed else data
    elif h is None if hasattr(data, "columns") else isinstance(data, Mapping):
        # Named columns with their own time: a dict, or a DataFrame for which no step h is given.
        known: dict[str, Any] = {} if like is None else {"known": like.columns, "known_hold": like.hold}
        wanted = Wanted(time, **names, **known, positions=named_by(polar))
        found = as_meant(_table(data, wanted), wanted, **meant)
        found = finished(found if like is None else angles_like(found, like), angles, *sensors)
        tell(found.table())
        return found.unwrapped()
    elif _is_list_of_recordings(data):
        several = "sensor_scales of several recordings: read each with its own, as_trajectories(one, sensor_scales=...)"
        # The angles of the list are unwrapped when its zeros are subtracted; a scale would have to act before.
        refuse({several: sensor_scales is not None and len(sensor_scales) > 0})
        return calibrated(_of_each(data, {"h": h, "time": time, **names, **meant}), sensor_zeros)
    else:
        found = as_meant(_array(data, h, time, names), NO_HEADER, **meant)
    found = finished(found, angles, *sensors)
    for note in found.notes[len(data.notes) if isinstance(data, Trajectories) else 0 :]:
        tell(f"{found.source or 'trajectories'}: {note}")
    return found.unwrapped()


def split_options(settings: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The options of `as_trajectories` among keyword arguments, and the others."""
    return {k: v for k, v in settings.items() if k in OPTIONS}, {k: v for k, v in settings.items() if k not in OPTIONS}


def _is_list_of_recordings(data: Any) -> bool:
    """Whether data are a list of anything but numbers, or an array (B, N, n)."""
    if isinstance(data, (np.ndarray, Tensor)):
        return data.ndim == 3
    if _is_series(data) or hasattr(data, "columns"):
        return False
    return isinstance(data, Sequence) and len(data) > 0 and not isinstance(data[0], Number)


def _is_series(data: Any) -> bool:
    """Whether data have an index, as a pandas Series; the `index` of a list is a method."""
    return hasattr(data, "index") and not callable(data.index)


def _of_each(data: Any, options: dict[str, Any]) -> Trajectories:
    """The recordings of a list, each read with the same options."""
    time, inputs = options["time"], options["inputs"]
    if len(data) > 1 and (time is not None or inputs is not None) and not isinstance(time, str):
        raise InputError("time and inputs of several arrays: give h, or Trajectories.of(...) for each of them")
    rows = [_floats("positions", one) if isinstance(one, (list, tuple)) else one for one in data]
    return Trajectories.cat([as_trajectories(one, **options) for one in rows])


def _table(data: Any, wanted: Wanted) -> Trajectories:
    """The recordings of a DataFrame or a dict of columns."""
    is_frame = hasattr(data, "columns")
    where = Path("DataFrame" if is_frame else "dict")
    frame = data if is_frame else Table(where, {str(name): plain(x) for name, x in data.items()})
    return in_radians_and_seconds(from_frame(frame, wanted, where))


def _array(data: Any, h: float | None, time: Any, names: dict[str, Any]) -> Trajectories:
    """One recording of an array (N,) or (N, n), of a Series, or of a DataFrame without its own time."""
    called = names["coordinates"]
    if hasattr(data, "columns"):
        data, called = np.asarray(data), called or [*map(str, data.columns)]
    elif _is_series(data):
        own = getattr(data, "name", None)
        called = called or (None if own is None else str(own))
        if h is None and time is None and type(data.index).__name__ != "RangeIndex":
            time = data.index
    q = torch.from_numpy(_floats("positions", data))
    refuse({
        f"{data!r} is no recording; give positions (N,) or (N, n), a table, the path of a file, or a list of these":
            q.ndim == 0 or not q.numel(),
    })  # fmt: skip
    refuse({
        "positions without times: give h, the time between two samples, or time, an array of times":
            (h is None) == (time is None),
        "h is the time between two samples, one number; where steps differ, give time":
            h is not None and np.size(h) != 1,
        f"positions (N, n) of shape {tuple(q.shape)}: few samples of many coordinates; transpose them, give a list "
        "of recordings, or name every coordinate with coordinates=":
            q.ndim == 2 and MAX_COORDINATES_PER_SAMPLE * len(q) < q.shape[1] != len(as_names(called or ())),
        "group and drop are of tables; give a list of arrays, and leave columns out by slicing":
            names["group"] is not None or names["drop"],
    })  # fmt: skip
    n = len(q)
    clock = time if time is None or isinstance(time, Tensor) else seconds(plain(time), lambda k: f"sample {k}")
    t = np.arange(n) * float(h) if h is not None else _floats("time", clock)
    u = None if names["inputs"] is None else _floats("inputs", names["inputs"])
    found = Trajectories.of(t, q.where(~q.isnan(), 0.0), u=u, source="array", **_labels(called))
    readings = [(k, name, False) for k, name in enumerate(found.names, 1)]
    table, marks = without_marks(np.column_stack([found.t, q.reshape(n, -1)]), [""] * n, range(n), readings)
    missing = torch.from_numpy(np.isnan(table[:, 1:]))
    known = int((~missing.any(1)).sum())
    refuse({f"array: {known} of its {n} samples have a value, {MIN_SAMPLES} are needed": known < MIN_SAMPLES < n})
    found = replace(found, notes=(*found.notes, *marks))
    found = with_missing(found, ~missing, lambda k: f"sample {k}") if known < n else found
    return in_radians_and_seconds(found)


def _labels(called: Names | None) -> dict[str, Any]:
    """Names and units from names of coordinates, as from cells of a header: `x[m]` is x, in m. Empty without names."""
    if called is None:
        return {}
    heads = [name_and_unit(name) for name in as_names(called)]
    refuse({f"{called!r} names no coordinate; write name or name[unit]": None in heads})
    names, units = zip(*(head for head in heads if head), strict=True)
    units = tuple(unit or "1" for unit in units)
    columns = tuple((name, "coordinate", unit) for name, unit in zip(names, units, strict=True))
    return {"names": names, "units": units, "angles": [unit == "rad" for unit in units], "columns": columns}


def _floats(name: str, x: Any) -> np.ndarray:
    """Numbers in float64; raise InputError for other objects, and for rows of different lengths."""
    try:
        return np.array(plain(x.detach().cpu() if isinstance(x, Tensor) else x), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not numbers in rows of one length ({error})") from None
