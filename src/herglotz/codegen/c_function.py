"""A C function of statements of a `Program`: locals, fused loops, outputs in their places.

Loops over rows of the same length become a single loop, whose numbers stay in registers. A program has a loop for every
operation on a row, and each loop stores a row that the next loop loads. Loops that read each other's rows entry by
entry are fused here; a row that only its own fused loop reads is not stored.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from herglotz.codegen.program import NAME, Atom, Program, Ref

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


# The declaration of a scalar that a structure holds.
HANDED = re.compile(r"^const REAL (@(\d+) =)")
# The place written to → its number, or the list of its numbers.
Outputs = Mapping[str, Any]


def places(outputs: Outputs) -> Iterator[tuple[str, int, str, Atom]]:
    """Every number of the outputs: (output, index, place in C, number)."""
    for name, row in outputs.items():
        for i, atom in enumerate(row_of(row)):
            yield name, i, name if row is atom else f"{name}[{i}]", atom


def row_of(numbers: Any) -> list[Any]:
    """The numbers of an output; a `Ref` is a single number."""
    return numbers if type(numbers) is list else [numbers]


def results(outputs: Outputs) -> set[int]:
    """The statements whose results are outputs."""
    return {atom.statement for *_, atom in places(outputs) if isinstance(atom, Ref)}


def named(program: Program, lines: Iterable[str], names: Mapping[int, str] = {}) -> str:
    """Lines with the names of results: of inputs, then of `names`, else the number of the statement."""
    name = lambda i: program.statements[i].name or names.get(i) or f"t{i}"  # noqa: E731
    return NAME.sub(lambda match: name(int(match[1])), "\n".join(lines))


def function(
    program: Program, head: str, numbers: Iterable[int], outputs: Outputs, handed_on: Mapping[int, str]
) -> str:
    """A C function of statements and outputs; `handed_on` names results that a structure holds."""
    text = named(program, [*_computed(program, numbers, outputs, handed_on), *_written(program, outputs)], handed_on)
    body = "".join(f"  {line}\n" for line in text.splitlines())
    unused = "".join(f"  (void){x};\n" for x in re.findall(r"(\w+)(?:\[\w+\])?(?=[,)])", head.rsplit("static", 1)[1])
                     if not re.search(rf"\b{x}\b", body))  # fmt: skip
    counter = "  int k;\n" if "(k = 0;" in body else ""
    return f"{head} {{\n{counter}{unused}{body}}}\n"


def _computed(
    program: Program, numbers: Iterable[int], outputs: Outputs, handed_on: Mapping[int, str]
) -> Iterator[str]:
    """Declarations of rows, unless a structure holds a row or only its own loop reads the row, and all statements."""
    computed = [i for i in sorted(numbers) if not program.statements[i].name]
    texts, inner = fused(program, computed, results(outputs) | set(handed_on))
    for i in computed:
        if (size := program.statements[i].size) and i not in handed_on and i not in inner:
            yield f"REAL t{i}[{size}];"
    for text in texts:
        yield HANDED.sub(lambda m: m[1] if int(m[2]) in handed_on else m[0], text)


def _written(program: Program, outputs: Outputs) -> Iterator[str]:
    """The outputs, put in their places."""
    for _, _, place, atom in places(outputs):
        right = program.read(atom)
        yield f"{place} = {right if isinstance(atom, Ref) else f'SPREAD({right})'};"


def as_scalars(text: str) -> str:
    """A C text of `REAL` and `FN_` as code for a single sample."""
    return text.replace("SPREAD(", "(").replace("FN_", "hz_").replace("REAL", "hz_real")


def whole(program: Program, head: str, outputs: Outputs) -> str:
    """The C function of all statements that the outputs need."""
    return function(program, head, needed_by(program, outputs), outputs, {})


def needed_by(program: Program, outputs: Outputs) -> set[int]:
    """The statements that outputs need, down to the inputs."""
    todo = list(results(outputs))
    needed: set[int] = set()
    while todo:
        i = todo.pop()
        if i not in needed:
            needed.add(i)
            todo += program.statements[i].reads
    return needed
