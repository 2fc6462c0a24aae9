"""A C function of statements of a `Program`: locals, statements, outputs in their places."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from herglotz.codegen.program import NAME, Atom, Program, Ref

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
    computed = [i for i in sorted(numbers) if not program.statements[i].name]
    sizes = {i: program.statements[i].size for i in computed if i not in handed_on}
    lines = [f"REAL t{i}[{size}];" for i, size in sizes.items() if size]
    lines += [program.statements[i].text.removeprefix("const REAL " if i in handed_on else "") for i in computed]
    text = named(program, [*lines, *_written(program, outputs)], handed_on)
    body = "".join(f"  {line}\n" for line in text.splitlines())
    unused = "".join(f"  (void){x};\n" for x in re.findall(r"(\w+)(?:\[\w+\])?(?=[,)])", head.rsplit("static", 1)[1])
                     if not re.search(rf"\b{x}\b", body))  # fmt: skip
    counter = "  int k;\n" if "(k = 0;" in body else ""
    return f"{head} {{\n{counter}{unused}{body}}}\n"


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
