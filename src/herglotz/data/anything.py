"""Recordings in the form in which the user has them: files, DataFrames, dicts, Series, arrays, lists of these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Number
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.csv_columns import Names, Wanted, as_names, name_and_unit
from herglotz.data.extra_formats import Table
from herglotz.data.gaps import parted, with_missing
from herglotz.data.polar import named_by
from herglotz.data.readers import angles_like, as_told, load, with_angles
from herglotz.data.sensors import calibrated
from herglotz.data.simulate import OF_AN_L_D
from herglotz.data.table import from_frame, plain, seconds
from herglotz.data.trajectories import Trajectories
from herglotz.data.units import in_radians_and_seconds
from herglotz.errors import InputError, refuse
from herglotz.telling import tell

TRANSPOSED = 4  # times as many coordinates as samples: chains that are recorded so shortly tell nothing
AS_THEY_ARE = Wanted(coordinates=())  # coordinates of arrays, which no header names
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
    """Make trajectories of a path, a DataFrame, a Series, an array (N,) or (N, n), or a list of any of them.

    A dict of columns or a structured array is read like a DataFrame, and what each column was taken for is printed on
    stderr, as by `load`. A list holds one recording an entry, unless its entries are numbers: that is one recording of
    one coordinate. Angles come unwrapped, as from `load`. A Series takes its times from its index, unless `h` or `time`
    gives them; the index of a DataFrame is a column, unless it merely counts the rows.

    Parameters
    ----------
    data
        One of these, or `Trajectories`.
    h
        Time between the samples of arrays, in s or the unit of your choice: the model has the same.
    time
        Of a table the name of its column; of an array the times (N,): numbers, dates or durations.
    coordinates
        Of a table the columns; of an array what to call its columns, `name` or `name[unit]`.
    inputs
        Of a table the columns, () for none; of an array the inputs (N,) or (N, m).
    drop, group
        Columns of a table that are left aside; the column that numbers its trajectories.
    angles
        Coordinates that are angles in rad; True for all, () for none; left out: those in rad or deg.
    degrees, polar, input_terms
        Coordinates in degrees whose header does not say so; pairs of positions that become one angle each; terms of
        inputs that act beside them: as in `load`.
    sensor_zeros, sensor_scales
        q = scale · (reading − zero), zeros in the units of the readings: n numbers, or n for each recording; None or ()
        for none.
    like
        Another recording: columns of a table that have its names mean the same.

    Returns
    -------
    Trajectories
        In float64, times in s; coordinates in deg became rad.

    Raises
    ------
    InputError
        If arrays come without times, or as `load` and `read_csv` do.
    """
    names = _lists({"coordinates": coordinates, "inputs": inputs, "drop": drop, "group": group})
    coordinates, data = names["coordinates"], _by_field(data)
    meant = {"angles": angles, "degrees": degrees, "polar": polar, "input_terms": input_terms}
    refuse({f"a function is no recording; {OF_AN_L_D}": isinstance(data, FunctionType)})
    if isinstance(data, Trajectories):
        wrong = (
            "trajectories have their columns already; angles, degrees, polar, input_terms and sensors alone change them"
        )
        refuse({wrong: drop or any(x is not None for x in (h, time, coordinates, inputs, group))})
        found = data
    elif isinstance(data, (str, Path)):
        columns = {k: v for k, v in {"time": time, **names}.items() if v is not None}
        sensors = {"sensor_zeros": sensor_zeros, "sensor_scales": sensor_scales}
        return _shown(load(data, like=like, show=False, **meant, **sensors, **columns))
    elif hasattr(data, "columns") and h is not None:
        found = _array(np.asarray(data), h, time, {**names, "coordinates": coordinates or [*map(str, data.columns)]})
    elif hasattr(data, "columns") or isinstance(data, Mapping):
        wanted = Wanted(time, **names, known=() if like is None else like.columns, positions=named_by(polar))
        found = as_told(_table(data, wanted), wanted, **meant, like=like)
        found = found if like is None else angles_like(found, like)
        return _shown(_marked(calibrated(found, sensor_zeros, sensor_scales), angles))
    elif _is_list_of_recordings(data):
        several = "sensor_scales of several recordings: read each with its own, as_trajectories(one, sensor_scales=...)"
        refuse({several: sensor_scales is not None and len(sensor_scales) > 0})  # its angles are unwrapped by now
        options = {"h": h, "time": time, **names, **meant, "like": like}
        return calibrated(_of_each(data, options), sensor_zeros)
    else:
        found = _array(data, h, time, names)
    if not isinstance(data, Trajectories) or any(x is not None for x in (degrees, polar, input_terms)):
        found = as_told(found, AS_THEY_ARE, **meant, like=like)
    return _noted(_marked(calibrated(found, sensor_zeros, sensor_scales), angles), data)


def split_options(settings: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The options of `as_trajectories` among keyword arguments, and the others."""
    return {k: v for k, v in settings.items() if k in OPTIONS}, {k: v for k, v in settings.items() if k not in OPTIONS}


def _lists(told: dict[str, Any]) -> dict[str, Any]:
    """What is said of columns, with a list for each array or index of names, as a DataFrame's columns are."""
    hold = {role: hasattr(x, "tolist") and np.asarray(x).dtype.kind in "OU" for role, x in told.items()}
    return {role: x.tolist() if hold[role] else x for role, x in told.items()}


def _by_field(data: Any) -> Any:
    """The columns of a structured array, as numpy.genfromtxt makes; all other data as they are."""
    fields = getattr(getattr(data, "dtype", None), "names", None)
    return {name: data[name] for name in fields} if fields else data


def _is_list_of_recordings(data: Any) -> bool:
    if isinstance(data, (np.ndarray, Tensor)):
        return data.ndim == 3
    if _is_series(data):
        return False
    return isinstance(data, Sequence) and len(data) > 0 and not isinstance(data[0], Number)


def _is_series(data: Any) -> bool:
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
    called = names["coordinates"]
    if _is_series(data) and getattr(data, "name", None) is not None:
        called = called or str(data.name)
    if h is None and time is None and _is_series(data) and type(data.index).__name__ != "RangeIndex":
        time = data.index
    q = torch.from_numpy(_floats("positions", data))
    _check_array(
        q, called, timeless=(h is None) == (time is None), of_tables=names["group"] is not None or names["drop"]
    )
    n = len(q)
    clock = time if time is None or isinstance(time, Tensor) else seconds(plain(time))
    t = np.arange(n) * float(h) if h is not None else _floats("time", clock)
    u = None if names["inputs"] is None else _floats("inputs", names["inputs"])
    missing = q.isnan().reshape(n, -1)
    known = int((~missing.any(1)).sum())
    refuse({f"array: {known} of its {n} samples have a value, {MIN_SAMPLES} are needed": known < MIN_SAMPLES < n})
    found = Trajectories.of(t, q.where(~q.isnan(), 0.0), u=u, source="array", **_labels(called))
    found = with_missing(found, ~missing, lambda k: f"sample {k}") if known < n else found
    return in_radians_and_seconds(found)


def _check_array(q: Tensor, called: Names | None, *, timeless: bool, of_tables: bool) -> None:
    refuse({
        "positions without times: give h, the time between two samples, or time, an array of times": timeless,
        f"positions (N, n) of shape {tuple(q.shape)}: few samples of many coordinates; transpose them, give a list "
        "of recordings, or name every coordinate with coordinates=": (
            q.ndim == 2 and TRANSPOSED * len(q) < q.shape[1] != len(as_names(called or ()))
        ),
        "group and drop are of tables; give a list of arrays, and leave columns out by slicing": of_tables,
    })  # fmt: skip


def _labels(called: Names | None) -> dict[str, Any]:
    """What names of coordinates say, as cells of a header do: `x[m]` is x, in m. Nothing where there are none."""
    if called is None:
        return {}
    heads = [name_and_unit(name) for name in as_names(called)]
    refuse({f"{called!r} names no coordinate; write name or name[unit]": None in heads})
    names, units = zip(*(head for head in heads if head), strict=True)
    units = tuple(unit or "1" for unit in units)
    columns = tuple((name, "coordinate", unit) for name, unit in zip(names, units, strict=True))
    return {"names": names, "units": units, "angles": [unit == "rad" for unit in units], "columns": columns}


def _floats(name: str, x: Any) -> np.ndarray:
    try:
        return np.array(plain(x.detach().cpu() if isinstance(x, Tensor) else x), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not numbers in rows of one length ({error})") from None


def _marked(data: Trajectories, angles: Any) -> Trajectories:
    return parted(data if angles is None else with_angles(data, angles)).unwrapped()


def _noted(found: Trajectories, data: Any) -> Trajectories:
    """The same; notes that were not of the data already are printed."""
    for note in found.notes[len(data.notes) if isinstance(data, Trajectories) else 0 :]:
        tell(f"{found.source or 'trajectories'}: {note}")
    return found


def _shown(data: Trajectories) -> Trajectories:
    """The same; what each column of its table was taken for is printed, after all that was said of the columns."""
    if data.columns:
        tell(data.table())
    return data
