"""Named friction forces of one joint: |v| v, v³, q² v, and so on, with a learned coefficient each.

The text of one is a product: a power of a length's position if any, |v|, and a power of the joint's own speed:

    |v1| v1        v2^3        q1^2 v1        q1^2 |v1| v1        load 2

`load 2` is a constant force on coordinate 2: on an angle no potential has it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from herglotz.errors import InputError, refuse
from herglotz.mechanics import Forces
from herglotz.models.term import with_force

HIGHEST = 9  # power of a speed or a position
_TEXT = re.compile(
    r"(?:q(?P<q>\d+)(?:\^(?P<a>\d+))? )?(?:\|v(?P<w>\d+)\| )?v(?P<v>\d+)(?:\^(?P<c>\d+))?|load (?P<load>\d+)"
)


@dataclass(frozen=True)
class DragFeature:
    """q_at^a |v_on|^b v_on^c, which brakes the coordinate `on`."""

    on: int
    at: int
    a: int
    b: int  # 0 or 1
    c: int  # 1 or more; 0: a constant force


def parse_drag(text: str, angles: Sequence[bool]) -> DragFeature:
    """Read the text of a friction force.

    Raises
    ------
    InputError
        If it is none, or names a coordinate that the model has not.
    """
    match, n = _TEXT.fullmatch(" ".join(text.split())), len(angles)
    if match is None:
        raise InputError(f"drag '{text}': write '|v1| v1', 'v1^3', 'q1^2 v1' or 'load 1'")
    number = {name: int(digits) for name, digits in match.groupdict().items() if digits}
    on = number["v" if "v" in number else "load"]
    at, c = number.get("q", on), 0 if "load" in number else number.get("c", 1)
    a = number.get("a", 1) if "q" in number else 0
    powers = "v" not in number or (a <= HIGHEST and 1 <= c <= HIGHEST)
    refuse({
        f"drag '{text}': the coordinates are numbered 1 … {n}": not (1 <= on <= n and 1 <= at <= n),
        f"drag '{text}': |v| and v are the speed of one joint; write '|v{on}| v{on}'": number.get("w", on) != on,
        f"drag '{text}': a power of an angle is not periodic; leave q{at} out": a and any(angles[at - 1 : at]),
        f"drag '{text}': powers are whole numbers from 1 to {HIGHEST}": not powers,
    })  # fmt: skip
    return DragFeature(on - 1, at - 1, a, int("w" in number), c)


class Drag(nn.Module):
    """f_i = −Σ_g θ_g q̄_j^a |v_i|^b v_i^c of each joint i, with F⁻ = c (h/2) f, F⁺ = (h/2) f, v = Δ/h.

    The coefficients θ are plain parameters that start at 0; van der Pol's oscillator has viscous friction of negative
    sign and one of q² v.
    """

    def __init__(self, features: Sequence[DragFeature], dof: int):
        super().__init__()
        self.features = tuple(features)
        self.coefficient = nn.Parameter(torch.zeros(len(features), dtype=torch.float64))
        eye = torch.eye(dof, dtype=torch.float64)
        for name, rows in (("on", [f.on for f in features]), ("at", [f.at for f in features])):
            self.register_buffer(name, eye[rows], persistent=False)
        self.on: Tensor
        self.at: Tensor

    def terms(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return φ_g and its slopes by q̄_j and v_i, each (..., G)."""
        x, y = q @ self.at.T, v @ self.on.T
        columns = []
        for g, f in enumerate(self.features):
            at, speed = x[..., g], y[..., g]
            own = speed.abs() if f.b else torch.ones_like(speed)
            position, slope = _power(at, f.a), _power(at, f.a - 1) * f.a
            bend = own * _power(speed, f.c - 1) * (f.b + f.c)
            grip = own * _power(speed, f.c)
            columns.append((position * grip, slope * grip, position * bend))
        value, by_q, by_v = (torch.stack(x, -1) for x in zip(*columns, strict=True))
        return value, by_q, by_v

    def forward(self, q: Tensor, v: Tensor, c: Tensor, h: Tensor, own: Forces) -> Forces:
        """Return `own` plus these forces at the mean position q and the velocity v, with derivatives if it has them."""
        value, by_q, by_v = (x * self.coefficient for x in self.terms(q, v))
        slope, by_position = -torch.diag_embed(by_v @ self.on), -(self.on.T @ (by_q[..., None] * self.at))
        return with_force(own, -value @ self.on, slope, c, h, by_position)


def _power(x: Tensor, k: int) -> Tensor:
    """x^k by multiplication: the forward derivative of `pow` takes the logarithm of negative numbers."""
    out = torch.ones_like(x)
    for _ in range(k):
        out = out * x
    return out
