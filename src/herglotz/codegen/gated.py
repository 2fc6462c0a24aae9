"""A C function that skips the statements which only absent parameters need.

A parameter θ_k is *off* if θ_k is 0 and no derivative by θ_k is asked for. A product with a parameter that is off is 0,
and a number that only such products read is not needed. Every statement stands behind a gate: a set of parameters of
which at least a single parameter must be on. The numbers of a skipped statement are 0. A compiled dictionary of terms
then costs no more than the terms of the evaluated model. Numbers that depend on parameters alone are computed once for
many calls.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from herglotz.codegen.program import Outputs, Program, Ref, named, needed_by, places

SUMS = ("{0} + {1}", "{0} - {1}", "{0} + {1} * {2}", "{0} - {1} * {2}")
# Operations with finite results for finite operands, each cheaper than a branch.
PLAIN = (*SUMS, "{0} * {1}", "-{0}")
# Arguments that do not change from step to step.
CONSTANT = ("theta", "constants")
# Number of plain operations from which a branch is cheaper than the operations.
WORTH_A_BRANCH = 3

# Parameters of which at least one must be on for the gate to open; None: always open.
Gate = frozenset[int] | None


@dataclass
class Prepared:
    """Arguments that all functions of a library share: gates, and numbers that depend on parameters alone.

    `gates` has the index of each gate in the array of flags, `fixed` the count of numbers that depend on parameters
    alone, and `parts` the blocks of C that compute these numbers.
    """

    gates: dict[frozenset[int], int] = field(default_factory=dict)
    fixed: int = 0
    parts: list[str] = field(default_factory=list)

    def flag(self, gate: frozenset[int]) -> str:
        """The C expression of a gate's flag."""
        return f"gate[{self.gates.setdefault(gate, len(self.gates))}]"

    def fix(self, program: Program, statements: list[int], read: list[int]) -> dict[int, str]:
        """Names in C of the fixed numbers that other statements `read`, by statement."""
        names = {i: f"fixed[{self.fixed + at}]" for at, i in enumerate(read)}
        lines = [program.statements[i].text for i in statements] + [f"{name} = @{i};" for i, name in names.items()]
        self.parts.append(f"  {{\n{named(program, [f'    {line}' for line in lines])}\n  }}\n")
        self.fixed += len(read)
        return names

    def function(self) -> str:
        """The C function that sets all flags and fixed numbers; `on` says which parameters are on."""
        flags = [f"  gate[{i}] = {' || '.join(f'on[{k}]' for k in sorted(x))};\n" for x, i in self.gates.items()]
        sizes = f"\n#define hz_GATES {max(1, len(self.gates))}\n#define hz_FIXED {max(1, self.fixed)}\n"
        taken = "const double *theta, const double *constants, const char *on, char *gate, double *fixed"
        head = f"static void hz_prepare({taken}) {{\n  (void)on, (void)gate, (void)fixed, (void)constants;\n"
        return "".join([sizes, head, *flags, *self.parts, "}\n"])


def gated(program: Program, head: str, outputs: Outputs, prepared: Prepared, columns: Mapping[str, int] = {}) -> str:
    """The C function of these outputs.

    `columns` has the number of parameters of outputs that are derivatives, row by row; the column of a parameter that
    is off is not written.
    """
    numbers = sorted(i for i in needed_by(program, outputs) if not program.statements[i].name)
    wanted = _wanted(outputs, columns)
    gate = _gates(program, numbers, wanted)
    fixed = _fixed(program, numbers)
    moving = [i for i in numbers if i not in fixed]
    read = set(wanted).union(*(program.statements[i].reads for i in moving)) & fixed
    names = prepared.fix(program, [i for i in numbers if i in fixed], sorted(read))
    lines = [*_statements(program, moving, gate, wanted, prepared), *_written(program, outputs, columns, prepared)]
    return f"{head} {{\n{named(program, lines, names)}\n}}\n"


def _fixed(program: Program, numbers: list[int]) -> set[int]:
    """The scalars that depend on parameters alone."""
    found = {i for i, x in enumerate(program.statements) if x.name in CONSTANT}
    for i in numbers:
        if not program.statements[i].size and program.statements[i].reads <= found:
            found.add(i)
    return found & set(numbers)


def _wanted(outputs: Outputs, columns: Mapping[str, int]) -> dict[int, Gate]:
    """The statements whose results are outputs, and the gate of each output."""
    found: dict[int, Gate] = {}
    for name, i, _, atom in places(outputs):
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
    """The gate of every statement: if the gate is closed, the result is 0, or nothing needs the result."""
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
    """For every operation on scalars, the parameters without which the result is 0."""
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
        elif form in SUMS:
            # A sum has the gate of an operand, never a new gate.
            second = _narrower(*parts[1:]) if len(parts) > 2 else parts[1]
            both = _either(parts[0], second)
            found[i] = both if both in (parts[0], second) else None
    return found


def _statements(
    program: Program, numbers: list[int], gate: Mapping[int, Gate], wanted: Mapping[int, Gate], prepared: Prepared
) -> Iterator[str]:
    """Declarations of the numbers that are read outside of their block, and the blocks, each behind its gate."""
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
        if own is None:
            yield from (f"  {line}" for line in lines)
        else:
            yield from (f"  if ({prepared.flag(own)}) {{", *(f"    {line}" for line in lines), "  }")


def _read_outside(
    program: Program, blocks: list[tuple[Gate, list[int]]], gate: Mapping[int, Gate], wanted: Mapping[int, Gate]
) -> Iterator[tuple[int, Gate]]:
    """The numbers that outputs or other blocks read, each with the gate of the reader."""
    block = {i: at for at, (_, own) in enumerate(blocks) for i in own}
    for i, at in block.items():
        if i in wanted:
            yield i, wanted[i]
        yield from ((j, gate[i]) for j in program.statements[i].reads if block.get(j, at) != at)


def _covers(outer: Gate, inner: Gate) -> bool:
    """Whether the outer gate is open whenever the inner gate is open."""
    return outer is None or (inner is not None and inner <= outer)


def _blocks(program: Program, numbers: list[int], gate: Mapping[int, Gate]) -> Iterator[tuple[Gate, list[int]]]:
    """Statements in an order in which they can run; statements of the same gate stand together where possible."""
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
    for name, i, text, atom in places(outputs):
        line = f"{text} = {program.read(atom)};"
        if name in columns:
            behind.setdefault(i % columns[name], []).append(line)
        else:
            yield f"  {line}"
    for k, lines in behind.items():
        yield f"  if ({prepared.flag(frozenset([k]))}) {{ {' '.join(lines)} }}"
