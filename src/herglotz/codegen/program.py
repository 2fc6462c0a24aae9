"""Straight-line C in static single assignment: scalars, loops over rows and calls of kernels, each expression once.

A number of the traced function is an `Atom`: a Python float if the number is constant, else a `Ref` to the result of a
statement. Constants are folded, zeros and ones dropped. A loop is written for eight or more neighbouring results whose
operands lie in rows of memory; every other result is a scalar on a line of its own. `function` makes a C function of
statements: locals, the statements, outputs in their places.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from herglotz.errors import InputError

# Number of results from which a loop is written: shorter rows are faster as scalars, and take no more lines.
LOOP = 8
# Sine and cosine of a row are computed in the same loop, which compilers turn into a single call: networks read both.
SINE_AND_COSINE = ("FN_sin({0})", "FN_cos({0})")
# Number of nonzero weights from which a matrix product is a call of a kernel.
DENSE = 64


class Ref(NamedTuple):
    """A result of a statement: a scalar, or entry `index` of its row."""

    statement: int
    index: int = 0


class Compared(NamedTuple):
    """The condition a > b, which only `where` reads."""

    a: Any
    b: Any


# A float or a `Ref`.
Atom = Any
NAME = re.compile(r"@(\d+)")
# The place written to → its number, or the list of its numbers.
Outputs = Mapping[str, Any]


@dataclass
class Statement:
    """A line or a loop; `@7` in the text is the result of statement 7, which may be this statement itself.

    `size` is the length of the row, 0 for a scalar; `name` is the name of an input in C, empty for a result.
    """

    text: str
    size: int
    reads: set[int]
    name: str = ""


@dataclass
class Program:
    """Statements in order, and tables of their results for reuse.

    `operations` has the form and the operands of every scalar. A loop is written for `loop` results or more; infinity
    writes no loops. `angles`, an `herglotz.codegen.angles.Angles`, expands sines and cosines of sums.
    """

    statements: list[Statement] = field(default_factory=list)
    tables: dict[tuple[float, ...], str] = field(default_factory=dict)
    known: dict[Any, Atom] = field(default_factory=dict)
    operations: dict[Ref, tuple[Any, ...]] = field(default_factory=dict)
    loop: float = LOOP
    angles: Any = None

    def given(self, name: str, size: int) -> list[Ref]:
        """An input of the function: a row of `size` numbers, or a scalar for size 0."""
        self.statements.append(Statement("", size, set(), name))
        return [Ref(len(self.statements) - 1, i) for i in range(max(size, 1))]

    def table(self, values: Iterable[float]) -> str:
        """The name of a row of constants."""
        key = tuple(float(x) for x in values)
        return self.tables.setdefault(key, f"hz_w{len(self.tables)}")

    def scalar(self, form: str, atoms: Sequence[Atom]) -> Ref:
        """The result of a formula such as `{0} + {1}`; a repeated formula of the same numbers is computed once."""
        key = (form, *atoms)
        if key not in self.known:
            ref = self._append(f"const REAL @@ = {form.format(*map(self.read, atoms))};", 0)
            self.known[key], self.operations[ref] = ref, key
        return self.known[key]

    def elementwise(
        self, form: str, fold: Callable[..., Atom | None], *operands: Any, kernel: str | None = None
    ) -> np.ndarray:
        """A formula as in `scalar`, entry by entry of arrays of atoms that broadcast.

        `fold` gives the result if no operation is needed, else None; `kernel` names a C function of (count, x, y) for a
        whole row.
        """
        arrays = np.broadcast_arrays(*(np.asarray(x, object) for x in operands))
        out = np.empty(arrays[0].size, object)
        columns = [x.ravel() for x in arrays]
        fresh: dict[Any, list[int]] = {}
        for i, atoms in enumerate(zip(*columns, strict=True)):
            value = fold(*atoms)
            if value is None:
                value = self.known.get((form, *atoms))
            if value is None:
                fresh.setdefault(atoms, []).append(i)
            else:
                out[i] = value
        todo = list(fresh)
        start = 0
        while start < len(todo):
            count = _run(todo, start)
            results = self._row(form, todo[start : start + count], kernel)
            for atoms, result in zip(todo[start : start + count], results, strict=True):
                for i in fresh[atoms]:
                    out[i] = result
            start += count
        return out.reshape(arrays[0].shape)

    def _row(self, form: str, entries: list[tuple[Atom, ...]], kernel: str | None) -> list[Ref]:
        """The results of a run of entries: a loop if the run is long, else scalars."""
        count = len(entries)
        if count < self.loop:
            return [self.scalar(form, atoms) for atoms in entries]
        columns, forms = list(zip(*entries, strict=True)), (form,)
        if form in SINE_AND_COSINE:
            forms = SINE_AND_COSINE
            sine, cosine = (f.format(self._in_loop(columns[0])) for f in forms)
            text = f"for (k = 0; k < {count}; k++) {{ @@[k] = {sine}; @@[k + {count}] = {cosine}; }}"
        elif kernel is not None:
            text = f"{kernel}({count}, {self.pointer(columns[0])}, @@);"
        else:
            text = f"for (k = 0; k < {count}; k++) @@[k] = {form.format(*map(self._in_loop, columns))};"
        number = self._append(text, len(forms) * count).statement
        for j, f in enumerate(forms):
            for i, atoms in enumerate(entries):
                self.known[(f, *atoms)] = Ref(number, j * count + i)
        return [self.known[(form, *atoms)] for atoms in entries]

    def _in_loop(self, column: Sequence[Atom]) -> str:
        """The operand of a loop over k for a column whose entries are evenly spaced (`_run`)."""
        first = column[0]
        if not isinstance(first, Ref):
            return self.read(first) if len(set(column)) == 1 else f"{self.table(column)}[k]"
        stride = column[1].index - first.index
        if not stride:
            return self.read(first)
        index = "k" if stride == 1 else f"{stride} * k"
        return f"@{first.statement}[{index}{f' + {first.index}' if first.index else ''}]"

    def read(self, atom: Atom) -> str:
        """A number as an operand in C."""
        if not isinstance(atom, Ref):
            return literal(atom)
        return f"@{atom.statement}[{atom.index}]" if self.statements[atom.statement].size else f"@{atom.statement}"

    def pointer(self, atoms: Sequence[Atom]) -> str:
        """The address of a row with these numbers; numbers that are no row in memory are copied into a new row."""
        first = atoms[0]
        if isinstance(first, Ref) and self.statements[first.statement].size:
            wanted = [Ref(first.statement, first.index + i) for i in range(len(atoms))]
            if list(atoms) == wanted:
                return f"@{first.statement}" + (f" + {first.index}" if first.index else "")
        return f"@{self._once(('packed', *atoms), lambda: self._packed(atoms), len(atoms)).statement}"

    def _packed(self, atoms: Sequence[Atom]) -> str:
        """The statements that copy numbers into a row."""
        lines, start = [], 0
        while start < len(atoms):
            count = _run([(x,) for x in atoms], start)
            spread = "{}" if isinstance(atoms[start], Ref) else "SPREAD({})"
            if count < self.loop:
                lines += [f"@@[{i}] = {spread.format(self.read(atoms[i]))};" for i in range(start, start + count)]
            else:
                right = spread.format(self._in_loop(atoms[start : start + count]))
                lines.append(f"for (k = 0; k < {count}; k++) @@[{f'k + {start}' if start else 'k'}] = {right};")
            start += count
        return "\n".join(lines)

    def product(self, x: Sequence[Atom], weight: np.ndarray, bias: Sequence[Atom] | None) -> list[Atom]:
        """Σ_j x_j w_jk + b_k for a row x (k,), w (k, m) and b (m,)."""
        kept = [j for j, value in enumerate(x) if value != 0.0 and np.any(weight[j] != 0.0)]
        x, weight = [x[j] for j in kept], weight[kept]
        size = weight.shape[1]
        start = [0.0] * size if bias is None else list(bias)
        if not kept:
            return start
        dense = max(len(kept), size) >= self.loop and np.count_nonzero(weight) >= min(DENSE, weight.size)
        if dense and _varies(x) and not _varies([*weight.flat, *start]):
            key = ("product", tuple(x), tuple(weight.flat), tuple(start))
            row = self._once(key, lambda: self._call_product(x, weight, start), size).statement
            return [Ref(row, i) for i in range(size)]
        return [self.sum([start[k], *(multiply(self, v, w) for v, w in zip(x, weight[:, k], strict=True))])
                for k in range(size)]  # fmt: skip

    def _call_product(self, x: Sequence[Atom], weight: np.ndarray, start: Sequence[float]) -> str:
        """The call of the kernel that adds a matrix product to the start."""
        where, size = self.pointer(x), len(start)
        tables = f"{self.table(weight.flat)}, {self.table(weight.T.flat)}"
        text = f"for (k = 0; k < {size}; k++) @@[k] = SPREAD({self._in_loop(list(start))});\n"
        return f"{text}FN_product({len(x)}, {size}, {tables}, {where}, @@);"

    def sum(self, atoms: Iterable[Atom]) -> Atom:
        """The sum; of numbers in a long row by a call of a kernel."""
        terms = [x for x in atoms if x != 0.0]
        if len(terms) >= self.loop and _run([(x,) for x in terms], 0) == len(terms) and isinstance(terms[0], Ref):
            where = self.pointer(terms)
            text = f"const REAL @@ = FN_sum({len(terms)}, {where});"
            return self._once(("sum", where, len(terms)), lambda: text, 0)
        total: Atom = 0.0
        for x in terms:
            total = add(self, total, x)
        return total

    def inverse(self, matrix: np.ndarray) -> list[Ref]:
        """The inverse of a matrix (n, n) of atoms, row by row."""
        where, n = self.pointer(list(matrix.flat)), len(matrix)
        number = self._append(f"FN_inverse({n}, {where}, @@);", n * n).statement
        return [Ref(number, i) for i in range(n * n)]

    def _once(self, key: Any, text: Callable[[], str], size: int) -> Ref:
        """The result of the statement with this key, which is written on first use."""
        if key not in self.known:
            self.known[key] = self._append(text(), size)
        return self.known[key]

    def _append(self, text: str, size: int) -> Ref:
        """The result of a new statement; `@@` in the text is the result of this statement."""
        number = len(self.statements)
        reads = {int(x) for x in NAME.findall(text)}
        self.statements.append(Statement(text.replace("@@", f"@{number}"), size, reads))
        return Ref(number)


def add(program: Program, a: Atom, b: Atom) -> Atom:
    """The sum of two numbers."""
    value = fold_add(a, b)
    return program.scalar("{0} + {1}", (a, b)) if value is None else value


def multiply(program: Program, a: Atom, b: Atom) -> Atom:
    """The product of two numbers."""
    value = fold_multiply(a, b)
    if value is None and -1.0 in (a, b):
        return program.scalar("-{0}", (b if a == -1.0 else a,))
    return program.scalar("{0} * {1}", (a, b)) if value is None else value


def fold_add(a: Atom, b: Atom) -> Atom | None:
    """The sum if no operation is needed, else None."""
    if isinstance(a, Ref):
        return a if not isinstance(b, Ref) and b == 0.0 else None
    if isinstance(b, Ref):
        return b if a == 0.0 else None
    return a + b


def fold_multiply(a: Atom, b: Atom) -> Atom | None:
    """The product if no operation is needed, else None."""
    if not isinstance(a, Ref) and not isinstance(b, Ref):
        return a * b
    for number, other in ((a, b), (b, a)):
        if not isinstance(number, Ref):
            return 0.0 if number == 0.0 else other if number == 1.0 else None
    return None


def literal(value: float) -> str:
    """A constant in C, which `herglotz.export.c_header` rounds and marks by the number type.

    Raise InputError if the constant is not finite, such as the inverse of a singular mass (erratum E4: no step exists).
    """
    if not math.isfinite(value):
        raise InputError(
            f"a constant of the step equation is {value}: the mass matrix is singular or a parameter overflowed, "
            "so the model has no step; fit it again"
        )
    text = repr(float(value))
    return f"R({text})" if value >= 0 else f"(-R({text[1:]}))"


def _varies(atoms: Iterable[Atom]) -> bool:
    """Whether any of these numbers is the result of a statement, not a constant."""
    return any(isinstance(x, Ref) for x in atoms)


def _run(entries: Sequence[tuple[Atom, ...]], start: int) -> int:
    """How many entries from `start` a loop can read: each operand is constant, the same number, or evenly spaced."""
    first, count = entries[start], 1
    strides: list[int | None] | None = None
    while start + count < len(entries):
        entry = entries[start + count]
        steps = [_step(a, b, count) for a, b in zip(first, entry, strict=True)]
        if None in steps or (strides is not None and steps != strides):
            break
        strides = steps
        count += 1
    return count


def _step(a: Atom, b: Atom, distance: int) -> int | None:
    """The stride between two entries of a row, None if their distance is no multiple of a stride."""
    if isinstance(a, Ref) and isinstance(b, Ref) and a.statement == b.statement:
        gap = b.index - a.index
        return gap // distance if gap % distance == 0 else None
    return None if isinstance(a, Ref) or isinstance(b, Ref) else 0


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
    rows = _rows(program, computed, handed_on, results(outputs))
    sizes = {name: program.statements[i].size for i, name in rows.items()}
    lines = [f"REAL {name}[{size}];" for name, size in sizes.items()]
    lines += [program.statements[i].text.removeprefix("const REAL " if i in handed_on else "") for i in computed]
    text = named(program, [*lines, *_written(program, outputs)], {**handed_on, **rows})
    body = "".join(f"  {line}\n" for line in text.splitlines())
    unused = "".join(f"  (void){x};\n" for x in re.findall(r"(\w+)(?:\[\w+\])?(?=[,)])", head.rsplit("static", 1)[1])
                     if not re.search(rf"\b{x}\b", body))  # fmt: skip
    counter = "  int k;\n" if "(k = 0;" in body else ""
    return f"{head} {{\n{counter}{unused}{body}}}\n"


def _rows(program: Program, computed: list[int], handed_on: Collection[int], kept: Collection[int]) -> dict[int, str]:
    """The names of the rows that statements compute; a row that no later statement reads gives its place to the next.

    Compilers do not share the stack in this way. Rows of `kept` statements are never given away, and those that are
    handed on have names already.
    """
    last_reader = {j: i for i in computed for j in program.statements[i].reads if j not in kept}
    names: dict[int, str] = {}
    free: dict[int, list[str]] = {}
    for i in computed:
        size = program.statements[i].size
        if size and i not in handed_on:
            places = free.get(size)
            names[i] = places.pop() if places else f"t{i}"
        for j in program.statements[i].reads:
            if j in names and last_reader.get(j) == i:
                free.setdefault(program.statements[j].size, []).append(names[j])
    return names


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
