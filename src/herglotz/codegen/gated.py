"""A C function that leaves out what only absent parameters need.

A parameter θ_k that is 0 and that no derivative is asked by is *off*. A product with such a parameter is 0, and what
nothing but such products read is not needed. Every statement is put behind a gate, a set of parameters of which one at
least must be on; the numbers of a statement that is left out are 0. One compiled dictionary then costs what the terms
of the model cost that is evaluated. What follows from parameters alone is computed once for many calls.
"""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from herglotz.codegen.c_function import Outputs, needed_by, row_of
from herglotz.codegen.program import NAME, Program, Ref

SUMS = ("{0} + {1}", "{0} - {1}", "{0} + {1} * {2}", "{0} - {1} * {2}")
PLAIN = (*SUMS, "{0} * {1}", "-{0}")  # of finite numbers these are finite, and cost next to nothing
CONSTANT = ("theta", "sharpest")  # arguments that do not change from step to step
WORTH_A_BRANCH = 3  # plain operations: fewer are done without asking

Gate = frozenset[int] | None  # None: always open


@dataclass
class Prepared:
    """What all functions of a library are handed: gates, and numbers that follow from parameters alone."""

    gates: dict[frozenset[int], int] = field(default_factory=dict)  # with their places in an array of flags
    fixed: int = 0  # numbers
    parts: list[str] = field(default_factory=list)  # of the C that computes them

    def flag(self, gate: frozenset[int]) -> str:
        """The flag of a gate, as C reads it."""
        return f"gate[{self.gates.setdefault(gate, len(self.gates))}]"

    def fix(self, program: Program, statements: list[int], read: list[int]) -> dict[int, str]:
        """How the numbers of those of these `statements` are called that others `read`."""
        names = {i: f"fixed[{self.fixed + at}]" for at, i in enumerate(read)}
        lines = [program.statements[i].text for i in statements] + [f"{name} = @{i};" for i, name in names.items()]
        self.parts.append(f"  {{\n{_named(program, [f'    {line}' for line in lines])}\n  }}\n")
        self.fixed += len(read)
        return names

    def function(self) -> str:
        """The C function that sets all of it; `on` says which parameters are on."""
        flags = [f"  gate[{i}] = {' || '.join(f'on[{k}]' for k in sorted(x))};\n" for x, i in self.gates.items()]
        sizes = f"\n#define hz_GATES {max(1, len(self.gates))}\n#define hz_FIXED {max(1, self.fixed)}\n"
        taken = "const double *theta, const double *sharpest, const char *on, char *gate, double *fixed"
        head = f"static void hz_prepare({taken}) {{\n  (void)on, (void)gate, (void)fixed, (void)sharpest;\n"
        return "".join([sizes, head, *flags, *self.parts, "}\n"])


def gated(
    program: Program,
    head: str,
    outputs: Outputs,
    prepared: Prepared,
    columns: Mapping[str, int] = {},
) -> str:
    """The C function of these outputs; a column of a parameter that is off is not written."""
    numbers = sorted(i for i in needed_by(program, outputs) if not program.statements[i].name)
    wanted = _wanted(outputs, columns)
    gate = _gates(program, numbers, wanted)
    fixed = _fixed(program, numbers)
    moving = [i for i in numbers if i not in fixed]
    read = set(wanted).union(*(program.statements[i].reads for i in moving)) & fixed
    names = prepared.fix(program, [i for i in numbers if i in fixed], sorted(read))
    lines = [*_statements(program, moving, gate, wanted, prepared), *_written(program, outputs, columns, prepared)]
    return f"{head} {{\n{_named(program, lines, names)}\n}}\n"


def _named(program: Program, lines: list[str], names: Mapping[int, str] = {}) -> str:
    """Lines with the names of numbers, `names` before others."""

    def name(match: re.Match[str]) -> str:
        i = int(match[1])
        return program.statements[i].name or names.get(i) or f"t{i}"

    return NAME.sub(name, "\n".join(lines))


def _fixed(program: Program, numbers: list[int]) -> set[int]:
    """The scalars that follow from parameters alone."""
    found = {i for i, x in enumerate(program.statements) if x.name in CONSTANT}
    for i in numbers:
        if not program.statements[i].size and program.statements[i].reads <= found:
            found.add(i)
    return found & set(numbers)


def _wanted(outputs: Outputs, columns: Mapping[str, int]) -> dict[int, Gate]:
    """The statements that are written as outputs, with the gates behind which they are."""
    found: dict[int, Gate] = {}
    for name, row in outputs.items():
        for i, atom in enumerate(row_of(row)):
            if isinstance(atom, Ref):
                gate = frozenset([i % columns[name]]) if name in columns else None
                found[atom.statement] = _either(found.get(atom.statement, frozenset()), gate)
    return found


def _either(a: Gate, b: Gate) -> Gate:
    return None if a is None or b is None else a | b


def _narrower(a: Gate, b: Gate) -> Gate:
    if a is None or b is None:
        return b if a is None else a
    return b if len(b) < len(a) else a


def _gates(program: Program, numbers: list[int], wanted: Mapping[int, Gate]) -> dict[int, Gate]:
    """The gate of every statement: without it the statement is 0, or nothing needs it."""
    operations = {ref.statement: key for ref, key in program.operations.items()}
    vanishing = _vanishing(program, numbers, operations)
    read: dict[int, Gate] = dict(wanted)
    gate: dict[int, Gate] = {}
    for i in reversed(numbers):
        gate[i] = _narrower(vanishing.get(i), read[i]) if i in operations else None
        for j in program.statements[i].reads:
            read[j] = _either(read.get(j, frozenset()), gate[i])
    plain = {i for i in numbers if operations.get(i, ("",))[0] in PLAIN}
    worth: Counter[Gate] = Counter()
    for i in numbers:
        worth[gate[i]] += 1 if i in plain else WORTH_A_BRANCH
    return {i: None if i in plain and worth[x] < WORTH_A_BRANCH else x for i, x in gate.items()}


def _vanishing(program: Program, numbers: list[int], operations: Mapping[int, tuple]) -> dict[int, Gate]:
    """The parameters without which a number is 0, of every operation on single numbers."""
    found: dict[int, Gate] = {}

    def zero(atom: object) -> Gate:
        if not isinstance(atom, Ref):
            return None
        is_parameter = program.statements[atom.statement].name == "theta"
        return frozenset([atom.index]) if is_parameter else found.get(atom.statement)

    for i in numbers:
        form, *atoms = operations.get(i, ("",))
        parts = [zero(atom) for atom in atoms]
        if form == "{0} * {1}":
            found[i] = _narrower(*parts)
        elif form in ("-{0}", "{0} / {1}"):
            found[i] = parts[0]
        elif form in SUMS:  # makes no gate of its own
            second = _narrower(*parts[1:]) if len(parts) > 2 else parts[1]
            both = _either(parts[0], second)
            found[i] = both if both in (parts[0], second) else None
    return found


def _statements(
    program: Program, numbers: list[int], gate: Mapping[int, Gate], wanted: Mapping[int, Gate], prepared: Prepared
) -> Iterator[str]:
    """Declarations of what is read outside of its block, and the blocks, each behind its gate."""
    blocks = list(_blocks(program, numbers, gate))
    outside = [(i, x) for i, x in _read_outside(program, blocks, gate, wanted) if gate[i] is not None]
    shared = {i for i, _ in outside}
    zeros = {i for i, reader in outside if not _covers(gate[i], reader)}
    for i in numbers:
        if size := program.statements[i].size:
            yield f"  REAL @{i}[{size}];"
        elif i in shared:
            yield f"  REAL @{i}{' = 0' if i in zeros else ''};"
    for own, statements in blocks:
        lines = [program.statements[i].text.removeprefix("const REAL " if i in shared else "") for i in statements]
        yield from [f"  {line}" for line in lines] if own is None else _behind(prepared.flag(own), lines)


def _behind(flag: str, lines: list[str]) -> list[str]:
    return [f"  if ({flag}) {{", *(f"    {line}" for line in lines), "  }"]


def _read_outside(
    program: Program, blocks: list[tuple[Gate, list[int]]], gate: Mapping[int, Gate], wanted: Mapping[int, Gate]
) -> Iterator[tuple[int, Gate]]:
    """The numbers that outputs or other blocks read, each with the gate of its reader."""
    block = {i: at for at, (_, own) in enumerate(blocks) for i in own}
    for i, at in block.items():
        if i in wanted:
            yield i, wanted[i]
        yield from ((j, gate[i]) for j in program.statements[i].reads if block.get(j, at) != at)


def _covers(outer: Gate, inner: Gate) -> bool:
    """Whether a gate is open wherever another one is."""
    return outer is None or (inner is not None and inner <= outer)


def _blocks(program: Program, numbers: list[int], gate: Mapping[int, Gate]) -> Iterator[tuple[Gate, list[int]]]:
    """Statements in an order in which they can run, those behind one gate together as far as that goes."""
    own_numbers = set(numbers)
    waits = {i: len(program.statements[i].reads & own_numbers) for i in numbers}
    readers: dict[int, list[int]] = {}
    for i in numbers:
        for j in program.statements[i].reads:
            readers.setdefault(j, []).append(i)
    ready: dict[Gate, list[int]] = {}
    for i in numbers:
        if not waits[i]:
            heapq.heappush(ready.setdefault(gate[i], []), i)
    while ready:
        own = None if None in ready else max(ready, key=lambda x: (len(ready[x]), -ready[x][0]))
        done = []
        while ready.get(own):
            i = heapq.heappop(ready[own])
            done.append(i)
            for j in readers.get(i, ()):
                waits[j] -= 1
                if not waits[j]:
                    heapq.heappush(ready.setdefault(gate[j], []), j)
        del ready[own]
        yield own, done


def _written(program: Program, outputs: Outputs, columns: Mapping[str, int], prepared: Prepared) -> Iterator[str]:
    """The outputs, put in their places; columns of parameters behind their gates."""
    behind: dict[int, list[str]] = {}
    for place, row in outputs.items():
        for i, atom in enumerate(row_of(row)):
            right = program.read(atom)
            line = f"{place if row is atom else f'{place}[{i}]'} = {right};"
            if place in columns:
                behind.setdefault(i % columns[place], []).append(line)
            else:
                yield f"  {line}"
    for k, lines in behind.items():
        yield f"  if ({prepared.flag(frozenset([k]))}) {{ {' '.join(lines)} }}"
