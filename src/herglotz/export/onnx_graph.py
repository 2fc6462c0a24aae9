"""The ONNX graph of a rollout: a loop over blocks of steps, each step an attempt with Newton's loop behind an If."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from herglotz.export.attempt import HISTORY
from herglotz.export.onnx_leap import MOVED, decided, reported
from herglotz.export.onnx_ops import NUMPY, Constants, Writer, kind_of
from herglotz.export.onnx_pieces import SOLVE, Pieces
from herglotz.export.trace import Graph

BLOCK = 8  # steps in the body of the loop: an iteration costs as much as a dozen operations
LARGE = 400  # nodes of a step beyond which a turn of the loop is nothing, and eight copies are a large file
Row = tuple[list[str], list[str]]


class RolloutWriter:
    """The nodes of a rollout: h → what depends on it; a loop over blocks; a loop over the rest; the report."""

    def __init__(self, pieces: Pieces, n: int, dtype: torch.dtype):
        self.pieces, self.one, self.n, self.dtype = pieces, pieces.one, n, dtype
        self.real = kind_of(dtype)
        self.constants = Constants()
        self.main = Writer(self.constants, dtype, "x")
        self.bodies = 0
        self.width, self.count = MOVED, BLOCK * MOVED

    def write(self) -> list[str]:
        """From q, p, s, h[, u] to the names of the outputs: q, p (K, B, n), the others (K, B)."""
        w, one = self.main, self.one
        shape, batch = w.emit("Shape", "h"), w.emit("Shape", "s")
        leaps = self.pieces.leaps
        h = self._h()
        safe = self._safe(h)
        fixed, begin = None if leaps is None else decided(w, leaps, safe), []
        table = self._table(safe) if fixed is None else [fixed.loop]
        column = w.emit("Unsqueeze", "s", w.integers(1))
        zero = w.constant(0, NUMPY[self.dtype])
        if leaps is not None and fixed is not None:
            begin = w.write(leaps.start, ["q", "p", fixed.half])
            carry = ["q", begin[0]]
            if leaps.lost:
                carry.append(w.emit("Expand", zero, w.emit("Shape", "q")))
        else:
            carry = ["q", "p", column, *([] if self.pieces.start is None else w.write(self.pieces.start, ["q"]))]
        if one.iterates:
            wide = w.emit("Concat", batch, w.integers(HISTORY * self.n), axis=0)
            carry.append(w.emit("Expand", zero, wide))
        if self.pieces.lost and leaps is None:
            carry += [w.emit("Expand", zero, w.emit("Shape", x)) for x in ("q", column)]
        steps, cut = w.emit("Shape", "h", start=0, end=1), w.integers(0)
        parts = []
        if self.blocked:
            blocks = w.emit("Div", steps, w.integers(BLOCK))
            cut = w.emit("Mul", blocks, w.integers(BLOCK))
            whole = []  # (blocks, BLOCK, B, ...)
            for x in table:
                size = w.emit("Concat", blocks, w.integers(BLOCK), w.emit("Shape", x, start=1), axis=0)
                head = w.emit("Slice", x, w.integers(0), cut, w.integers(0))
                whole.append(w.emit("Reshape", head, size, allowzero=1))
            wide = w.emit("Concat", blocks, w.emit("Shape", table[0], start=1, end=2), w.integers(self.count), axis=0)
            turned = w.emit("Transpose", whole[0], perm=[0, 2, 1, 3])
            whole[0] = w.emit("Reshape", turned, wide, allowzero=1)  # (blocks, B, BLOCK · r): a block splits it once
            carry, found = self.loop(w, blocks, carry, whole, self.block)
            parts.append(found)
            table = [w.emit("Slice", x, cut, steps, w.integers(0)) for x in table]
        parts.append(self.loop(w, w.emit("Sub", steps, cut), carry, table, self.single)[1])
        rows = []
        for *found, width in zip(*parts, self.widths, strict=True):
            size = w.emit("Concat", w.integers(-1), batch, w.integers(width), axis=0)
            rows.append(w.emit("Concat", *(w.emit("Reshape", x, size) for x in found), axis=0))
        if leaps is not None and fixed is not None:
            rows = reported(w, leaps, fixed, [*begin, column], rows)
        return self.report(rows, h, shape)

    @property
    def blocked(self) -> bool:
        """Whether steps are taken `BLOCK` at a time."""
        if self.one.iterates and not self.one.attempt.plan.evaluations:
            return False
        return len(self.pieces.parts[0][1].code.graph.nodes) <= LARGE

    def _table(self, h: str) -> list[str]:
        """What h decides, (K, B, r), h itself first; and u, (K, B, m). Where all samples share their steps B is 1.

        A factor for all samples is multiplied in a tenth of the time that one for each takes.
        """
        w, axis = self.main, self.main.integers(1)
        columns, self.columns = [w.emit("Unsqueeze", w.emit("Reshape", h, w.integers(-1)), axis)], []
        for first, _ in self.pieces.parts:
            mine = []
            for x, flat in [] if first is None else zip(w.write(first, columns[:1]), _flat(first), strict=True):
                mine.append((len(columns), flat))
                columns.append(w.emit("Unsqueeze", x, axis) if flat else x)
            self.columns.append(mine)
        self.width, self.count = len(columns), BLOCK * len(columns)
        wide = w.emit("Concat", w.emit("Shape", h), w.integers(self.width), axis=0)
        return [w.emit("Reshape", w.emit("Concat", *columns, axis=1), wide), *["u"] * bool(self.pieces.inputs)]

    def _h(self) -> str:
        """H, (K, B) or, where all samples share their steps, (K, 1)."""
        w, axis = self.main, self.main.integers(1)
        extremes = [w.emit(kind, "h", axis, keepdims=0) for kind in ("ReduceMin", "ReduceMax")]
        shared = w.emit("ReduceMin", w.emit("Equal", *extremes), w.integers(0), keepdims=1)
        end = w.emit("Shape", "s")
        if not self.one.iterates or self.one.attempt.plan.lean:  # others put what h decides beside what the state does
            end = w.emit("Where", shared, axis, end)
        return w.emit("Slice", "h", w.integers(0), end, axis)

    def _safe(self, h: str) -> str:
        """The same where it is a step, else NaN."""
        w = self.main
        (safe,) = w.write(self.pieces.safe, [w.emit("Reshape", h, w.integers(-1))])
        return w.emit("Reshape", safe, w.emit("Shape", h), allowzero=1)

    def report(self, rows: list[str], h: str, shape: str) -> list[str]:
        """The rows of all steps, (K, B, width), as the outputs of the file; h is that of `_h`."""
        w = self.main
        first, last = w.integers(0), w.integers(-1)
        after = [*rows[:2], *(w.emit("Reshape", x, shape) for x in rows[2:3])]
        before = []
        for start, x in zip(("q", "p", "s"), after, strict=True):
            if not self.pieces.boxed:  # onnxruntime computes what nobody reads
                before.append(x)
                continue
            head = w.emit("Unsqueeze", start, first)
            before.append(w.emit("Concat", head, w.emit("Slice", x, first, last, first), axis=0))
        others = [w.emit("Reshape", x, shape) for x in rows[3:]]
        if self.pieces.conformal is not None:
            (c,) = w.write(self.pieces.conformal, [w.emit("Reshape", h, last)])
            others = [w.emit("Expand", w.emit("Reshape", c, w.emit("Shape", h), allowzero=1), shape), *others]
        return w.write(self.pieces.said, ["h", *before, *after, *others])

    def loop(
        self, outer: Writer, trip: str, carry: list[str], table: list[str], body: Callable[..., tuple[list[str], ...]]
    ) -> tuple[list[str], list[str]]:
        """`trip` rounds of `body`; the carry after them, and the rows of vectors and of numbers."""
        from onnx import TensorProto, helper

        self.bodies += 1
        tag = f"l{self.bodies}_"
        w = Writer(self.constants, self.dtype, tag)
        inside = [f"{tag}carry{i}" for i in range(len(carry))]
        state, found = body(w, inside, [w.emit("Gather", x, f"{tag}i", axis=0) for x in table])
        more, state = w.emit("Identity", f"{tag}on"), own(w, state, inside)
        value, empty = helper.make_tensor_value_info, helper.make_empty_tensor_value_info
        graph = helper.make_graph(
            w.nodes, f"{tag}steps",
            [value(f"{tag}i", TensorProto.INT64, []), value(f"{tag}on", TensorProto.BOOL, []), *map(empty, inside)],
            [value(more, TensorProto.BOOL, []), *map(empty, state),
             *(value(x, self.real, [None, width]) for x, width in zip(found, self.widths, strict=True))],
        )  # fmt: skip
        count = len(carry) + len(found)
        out = outer.several("Loop", [outer.emit("Squeeze", trip), "", *carry], count, body=graph)
        return out[: len(carry)], out[len(carry) :]

    def single(self, w: Writer, carry: list[str], table: list[str]) -> tuple[list[str], list[str]]:
        """One step, without a good guess: the next carry and the rows."""
        row = self._row(w, table)
        if not self.one.iterates:
            state, values = self._leap(w, carry, row)
            return state, self._rows(w, [values])
        kept = 3 + self.one.kept
        found = self._attempt(w, carry, carry[kept], row, 1)
        *found, leap = self._decided(w, found, [*carry[:kept], *row[1]], row[0][0])
        *solved, left, last = found
        state, rest = self._landed(w, carry, row, solved)
        old = w.emit("Slice", carry[kept], w.integers(0), w.integers((HISTORY - 1) * self.n), w.integers(1))
        state.insert(kept, w.emit("Concat", w.emit("Sub", solved[0], leap), old, axis=1))
        return state, [*self._rows(w, [[*state[:3], *rest]]), left, last]

    def block(self, w: Writer, carry: list[str], table: list[str]) -> tuple[list[str], list[str]]:
        """`BLOCK` steps by attempts alone or, where they do not suffice, one by one."""
        from onnx import helper

        kept = 3 + self.one.kept
        state, values, sizes = carry, [], []
        misses = []
        if self.one.iterates:
            parts = w.integers(*[self.n] * HISTORY)
            misses = w.several("Split", [carry[kept], parts], HISTORY, axis=1)
        fixed = w.several("Split", [table[0], w.integers(*[1] * self.count)], self.count, axis=1)
        for j in range(BLOCK):
            at = w.constant(j, np.int64)
            row = fixed[j * self.width : (j + 1) * self.width], [w.emit("Gather", x, at, axis=0) for x in table[1:]]
            if not self.one.iterates:
                state, found = self._leap(w, state, row)
                values.append(found)
            else:
                x, p1, L, c, *size = self._attempt(w, state, w.emit("Concat", *misses, axis=1), row, 0)
                sizes.append((x, *size))
                misses = [size[0], *misses[:-1]]
                new, rest = self._landed(w, state, row, [x, p1, L, c])
                state = [*new[:kept], "", *new[kept:]]
                values.append([*state[:3], *rest])
        rows = self._rows(w, values)
        if not self.one.iterates:
            return state, rows
        state[kept] = w.emit("Concat", *misses, axis=1)
        stacked = w.emit("Concat", w.integers(BLOCK), w.emit("Shape", carry[0]), axis=0)
        checked = [w.emit("Reshape", w.emit("Concat", *x, axis=0), stacked) for x in zip(*sizes, strict=True)]
        before = w.emit("Unsqueeze", carry[2], w.integers(0))
        left, last, _, trouble = w.write(self.pieces.troubles, [before, *checked])
        rows += [w.emit("Reshape", x, w.integers(-1, 1)) for x in (left, last)]
        self.bodies += 1
        quick, slow = (Writer(self.constants, self.dtype, f"{x}{self.bodies}_") for x in ("a", "b"))
        taken = [quick.emit("Identity", x) for x in (*state, *rows)]
        rows_of_h = slow.emit("Reshape", table[0], slow.integers(0, BLOCK, self.width))
        steps = [slow.emit("Transpose", rows_of_h, perm=[1, 0, 2]), *table[1:]]
        again, more = self.loop(slow, slow.integers(BLOCK), carry, steps, self.single)
        more = [slow.emit("Reshape", x, slow.integers(-1, y)) for x, y in zip(more, self.widths, strict=True)]
        again = own(slow, [*again, *more], [])
        empty = helper.make_empty_tensor_value_info
        branch = [
            helper.make_graph(part.nodes, name, [], [empty(x) for x in outputs])
            for part, name, outputs in ((slow, "one_by_one", again), (quick, "attempts", taken))
        ]
        found = w.several("If", [trouble], len(taken), then_branch=branch[0], else_branch=branch[1])
        return found[: len(state)], found[len(state) :]

    @property
    def widths(self) -> list[int]:
        """Of the rows: q1, p1, s1[, c][, the last two increments' sizes]; or those of `Move`."""
        if self.pieces.leaps is not None:
            return [self.n, self.n, self.n, 1]
        return [self.n, self.n, *[1] * (1 + (self.pieces.conformal is None) + 2 * self.one.iterates)]

    def _rows(self, w: Writer, values: list[list[str]]) -> list[str]:
        """Q1, p1, s1[, c] of several steps, one below the other."""
        return [w.emit("Concat", *x, axis=0) for x in zip(*values, strict=True)]

    def _row(self, w: Writer, table: list[str]) -> tuple[list[str], list[str]]:
        """What h decides at one step, each (B, 1), and u."""
        return w.several("Split", [table[0], w.integers(*[1] * self.width)], self.width, axis=1), table[1:]

    def _fixed(self, w: Writer, row: Row, part: int) -> list[str]:
        """What h decides for one of the parts."""
        return [w.emit("Squeeze", row[0][i], w.integers(1)) if flat else row[0][i] for i, flat in self.columns[part]]

    def _leap(self, w: Writer, carry: list[str], row: Row) -> tuple[list[str], list[str]]:
        """An explicit step: the next carry, and what is a row."""
        if self.pieces.leaps is not None:
            new = w.write(self.pieces.leaps.move, [*carry[:2], *row[0], *carry[2:]])
            return [*new[:2], *new[4:]], new[:4]
        fixed = self._fixed(w, row, 0)
        *new, c = w.write(self.pieces.parts[0][1], [*carry, *row[1], *fixed])
        return new, [*new[:3], *([] if self.pieces.conformal is not None else [c])]

    def _attempt(self, w: Writer, carry: list[str], misses: str, row: Row, patient: int) -> list[str]:
        """What `Attempt` gives."""
        fixed = self._fixed(w, row, patient)
        start = [*carry[:3], misses, *carry[3 : 3 + self.one.kept], *row[1], *fixed]
        return w.write(self.pieces.parts[patient][1], start)

    def _landed(self, w: Writer, carry: list[str], row: Row, solved: list[str]) -> tuple[list[str], list[str]]:
        """The carry without misses after a step that gives Δ, p1, L, c, and c where it is a row."""
        x, p1, L, c = solved
        fixed = self._fixed(w, row, 2)
        lost = carry[4 + self.one.kept :]
        new = w.write(self.pieces.parts[2][1], [carry[0], carry[2], x, p1, L, *lost, *fixed])
        return new, [] if self.pieces.conformal is not None else [c]

    def _decided(self, w: Writer, found: list[str], problem: list[str], h: str) -> list[str]:
        """Δ, p1, L, c and two sizes (see `Said`) of the attempt or, where it is not enough, of Newton; the leap."""
        from onnx import helper

        x, p1, L, c, *iterates, size = found
        left, last, bad, trouble = w.write(self.pieces.trouble, [problem[2], x, *iterates, size])
        leap = w.emit("Sub", x, iterates[0])
        values = [x, p1, L, c, left, last]
        self.bodies += 1
        quick, slow = (Writer(self.constants, self.dtype, f"{x}{self.bodies}_") for x in ("a", "b"))
        taken = [quick.emit("Identity", y) for y in values]
        column, *rest = problem[2:]
        axis = slow.integers(1)
        h = slow.emit("Expand", h, slow.emit("Shape", column))
        h, s, *flat = (slow.emit("Squeeze", y, axis) for y in (h, column, *rest[: min(1, self.one.kept)]))
        begin = slow.write(self.pieces.proceed, [column, *values, bad])
        ended = self.newton(slow, begin, [*problem[:2], s, h, *flat, *rest[len(flat) :]])
        solved = own(slow, slow.write(self.pieces.outcome, [h, *ended]), [])
        empty = helper.make_empty_tensor_value_info
        branch = [
            helper.make_graph(part.nodes, name, [], [empty(y) for y in outputs])
            for part, name, outputs in ((slow, "newton", solved), (quick, "attempt", taken))
        ]
        return [*w.several("If", [trouble], len(taken), then_branch=branch[0], else_branch=branch[1]), leap]

    def newton(self, w: Writer, begin: list[str], problem: list[str]) -> list[str]:
        """The loop of Newton; Δ, −J⁻¹F, |F|, done, p1, L, c."""
        from onnx import TensorProto, helper

        tag = f"n{w.prefix}"
        body = Writer(self.constants, self.dtype, tag)
        inside = [f"{tag}carry{i}" for i in range(SOLVE)]
        more, *carry = body.write(self.pieces.iterate, [*problem[:4], *inside, *problem[4:]])
        carry = own(body, carry, inside)
        value, empty = helper.make_tensor_value_info, helper.make_empty_tensor_value_info
        graph = helper.make_graph(
            body.nodes, f"{tag}iteration",
            [value(f"{tag}i", TensorProto.INT64, []), value(f"{tag}on", TensorProto.BOOL, []), *map(empty, inside)],
            [value(more, TensorProto.BOOL, []), *map(empty, carry)],
        )  # fmt: skip
        start = ["", w.constant(True, np.bool_), w.constant(0, np.int64), *begin]
        _, done, x, delta, merit, _, _, p1, L, c = w.several("Loop", start, SOLVE, body=graph)
        return [x, delta, merit, done, p1, L, c]


def own(w: Writer, names: Sequence[str], inputs: Sequence[str]) -> list[str]:
    """Names that this graph makes, each once: what it only passes on gets a node."""
    made = {y for node in w.nodes for y in node.output}
    seen: set[str] = set(inputs)
    out = []
    for name in names:
        if name in seen or name not in made:
            name = w.emit("Identity", name)
        seen.add(name)
        out.append(name)
    return out


def _flat(graph: Graph) -> list[bool]:
    """Which results of a graph are (B,), not (B, 1)."""
    (output,) = (x for x in graph.code.graph.nodes if x.op == "output")
    results: Any = output.args[0]
    return [len(x.meta["example"].shape) == 1 for x in results]
