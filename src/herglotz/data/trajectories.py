"""`Trajectories`: a ragged set of sampled motions; steps may be irregular and samples missing."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from herglotz.data.checks import ARRAYS, DTYPES, as_columns, as_tensor, check, check_alike, offsets_of, unnamed
from herglotz.data.column_roles import is_angular, is_torque
from herglotz.data.holds import Arrival, check_arrival, interpolated, interpolated_input, last_read
from herglotz.data.splits import every_mth, inputs_of_kept, liveliest_rows, time_split
from herglotz.data.windows import Steps, Triples, triples, unwrap
from herglotz.errors import check_coordinates, refuse

# Stands in place of a unit that is missing in the header, or wrong.
TAKEN_FOR_DEGREES = "taken for deg"
# German for degrees, and the name of a four-hundredth of a turn elsewhere.
GRAD = "grad"
DEGREES = ("deg", "°", "degree", "degrees", "Grad", GRAD, "degrés", "grados", "gradi", TAKEN_FOR_DEGREES)
# A step longer than this many typical (median) steps is a gap.
GAP = 1.5
# Standard deviation of the steps over their median: the clocks of loggers stay below 0.02.
IRREGULAR = 0.05
# Role of a column of u that was computed from a recorded input.
INPUT_TERM = "input term"
# Begins a note that is printed outside of the table, too.
WARNING = "warning: "


@dataclass(frozen=True, eq=False, repr=False)
class Trajectories:
    """B trajectories of n coordinates, stored one after the other; N samples in all. `of` fills in defaults.

    Construction checks: finite values, increasing time, three samples each, shapes, one floating dtype.

    Parameters
    ----------
    t, q, lengths, names, units, angles
        (N,) time, (N, n) position, samples of each trajectory; of the coordinates names, units ("rad", "m", "1", ...),
        and which are angles, 2π-periodic and in "rad".
    s, p, u, v
        (N,) action and (N, n) momentum, as in `herglotz.State`, (N, m) control input and (N, n) velocity of a model, in
        units of the recording, where they are known.
    observed
        (N, n) dimensionless weight of each position in a fit: 0 for a missing position, which q interpolates, else 1;
        None: no position is missing.
    recordings
        Name of each trajectory where it has one, a file or a value of the column that groups rows; () for none.
    time_unit, source, columns, notes
        Unit of t; file or scene of origin, for messages; name, role and unit of each column of a table, as read; notes
        on the reading.
    hold, delay, lag
        The input between samples (`herglotz.data.holds`), "" if unspecified; the delay and the time constant of the
        actuator (`herglotz.data.driving`), in the unit of t: None if unspecified, 0: u itself acts.

    Raises
    ------
    InputError
        Naming the field, the trajectory, the sample and the remedy.
    """

    t: Tensor  # (N,)
    q: Tensor  # (N, n)
    lengths: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[bool, ...]
    s: Tensor | None = None  # (N,)
    p: Tensor | None = None  # (N, n)
    u: Tensor | None = None  # (N, m)
    time_unit: str = "s"
    source: str = ""
    hold: str = ""
    delay: float | None = None
    lag: float | None = None
    columns: tuple[tuple[str, str, str], ...] = ()
    notes: tuple[str, ...] = ()
    v: Tensor | None = None  # (N, n)
    observed: Tensor | None = None  # (N, n)
    recordings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_arrival(self.source or "trajectories", self.arrival)
        check(self)

    @classmethod
    def of(
        cls,
        t: Tensor | np.ndarray | Sequence,
        q: Tensor | np.ndarray | Sequence,
        lengths: Sequence[int] | Tensor | np.ndarray | None = None,
        *,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        angles: Sequence[bool] | None = None,
        s: Tensor | np.ndarray | None = None,
        p: Tensor | np.ndarray | None = None,
        u: Tensor | np.ndarray | None = None,
        v: Tensor | np.ndarray | None = None,
        observed: Tensor | np.ndarray | None = None,
        time_unit: str = "s",
        source: str = "",
        hold: str = "",
        delay: float | None = None,
        lag: float | None = None,
        columns: tuple[tuple[str, str, str], ...] = (),
        recordings: Sequence[str] = (),
    ) -> Trajectories:
        """Build a set from tensors, arrays or lists, with defaults for the rest.

        Arrays and lists become float64; tensors keep their dtype. `q`, `p`, `v`, `u` and `observed` (N,) become (N, 1).
        Defaults: a single trajectory, names q (or q1, q2, ...), unit "rad" for an angle and "1" otherwise, no angles.
        """
        t, points = as_tensor("t", t), as_columns("q", q)
        counts = lengths.tolist() if isinstance(lengths, (Tensor, np.ndarray)) else lengths
        n = points.shape[-1]
        flags = (False,) * n if angles is None else tuple(bool(a) for a in angles)
        return cls(
            t, points, (len(t),) if counts is None else tuple(counts), unnamed(n) if names is None else tuple(names),
            tuple("rad" if a else "1" for a in flags) if units is None else tuple(units), flags,
            None if s is None else as_tensor("s", s), as_columns("p", p), as_columns("u", u), time_unit, source,
            hold, delay, lag, columns, v=as_columns("v", v), observed=as_columns("observed", observed),
            recordings=tuple(recordings),
        )  # fmt: skip

    def __repr__(self) -> str:
        return f"Trajectories({self.summary()})"

    def __len__(self) -> int:
        """Return B, the number of trajectories."""
        return len(self.lengths)

    def __getitem__(self, i: int) -> Trajectories:
        """Return trajectory i alone (negative i counts from the end)."""
        return self.select([range(len(self))[i]])

    def __iter__(self) -> Iterator[Trajectories]:
        return (self[i] for i in range(len(self)))

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return self.q.shape[1]

    @property
    def samples(self) -> int:
        """Number of samples N of all trajectories together."""
        return self.q.shape[0]

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """Row of the concatenation at which each trajectory starts."""
        return offsets_of(self.lengths)

    @cached_property
    def trajectory(self) -> Tensor:
        """Trajectory of every sample, (N,) long."""
        return torch.repeat_interleave(torch.arange(len(self)), torch.tensor(self.lengths)).to(self.t.device)

    def label(self, i: int) -> str:
        """Return the number of a trajectory, and its name if that says more: `trajectory 3 (rec_17.csv)`."""
        number = f"trajectory {i}"
        name = self.recordings[i] if self.recordings else number
        return number if name in ("", number) else f"{number} ({name})"

    @property
    def complete(self) -> Tensor:
        """Whether all positions of a sample were read, (N,) bool."""
        return torch.ones_like(self.t, dtype=torch.bool) if self.observed is None else (self.observed > 0).all(1)

    @property
    def degrees(self) -> tuple[str, ...]:
        """Coordinates that the table had in degrees: they are in rad here, and reported in degrees, too."""
        return tuple(name for name, _, unit in self.columns if unit in DEGREES and name in self.names)

    @property
    def input_labels(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each column of u, as in the table; u, or u1, u2, ..., if no table was read."""
        m = 0 if self.u is None else self.u.shape[1]
        found = tuple((name, unit) for name, role, unit in self.columns if role in ("input", INPUT_TERM))
        return found if len(found) == m else tuple(("u" if m == 1 else f"u{j + 1}", "") for j in range(m))

    @cached_property
    def balance(self) -> Tensor:
        """(n,) size of the motion of each kind of coordinate over the largest: 1 if all have the same unit.

        Errors over the balance can be added up and compared: metres and radians cannot. Coordinates of the same unit
        share a balance, and keep their differences.
        """
        kinds = list(zip(self.units, self.angles, strict=True))
        moved = (self.q - self.q[0]).std(0, correction=0)
        size = torch.stack([moved[[other == kind for other in kinds]].square().mean().sqrt() for kind in kinds])
        size = size / size.max()
        return torch.where(torch.isfinite(size) & (size > 0), size, 1.0)

    def steps(self) -> Steps:
        """Return all N - B steps, each with the trajectory and the row of its start."""
        index = (self.trajectory[1:] == self.trajectory[:-1]).nonzero()[:, 0]
        return Steps(self.t[index + 1] - self.t[index], self.trajectory[index], index)

    def inputs_of_steps(self, row: Tensor | None = None, part: Tensor | None = None) -> Tensor | None:
        """Return the input of each step, between samples by `hold`; None without inputs.

        Parameters
        ----------
        row, part
            (...) sample at which a recorded step starts and where in the step, from 0 to 1; default the middle of the
            step at every sample, (N, m). The last sample of a trajectory, where no step starts, has u itself.
        """
        if self.u is None:
            return None
        row = torch.arange(self.samples, device=self.t.device) if row is None else row
        part = torch.full_like(row, 0.5, dtype=self.t.dtype) if part is None else part
        return interpolated_input(self.hold, self.t, self.u, self.lengths, row, part)

    @property
    def arrival(self) -> Arrival:
        """Hold, delay and lag of the inputs, as recorded."""
        return Arrival(self.hold, self.delay, self.lag)

    def triples(self, max_step: float | None = None) -> Triples:
        """Return all three-sample windows; those with a step longer than `max_step` are left out.

        Angles should be `unwrapped()` first: a jump of 2π between two samples would read as a motion.
        """
        return triples(self.t, self.q, self.trajectory, max_step)

    @property
    def typical_step(self) -> float:
        """Median step."""
        return float(self.steps().h.median())

    @property
    def irregular(self) -> bool:
        """Whether the steps differ by more than the clocks of loggers do, gaps aside."""
        h = self.steps().h
        return float(h[h <= GAP * h.median()].std(correction=0)) > IRREGULAR * self.typical_step

    @property
    def gaps(self) -> int:
        """Number of steps longer than 1.5 typical steps: samples are missing there, unless the steps are irregular."""
        return int((self.steps().h > GAP * self.typical_step).sum())

    def split_time(self, fraction: float) -> tuple[Trajectories, Trajectories]:
        """Cut every trajectory in time: the first `round(fraction * length)` samples train, the others test."""
        (train, train_lengths), (test, test_lengths) = time_split(self.lengths, fraction, self.source)
        device = self.t.device
        return self.rows(train.to(device), train_lengths), self.rows(test.to(device), test_lengths)

    def liveliest(self, most: int) -> Trajectories:
        """Return at most about `most` samples: from evenly chosen trajectories the run of samples that moves most."""
        rows, lengths = liveliest_rows(self.q, self.lengths, most)
        return self if len(rows) == self.samples else self.rows(rows.to(self.t.device), lengths)

    def thinned(self, every: int) -> Trajectories:
        """Return samples 0, m, 2m, … of each trajectory, with inputs averaged over the longer steps.

        If positions are missing, only complete samples and the first sample of each trajectory are counted.

        Raises
        ------
        InputError
            If `every` is not a whole number >= 1, or a trajectory keeps fewer than three samples.
        """
        kept = self.complete
        kept[list(self.offsets)] = True
        counts = [int(own.sum()) for own in kept.split(self.lengths)]
        return self.keep(kept.masked_scatter(kept, every_mth(counts, every).to(kept.device)))

    def keep(self, kept: Tensor) -> Trajectories:
        """Return these samples alone, (N,) bool; steps become longer where samples between are left out.

        A longer step takes the mean of its inputs, weighted by duration. A trajectory without a sample is left out,
        too. Inputs then belong to steps: the hold, if known, is "zero".
        """
        if bool(kept.all()):
            return self
        u = self.inputs_of_steps()
        u = None if u is None else inputs_of_kept(self.t, u, self.lengths, kept)
        counts = tuple(int(own.sum()) for own in kept.split(list(self.lengths)) if own.any())
        return replace(self.rows(kept, counts), u=u, hold="zero" if self.hold else "")

    def select(self, indices: Iterable[int] | Tensor) -> Trajectories:
        """Return these trajectories, in this order; an index may come twice."""
        chosen = [int(i) for i in indices]
        for i in chosen:
            missing = f"{self.source or 'trajectories'}: there is no trajectory {i}; select from 0 to {len(self) - 1}"
            refuse({missing: not 0 <= i < len(self)})
        spans = [torch.arange(self.offsets[i], self.offsets[i] + self.lengths[i]) for i in chosen]
        rows = torch.cat(spans) if spans else torch.arange(0)
        return self.rows(rows.to(self.t.device), tuple(self.lengths[i] for i in chosen))

    @classmethod
    def cat(cls, sets: Iterable[Trajectories]) -> Trajectories:
        """Join sets of the same coordinates, units and optional arrays, after `made_alike`."""
        sets = made_alike(list(sets))
        check_alike(sets)
        present = [name for name in ARRAYS if getattr(sets[0], name) is not None]
        columns = {name: torch.cat([getattr(one, name) for one in sets]) for name in present}
        lengths = tuple(length for one in sets for length in one.lengths)
        source = ", ".join(dict.fromkeys(one.source for one in sets if one.source))
        notes = tuple(dict.fromkeys(note for one in sets for note in one.notes))
        names = [name for one in sets for name in one.recordings or (one.source,) * len(one)]
        recordings = tuple(names) if len(set(names)) > 1 else ()
        return replace(sets[0], **columns, lengths=lengths, source=source, notes=notes, recordings=recordings)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Trajectories:
        """Return the set in another dtype (float32 or float64) or on another device."""
        refuse({f"dtype must be torch.float32 or torch.float64, got {dtype}": dtype not in (None, *DTYPES)})
        return replace(self, **self._map(lambda x: x.to(device=device, dtype=dtype or x.dtype)))

    def unwrapped(self) -> Trajectories:
        """Return the set with every angle continuous: jumps longer than π lose their multiple of 2π.

        The result is wrong where an angle truly turns by more than π between two samples.
        """
        turning = torch.tensor(self.angles, device=self.q.device)
        if not turning.any():
            return self
        q = self.q if self.observed is None else last_read(self.q, self.observed > 0, self.trajectory)
        q = unwrap(q, self.trajectory, turning)
        return replace(self, q=q if self.observed is None else interpolated(self.t, q, self.observed > 0, self.lengths))

    def with_angles(self, angles: str | Iterable[str]) -> Trajectories:
        """Return the set with exactly these coordinates marked as angles; a unit "1" among them becomes "rad"."""
        wanted = (angles,) if isinstance(angles, str) else tuple(angles)
        check_coordinates(self.source, "angles", wanted, self.names)
        flags = tuple(name in wanted for name in self.names)
        units = tuple("rad" if a and unit == "1" else unit for a, unit in zip(flags, self.units, strict=True))
        return replace(self, angles=flags, units=units)

    def digest(self) -> str:
        """Return the sha256 (hex) of values, dtype and labels, without source and device."""
        arrays = {name: x for name in ARRAYS if (x := getattr(self, name)) is not None}
        labels = [self.lengths, self.names, self.units, self.angles, self.time_unit, str(self.t.dtype)]
        labels += [x if name == "hold" else {name: x} for name, x in self.arrival._asdict().items() if x]
        shapes = {name: list(x.shape) for name, x in arrays.items()}
        sha = hashlib.sha256(json.dumps([labels, shapes]).encode())
        for x in arrays.values():
            sha.update(x.detach().cpu().contiguous().numpy().tobytes())
        return sha.hexdigest()

    def summary(self) -> str:
        """Return a line for people: coordinates and inputs, the number of samples, and the steps."""
        coordinates = ", ".join(f"{name} [{unit}]" for name, unit in zip(self.names, self.units, strict=True))
        known = "".join(f", {name}" for name in "sp" if getattr(self, name) is not None)
        known += "".join(f", input {name}" + (f" [{unit}]" if unit else "") for name, unit in self.input_labels)
        plural, unit = "y" if len(self) == 1 else "ies", "" if self.time_unit == "1" else f" {self.time_unit}"
        gaps = f", {self.gaps} gap{'' if self.gaps == 1 else 's'}" if self.gaps else ""
        h = self.steps().h
        irregular = f"irregular steps, {float(h.min()):.3g} to {float(h.max()):.3g}{unit}"
        step = irregular if self.irregular else f"step {self.typical_step:.4g}{unit}{gaps}"
        return (
            f"{self.source or 'trajectories'}: {len(self)} trajector{plural}, {self.samples} samples of "
            f"{coordinates}{known}; {step}"
        )

    def table(self) -> str:
        """Return a line for each column of the table that was read: role, unit, and its conversion; then the notes."""
        rows = [("column", "is taken for", "unit"), *column_rows(self)]
        widths = [max(len(row[k]) for row in rows) for k in range(2)]
        lines = [f"  {a:<{widths[0]}}  {b:<{widths[1]}}  {c}" for a, b, c in rows]
        source = self.source or "table"
        notes = [f"  {note}" for note in self.notes if not note.startswith(WARNING)]
        warnings = [f"{WARNING}{source}: {note[len(WARNING) :]}" for note in self.notes if note.startswith(WARNING)]
        return "\n".join([f"{source}:", *lines, *notes, *warnings])

    def _map(self, change: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        return {name: change(x) for name in ARRAYS if (x := getattr(self, name)) is not None}

    def rows(self, rows: Tensor, lengths: tuple[int, ...]) -> Trajectories:
        """Return these rows of the concatenation, as trajectories of these lengths, each named by its first row."""
        owners = self.trajectory[rows].tolist() if self.recordings else []
        recordings = tuple(self.recordings[owners[k]] for k in offsets_of(lengths)) if owners else ()
        return replace(self, **self._map(lambda x: x[rows]), lengths=lengths, recordings=recordings)


def made_alike(sets: Sequence[Trajectories]) -> list[Trajectories]:
    """The sets, ready to be joined although samples are missing in only some of them.

    A set without `observed` has all its positions. Inputs that go in lines or cubics between samples become the means
    of their steps beside a set that has such means, with the hold "zero" (`Trajectories.keep`).
    """
    if any(one.observed is not None for one in sets):
        sets = [replace(one, observed=torch.ones_like(one.q)) if one.observed is None else one for one in sets]
    if any(one.hold == "zero" for one in sets):
        note = "warning: inputs with hold {} are means of steps, because a recording beside them has hold zero"
        sets = [
            replace(one, u=one.inputs_of_steps(), hold="zero", notes=(*one.notes, note.format(one.hold)))
            if one.hold not in ("", "zero") else one
            for one in sets
        ]  # fmt: skip
    return list(sets)


def of_file(name: str, note: str) -> str:
    """A note on a single file of several."""
    return f"{WARNING}{name}: {note[len(WARNING) :]}" if note.startswith(WARNING) else f"{name}: {note}"


def perhaps_angles(data: Trajectories) -> tuple[str, ...]:
    """Coordinates without a unit that are no angles, although their names or a torque among the inputs say so."""
    turned = any(is_torque(name) for name, _ in data.input_labels)
    every = zip(data.names, data.units, data.angles, strict=True)
    return tuple(name for name, unit, angle in every if unit == "1" and not angle and (turned or is_angular(name)))


def column_rows(data: Trajectories) -> list[tuple[str, str, str]]:
    """Name, final role and final unit of each column of `Trajectories`, in words."""
    now = dict(zip(data.names, zip(data.units, data.angles, strict=True), strict=True))
    asked, rows = perhaps_angles(data), []
    for name, role, unit in data.columns:
        if role == "coordinate" and name in now:
            role = "angle" if now[name][1] else role
            unit = _converted(unit, now[name][0])
            if role == "coordinate" and not unit and name in asked:
                far = float(data.q[:, data.names.index(name)].abs().max()) > 2 * math.pi
                unit = f"- (an angle in {'deg? --degrees' if far else 'rad? --angles'} {name})"
        elif role == "polar":
            role, unit = "angle", "rad"
        elif role == "time":
            unit = _converted(unit, data.time_unit) if unit else f"- (taken for {data.time_unit})"
        rows.append((name, role, unit or "-"))
    return rows


def _converted(unit: str, now: str) -> str:
    """The unit of a column, and the unit after conversion; for a column without a unit the assigned unit."""
    given = "" if now == "1" else now
    return unit if unit == now else f"{unit}, converted to {now}" if unit else given
