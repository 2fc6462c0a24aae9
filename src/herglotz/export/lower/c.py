"""A traced step as C: the functions that the runtime calls, cut by the variables that each number depends on.

The step of a model is one traced function (`herglotz.export.step_parts.StepParts`). Its numbers are computed by
functions that run at different times. Members of two structures hand numbers on to later functions:

    prepare    numbers of h alone                    members of NAME_problem, kept while h stays
    begin      numbers of the start of a step        members of NAME_problem, and the guess of Δ
    evaluate   F and, on demand, J at a trial Δ      members of NAME_terms
    gains      p1 − p0, s1 − s0 and c − 1 at the end
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np

from herglotz.codegen.c_function import function, needed_by, row_of, whole
from herglotz.codegen.interpret import interpret
from herglotz.codegen.program import Program, Ref, literal
from herglotz.codegen.trace import Graph
from herglotz.export.equation import Equations
from herglotz.export.step_parts import step_parts

PREPARE, BEGIN, EVALUATE, GAINS = range(4)
Tables = dict[tuple[float, ...], str]


class StepInC:
    """The C functions of one model's step, in float64: numbers are rounded when they are written."""

    def __init__(self, equations: Equations):
        self.explicit = equations.model.capabilities.explicit
        self.program = Program()
        self.n, self.m = n, m = equations.model.dof, equations.model.inputs
        # The sizes of the arguments of traced functions; 0 is a scalar.
        self.start = {"P->q0": n, "P->p0": n, "P->s0": 0, "P->h": 0}
        self.more = {name: size for name, size in (("P->push", m), ("P->theta", len(equations.numbers or ()))) if size}
        field = {"P->V0.value": 0, "P->V0.slope": n, "t->move": n, "x": n, "V1->value": 0, "V1->slope": n}
        given = {name: self.program.given(name, size) for name, size in (self.start | field | self.more).items()}
        arrays = interpret(self.program, step_parts(equations), list(given.values()))
        guess, F, J, dp, ds, E, *bound = (list(x.ravel()) for x in arrays)
        self.sticks = bool(bound)
        self.earliest = self._earliest({name: given[name][0].statement for name in given})
        self.outputs = {
            "begin": {"move": guess, **({"P->bound": bound[0]} if bound else {})},
            "evaluate_first": {"t->F": F},
            **({} if self.explicit else {"evaluate": {"t->F": F, "t->J": J}}),
            "gains": {"dp": dp, "*ds": ds[0], "*E": E[0]},
        }

    def _earliest(self, given: Mapping[str, int]) -> list[int]:
        """The first function in which each statement could run."""
        of_input = {"P->h": PREPARE, "P->theta": PREPARE, "t->move": EVALUATE}
        of_input |= dict.fromkeys(("x", "V1->value", "V1->slope"), GAINS)
        known = {number: of_input.get(name, BEGIN) for name, number in given.items()}
        earliest: list[int] = []
        for i, statement in enumerate(self.program.statements):
            earliest.append(known.get(i, max((earliest[j] for j in statement.reads), default=PREPARE)))
        return earliest

    @cached_property
    def runs(self) -> dict[str, set[int]]:
        """The statements of each function: each as early as possible, but in `gains` those that only `gains` needs.

        `gains` reads results of `evaluate_first` but none of `evaluate`, because either may be the last to run.
        """
        needed = {name: needed_by(self.program, outputs) for name, outputs in self.outputs.items()}
        first, second = needed["evaluate_first"], needed.get("evaluate", set())
        runs = {
            "prepare": {i for i in set().union(*needed.values()) if self.earliest[i] == PREPARE},
            "begin": {i for i in needed["begin"] | first | second if self.earliest[i] == BEGIN},
            "evaluate_first": {i for i in first if self.earliest[i] == EVALUATE},
            "evaluate": {i for i in second if self.earliest[i] == EVALUATE},
        }
        runs["gains"] = needed["gains"] - runs["prepare"] - runs["begin"] - runs["evaluate_first"]
        return runs

    @cached_property
    def handed_on(self) -> dict[int, str]:
        """The statements whose results another function reads, and the member that keeps each result."""
        read: dict[str, set[int]] = {}
        for name, run in self.runs.items():
            read[name] = set().union(*(self.program.statements[i].reads for i in run))
            rows = self.outputs.get(name, {}).values()
            read[name] |= {x.statement for row in rows for x in row_of(row) if isinstance(x, Ref)}
        kept: dict[int, str] = {}
        for name, holder, readers in (
            ("prepare", "P", ("begin", "evaluate_first", "evaluate", "gains")),
            ("begin", "P", ("evaluate_first", "evaluate", "gains")),
            ("evaluate_first", "t", ("gains",)),
        ):
            wanted = set().union(*(read.get(reader, set()) for reader in readers))
            for i in sorted(self.runs[name] & wanted):
                if not self.program.statements[i].name:
                    kept[i] = f"{holder}->x{i}"
        return kept

    def members(self, holder: str) -> str:
        """The declarations of the members of one structure."""
        lines = []
        for i, place in self.handed_on.items():
            size = self.program.statements[i].size
            if place.startswith(f"{holder}->"):
                lines.append(f"  REAL x{i}{f'[{size}]' if size else ''};\n")
        return "".join(lines)

    def source(self) -> str:
        """The functions as a text of `REAL` and `FN_`, which become those of one sample or of a register of samples."""
        parts = []
        for name, (comment, arguments) in FUNCTIONS.items():
            if name == "evaluate" and self.explicit:
                continue
            head = f"\n/* {comment} */\nstatic inline void FN_{name}({arguments})"
            parts.append(function(self.program, head, self.runs[name], self.outputs.get(name, {}), self.handed_on))
        return "".join(parts)


FUNCTIONS = {
    "prepare": ("Numbers of h alone.", "FN_problem *P"),
    "begin": (
        "Numbers of the start of the step, and the uncoupled leapfrog step as a guess.",
        "FN_problem *P, REAL move[hz_N]",
    ),
    "evaluate_first": ("F at q1 = q0 + t->move.", "const FN_problem *P, FN_terms *t"),
    "evaluate": ("F and J = dF/dq1.", "const FN_problem *P, FN_terms *t"),
    "gains": (
        "p1 - p0, s1 - s0 and c - 1 of the solved step: x is the move, t->move where F was evaluated.",
        "const FN_problem *P, const FN_terms *t, const REAL x[hz_N], const FN_potential_t *V1,\n"
        "    REAL dp[hz_N], REAL *ds, REAL *E",
    ),
}


class Emitted(NamedTuple):
    """The parts of a header that depend on the model; `step` is a text of `REAL` and `FN_`.

    momentum is the Legendre transform and slopes the derivative of a step; either is "" where it was not asked for.
    """

    tables: str
    step: str
    momentum: str
    slopes: str


def model_source(
    step: StepInC, equations: Equations, derivatives: bool, velocities: bool = True, adjoint: bool = False
) -> Emitted:
    """The emitted parts of a header, with constants as `R(0.5)`."""
    push = "  REAL push[hz_INPUTS];\n" if step.m else ""
    push += "  REAL theta[hz_P];\n" if equations.numbers else ""
    push += "  REAL bound[hz_N]; /* dry friction holds moves up to this */\n" if step.sticks else ""
    types = TYPES.format(push=push, problem=step.members("P"), terms=step.members("t"))
    texts = types + _potential_source(equations, step) + step.source()
    slopes = _slopes_source(equations, step) if derivatives else ""
    slopes += _pull_source(equations, step) if adjoint else ""
    momentum = _momentum_source(equations, step) if velocities else ""
    tables = "".join(
        f"static const hz_real {name}[{len(row)}] = {{{', '.join(map(literal, row))}}};\n"
        for row, name in step.program.tables.items()
    )
    return Emitted(tables, texts, momentum, slopes)


TYPES = """
/* The potential at one point. */
typedef struct {{
  REAL value, slope[hz_N];
}} FN_potential_t;

/* The start of a step, and numbers that do not change while it is solved. */
typedef struct {{
  REAL q0[hz_N], p0[hz_N], s0, h;
{push}  FN_potential_t V0;
{problem}}} FN_problem;

/* The step equation at one q1 = q0 + move. After the solve, q1 = q0 + move + rest with the last, tiny correction. */
typedef struct {{
  REAL move[hz_N], rest[hz_N], F[hz_N], J[hz_N * hz_N];
{terms}}} FN_terms;
"""


def as_lanes(text: str) -> str:
    """A text of `REAL` and `FN_` as that of a register of samples."""
    return text.replace("SPREAD(", "hz_spread(").replace("FN_", "hz_wide_").replace("REAL", "hz_lanes")


def interpreted(graph: Graph, sizes: Mapping[str, int], tables: Tables) -> tuple[Program, list[np.ndarray]]:
    """A graph as a program of arguments with these names and sizes, which shares the tables, and its results."""
    program = Program(tables=tables)
    return program, interpret(program, graph, [program.given(name, size) for name, size in sizes.items()])


def _theta(equations: Equations) -> tuple[dict[str, int], str]:
    """The size and the declaration of the argument θ of a C function, where the header has parameters."""
    K = len(equations.numbers or ())
    return ({"theta": K}, "const REAL theta[hz_P], ") if K else ({}, "")


def _potential_source(equations: Equations, step: StepInC) -> str:
    """The potential and its slope as a C function."""
    theta, declared = _theta(equations)
    program, V, slope = Program(tables=step.program.tables), np.full(1, 0.0, object), np.full(step.n, 0.0, object)
    if equations.model.config.baseline:
        program, (V, slope) = interpreted(equations.potential, {"q": step.n} | theta, step.program.tables)
    head = f"\n/* V(q) and V'(q). */\nstatic inline void FN_potential(const REAL q[hz_N], {declared}FN_potential_t *V)"
    return whole(program, head, {"V->value": V.ravel()[0], "V->slope": list(slope.ravel())})


def _slopes_source(equations: Equations, step: StepInC) -> str:
    """The derivative of a solved step as a C function."""
    sizes = step.start | {"move": step.n} | step.more
    program, (slopes,) = interpreted(equations.jacobian, sizes, step.program.tables)
    head = "\n/* d(q, p, s)' / d(q, p, s, h, push) at the solution q1 = q0 + move, row by row. */\n"
    head += "static inline void FN_slopes(const FN_problem *P, const REAL move[hz_N], REAL *slopes)"
    return whole(program, head, {"slopes": list(slopes.ravel())})


def _momentum_source(equations: Equations, step: StepInC) -> str:
    """The Legendre transform p = L_v as a C function: `herglotz.stepping.velocity`."""
    theta, declared = _theta(equations)
    sizes = {"q": step.n, "v": step.n, "s": 0, "h": 0} | theta
    program, arrays = interpreted(equations.momentum, sizes, step.program.tables)
    named = zip(("p", "by_v", "grip", "grip_by_v"), arrays, strict=False)
    outputs = {name: list(x.ravel()) for name, x in named}
    head = "\n/* L_v and L_vv at (q, v, s); of set-valued friction (h/2) r(q, v) and its slope by v. */\n"
    head += "static inline void FN_momentum(const REAL q[hz_N], const REAL v[hz_N], REAL s, REAL h,\n    "
    head += declared + ", ".join(f"REAL {name}[{'hz_N * hz_N' if name == 'by_v' else 'hz_N'}]" for name in outputs)
    return whole(program, f"{head})", outputs)


def _pull_source(equations: Equations, step: StepInC) -> str:
    """The derivative of a solved step, transposed and times a vector, as a C function."""
    sizes = step.start | {"move": step.n, "of": 2 * step.n + 1} | step.more
    program, rows = interpreted(equations.pull, sizes, step.program.tables)
    head = "\n/* The derivatives by (q, p, s, h, push) before a solved step from those `of` (q, p, s)' after it. */\n"
    head += "static inline void FN_pull(const FN_problem *P, const REAL move[hz_N], const REAL *of, REAL *pulled)"
    return whole(program, head, {"pulled": [x for row in rows for x in row.ravel()]})
