"""Checks of trajectories, of the arrays that make them, and of cells of text; a failure is an `InputError`."""

from __future__ import annotations

import math
import unicodedata
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor

from herglotz.errors import InputError, refuse

ARRAYS = ("t", "q", "s", "p", "u", "v", "observed")
# One discrete Herglotz residual joins q_{k−1}, q_k, q_{k+1}.
MIN_SAMPLES = 3
# Integers up to here are floats of double precision.
EXACT = 2**53
# Between these sizes the cubes and the sums of a million squares neither vanish nor overflow.
SMALLEST, LARGEST = 1e-50, 1e50
DTYPES = (torch.float32, torch.float64)


def unnamed(n: int) -> tuple[str, ...]:
    """Default names of n coordinates: q, or q1, q2, … as a model's features number coordinates."""
    return ("q",) if n == 1 else tuple(f"q{i + 1}" for i in range(n))


def check(data: Any) -> None:
    """Check types, shapes, labels and values of `Trajectories`, in this order.

    InputError names the field, the trajectory and the sample (both counted from 0), the value and the remedy.
    """
    where = data.source or "trajectories"
    arrays = {name: x for name in ARRAYS if (x := getattr(data, name)) is not None}
    _check_tensors(where, arrays)
    _check_shapes(where, arrays)
    _check_lengths(where, data.lengths, len(arrays["t"]))
    _check_labels(where, data, arrays["q"].shape[1])
    offsets = offsets_of(data.lengths)
    for name, x in arrays.items():
        _check_finite(where, offsets, name, x)
    _check_time(where, offsets, arrays["t"])
    if "observed" in arrays:
        _check_observed(where, offsets, arrays["observed"])


def offsets_of(lengths: Sequence[int]) -> tuple[int, ...]:
    """Row of the concatenation at which each trajectory starts."""
    return (0, *accumulate(lengths[:-1]))


def locate(offsets: tuple[int, ...], row: int) -> tuple[int, int]:
    """Return (trajectory, sample) of a row of the concatenation, both counted from 0."""
    trajectory = bisect_right(offsets, row) - 1
    return trajectory, row - offsets[trajectory]


def _check_tensors(where: str, arrays: Mapping[str, Tensor]) -> None:
    t = arrays["t"]
    for name, x in arrays.items():
        if not isinstance(x, Tensor):
            kind = type(x).__name__
            raise InputError(f"{where}: {name} must be a torch.Tensor, got {kind}; use Trajectories.of(...)")
        both = f"{name} is {x.dtype} on {x.device} but t is {t.dtype} on {t.device}; use the same"
        refuse({
            f"{where}: {name} has dtype {x.dtype}; convert it to torch.float64 (or torch.float32)":
                x.dtype not in DTYPES,
            f"{where}: {both}": (x.dtype, x.device) != (t.dtype, t.device),
        })  # fmt: skip


def _check_shapes(where: str, arrays: Mapping[str, Tensor]) -> None:
    t, q = arrays["t"], arrays["q"]
    refuse({f"{where}: t must have shape (N,), got {tuple(t.shape)}; flatten it": t.ndim != 1})
    if q.ndim != 2 or q.shape[0] != len(t) or q.shape[1] < 1:
        raise InputError(f"{where}: q must have shape ({len(t)}, n), one row a sample of t, got {tuple(q.shape)}")
    for name, x in arrays.items():
        shape = {"t": t.shape, "s": t.shape, "u": (len(t), max(1, x.shape[-1]) if x.ndim else 1)}.get(name, q.shape)
        if x.shape != shape:
            wanted = f"({len(t)}, m)" if name == "u" else tuple(shape)
            raise InputError(f"{where}: {name} must have shape {wanted}, got {tuple(x.shape)}")


def check_trajectory(trajectory: int, count: int) -> None:
    """Raise InputError unless `trajectory` is the number of one of `count` trajectories, from 0."""
    if not 0 <= trajectory < count:
        raise InputError(f"there is no trajectory {trajectory}; choose one from 0 to {count - 1}")


def _check_lengths(where: str, lengths: tuple[int, ...], samples: int) -> None:
    refuse({f"{where}: there is no trajectory; give at least one of {MIN_SAMPLES} samples": not lengths})
    for b, length in enumerate(lengths):
        if isinstance(length, bool) or not isinstance(length, int):
            raise InputError(f"{where}: lengths[{b}] is {length!r}, not an int; count the samples of each trajectory")
        has = f"{length} sample{'' if length == 1 else 's'}, at least {MIN_SAMPLES} are needed"
        refuse({f"{where}: trajectory {b} has {has}; leave it out": length < MIN_SAMPLES})
    total = sum(lengths)
    refuse({f"{where}: lengths add up to {total} but t has {samples} samples; correct the lengths": total != samples})


def _check_labels(where: str, labels: Any, n: int) -> None:
    for field in ("names", "units", "angles"):
        entries = getattr(labels, field)
        if len(entries) != n:
            raise InputError(f"{where}: {field} has {len(entries)} entries for {n} coordinates; give one a coordinate")
    names, count = labels.recordings, len(labels.lengths)
    wrong = f"recordings has {len(names)} names for {count} trajectories; give one a trajectory, or none"
    refuse({f"{where}: {wrong}": len(names) not in (0, count)})
    unclear = len(set(labels.names)) != n or not all(labels.names)
    empty = not all(labels.units) or not labels.time_unit
    refuse({
        f"{where}: names {labels.names} must differ and not be empty; rename a coordinate": unclear,
        f"{where}: a unit is empty ({labels.units}, {labels.time_unit!r}); write '1' for none": empty,
    })  # fmt: skip
    for text in (*labels.names, *labels.units, labels.time_unit):
        # Control characters and halves of surrogate pairs can be neither drawn nor written.
        if any(unicodedata.category(x) in ("Cc", "Cs") for x in text):
            raise InputError(f"{where}: {text!r} has control characters or half a character; rename it")
    for name, unit, angle in zip(labels.names, labels.units, labels.angles, strict=True):
        convert = f"the angle {name!r} is in {unit!r}; convert it to radians and give it the unit 'rad'"
        refuse({f"{where}: {convert}": angle and unit != "rad"})


def _check_finite(where: str, offsets: tuple[int, ...], name: str, x: Tensor) -> None:
    if bool(torch.isfinite(x.detach()).all()):
        return
    place = (~torch.isfinite(x.detach())).nonzero()[0].tolist()
    b, k = locate(offsets, place[0])
    column = f"{name}[{place[1]}]" if len(place) > 1 else name
    what = f"{column} of trajectory {b}, sample {k}, is {float(x[tuple(place)])}"
    raise InputError(f"{where}: {what}; delete that sample")


def _check_observed(where: str, offsets: tuple[int, ...], observed: Tensor) -> None:
    for row, i in ((observed != 0) & (observed != 1)).nonzero().tolist():
        b, k = locate(offsets, row)
        what = f"observed[{i}] of trajectory {b}, sample {k}, is {float(observed[row, i])}"
        raise InputError(f"{where}: {what}; write 1 where it was read, else 0")


def check_sizes(where: str, q: Tensor, names: Sequence[str]) -> None:
    """Raise if positions (N, n) are so large or small that their squares, which a fit needs, overflow or vanish."""
    for name, size in zip(names, q.detach().abs().amax(0).tolist(), strict=True):
        if size > LARGEST:
            raise InputError(f"{where}: {name} has a number of {size:.1e}, above {LARGEST:.0e}; use a larger unit")
        if 0.0 < size < SMALLEST:
            raise InputError(f"{where}: all numbers of {name} are below {SMALLEST:.0e}; use a smaller unit")


def _check_time(where: str, offsets: tuple[int, ...], t: Tensor) -> None:
    bad = ~(t.diff() > 0)
    # Time may fall from one trajectory to the next.
    bad[torch.tensor(offsets[1:], dtype=torch.long, device=t.device) - 1] = False
    if not bad.any():
        return
    row = int(bad.nonzero()[0, 0])
    b, k = locate(offsets, row)
    hint = "" if t.dtype == torch.float64 else " (times may coincide in float32: use float64)"
    raise InputError(
        f"{where}: t of trajectory {b} does not increase from sample {k} to {k + 1} ({float(t[row])!r} then "
        f"{float(t[row + 1])!r}); sort the samples or delete one{hint}"
    )


def check_positive(name: str, value: float) -> None:
    """Raise unless `value` is finite and greater than 0."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} must be finite and > 0, got {value}")


def check_alike(sets: Sequence[Any]) -> None:
    """Raise unless the sets can be joined: they have the same coordinates, units and arrays."""
    if not sets:
        raise InputError("cat needs at least one set of trajectories, got none")
    for other in sets[1:]:
        for what in ("names", "units", "angles", "time_unit", "hold", "delay", "lag"):
            one, two = getattr(sets[0], what), getattr(other, what)
            if one != two:
                raise InputError(f"sets with different {what} cannot be joined: {one} and {two}; make them the same")
    for name in ARRAYS:
        arrays = [x for one in sets if (x := getattr(one, name)) is not None]
        if len(arrays) not in (0, len(sets)):
            raise InputError(f"{len(arrays)} of the {len(sets)} sets to join have {name}; drop it or add it to all")
        if len({(x.dtype, x.device, x.shape[1:]) for x in arrays}) > 1:
            raise InputError(f"the sets to join differ in the dtype, device or width of {name}; make them the same")


def as_tensor(name: str, x: Tensor | np.ndarray | Sequence) -> Tensor:
    """A tensor unchanged, any other array of numbers in float64; raise InputError for other objects."""
    if isinstance(x, Tensor):
        return torch.atleast_1d(x)
    try:
        return torch.from_numpy(np.array(x, dtype=np.float64, ndmin=1))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is not an array of numbers ({error}); give a tensor, an array or a list") from error


def as_columns(name: str, x: Tensor | np.ndarray | Sequence | None) -> Any:
    """An array (N,) or (N, n) as (N, n); None stays None."""
    x = None if x is None else as_tensor(name, x)
    return x[:, None] if x is not None and x.ndim == 1 else x


# Characters of a bad cell that a message quotes.
MAX_QUOTED = 40
# What programs write for a missing value.
MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none")


class Unusable(InputError):
    """A recording that is too short or out of order: the other recordings of the set can be used without it."""


def quote(text: str) -> str:
    """Quote a cell for a one-line message: control characters escaped, long text cut."""
    return repr(text if len(text) <= MAX_QUOTED else text[:MAX_QUOTED] + "…")


def number(cell: Any, where: str, remedy: str = "correct or delete the row", if_infinite: str = "") -> float:
    """The finite number in a cell.

    Raise InputError, which begins with `where` (file, row and column) and ends with the remedy, if the cell is blank,
    not a number, NaN, infinite, or an integer that float64 rounds.
    """
    try:
        value = float(cell)
    except (TypeError, ValueError):
        value = None
    text = str(cell)
    shown = quote(text) if isinstance(cell, str) or value is None else text
    # Python reads 1_000 as a number; in a data file the underscore is a mistake.
    if value is None or "_" in text:
        raise InputError(f"{where}: {shown if text else 'a blank cell'} is not a number; {remedy}")
    if abs(value) >= EXACT and text.strip("+-").isdecimal() and int(text) != value:
        raise InputError(f"{where}: {shown} is above 2^53 and would be rounded; subtract the first one from all")
    if not math.isfinite(value):
        raise InputError(f"{where}: {shown} is not finite; {if_infinite or remedy}")
    return value


def numbers_runs(column: np.ndarray, anew: np.ndarray, again: bool = False) -> bool:
    """Whether a column (N,) has a value of its own in each run of rows, most of which have three rows or more.

    `anew` (N - 1,) bool: a run begins at the next row, because time falls there. A value may come `again` in a run
    that is not the next one.
    """
    runs = np.diff(np.flatnonzero(anew), prepend=-1, append=len(anew))
    constant = bool(((column[1:] != column[:-1]) == anew).all())
    return constant and (again or len(np.unique(column)) == len(runs)) and float(np.median(runs)) >= MIN_SAMPLES


def out_of_order(values: np.ndarray, anew: np.ndarray, names: Sequence[str]) -> str:
    """The remedy for times that do not increase where `anew` (N - 1,) is true, and that begin no recordings there.

    A column that changes there and nowhere else numbers the recordings. `names` are those of the columns, time first.
    """
    return numbering(values, anew, names) or (
        "sort the rows, delete one, or number the trajectories in a column 'trajectory' (another name: --group NAME, "
        "group= in Python)"
    )


def numbering(values: np.ndarray, anew: np.ndarray, names: Sequence[str]) -> str:
    """The words on a column that changes wherever `anew` (N - 1,) is true, and nowhere else; "" for no column."""
    found = [name for name, own in zip(names, values.T, strict=True) if numbers_runs(own, anew)]
    if not found:
        return ""
    return f"column '{found[0]}' changes wherever time starts anew: --group {found[0]} (group= in Python)"


def begins_anew(before: np.ndarray, behind: np.ndarray) -> bool:
    """Whether a clock fell back between two runs of increasing times: they are passed twice, or come before all others.

    The runs overlap by as many rows as a recording has at least, in either of them, or all these rows of the second run
    are earlier than the first run. A single wrong stamp overlaps on one side only, and a block of rows in another place
    does not overlap.
    """
    twice = (before >= behind[0]) & (before <= behind[-1]), behind <= before[-1]
    overlap = min(int(rows.sum()) for rows in twice)
    earlier = behind[-1] < before[0] and min(len(before), len(behind)) >= MIN_SAMPLES
    return overlap >= MIN_SAMPLES or bool(earlier)
