"""One C function of statements of a `Program`: locals, statements in order, outputs in their places."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from herglotz.codegen.fuse import fused
from herglotz.codegen.program import NAME, Program, Ref

HANDED = re.compile(r"^const REAL (@(\d+) =)")
# The place written to → its number, or the list of its numbers.
Outputs = Mapping[str, Any]


def function(
    program: Program, head: str, numbers: Iterable[int], outputs: Outputs, handed_on: Mapping[int, str]
) -> str:
    """One C function of statements and outputs."""
    lines = [*_computed(program, numbers, outputs, handed_on), *_written(program, outputs)]
    text = NAME.sub(lambda m: _name(program, int(m[1]), handed_on), "\n".join(lines))
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
    read = {x.statement for row in outputs.values() for x in row_of(row) if isinstance(x, Ref)}
    texts, inner = fused(program, computed, read | set(handed_on))
    for i in computed:
        if (size := program.statements[i].size) and i not in handed_on and i not in inner:
            yield f"REAL t{i}[{size}];"
    for text in texts:
        yield HANDED.sub(lambda m: m[1] if int(m[2]) in handed_on else m[0], text)


def _written(program: Program, outputs: Outputs) -> Iterator[str]:
    """The outputs, put in their places."""
    for place, row in outputs.items():
        for i, atom in enumerate(row_of(row)):
            right = program.read(atom) if isinstance(atom, Ref) else f"SPREAD({program.read(atom)})"
            yield f"{place if row is atom else f'{place}[{i}]'} = {right};"


def row_of(numbers: Any) -> list[Any]:
    """The numbers of an output; a `Ref` is one number."""
    return numbers if type(numbers) is list else [numbers]


def _name(program: Program, number: int, handed_on: Mapping[int, str]) -> str:
    return program.statements[number].name or handed_on.get(number) or f"t{number}"


def as_scalars(text: str) -> str:
    """A C text of `REAL` and `FN_` as code for a single sample."""
    return text.replace("SPREAD(", "(").replace("FN_", "hz_").replace("REAL", "hz_real")


def whole(program: Program, head: str, outputs: Outputs) -> str:
    """The C function of all statements that the outputs need."""
    return function(program, head, needed_by(program, outputs), outputs, {})


def needed_by(program: Program, outputs: Outputs) -> set[int]:
    """The statements that outputs need, down to the inputs."""
    todo = [x.statement for row in outputs.values() for x in row_of(row) if isinstance(x, Ref)]
    needed: set[int] = set()
    while todo:
        i = todo.pop()
        if i not in needed:
            needed.add(i)
            todo += program.statements[i].reads
    return needed
