"""Explicit steps without friction in ONNX: what a loop has to do is the motion, all else is done once for all steps.

With r = p − h/2 V′(q), the momentum that moves q, x = m⁻¹ r and a = m⁻¹ V′(q1), a step is

    q1 = q + h √c x,    x1 = c x − (h + h₁)/2 a    (h₁ is the step after it),

and behind the loop, for all steps at once,

    p1 = m (c x − h/2 a),    s1 = c s + l,    l = c/2 h √c x·(m x) − h/2 (V(q1) + c V(q)).

s is a sum with factors, joined by doubling (Hillis and Steele, Commun. ACM 29 (1986) 1170): rounding grows with log K.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from herglotz.export.equation import example
from herglotz.export.lean import LeanField
from herglotz.export.onnx_ops import NUMPY, Writer
from herglotz.export.trace import traced
from herglotz.models import ContactLagrangian

MOVED = 3  # of the numbers a step that h decides (`Columns`), those that the loop takes
FIXED = 5
RUN = 16  # terms of s joined one by one


class Columns(nn.Module):
    """h √c, c, (h + h₁)/2, h/2 and c/2 of every step, (R, 5)."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.damping = model.damping

    def forward(self, h: Tensor, after: Tensor) -> Tensor:
        """H and the step after it, (R,)."""
        g = 0.0 * h if self.damping is None else self.damping(h, h, h, 1)
        c = 1.0 + torch.expm1(g)
        return torch.stack([h * (g / 2).exp(), c, (h + after) / 2, h / 2, c / 2], -1)


class Accelerated(nn.Module):
    """m⁻¹ V′ and V at a position."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.field = LeanField(model.potential)
        inverse = torch.linalg.inv_ex(model.kinetic.mass())[0]  # pyright: ignore[reportCallIssue]
        if self.field.features.all:
            self.field.features.fold = self.field.features.fold @ inverse
        else:
            self.inverse = inverse

    def forward(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """(B, n) and (B, 1)."""
        V, slope = self.field(q)
        return slope if self.field.features.all else slope @ self.inverse, V


class Move(nn.Module):
    """One turn of the loop."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.accelerated = Accelerated(model)

    def forward(
        self, q: Tensor, x: Tensor, stretch: Tensor, c: Tensor, mean: Tensor, *lost: Tensor
    ) -> tuple[Tensor, ...]:
        """q1, x1, a, V at q1 and, in float32, what rounding took from q1."""
        move = x * stretch
        if lost:
            move = move + lost[0]
        q1 = q + move
        a, V = self.accelerated(q1)
        return q1, c * x - mean * a, a, V, *((move - (q1 - q),) if lost else ())


class Start(nn.Module):
    """x and V at the start."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.accelerated = Accelerated(model)
        self.inverse = torch.linalg.inv_ex(model.kinetic.mass())[0]  # pyright: ignore[reportCallIssue]

    def forward(self, q: Tensor, p: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        """Half is h/2 of the first step, (B, 1)."""
        a, V = self.accelerated(q)
        return p @ self.inverse - half * a, V


class Gained(nn.Module):
    """c x − h/2 a and l from the rows of all steps."""

    def forward(
        self, x: Tensor, mx: Tensor, a: Tensor, V: Tensor, V1: Tensor,
        stretch: Tensor, c: Tensor, half: Tensor, half_c: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """x, m x and a (K, B, n), V (K, B, 1), the others (K, B, 1) or (K, 1, 1)."""
        work = (x * mx).sum(-1, keepdim=True)
        return c * x - half * a, half_c * stretch * work - half * (V1 + c * V)


class Leaps:
    """The pieces of such a rollout, traced."""

    def __init__(self, model: ContactLagrangian):
        q, p, s, h = example(model, 0.1)
        self.lost = q.dtype == torch.float32
        column = s[:, None]
        three = (column + 1, column + 2, column + 3)
        self.columns = traced(Columns(model), (h, 2 * h))
        self.start = traced(Start(model), (q, p, column + 1))
        self.move = traced(Move(model), (q, 0.1 * p, *three, *((0.2 * p,) if self.lost else ())))
        rows = (0.1 * p, 0.3 * p, 0.2 * q, column, column + 1, *three, column + 4)
        self.mass = model.kinetic.mass().detach()  # pyright: ignore[reportCallIssue]
        self.gained = traced(Gained(), tuple(torch.stack([x, 2 * x], 1) for x in rows))


def has_leaps(model: ContactLagrangian) -> bool:
    """Whether an explicit step of this model is one without friction and inputs, with a potential known to be lean."""
    return model.friction is None and model.potential.features is None


class Decided(NamedTuple):
    """What h decides, by name."""

    all: str  # (K, B, 5), or (K, 1, 5) where samples share their steps
    loop: str  # (K, ·, 3)
    half: str  # (·, 1) of the first step


def decided(w: Writer, leaps: Leaps, h: str) -> Decided:
    """From h, (K, B) or (K, 1)."""
    zero, one, two = w.integers(0), w.integers(1), w.integers(2)
    flat, long = w.integers(-1), w.integers(2**62)
    after = w.emit("Concat", w.emit("Slice", h, one, long, zero), w.emit("Slice", h, flat, long, zero), axis=0)
    (found,) = w.write(leaps.columns, [w.emit("Reshape", x, flat) for x in (h, after)])
    wide = w.emit("Concat", w.emit("Shape", h), w.integers(FIXED), axis=0)
    every = w.emit("Reshape", found, wide, allowzero=1)
    first = w.emit("Slice", every, w.integers(0, 3), w.integers(1, 4), w.integers(0, 2))
    half = w.emit("ReduceSum", first, zero, keepdims=0)  # 0 where there is no step
    return Decided(every, w.emit("Slice", every, zero, w.integers(MOVED), two), half)


def reported(w: Writer, leaps: Leaps, fixed: Decided, start: list[str], rows: list[str]) -> list[str]:
    """Rows q1, p1, s1, (K, B, ·), from those of `Move`; `start` is x, V and s, (B, ·)."""
    zero, last = w.integers(0), w.integers(-1)
    q, x, a, V = rows
    before = []
    for one, many in zip(start, (x, V), strict=False):
        head = w.emit("Unsqueeze", one, zero)
        before.append(w.emit("Concat", head, w.emit("Slice", many, zero, last, zero), axis=0))
    stretch, c, _, half, half_c = w.several("Split", [fixed.all, w.integers(*[1] * FIXED)], FIXED, axis=2)
    shape, mass = w.emit("Shape", q), w.constant(leaps.mass.numpy(), NUMPY[w.real])

    def weighted(y: str) -> str:
        """M y; one product of all rows, as onnxruntime is slow with three axes."""
        flat = w.emit("Reshape", y, w.integers(-1, len(leaps.mass)))
        return w.emit("Reshape", w.emit("Gemm", flat, mass), shape, allowzero=1)

    x, V0 = before
    push, gain = w.write(leaps.gained, [x, weighted(x), a, V0, V, stretch, c, half, half_c])
    return [q, weighted(push), summed(w, start[2], c, gain)]


def summed(w: Writer, first: str, factors: str, terms: str) -> str:
    """s_1 … s_K of s_{k+1} = c_k s_k + l_k: first (B, 1), factors (K, B or 1, 1), terms (K, B, 1).

    Runs of `RUN` terms are joined one by one, all runs at once; then the runs, by doubling; so most numbers are read
    a few times only.
    """
    zero, one = w.integers(0), w.integers(1)
    steps, run = w.emit("Shape", terms, start=0, end=1), w.integers(RUN)
    runs = w.emit("Div", w.emit("Add", steps, w.integers(RUN - 1)), run)
    missing = w.emit("Concat", w.integers(0, 0, 0), w.emit("Sub", w.emit("Mul", runs, run), steps), w.integers(0, 0),
                     axis=0)  # fmt: skip
    parts = []
    for x, value in ((factors, 1.0), (terms, 0.0)):
        size = w.emit("Concat", runs, run, w.emit("Shape", x, start=1), axis=0)
        whole = w.emit("Pad", x, missing, w.constant(value, NUMPY[w.real]))
        whole = w.emit("Reshape", whole, size, allowzero=1)
        parts.append(w.several("Split", [whole, w.integers(*[1] * RUN)], RUN, axis=1))
    products, sums = [parts[0][0]], [parts[1][0]]
    for c, term in zip(parts[0][1:], parts[1][1:], strict=True):
        sums.append(w.emit("Add", w.emit("Mul", c, sums[-1]), term))
        products.append(w.emit("Mul", c, products[-1]))
    ends = [w.emit("Squeeze", x[-1], one) for x in (products, sums)]
    before = w.emit("Unsqueeze", _doubled(w, w.emit("Unsqueeze", first, zero), *ends), one)  # (runs, 1, B, 1)
    through = w.emit("Mul", w.emit("Concat", *products, axis=1), before)
    whole = w.emit("Add", through, w.emit("Concat", *sums, axis=1))
    long = w.emit("Concat", w.emit("Mul", runs, run), w.emit("Shape", terms, start=1), axis=0)
    return w.emit("Slice", w.emit("Reshape", whole, long, allowzero=1), zero, steps, zero)


def _doubled(w: Writer, first: str, factors: str, terms: str) -> str:
    """s_0 … s_{K-1} of s_{k+1} = c_k s_k + l_k: first (1, B, 1), factors (K, B or 1, 1), terms (K, B, 1)."""
    from onnx import TensorProto, helper

    zero, one = w.integers(0), w.integers(1)
    real = NUMPY[w.real]
    alone = w.emit("Concat", one, w.emit("Shape", factors, start=1), axis=0)
    a = w.emit("Concat", w.emit("Expand", w.constant(1, real), alone), factors, axis=0)
    b = w.emit("Concat", first, terms, axis=0)
    body = Writer(w.constants, w.real, f"{w.prefix}d")
    a0, b0, shift = "d_factors", "d_terms", "d_shift"
    room = body.emit("Concat", shift, body.integers(*[0] * 5), axis=0)
    back = body.emit("Neg", shift)

    def behind(x: str, value: float) -> str:
        """What is `shift` rows before, `value` where nothing is."""
        kept = body.emit("Slice", x, body.integers(0), back, body.integers(0))
        return body.emit("Pad", kept, room, body.constant(value, real))

    b1 = body.emit("Add", b0, body.emit("Mul", a0, behind(b0, 0.0)))
    a1 = body.emit("Mul", a0, behind(a0, 1.0))
    twice = body.emit("Add", shift, shift)
    length = body.emit("Shape", b0, start=0, end=1)
    more = body.emit("Squeeze", body.emit("Less", twice, length))
    value, empty = helper.make_tensor_value_info, helper.make_empty_tensor_value_info
    graph = helper.make_graph(
        body.nodes, "doubling",
        [value("d_i", TensorProto.INT64, []), value("d_on", TensorProto.BOOL, []), empty(a0), empty(b0), empty(shift)],
        [value(more, TensorProto.BOOL, []), empty(a1), empty(b1), empty(twice)],
    )  # fmt: skip
    some = w.emit("Squeeze", w.emit("Less", one, w.emit("Shape", b, start=0, end=1)))
    _, b, _ = w.several("Loop", ["", some, a, b, one], 3, body=graph)
    return w.emit("Slice", b, zero, w.integers(-1), zero)
