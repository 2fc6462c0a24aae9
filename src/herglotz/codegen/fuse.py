"""Loop fusion: loops over rows of the same length become a single loop, whose numbers stay in registers.

A program has a loop for every operation on a row, and each loop stores a row that the next loop loads. Loops that read
each other's rows entry by entry are fused here; a row that only its own fused loop reads is not stored.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from typing import NamedTuple

from herglotz.codegen.program import NAME, Program

LOOP_OVER = re.compile(r"for \(k = 0; k < (\d+); k\+\+\) @(\d+)\[k\] = (.*);")
ENTRY = re.compile(r"@(\d+)\[k\]")


class Loop(NamedTuple):
    """A statement that computes a row, entry k out of numbers and entries k."""

    number: int
    count: int
    right: str

    @property
    def whole_rows(self) -> set[int]:
        """Numbers of the statements whose rows the loop does not read entry by entry."""
        return {int(x) for x in NAME.findall(ENTRY.sub("", self.right))}


def fused(program: Program, numbers: Iterable[int], kept: Collection[int]) -> tuple[list[str], set[int]]:
    """The texts of these statements in an order in which they can run, and the statements whose rows are not stored.

    Rows of `kept` statements are always stored.
    """
    texts, inner = [], set()
    parts = _parts(program, sorted(numbers))
    reads = [set().union(*(program.statements[i].reads for i in part)) for part in parts]
    for at, part in enumerate(parts):
        outside = set(kept).union(*reads[:at], *reads[at + 1 :])
        loops = [loop for i in part if (loop := _loop(program, i)) is not None]
        inside = {x.number for x in loops} - outside if len(part) > 1 else set()
        texts.append(_one_loop(loops, inside) if len(part) > 1 else program.statements[part[0]].text)
        inner |= inside
    return texts, inner


def _parts(program: Program, order: list[int]) -> list[list[int]]:
    """Groups of statements: single statements, and loops to be fused. A group ends where one of its rows is needed."""
    parts: list[list[int]] = []
    # Loop → the waiting loops that must run with this loop, itself included.
    waiting: dict[int, set[int]] = {}
    length = 0
    for i in order:
        reads, loop = program.statements[i].reads, _loop(program, i)
        if loop is None:
            parts += [*_run(waiting, reads), [i]]
            continue
        parts += _run(waiting, set(waiting) if loop.count != length else loop.whole_rows)
        length = loop.count
        waiting[i] = {i}.union(*(waiting[j] for j in reads if j in waiting))
    return [*parts, *_run(waiting, set(waiting))]


def _run(waiting: dict[int, set[int]], needed: set[int]) -> list[list[int]]:
    """Take from `waiting` the loops whose rows are needed, with the loops that these need; return them as a group."""
    done = set().union(*(needs for i, needs in waiting.items() if i in needed))
    for i in done:
        del waiting[i]
    for needs in waiting.values():
        needs -= done
    return [sorted(done)] if done else []


def _loop(program: Program, number: int) -> Loop | None:
    match = LOOP_OVER.fullmatch(program.statements[number].text)
    return None if match is None else Loop(number, int(match[1]), match[3])


def _one_loop(loops: list[Loop], inside: set[int]) -> str:
    """The fused loop; the rows `inside`, which no other statement reads, are not stored."""
    own, lines = {x.number for x in loops}, []
    for x in loops:
        right = ENTRY.sub(lambda m: f"v{m[1]}" if int(m[1]) in own else m[0], x.right)
        lines.append(f"  const REAL v{x.number} = {right};")
        if x.number not in inside:
            lines.append(f"  @{x.number}[k] = v{x.number};")
    return "\n".join([f"for (k = 0; k < {loops[0].count}; k++) {{", *lines, "}"])
