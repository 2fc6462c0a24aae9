"""A traced step as C: the functions that the runtime calls, cut by the variables that each number depends on.

The step of a model is one traced function (`StepParts`). Its numbers are computed by
functions that run at different times. Members of two structures hand numbers on to later functions:

    prepare    numbers of h alone                    members of NAME_problem, kept while h stays
    begin      numbers of the start of a step        members of NAME_problem, and the guess of Δ
    evaluate   F and, on demand, J at a trial Δ      members of NAME_terms
    gains      p1 − p0, s1 − s0 and c − 1 at the end
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from types import MethodType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from herglotz.codegen.interpret import interpret
from herglotz.codegen.program import Program, Ref, function, literal, needed_by, row_of, whole
from herglotz.codegen.trace import Graph
from herglotz.export.equation import Equations, example, field_like
from herglotz.mechanics.legendre import soft_threshold
from herglotz.mechanics.newton import Point
from herglotz.models import ContactLagrangian, OwnLagrangian
from herglotz.models.friction import Friction
from herglotz.models.jet import Jet
from herglotz.models.terms import FeatureKinetic, PositionKinetic, Potential
from herglotz.stepping import State
from herglotz.stepping.equation import PartialsEquation, model_equation
from herglotz.stepping.explicit import Field, Leapfrog
from herglotz.stepping.newton import StickSlip, at_rest
from herglotz.stepping.single_step import driven_by

# The potential at q0 and q1.
Ends = tuple[Field, Field]
# The results of `StepParts`.
Parts = tuple[Tensor, ...]


def step_parts(equations: Equations) -> Graph:
    """`StepParts` as a graph."""
    q, p, s, h, *u = example(equations.model, 0.1)
    V, slope = field_like(q)
    more = (V, slope, 0.1 * p, 0.2 * p, V + 1, slope + 1)
    return equations.traced(StepParts(equations.model), (q, p, s, h, *more, *u))


def with_zero_as_input(model: ContactLagrangian) -> ContactLagrangian:
    """The model with a last input, 1 where inputs act and 0 where none does, as the factor of u₀. Changed in place.

    Inputs that are all 0 then exert no force. A model without u₀ stays as it is.
    """
    friction = model.friction
    if friction is not None and friction.input_zero is not None:
        model.config = replace(model.config, inputs=model.config.inputs + 1, input_map=())
        friction.applied = MethodType(_applied, friction)
    return model


def _applied(friction: Friction, u: Tensor) -> Tensor:
    """G (u − a u₀), where a is the last input."""
    assert friction.input_zero is not None
    return (u[..., :-1] - u[..., -1:] * friction.input_zero) @ friction.input_map.T


class GivenPotential(nn.Module):
    """A potential whose values and slopes at q0 and q1 are given; its second derivatives are 0 and never read."""

    def __init__(self, potential: Potential, ends: Ends):
        super().__init__()
        self.features = potential.features
        self.ends = ends

    def forward(self, q: Tensor, order: int) -> Jet:
        """The jets at (q0, q1), (2, B, n)."""
        n = q.shape[-1]
        rows = [torch.stack([end.V for end in self.ends])[None]]
        rows.append(torch.stack([end.slope for end in self.ends]).movedim(-1, 0))
        if order == 2:
            rows.append(q.new_zeros(n * (n + 1) // 2, *q.shape[:-1]))
        return Jet(torch.cat(rows), n, order)


class StepParts:
    """The terms of a step, for `StepInC`.

    Where the step is explicit, the guess is the solution, and J is 0.
    """

    def __init__(self, model: ContactLagrangian):
        self.model = model

    def __call__(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """The guess of Δ, F and J at the trial, and p1 − p0, s1 − s0 and c − 1.

        The arguments are q, p (B, n), s, h (B,), V0 (B,) and V′ (B, n) at q0, a trial Δ = q1 − q0 and the exact Δ near
        the trial (B, n), V1 and V′ at q1, and u (B, m) where the model takes inputs. Where dry friction can hold a
        coordinate, Δ stands for the z of `herglotz.stepping.newton.StickSlip`, and w/K is a last result.
        """
        (q, p, s, h, V0, slope0, delta, x, V1, slope1), u = arguments[:10], arguments[10:]
        ends = Field(V0, slope0), Field(V1, slope1)
        known = self.model.capabilities
        form = self._explicit if known.explicit else self._by_terms if known.by_terms else self._by_jets
        if known.sticking:
            form = self._by_sticking
        guess, F, J, dp, L, E, *bound = form(State(q, p, s), h, ends, delta, x, u[0] if u else None)
        return *(y.clone() for y in (guess, F, J, dp, L)), E.expand(s.shape).clone(), *bound

    def _explicit(self, state: State, h: Tensor, ends: Ends, delta: Tensor, _: Tensor, u: Tensor | None) -> Parts:
        frog = Leapfrog(self.model, field=lambda _: ends[1])
        move = frog(state, h, ends[0], u, True)
        assert move.dp is not None
        maker = model_equation(self.model, fold=False)
        assert maker is not None
        # FL⁺ needs F; the step itself does not.
        F = maker.at(state, h, u, True, ends[0])(delta, False).F
        J = F[..., None] * torch.zeros_like(F)[..., None, :]
        return move.delta, F, J, move.dp, move.L, frog.constants(h).c_minus_1

    def _by_terms(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        maker = model_equation(self.model, fold=False)
        assert maker is not None
        maker.field = lambda _: ends[1]  # pyright: ignore[reportAttributeAccessIssue]
        form = maker.at(state, h, u, True, ends[0])
        point = form(delta, True)
        v, mv, N, damping, force = form.at(x, point).rest
        if self.model.friction is not None:
            # Dry friction is steep near rest, so it is evaluated at the exact velocity.
            force = self.model.friction.value_and_slope(v, u)[0]
        end = form.end(x, Point(point.F, point.J, (v, mv, N, damping, force)))
        E = form.constants.c_minus_1 if damping is None else damping[1]
        dp = end.dp
        if dp is None:
            # F at the trial is not quite 0: the move from the trial to x adds F to p1.
            dp = (form.end(delta, point).p1 + point.F) - state.p
        assert point.J is not None
        return form.leap(), point.F, point.J, dp, end.L, E

    def _by_jets(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        with self._given(ends):
            form = PartialsEquation(driven_by(self.model, u), state, h, 1, increments=True)
            point = form(delta, True)
        end = form.end(delta, point)
        # F at the trial is not quite 0, as in `_by_terms`.
        dp = (end.p1 + point.F) - state.p
        assert point.J is not None
        guess = self._leap(state, h, ends[0])
        return guess, point.F, point.J, dp, end.L + (end.p1 * (x - delta)).sum(-1), point.rest.D3

    def _by_sticking(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        with self._given(ends):
            equation = PartialsEquation(driven_by(self.model, u), state, h, 1, increments=True)
            guess, stiffness, bound = at_rest(equation)
            form = StickSlip(equation, stiffness, bound)
            point = form(delta, True)
        end, moved = equation.end(delta, point), soft_threshold(x, bound) - soft_threshold(delta, bound)
        # −J (Δ(x) − Δ): F changes with Δ alone, not with the part of z inside the bound.
        left = point.F - torch.where(form.slides(delta), 0.0, stiffness * (x - delta))
        assert point.J is not None
        L = end.L + (end.p1 * moved).sum(-1)
        return guess, point.F, point.J, (end.p1 + left) - state.p, L, point.rest.D3, bound.clone()

    @contextmanager
    def _given(self, ends: Ends) -> Iterator[None]:
        """The model with a `GivenPotential`; an L_d of the user's own has no potential."""
        potential = self.model.potential
        if isinstance(self.model, OwnLagrangian):
            yield
            return
        self.model.potential = GivenPotential(potential, ends)  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            self.model.potential = potential

    def _leap(self, state: State, h: Tensor, here: Field) -> Tensor:
        """A guess of Δ: the leapfrog step with the mass at q = 0 and without the correction network."""
        model = self.model
        if not model.config.baseline:
            return torch.zeros_like(state.q)
        kinetic: Any = model.kinetic
        kinetic = kinetic.base if isinstance(kinetic, FeatureKinetic) else kinetic
        mass = (kinetic.constant if isinstance(kinetic, PositionKinetic) else kinetic).mass()
        root = torch.ones_like(h) if model.damping is None else (-model.damping.rate * h / 2).exp()
        push = state.p - (h / 2)[..., None] * here.slope
        return (push @ torch.linalg.inv_ex(mass)[0]) * (h * root)[..., None]


PREPARE, BEGIN, EVALUATE, GAINS = range(4)


class StepInC:
    """The C functions of one model's step, in float64: numbers are rounded when they are written."""

    def __init__(self, equations: Equations):
        self.equations = equations
        self.explicit = equations.model.capabilities.explicit
        self.program = Program()
        self.n, self.m = n, m = equations.model.dof, equations.model.inputs
        # The sizes of the arguments of traced functions; 0 is a scalar.
        self.start = {"P->q0": n, "P->p0": n, "P->s0": 0, "P->h": 0}
        self.more = {name: size for name, size in (("P->u", m), ("P->theta", len(equations.numbers or ()))) if size}
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
        """The step as a text of `REAL` and `FN_`, which become those of one sample or of a register of samples.

        Constants are written as `R(0.5)`.
        """
        parts = [TYPES.format(problem=self.members("P"), terms=self.members("t")), self._potential()]
        for name, (comment, arguments) in FUNCTIONS.items():
            if name == "evaluate" and self.explicit:
                continue
            head = f"\n/* {comment} */\nstatic inline void FN_{name}({arguments})"
            parts.append(function(self.program, head, self.runs[name], self.outputs.get(name, {}), self.handed_on))
        return "".join(parts)

    def tables(self) -> str:
        """The constant rows of all functions that have been written."""
        rows = ((name, ", ".join(map(literal, row)), len(row)) for row, name in self.program.tables.items())
        return "".join(f"static const hz_real {name}[{size}] = {{{row}}};\n" for name, row, size in rows)

    def _interpreted(self, graph: Graph, sizes: Mapping[str, int]) -> tuple[Program, list[np.ndarray]]:
        """A graph as a program of arguments with these names and sizes, which shares the tables, and its results."""
        program = Program(tables=self.program.tables)
        return program, interpret(program, graph, [program.given(name, size) for name, size in sizes.items()])

    def _theta(self) -> tuple[dict[str, int], str]:
        """The size and the declaration of the argument θ of a C function, where the header has parameters."""
        K = len(self.equations.numbers or ())
        return ({"theta": K}, "const REAL theta[hz_P], ") if K else ({}, "")

    def _potential(self) -> str:
        """The potential and its slope as a C function."""
        theta, declared = self._theta()
        program, V, slope = Program(tables=self.program.tables), np.full(1, 0.0, object), np.full(self.n, 0.0, object)
        if self.equations.model.config.baseline:
            program, (V, slope) = self._interpreted(self.equations.potential, {"q": self.n} | theta)
        head = "\n/* V(q) and V'(q). */\n"
        head += f"static inline void FN_potential(const REAL q[hz_N], {declared}FN_potential_t *V)"
        return whole(program, head, {"V->value": V.ravel()[0], "V->slope": list(slope.ravel())})

    def slopes(self) -> str:
        """The derivative of a solved step as a C function."""
        program, (slopes,) = self._interpreted(self.equations.jacobian, self.start | {"move": self.n} | self.more)
        head = "\n/* d(q, p, s)' / d(q, p, s, h, u, theta) at the solution q1 = q0 + move, row by row. */\n"
        head += "static inline void FN_slopes(const FN_problem *P, const REAL move[hz_N], REAL *slopes)"
        return whole(program, head, {"slopes": list(slopes.ravel())})

    def momentum(self) -> str:
        """The Legendre transform p = L_v as a C function: `herglotz.stepping.velocity`."""
        theta, declared = self._theta()
        program, arrays = self._interpreted(self.equations.momentum, {"q": self.n, "v": self.n, "s": 0, "h": 0} | theta)
        named = zip(("p", "by_v", "grip", "grip_by_v"), arrays, strict=False)
        outputs = {name: list(x.ravel()) for name, x in named}
        head = "\n/* L_v and L_vv at (q, v, s); of set-valued friction (h/2) r(q, v) and its slope by v. */\n"
        head += "static inline void FN_momentum(const REAL q[hz_N], const REAL v[hz_N], REAL s, REAL h,\n    "
        head += declared + ", ".join(f"REAL {name}[{'hz_N * hz_N' if name == 'by_v' else 'hz_N'}]" for name in outputs)
        return whole(program, f"{head})", outputs)

    def pull(self) -> str:
        """The derivative of a solved step, transposed and times a vector, as a C function."""
        sizes = self.start | {"move": self.n, "of": 2 * self.n + 1} | self.more
        program, rows = self._interpreted(self.equations.pull, sizes)
        head = "\n/* The derivatives before a solved step, by (q, p, s, h, u, theta), from `of`, those after. */\n"
        head += "static inline void FN_pull(const FN_problem *P, const REAL move[hz_N], const REAL *of, REAL *pulled)"
        return whole(program, head, {"pulled": [x for row in rows for x in row.ravel()]})


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


TYPES = """
/* The potential at one point. */
typedef struct {{
  REAL value, slope[hz_N];
}} FN_potential_t;

/* The start of a step, and numbers that do not change while it is solved. */
typedef struct {{
  REAL q0[hz_N], p0[hz_N], s0, h;
#if hz_INPUTS
  REAL u[hz_INPUTS];
#endif
#if hz_P
  REAL theta[hz_P];
#endif
#if hz_STICKING
  REAL bound[hz_N]; /* dry friction holds moves up to this */
#endif
  FN_potential_t V0;
{problem}}} FN_problem;

/* The step equation at one q1 = q0 + move. After the solve, q1 = q0 + move + rest with the last, tiny correction. */
typedef struct {{
  REAL move[hz_N], rest[hz_N], F[hz_N], J[hz_N * hz_N];
{terms}}} FN_terms;
"""


def as_lanes(text: str) -> str:
    """A text of `REAL` and `FN_` as that of a register of samples."""
    return text.replace("SPREAD(", "hz_spread(").replace("FN_", "hz_wide_").replace("REAL", "hz_lanes")
