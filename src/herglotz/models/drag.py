"""Named forces beside L, with a learned coefficient each: friction |v| v, v³, q² v and so on, and inputs times u cos q.

The text of a force is a product: a power or a wave of a position (optional), |v|, and a power of the same speed v, the
speed of a joint or the relative speed of two joints with a damper between them, where a number before the first speed
says how far it moves for the second one, as a motor moves a belt:

    |v1| v1        v2^3        q1^2 v1        q1^2 |v1| v1        (v1 - v2)        |v1 - v2| (v1 - v2)        load 2
    (20.5 v1 - v2)
    cos(q1) v1     sin(2.5 q2) v1     sin(2.5 v1)     cos(0.8 (v1 - v2))

Dampers that saturate or act on one side are sums of waves of a speed. `load 2` is a constant force on coordinate 2,
which no periodic potential of an angle gives. `|v1|` is the difference of viscous friction between the two directions.
`|v| v` is air drag on a body that moves in a plane or in space: |v| is the length of the whole velocity. Dry friction
that changes with the position, or with the load that a position puts on a bearing, is written as

    q1^2 sgn(v1)        cos(q1) sgn(v1)        sin(q2) sgn(v1)

An input that acts through the position drives the coordinate that it names, or another one, and an input that brakes
has a speed:

    u1 cos(q1)        u2 sin(q1)        u1 q1        u1 sin(q2) on q1        u1 v1        u1^2 v1

A pendulum on a pivot with the horizontal acceleration u1 has −u1 cos(q1)/l, and a force u1 with a fixed direction on a
crank u1 cos(q1). A thruster of a body with the heading q2 pushes the length q1 by u1 sin(q2). A brake by eddy currents
with the current u1 has u1² v.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.errors import InputError, refuse
from herglotz.mechanics import Forces
from herglotz.models.term import with_force

# Highest power of a speed or a position.
MAX_POWER = 9
_NUMBER = r"\d+(?:\.\d*)?(?:e[-+]?\d+)?"
_PLAIN_PAIR = r"v\d+ - v\d+"
_PAIR = rf"(?:-?{_NUMBER} )?{_PLAIN_PAIR}"
_SPEED, _PLAIN_SPEED = (rf"(?:(?P<v>v\d+)|\((?P<pair>{pair})\))" for pair in (_PAIR, _PLAIN_PAIR))
_WAVE = rf"(?P<wave>cos|sin)\((?:(?P<rate>{_NUMBER}) ?)?"
_AT = rf"(?:{_WAVE}q(?P<angle>\d+)\)|q(?P<q>\d+)(?:\^(?P<a>\d+))?)"
_INPUTS = (rf"u(?P<input>\d+) {_AT}(?: on q(?P<on>\d+))?", r"u(?P<input>\d+)(?:\^(?P<power>\d+))? v(?P<on>\d+)")

AIR = "|v| v"


@dataclass(frozen=True)
class DragFeature:
    """q_at^a |v|^b v^c of the speed v: a force that brakes the coordinate `on` and drives `of`.

    v is v_on, or ratio · v_on − v_of with a damper between both. b is 0 or 1, and with b = c = 0 the force is constant.
    A `dry` feature is q_at^a sgn(v). A `wave`, cos or sin, of rate · q_at replaces the power of q_at; with `of_speed`
    the wave of rate · v is the whole feature. `air` is |v| v of the whole velocity, on every coordinate. With an
    `input`, a column of u, −u takes the place of the factors of v: the force drives `on`. With a `power` as well uᵖ v
    takes their place: the force brakes `on`.
    """

    on: int
    at: int
    a: int = 0
    b: int = 0
    c: int = 0
    of: int | None = None
    air: bool = False
    dry: bool = False
    wave: str = ""
    rate: float = 1.0
    of_speed: bool = False
    input: int | None = None
    power: int = 0
    ratio: float = 1.0

    @property
    def even(self) -> bool:
        """Whether the feature is |v|."""
        return (self.b, self.c) == (1, 0)

    def position(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the factor that depends on q_at, and its slope; a wave takes rate · q_at."""
        return self._wave(q) if self.wave and not self.of_speed else (_power(q, self.a), _power(q, self.a - 1) * self.a)

    def speed(self, v: Tensor, width: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the factor that depends on v, and its slope; a wave takes rate · v.

        Dry friction is tanh(v/width), or 0 without a width.
        """
        if self.of_speed:
            return self._wave(v)
        if self.dry:
            rate = 0.0 if width is None else 1 / width
            sign = (v * rate).tanh()
            return sign, (1.0 - sign * sign) * rate
        own = v.abs() if self.b else torch.ones_like(v)
        slope = v.sign() if self.even else own * _power(v, self.c - 1) * (self.b + self.c)
        return own * _power(v, self.c), slope

    def _wave(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the wave at x, and its slope by x."""
        return (x.cos(), -x.sin()) if self.wave == "cos" else (x.sin(), x.cos())


def parse_drag(text: str, angles: Sequence[bool]) -> DragFeature:
    """Read the text of a force.

    Raise InputError if the text is no force, or names a coordinate that the model does not have.
    """
    plain, n = " ".join(text.split()), len(angles)
    if plain == AIR:
        refuse({f"drag '{text}': an angle has no speed through the air; write '|v1| v1'": any(angles)})
        return DragFeature(0, 0, b=1, c=1, air=True)
    f = _read(text, plain)
    # Indices are checked first, because the checks of angles below use them.
    powers = map(int, re.findall(r"\^(\d+)", plain))
    refuse({
        f"drag '{text}': the coordinates are numbered 1 … {n}": not {f.on, f.at, f.of} <= {None, *range(n)},
        f"drag '{text}': v{f.on + 1} is named twice; name two coordinates": f.of == f.on,
        f"drag '{text}': the number before v{f.on + 1} is {f.ratio:g}": not 0 < abs(f.ratio) < math.inf,
        f"drag '{text}': inputs are numbered from 1": f.input == -1,
        f"drag '{text}': powers are whole numbers from 1 to {MAX_POWER}": not all(1 <= k <= MAX_POWER for k in powers),
    })  # fmt: skip
    refuse({
        f"drag '{text}': a power of an angle is not periodic; write 'cos(q{f.at + 1})' instead": angles[f.at] and f.a,
        f"drag '{text}': a wave of an angle is periodic; write a whole number before q{f.at + 1}":
            angles[f.at] and f.rate % 1 and not f.of_speed,
    })  # fmt: skip
    return f


# The parts of a text by name, "" for those that the text does not have, and the whole `text`.
Parts = dict[str, str]


def _read(text: str, plain: str) -> DragFeature:
    """The feature of a text with single blanks, `plain`; messages quote the user's `text`."""
    for pattern, read in _FORMS:
        if match := pattern.fullmatch(plain):
            return read(match.groupdict("") | {"text": text})
    raise InputError(
        f"drag '{text}': write '|v1| v1', 'v1^3', 'q1^2 v1', '(v1 - v2)', '|v| v', 'sin(2.5 v1)', 'load 1', "
        "'cos(q1) sgn(v1)', 'u1 cos(q1)' or 'u1^2 v1'"
    )


def _joints(speed: str) -> dict[str, Any]:
    """The coordinate of a speed, and the second one of a relative speed with the ratio of the first."""
    on, *of = (int(k) - 1 for k in re.findall(r"v(\d+)", speed))
    number = speed.partition("v")[0].strip()
    return {"on": on, "of": of[0] if of else None, "ratio": float(number) if number else 1.0}


def _place(found: Parts) -> dict[str, Any]:
    """The factor of a position."""
    if found["angle"]:
        return {"at": int(found["angle"]) - 1, "wave": found["wave"], "rate": float(found["rate"] or 1)}
    return {"at": int(found["q"]) - 1, "a": int(found["a"] or 1)}


def _power_of_speed(found: Parts) -> DragFeature:
    """A power of a speed, alone or times |v| and a factor of a position."""
    speed = found["v"] or found["pair"]
    if found["size"] not in ("", speed):
        raise InputError(f"drag '{found['text']}': |v| and v are one speed; write '|{speed}|' before it")
    joints = _joints(speed)
    place: dict[str, Any] = _place(found) if found["angle"] or found["q"] else {"at": joints["on"]}
    return DragFeature(**joints, **place, b=int(bool(found["size"])), c=int(found["c"] or 1))


def _wave_of_speed(found: Parts) -> DragFeature:
    """A sine or cosine of a speed."""
    joints = _joints(found["v"] or found["pair"])
    return DragFeature(**joints, at=joints["on"], wave=found["wave"], rate=float(found["rate"] or 1), of_speed=True)


def _of_an_input(found: Parts) -> DragFeature:
    """An input times a factor of a position, on the coordinate of that position or on another one."""
    place = _place(found)
    on = int(found["on"]) - 1 if found["on"] else place["at"]
    return DragFeature(on, **place, input=int(found["input"]) - 1)


def _on_a_joint(found: Parts, **more: Any) -> DragFeature:
    """A feature of the joint `on` with these fields."""
    on = int(found["on"]) - 1
    return DragFeature(on, **{"at": on, **more})


# Each form of a force, and the function that reads the form.
_FORMS: tuple[tuple[re.Pattern[str], Callable[[Parts], DragFeature]], ...] = tuple(
    (re.compile(pattern), read)
    for pattern, read in (
        (rf"(?:{_AT} )?(?:\|(?P<size>v\d+|{_PAIR})\| )?{_SPEED}(?:\^(?P<c>\d+))?", _power_of_speed),
        (rf"{_WAVE}{_PLAIN_SPEED}\)", _wave_of_speed),
        (rf"{_AT} sgn\(v(?P<on>\d+)\)", lambda found: _on_a_joint(found, **_place(found), dry=True)),
        (r"load (?P<on>\d+)", _on_a_joint),
        (r"\|v(?P<on>\d+)\|", lambda found: _on_a_joint(found, b=1)),
        (_INPUTS[0], _of_an_input),
        (_INPUTS[1], lambda x: _on_a_joint(x, input=int(x["input"]) - 1, power=int(x["power"] or 1))),
    )
)


class Drag(nn.Module):
    """f = −Σ_g θ_g e q̄_j^a |v|^b v^c of the speeds v = e·Δ/h, with F⁻ = c (h/2) f and F⁺ = (h/2) f.

    e has 1 at a joint or, for the relative speed of two joints, their ratio and −1 at the second joint; drag through
    air is f = −θ |v| v of the whole velocity. The coefficients θ are plain parameters of either sign that start at 0:
    van der Pol's oscillator has negative viscous friction and the term q² v. The part of dry friction that depends on
    the position is −θ q̄_j^a tanh(v/v_s) with the width v_s of `Friction`; set-valued friction takes the part `held` at
    q0. An input that acts through the position is θ u_k q̄_j^a, or θ u_k cos q̄_j; a potential stands for its sensor's
    zero. An input that brakes is −θ u_kᵖ v.
    """

    def __init__(self, features: Sequence[DragFeature], dof: int):
        super().__init__()
        self.features = tuple(features)
        self.coefficient = nn.Parameter(torch.zeros(len(features), dtype=torch.float64))
        # The last row is 0, for features without a second joint.
        eye = torch.eye(dof + 1, dof, dtype=torch.float64)
        on, of = [f.on for f in features], [f.on if f.air else dof if f.of is None else f.of for f in features]
        self.air, self.dry = ([g for g, f in enumerate(features) if getattr(f, kind)] for kind in ("air", "dry"))
        rate = torch.tensor([f.rate for f in features], dtype=torch.float64)[:, None]
        of_speed = torch.tensor([f.of_speed for f in features])[:, None]
        ratio = torch.tensor([f.ratio for f in features], dtype=torch.float64)[:, None]
        e, place = ratio * eye[on] - eye[of], eye[[f.at for f in features]]
        self.register_buffer("on", e, persistent=False)
        # Rows of `at` give the arguments of factors of the position, rows of `along` those of factors of the speed. The
        # rate of a wave multiplies the row of its argument.
        self.register_buffer("at", torch.where(of_speed, place, rate * place), persistent=False)
        self.register_buffer("along", torch.where(of_speed, rate * e, e), persistent=False)
        self.on: Tensor  # (G, n)
        self.at: Tensor  # (G, n)
        self.along: Tensor  # (G, n)

    def held(self, q0: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return the part of set-valued friction that depends on q0, (..., n), and ∂/∂q0, (..., n, n)."""
        if not self.dry:
            return None
        at, x = self.at[self.dry], q0 @ self.at[self.dry].T
        columns = [self.features[g].position(x[..., k]) for k, g in enumerate(self.dry)]
        value, slope = (torch.stack(y, -1) * self.coefficient[self.dry] for y in zip(*columns, strict=True))
        return value @ self.on[self.dry], self.on[self.dry].T @ (slope[..., None] * at)

    def terms(
        self, q: Tensor, v: Tensor, widths: Tensor | None = None, u: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return φ_g, and its derivatives by the arguments at·q̄ and along·v of its factors, each (..., G).

        Dry terms need the `widths` (n,) of dry friction, and terms of inputs need u (..., m); they are 0 without.
        """
        x, y = q @ self.at.T, v @ self.along.T
        columns = []
        for g, f in enumerate(self.features):
            position, by_q = f.position(x[..., g])
            if f.input is None:
                factor, by_v = f.speed(y[..., g], None if widths is None else widths[f.on])
            else:
                given = torch.zeros_like(position) if u is None else torch.zeros_like(position) + u[..., f.input]
                by_v = _power(given, f.power) if f.power else torch.zeros_like(position)
                factor = by_v * y[..., g] if f.power else -given
            columns.append((position * factor, by_q * factor, position * by_v))
        value, by_q, by_v = (torch.stack(x, -1) for x in zip(*columns, strict=True))
        return value, by_q, by_v

    def forward(
        self, q: Tensor, v: Tensor, c: Tensor, h: Tensor, own: Forces, widths: Tensor | None = None,
        u: Tensor | None = None,
    ) -> Forces:  # fmt: skip
        """Return the forces `own` plus the drag at the mean position q and the velocity v.

        `widths` (n,) are those of smooth dry friction, u (..., m) the inputs. If `own` has derivatives, so has the sum.
        """
        value, by_q, by_v = (x * self.coefficient for x in self.terms(q, v, widths, u))
        slope, by_position = (-(self.on.T @ (x[..., None] * by)) for x, by in ((by_v, self.along), (by_q, self.at)))
        f = -value @ self.on
        if self.air:
            air, air_slope = self._through_air(v)
            f, slope = f + air, slope + air_slope
        return with_force(own, f, slope, c, h, by_position)

    def _through_air(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """−θ |v| v, (..., n), and the slope −θ (|v| I + v vᵀ/|v|), (..., n, n)."""
        theta, eye = self.coefficient[self.air].sum(), torch.eye(v.shape[-1], dtype=v.dtype, device=v.device)
        # With `tiny` the root has a derivative at rest. A smaller addend is 0 in float32, and onnxruntime drops it.
        size = ((v * v).sum(-1, keepdim=True) + torch.finfo(torch.float32).tiny).sqrt()
        slope = size[..., None] * eye + v[..., None] * (v / size)[..., None, :]
        return -theta * size * v, -theta * slope


def input_forces(texts: Iterable[str]) -> tuple[str, ...]:
    """Return those of these texts that are forces of inputs."""
    return tuple(text for text in texts if any(re.fullmatch(form, text) for form in _INPUTS))


def input_columns(terms: Iterable[str]) -> tuple[str, ...]:
    """Return those of these terms of inputs that are functions of the inputs alone, further columns of u."""
    return tuple(term for term in terms if not input_forces([term]))


def _power(x: Tensor, k: int) -> Tensor:
    """x^k by multiplication: the forward derivative of `pow` takes the logarithm of negative numbers."""
    out = torch.ones_like(x)
    for _ in range(k):
        out = out * x
    return out
