"""Mutants drawn at random: an operator, a comparison or a name exchanged for its opposite somewhere in a room."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from pathlib import Path

Change = tuple[int, str, str]  # where in the text, what stands there, what stands there instead
BINARY = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
COMPARE = {
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
}
BOOLEAN = {ast.And: ("and", "or"), ast.Or: ("or", "and")}
NAMES = {"min": "max", "amin": "amax", "minimum": "maximum", "sin": "cos", "any": "all", "argmin": "argmax"}
NAMES |= {new: old for old, new in NAMES.items()}
# Mutants that the draw leaves out: (file, line, column in it, what stands there instead, why no test can tell)
ALIKE: list[tuple[str, str, int, str, str]] = [
    ("data/simulate.py", "bad = ~(torch.isfinite(q).all(-1) & torch.isfinite(p).all(-1) & torch.isfinite(s))", 30, "", "the last axis of (B, n) is the first after B"),
    ("data/simulate.py", "bad = ~(torch.isfinite(q).all(-1) & torch.isfinite(p).all(-1) & torch.isfinite(s))", 58, "", "the last axis of (B, n) is the first after B"),
    ("training/foresight.py", "start.append(((z[..., P:] @ state) * z[..., P:]).sum(-1).mean(-1))", 62, "", "the last axis of (N, n) is the first after N"),
    ("plots/theory.py", "size = S1.S.abs() + S0.S.abs() + (S1.D2 * S1.q).sum(-1).abs() + H_plus.detach().abs()", 52, "", "the last axis of (F, n) is the first after F"),
    ("plots/theory.py", "distances.append((off[k].q - S1.q).norm(dim=-1).reshape(count, -1).nanmedian(1).values)", 44, "", "the last axis of (F, n) is the first after F"),
    ("codegen/program.py", "if value is None and -1.0 in (a, b):", 21, "", "C then says -1.0 * x, the same number as -x"),
    ("tune/search.py", "moved.append((x + JITTER * (high - low) * kick).clamp(low, high))", 16, "-", "kick is drawn from both sides alike"),
    ("mechanics/partials.py", "a, b, s = q0 * 1, q1 * 1, s0 * 1", 13, "/", "x / 1 is x * 1"),
    ("mechanics/partials.py", "a, b, s = q0 * 1, q1 * 1, s0 * 1", 21, "/", "x / 1 is x * 1"),
    ("mechanics/partials.py", "a, b, s = q0 * 1, q1 * 1, s0 * 1", 29, "/", "x / 1 is x * 1"),
    ("export/lower/c.py", "return guess, point.F, point.J, dp, end.L + (end.p1 * (x - delta)).sum(-1), point.rest.D3", 71, "", "the last axis of (B, n) is the first after B"),
    ("stepping/newton.py", "good = bool((done & torch.isfinite(residual + merit + L) & (c != 0)).all())", 44, "-", "the difference of numbers that are not finite is none either"),
    ("stepping/newton.py", "good = bool((done & torch.isfinite(residual + merit + L) & (c != 0)).all())", 52, "-", "the difference of numbers that are not finite is none either"),
]  # fmt: skip


class _Text:
    """A source with the places of its nodes: `ast` counts columns in bytes."""

    def __init__(self, text: str):
        self.data = text.encode()
        self.lines = [0]
        for line in self.data.splitlines(keepends=True):
            self.lines.append(self.lines[-1] + len(line))

    def at(self, line: int, column: int) -> int:
        return self.lines[line - 1] + column

    def between(self, left: ast.expr, right: ast.expr, old: str, new: str) -> Iterator[Change]:
        start = self.at(left.end_lineno or 0, left.end_col_offset or 0)
        end = self.at(right.lineno, right.col_offset)
        place = self.data.find(old.encode(), start, end)
        if place >= 0:
            yield self.change(place, old, new)

    def change(self, place: int, old: str, new: str) -> Change:
        return len(self.data[:place].decode()), old, new


def changes(text: str) -> list[Change]:
    """All places of a source that can be mutated; none in what only makes a message."""
    tree, where = ast.parse(text), _Text(text)
    found: list[Change] = []
    for node in _code(tree):
        found += _changes(node, where)
    return sorted(found)


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes under a node that compute: not messages, asserts, annotations."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Raise | ast.JoinedStr | ast.Assert | ast.arg):
            continue
        if isinstance(child, ast.AnnAssign) and child.value is not None:
            child = child.value
        yield child
        yield from _code(child)


def _changes(node: ast.AST, where: _Text) -> Iterator[Change]:
    if isinstance(node, ast.BinOp) and type(node.op) in BINARY:
        if not any(isinstance(x, ast.Constant) and isinstance(x.value, str) for x in (node.left, node.right)):
            yield from where.between(node.left, node.right, *BINARY[type(node.op)])
    elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARE:
        yield from where.between(node.left, node.comparators[0], *COMPARE[type(node.ops[0])])
    elif isinstance(node, ast.BoolOp):
        yield from where.between(node.values[0], node.values[1], *BOOLEAN[type(node.op)])
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        old = "-" if isinstance(node.op, ast.USub) else "not "
        yield where.change(where.at(node.lineno, node.col_offset), old, "")
    elif isinstance(node, ast.Attribute | ast.Name):
        name = node.attr if isinstance(node, ast.Attribute) else node.id
        end = where.at(node.end_lineno or 0, node.end_col_offset or 0)
        if name in NAMES:
            yield where.change(end - len(name), name, NAMES[name])
        elif name == "mT":
            yield where.change(end - len(".mT"), ".mT", "")


def sample(src: Path, room: str, number: int, seed: int) -> list[tuple[str, int, str, str]]:
    """A draw of `number` mutants of a room: (file, place, old, new), without those of `ALIKE`.

    What decides is a hash of the seed and the mutated line: an edit elsewhere leaves the draw as it was.
    """
    every: list[tuple[str, tuple[str, int, str, str]]] = []
    alike = {same[:4] for same in ALIKE}
    for path in sorted((src / room).rglob("*.py")):
        name, text = str(path.relative_to(src)), path.read_text(encoding="utf-8")
        for at, old, new in changes(text):
            start = text.rfind("\n", 0, at) + 1
            line = text[start:].split("\n", 1)[0].strip()
            place = at - start - (len(text[start:]) - len(text[start:].lstrip(" ")))
            if (name, line, place, new) not in alike:
                rank = hashlib.sha256(f"{seed} {name} {line} {place} {new}".encode()).hexdigest()
                every.append((rank, (name, at, old, new)))
    return sorted(mutant for _, mutant in sorted(every)[:number])
