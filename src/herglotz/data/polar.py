"""Positions x, y of bodies on circles, as cameras see them: one angle for each body, also of chains of bodies.

The angle is θ = atan2(x − x_c, −(y − y_c)): 0 towards −y, growing towards +x, so that a body that hangs from the centre
is at 0 where y grows upwards. The distance from the centre may be kept as a second coordinate, r.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data.column_roles import kind_of, name_and_unit
from herglotz.data.csv_columns import is_number
from herglotz.data.gaps import complete
from herglotz.data.noise import AT_THE_NOISE, precision
from herglotz.data.trajectories import Trajectories
from herglotz.errors import check_coordinates, refuse
from herglotz.least_squares import least_squares

# Begins the remedy for a distance that changes.
LENGTH = "if a length changes: "
# Part of the warning of a pair that stays on a circle, by which the warning is found among notes.
CIRCLE = "stay on a circle about"
# Role, in the table of columns, of an angle that was computed from positions.
POLAR = "polar"
# More samples do not change a circle.
MAX_SAMPLES = 4000
# Largest misfit of a circle over the misfit of a straight line: bodies on arms are far below, ellipses above.
ON_A_CIRCLE = 0.1
# Gauss–Newton iterations end when the variance falls by no more than rounding.
MAX_ITERATIONS, MIN_DECREASE = 50, 1 - 1e-12
# Error of an exact circle by rounding, over the radius.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Pair:
    """Two columns that hold the position of a body, and the centre of its circle.

    A sign is −1 if its axis grows the other way, that of the centre's column too. The centre is two columns, two
    numbers in the unit of the columns, or None: to be found. `inherited` marks a centre from another recording;
    `distance`: r is a coordinate too.
    """

    x: str
    y: str
    signs: tuple[float, float] = (1.0, 1.0)
    centre: tuple[str, str] | tuple[float, float] | None = None
    inherited: bool = False
    distance: bool = False

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns of the pair and of its centre."""
        return (self.x, self.y, *(c for c in self.centre or () if isinstance(c, str)))

    def spec(self, centre: Sequence[str | float]) -> str:
        """The pair as text for `polar=`, with this centre."""
        (x, y), ends = self.axes(), map(str, centre)
        return ",".join([x.removeprefix("+"), y.removeprefix("+"), *ends, *["r"] * self.distance])

    def axes(self) -> tuple[str, str]:
        """Both columns with their signs."""
        return ("-+"[self.signs[0] > 0] + self.x, "-+"[self.signs[1] > 0] + self.y)


def pairs_of(polar: str | Sequence[str] | None, like: Trajectories | None = None) -> list[Pair]:
    """The pairs of the user, `x,y` or `x,y,CENTRE_X,CENTRE_Y` each, or the pairs of another recording.

    `x,y,CENTRE_X,CENTRE_Y,r` keeps the distance from the centre, which no circle then shows. Raise InputError if a text
    does not name two columns.
    """
    if polar is None:
        specs = [] if like is None else [unit for _, role, unit in like.columns if role == POLAR]
        return [replace(_pair(text), inherited=True) for text in specs]
    specs = [polar] if isinstance(polar, str) else polar
    return [_pair(text) for text in specs if text.strip().lower() != "none"]


def named_by(polar: str | Sequence[str] | None) -> tuple[str, ...]:
    """All columns that the user names in pairs of positions: these columns are coordinates."""
    return tuple(name for pair in pairs_of(polar) for name in pair.columns)


def _pair(text: str) -> Pair:
    """The pair that a text names; raise InputError if the text is no pair of columns."""
    parts = [part.strip() for part in text.split(",")]
    distance = len(parts) == 5 and parts[-1] == "r"
    parts = parts[: len(parts) - distance]
    signs = tuple(-1.0 if part.startswith("-") else 1.0 for part in parts[:2])
    axes = [name_and_unit(part.removeprefix("-")) for part in parts[:2]]
    how = "write x,y or, with the centre of the circle in numbers or columns, x,y,X,Y; x,y,X,Y,r keeps the distance"
    refuse({f"polar: {text!r} is no pair of columns; {how}": len(parts) not in (2, 4) or None in axes
            or axes[0] == axes[-1]})  # fmt: skip
    x, y = (name for name, _ in filter(None, axes))
    numbers = [is_number(part) and math.isfinite(float(part)) for part in parts[2:]]
    refuse({f"polar: {text!r}: give both numbers of the centre, or both columns": len(set(numbers)) > 1})
    if not numbers:
        return Pair(x, y, signs)  # type: ignore[arg-type]
    own = [part if numbers[0] else part.removeprefix("-") for part in parts[2:]]
    other = [f"-{name}" for name, part, sign in zip(own, parts[2:], signs, strict=True) if name != part and sign > 0]
    refuse({f"polar: {text!r}: {', '.join(other)} of the centre has a sign that its axis has not; an axis that grows "
            "the other way has it at the position": other})  # fmt: skip
    heads = [(name_and_unit(part) or (part, ""))[0] for part in own]
    centre = tuple(map(float, parts[2:])) if numbers[0] else tuple(heads)
    return Pair(x, y, signs, centre, distance=distance)  # type: ignore[arg-type]


def in_polar(data: Trajectories, pairs: Sequence[Pair]) -> Trajectories:
    """The set with an angle in the place of each pair of positions; notes give the centre and the distance.

    A centre that is not given is a fixed point, found by least squares, or the body of an earlier pair: the more
    constant distance decides. The centre of another recording is kept unless a new centre is better by the Bayesian
    information criterion. Raise InputError if a pair does not name coordinates, or momenta are recorded.
    """
    names = {f"{name}_{unit}": name for name, unit in zip(data.names, data.units, strict=True)}
    pairs = [_by_name(pair, names) for pair in pairs if not pair.inherited or set(pair.columns) <= set(data.names)]
    if not pairs:
        return data
    _check(data, pairs)
    weight = torch.ones_like(data.q) if data.observed is None else data.observed
    old = {x: (x, data.q[:, k], data.units[k], data.angles[k], weight[:, k]) for k, x in enumerate(data.names)}
    new: dict[str, tuple[str, Tensor, str, bool, Tensor]] = {}
    bodies: list[tuple[Pair, Tensor]] = []
    rows, notes = [], []
    named = zip(pairs, _names(data, pairs, "theta"), _names(data, pairs, "r"), strict=True)
    for pair, name, radius in named:
        body = _positions(data, pair, (pair.x, pair.y))
        centre, spec, where = _centre(data, pair, body, bodies)
        arm = body - centre
        r = _radii(arm)
        at = f"{pair.x}, {pair.y} is at its centre at t = {float(data.t[int(r.argmin())]):g}, and has no angle there"
        refuse({f"{data.source or 'data'}: {at}; give another centre": bool((r == 0).any())})
        angle = torch.atan2(arm[:, 0], -arm[:, 1])
        # An angle was read if all its positions were read.
        read = torch.stack([old[column][-1] for column in _pair(spec).columns]).prod(0)
        new[pair.x] = (name, angle, "rad", True, read)
        rows.append((name, POLAR, spec))
        notes.append(_note(data, pair, name, where, r[data.complete], angle))
        unit = data.units[data.names.index(pair.x)]
        if pair.distance:
            new[pair.y] = (radius, r, unit, False, read)
            rows.append((radius, "distance", unit))
        else:
            notes += _changes(data, pair, r, read)
        bodies.append((pair, body))
    # A column that is both a position and a centre belongs to the pair of the position.
    angle_of = {column: new[pair.x][0] for pair in pairs for column in pair.columns}
    angle_of |= {column: new[pair.x][0] for pair in pairs for column in (pair.x, pair.y)}
    kept = [new.get(x, old[x]) for x in data.names if x in new or x not in angle_of]
    names, q, units, angles, observed = zip(*kept, strict=True)
    columns = tuple((x, f"of {angle_of[x]}" if x in angle_of else role, unit) for x, role, unit in data.columns)
    return replace(
        data, q=torch.stack(q, 1), observed=None if data.observed is None else torch.stack(observed, 1), v=None,
        names=names, units=units, angles=angles, columns=(*columns, *rows), notes=(*data.notes, *notes),
    )  # fmt: skip


def _by_name(pair: Pair, names: dict[str, str]) -> Pair:
    """The pair with the name of each column that the user gives as its whole cell, `x_m`."""
    centre = pair.centre and tuple(names.get(c, c) if isinstance(c, str) else c for c in pair.centre)
    return replace(pair, x=names.get(pair.x, pair.x), y=names.get(pair.y, pair.y), centre=centre)


def _check(data: Trajectories, pairs: Sequence[Pair]) -> None:
    """Raise unless the pairs name coordinates, each in one unit and each once, of a set without momenta."""
    where = data.source or "data"
    named = [name for pair in pairs for name in (pair.x, pair.y)]
    for pair in pairs:
        check_coordinates(data.source, "polar", pair.columns, data.names)
        units = {data.units[data.names.index(name)] for name in pair.columns}
        refuse({f"{where}: polar: {', '.join(pair.columns)} are not in one unit, but in {', '.join(units)}":
                len(units) > 1})  # fmt: skip
    twice = f"{where}: polar has a column twice, {', '.join(named)}; a position makes one angle"
    momenta = f"{where}: momenta of positions are no momenta of angles; leave them out with --drop"
    refuse({twice: len(set(named)) < len(named), momenta: data.p is not None})


def _positions(data: Trajectories, pair: Pair, names: Iterable[str]) -> Tensor:
    """(N, 2) of two columns, each axis with its sign."""
    columns = [data.q[:, data.names.index(name)] for name in names]
    return torch.stack(columns, 1) * data.q.new_tensor(pair.signs)


def _centre(
    data: Trajectories, pair: Pair, body: Tensor, earlier: Sequence[tuple[Pair, Tensor]]
) -> tuple[Tensor, str, str]:
    """The centre of a body's circle, (2,) or (N, 2), the pair as text for `polar=`, and the centre in words."""
    if pair.centre is not None and isinstance(pair.centre[0], str):
        names = [str(name) for name in pair.centre]
        return _positions(data, pair, names), pair.spec(names), ", ".join(names)
    found: list[tuple[float, Tensor, str, str]] = []
    read = body[data.complete]
    if pair.centre is None or (pair.inherited and not pair.distance):
        fixed = circle(read)
        found.append((_criterion(read - fixed, 2), fixed, *_words(data, pair, fixed)))
    if pair.centre is not None:
        given = body.new_tensor(pair.centre) * body.new_tensor(pair.signs)
        found.append((_criterion(read - given, 0), given, *_words(data, pair, given)))
    else:
        found += [(_criterion((body - other)[data.complete], 0), other, pair.spec((one.x, one.y)), f"{one.x}, {one.y}")
                  for one, other in earlier]  # fmt: skip
    return min(found, key=lambda candidate: candidate[0])[1:]


def _criterion(arm: Tensor, numbers: int) -> float:
    """The Bayesian information criterion of a circle by its radial errors, for this number of fitted coordinates."""
    r = _radii(arm)
    error = float(r.var(correction=0)) + (ROUNDING * float(r.mean())) ** 2
    return len(r) * math.log(max(error, 1e-300)) + numbers * math.log(len(r))


def _words(data: Trajectories, pair: Pair, centre: Tensor) -> tuple[str, str]:
    """The pair with a fixed centre as text for `polar=`, in the signs of the columns, and the centre in words."""
    own = (centre * centre.new_tensor(pair.signs)).tolist()
    return pair.spec([repr(x) for x in own]), f"({own[0]:.4g}, {own[1]:.4g}){_unit(data, pair)}"


def _unit(data: Trajectories, pair: Pair) -> str:
    """The unit of a pair behind a space; "" for plain numbers."""
    return f" {data.units[data.names.index(pair.x)]}".removesuffix(" 1")


def _note(data: Trajectories, pair: Pair, name: str, where: str, r: Tensor, angle: Tensor) -> str:
    """The note on an angle: centre, distance, direction, and the remedy if the body seems to stand upside down."""
    unit, x = _unit(data, pair), pair.axes()[0]
    size = f"{float(r.mean()):.4g}{unit} to within {float(r.std(correction=0)):.2g}{unit}"
    other = replace(pair, signs=(pair.signs[0], -pair.signs[1]))
    centre = pair.centre if pair.centre and not pair.inherited else ()
    over = f"; if {pair.y} grows the other way: --polar {other.spec(centre)}" if float(angle.cos().mean()) < 0 else ""
    zero = f"0 towards {other.axes()[1]}, growing towards {x}{over}"
    return f"{name} is the angle of {pair.x}, {pair.y} about {where}, at {size}; {zero}"


def _changes(data: Trajectories, pair: Pair, r: Tensor, read: Tensor) -> list[str]:
    """A warning if the distances (N,) move by more than their noise; `read` (N,) is 0 where there is none."""
    one = replace(data, q=r[:, None], names=("r",), units=("1",), angles=(False,), v=None,
                  observed=None if data.observed is None else read[:, None])  # fmt: skip
    noise, moved = precision(one), float(r[data.complete].std(correction=0))
    if moved <= max(AT_THE_NOISE * noise, ROUNDING * float(r.mean())):
        return []
    unit, spec = _unit(data, pair), replace(pair, distance=True).spec(pair.centre or ("X", "Y"))
    where = "" if pair.centre else ", with the centre in numbers or columns,"
    return [
        f"warning: the distance of {pair.x}, {pair.y} from the centre changes by {moved:.2g}{unit}, and its noise is "
        f"{noise:.2g}{unit}; {LENGTH}--polar {spec}{where} keeps it as a coordinate r"
    ]


def _names(data: Trajectories, pairs: Sequence[Pair], usual: str) -> list[str]:
    """`theta`, or `theta1`, `theta2`, … for several pairs; extended by the name of x if a coordinate has that name."""
    others = set(data.names) - {name for pair in pairs for name in pair.columns}
    found = [usual] if len(pairs) == 1 else [f"{usual}{k + 1}" for k in range(len(pairs))]
    return [name if name not in others else f"{name}_{pair.x}" for name, pair in zip(found, pairs, strict=True)]


def circle(x: Tensor) -> Tensor:
    """The centre (2,) of the circle of least squares through points (N, 2).

    Start: Taubin's algebraic fit (IEEE PAMI 13:1115, 1991). Then Gauss–Newton iterations on the distances.
    """
    middle = x.mean(0)
    x = x - middle
    size = x.square().sum(1).mean().clamp_min(torch.finfo(x.dtype).tiny)
    z = (x.square().sum(1) - size) / (2 * size.sqrt())
    a, b, c = torch.linalg.svd(torch.column_stack([z, x]), full_matrices=False).Vh[-1].tolist()
    # The scale is 0 for a straight line.
    scale = a / (2 * float(size.sqrt())) or torch.finfo(x.dtype).tiny
    centre = -x.new_tensor([b, c]) / (2 * scale)
    for _ in range(MAX_ITERATIONS):
        moved = centre + _gauss_newton(x - centre)
        if not _variance(x - moved) < MIN_DECREASE * _variance(x - centre):
            break
        centre = moved
    return centre + middle


def _gauss_newton(arm: Tensor) -> Tensor:
    """The step of a centre that minimises the variance of the distances, to first order."""
    r = _radii(arm)[:, None]
    along = arm / r.clamp_min(torch.finfo(arm.dtype).tiny)
    along = along - along.mean(0)
    return least_squares(along.T @ along, along.T @ (r - r.mean()))[:, 0]


def _radii(arm: Tensor) -> Tensor:
    """Distances (N,) of points (N, 2) from 0."""
    return arm.square().sum(1).sqrt()


def _variance(arm: Tensor) -> float:
    """Variance of the distances of points from 0."""
    return float(_radii(arm).var(correction=0))


def with_hints(data: Trajectories, recorded: Trajectories | None = None, pairs: Sequence[Pair] = ()) -> Trajectories:
    """The set with a warning of each pair of positions x, y that stays on a circle: it may be one body on an arm.

    The positions are those of the set as `recorded`, less those of which `pairs` made angles.
    """
    found = [one for one in circles(recorded or data) if {one.pair.x, one.pair.y} <= set(data.names)]
    notes = [f"warning: {hint([one], pairs)}" for one in found]
    return replace(data, notes=(*data.notes, *notes)) if notes else data


class Circle(NamedTuple):
    """A pair of coordinates that stays on a circle.

    `pair` has its centre where this is another pair, `beside` is the circle of that pair if it stays on one. `error` is
    the standard deviation of the distances from the centre, `columns` the places among the coordinates.
    """

    description: str
    pair: Pair
    beside: Circle | None
    error: float
    columns: tuple[int, int]

    def pairs(self) -> list[Pair]:
        """The pair, behind that of its centre."""
        return [*(self.beside.pairs() if self.beside else []), self.pair]


def hint(found: Sequence[Circle], given: Sequence[Pair] = ()) -> str:
    """These circles in words with a remedy, beside the pairs that the user gave."""
    flags, many = remedy(found, given)
    what = (
        f"bodies on arms? {flags} makes one angle of each"
        if many
        else f"one body on an arm? {flags} makes one angle of it"
    )
    return f"{', and '.join(one.description for one in found)}; {what}"


def remedy(found: Sequence[Circle], given: Sequence[Pair] = ()) -> tuple[str, bool]:
    """The flags that make angles of these pairs, beside the pairs that the user gave, and whether there are several."""
    known = {(pair.x, pair.y) for pair in given}
    every = dict.fromkeys(pair for one in found for pair in one.pairs() if (pair.x, pair.y) not in known)
    old, new = (" ".join(f"--polar {pair.spec(pair.centre or ())}" for pair in pairs) for pairs in (given, every))
    return f"{new} (polar= in Python)" + (f" beside {old}" if old else ""), len(every) > 1


def circles(data: Trajectories) -> list[Circle]:
    """The pairs of positions x, y that stay on a circle, about a fixed centre or about an earlier pair."""
    found, earlier, read = {}, [], complete(data)
    for x, y in _pairs_by_name(data):
        pair = Pair(x, y)
        body = _positions(read, pair, (x, y))[:: -(-read.samples // MAX_SAMPLES)]
        fixed = circle(body)
        others = [(other, f"{one.x}, {one.y}", (one.x, one.y)) for one, other in earlier]
        centres = [(fixed, _words(data, pair, fixed)[1], None), *others]
        earlier.append((pair, body))
        centre, where, names = min(centres, key=lambda one: _variance(body - one[0]))
        error = _variance(body - centre) ** 0.5
        line = float(torch.linalg.svdvals(body - body.mean(0))[-1]) / math.sqrt(len(body))
        if error < ON_A_CIRCLE * line:
            r = f"{float(_radii(body - centre).mean()):.4g}{_unit(data, pair)}"
            places = data.names.index(x), data.names.index(y)
            pair, beside = replace(pair, centre=names), None if names is None else found.get(names)
            found[x, y] = Circle(f"{x}, {y} {CIRCLE} {where}, at {r}", pair, beside, error, places)
    return list(found.values())


def _pairs_by_name(data: Trajectories) -> list[tuple[str, str]]:
    """Pairs of coordinates with the same unit whose names differ by x and y alone: x1 and y1, mass_x and mass_y."""
    units = dict(zip(data.names, data.units, strict=True))
    found = []
    for x in data.names:
        if kind_of(units[x]) == "position" or units[x] == "1":
            at = [i for i, letter in enumerate(x) if letter in "xX"]
            swaps = (f"{x[:i]}{'y' if x[i] == 'x' else 'Y'}{x[i + 1 :]}" for i in at)
            found += [(x, y) for y in swaps if units.get(y) == units[x]]
    return found
