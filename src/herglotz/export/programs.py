"""The programs of an exported file for every format: a step, K steps, a start from positions, velocities.

The modules are the loops around the traced functions of `herglotz.export.step`.
"""

from __future__ import annotations

import inspect
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch._higher_order_ops.scan import scan_op
from torch._higher_order_ops.while_loop import while_loop_op
from torch.export import Dim, ExportedProgram

from herglotz.data.files import PathLike, write_trusted
from herglotz.export.equation import Equations, dense, example
from herglotz.export.inline import inlined, opaque
from herglotz.export.metadata import describe
from herglotz.export.step import CARRIED, MAX_ITERATIONS, STATE, Layout, StepGraphs, Values, unfinished
from herglotz.mechanics.legendre import soft_threshold
from herglotz.models import ContactLagrangian
from herglotz.stepping import Status
from herglotz.stepping.linearise import eliminate

Call = Callable[..., Any]


def solved(
    begin: Call, iterate: Call, more: Values,
    layout: Layout, iterations: int, h: Tensor, u: Values, carry: Sequence[Tensor], unrolled: bool = False,
) -> Values:  # fmt: skip
    """Newton's last carry: `begin`, then `iterate` until every sample is done; `more` are the last arguments.

    With `unrolled` the iterations follow one another without a loop; those after the last needed one change nothing.
    """
    state, field, trail, _ = layout.split(carry)
    begun = tuple(dense(x) for x in begin(*((*state, h, *u) if layout.sticks else (h, *trail))))
    first, bounds = begun[:CARRIED], begun[CARRIED:]
    fixed: Any = (*state, h, *field, *u, *bounds, *more)
    ends = len(first), len(first) + STATE + 1

    def turn(*x: Tensor) -> Values:
        return iterate(*x[ends[0] : ends[1]], *x[: ends[0]], *x[ends[1] :])

    found: Any = first
    if unrolled:
        # Iteration 0 evaluates the guess.
        for _ in range(iterations + 1):
            found = turn(*found, *fixed)
    else:
        # The operator itself: its wrapper would have dynamo trace the loop, which takes longer than all else.
        found = while_loop_op(lambda *x: unfinished(x[0], x[1], iterations), turn, found, fixed)
    # Where friction can hold a coordinate, Newton's unknown is z, and Δ is the part of z beyond the bound.
    return (*found[:2], soft_threshold(found[2], bounds[1]), *found[3:]) if bounds else found


class RolloutModule(nn.Module):
    """(q, p, s, h[, u]) → K steps, h of shape (K, B), with the loop over steps and Newton's loop inside."""

    def __init__(self, graphs: StepGraphs, iterations: int):
        super().__init__()
        self.graphs, self.iterations = graphs, iterations

    def forward(
        self,
        q: Tensor,  # (B, n)
        p: Tensor,  # (B, n)
        s: Tensor,  # (B,)
        h: Tensor,  # (K, B)
        *u: Tensor,  # (K, B, m)
    ) -> Values:
        """K steps from one state: q, p (K, B, n), s, c, residual (K, B), status (K, B) uint8 and, with a box, outside.

        Entry k is the result of step k = 1 … K; the state is NaN from a failed step on.
        """
        graphs, layout = self.graphs, self.graphs.layout
        carry = [dense(x) for x in graphs.start(q, p, s)]
        parts = [*((graphs.begin, graphs.iterate) if layout.iterates else ()), graphs.finish]
        given = [[s.shape[0]], *(graph.constants for graph in parts)]

        def step(*x: Any) -> list[Tensor]:
            places = iter(x)
            carry = tuple(islice(places, layout.size))
            h, *u = islice(places, 1 + graphs.inputs)
            (size,), *constants = (tuple(islice(places, len(y))) for y in given)
            # The sum keeps the batch size a symbol of this graph, which inductor needs to allocate the outputs.
            h = h + torch.zeros(size, dtype=h.dtype, device=h.device)
            found: Values = ()
            if layout.iterates:
                begin, iterate = (lambda *x: graphs.begin.call(*x, *constants[0])), graphs.iterate.call
                found = solved(begin, iterate, constants[1], layout, self.iterations, h, tuple(u), carry)
            return [dense(y) for y in graphs.finish.call(h, *u, *carry, *found, *constants[-1])]

        return tuple(scan_op(step, carry, [h, *u], list(chain(*given)))[layout.size :])


class StepModule(nn.Module):
    """(q, p, s, h[, u]) → (q1, p1, s1, c, residual, status[, outside]), differentiable in the state.

    The solve is outside autograd; its derivative is that of the implicit-function theorem, dΔ = −J⁻¹ dF, with J at the
    solution. A step in closed form is differentiated directly. With `linearised` the derivative is a last output,
    d(q, p, s)′ / d(q, p, s, h, u), (B, 2n+1, 2n+2+m), and autograd has none. With `unrolled` there is no loop, and no
    derivative either.
    """

    def __init__(
        self,
        equations: Equations,
        graphs: StepGraphs,
        iterations: int,
        *,
        linearised: bool = False,
        unrolled: bool = False,
    ):
        super().__init__()
        self.graphs, self.iterations, self.unrolled = graphs, iterations, unrolled
        self.jacobian = equations.jacobian if linearised else None
        self.attaches = graphs.layout.iterates and not linearised and not unrolled
        if self.attaches:
            self.slopes, self.first_order = equations.slopes, equations.first_order

    def forward(
        self,
        q: Tensor,  # (B, n)
        p: Tensor,  # (B, n)
        s: Tensor,  # (B,)
        h: Tensor,  # (B,)
        *u: Tensor,  # (B, m) where the model takes inputs
    ) -> Values:
        """One step: guess → solve → attach the derivative → momentum and action.

        q1 (B, n), p1 (B, n), s1 (B,), c (B,), residual |J⁻¹F| (B,) in units of q, status (B,) uint8 and, with a box,
        outside (B,) uint8; last the derivative, if asked for. NaN in the samples whose status is not
        `Status.CONVERGED`.
        """
        graphs = self.graphs
        carry, found = graphs.start(q, p, s), ()
        if graphs.layout.iterates:
            fixed = [x.detach() for x in (h, *u, *carry)]
            split = 1 + len(u)
            steps = graphs.begin, graphs.iterate.call, graphs.iterate.constants
            given = fixed[0], tuple(fixed[1:split]), fixed[split:]
            found = solved(*steps, graphs.layout, self.iterations, *given, unrolled=self.unrolled)
            if self.attaches:
                found = self._attached((q, p, s, h), (*graphs.layout.split(carry)[1], *u), found)
        new = graphs.finish(h, *u, *carry, *found)
        outputs = new[len(carry) :]
        if self.jacobian is None:
            return outputs
        (J,) = self.jacobian(q, p, s, h, found[2] if found else new[0] - q, *u)
        return *outputs, torch.where((outputs[5] == int(Status.CONVERGED))[:, None, None], J, torch.nan)

    def _attached(self, problem: Values, more: Values, found: Values) -> Values:
        """Newton's last carry, with Δ, p1, L and c as functions of the problem."""
        delta = found[2]
        fixed = (x.detach() for x in more)
        J = self.slopes(*(x.detach() for x in problem), delta, *fixed)[-1]
        F = self.first_order(*problem, delta, *more)[0]
        # The same value, with the derivative −J⁻¹ dF.
        delta = delta - eliminate(J, (F - F.detach())[..., None])[..., 0]
        _, *values = self.first_order(*problem, delta, *more)
        return (*found[:2], delta, *found[3:7], *values)


class InitModule(nn.Module):
    """(q0, q1, s0, h[, u]) → (p1, s1) = (D2 L_d + F⁺, s0 + L_d): the state from two positions, differentiable."""

    def __init__(self, equations: Equations):
        super().__init__()
        self.first_order, self.field = equations.first_order, equations.field

    def forward(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, *u: Tensor) -> tuple[Tensor, Tensor]:
        """p1 (B, n) and s1 (B,)."""
        field = () if self.field is None else self.field(q0)
        _, p1, L, _ = self.first_order(q0, torch.zeros_like(q0), s0, h, q1 - q0, *field, *u)
        if self.field is not None:
            V, slope = self.field(q1)
            L, p1 = L - h / 2 * V, p1 - (h / 2)[..., None] * slope
        return p1, s0 + L


class LegendreModule(nn.Module):
    """(q, v, s, h) → L_v (B, n), L_vv (B, n, n)[, grip, its slope (B, n)]: `herglotz.stepping.velocity.Legendre`."""

    def __init__(self, equations: Equations):
        super().__init__()
        self.momentum = equations.momentum

    def forward(self, q: Tensor, v: Tensor, s: Tensor, h: Tensor) -> Values:
        """At (B, n), (B, n), (B,) and steps (B,)."""
        return tuple(self.momentum(q, v, s, h))


# Steps of the example rollout; the number of steps of the program stays free.
EXAMPLE_STEPS = 13


def programs_of(
    model: ContactLagrangian, entries: Mapping[str, Any], names: Sequence[str], inlines: bool = True
) -> dict[str, ExportedProgram]:
    """The named programs: `model` (a differentiable step), `rollout`, `linearise`, `init` and `legendre`.

    Each takes any batch size; `entries` is the file's metadata. Without `inlines`, the traced graphs in a program stay
    operators (`herglotz.export.inline.opaque`).
    """
    equations = Equations.of(model)
    graphs = StepGraphs(equations.model, entries["box"], entries.get("h_range"))
    q, p, s, *more = example(equations.model, entries["h"])
    stacked = [x.expand(EXAMPLE_STEPS, *x.shape).clone() for x in more]
    iterations, unrolled = entries["newton_iterations"], entries.get("unrolled", False)
    one_step = partial(StepModule, equations, graphs, iterations, unrolled=unrolled)
    make = {
        "model": lambda: (one_step(), (q, p, s, *more)),
        "linearise": lambda: (one_step(linearised=True), (q, p, s, *more)),
        "rollout": lambda: (RolloutModule(graphs, iterations), (q, p, s, *stacked)),
        "init": lambda: (InitModule(equations), (q, p, s, *more)),
        "legendre": lambda: (LegendreModule(equations), (q, p, s, more[0])),
    }
    return {name: _program(*make[name](), stacked=name == "rollout", inlines=inlines) for name in names}


def _program(module: nn.Module, arguments: tuple[Tensor, ...], stacked: bool, inlines: bool) -> ExportedProgram:
    """Export a module of (q, p, s, h, *u) for any batch size; if `stacked`, h and u have a free axis of steps first."""
    of_state = {0: Dim.DYNAMIC}
    of_h = {0: Dim.DYNAMIC, 1: Dim.DYNAMIC} if stacked else of_state
    # torch.export takes the arguments of *u as one tuple.
    of_u = ((of_h,),) if len(arguments) > 4 else ()
    with torch.no_grad(), opaque(module):
        program = torch.export.export(module, arguments, dynamic_shapes=(of_state, of_state, of_state, of_h, *of_u))
    if inlines:
        return _slim(inlined(program))
    # The program keeps the module alive, and with it the graphs of the operators.
    program.graph_module.meta["module"] = module
    return program


def _slim(program: ExportedProgram) -> ExportedProgram:
    """Drop stack traces (most of the file, with local paths in them) and give constants their own storage.

    Index tensors are views of one storage; torch saves such a group in one piece, and warns that the piece may be
    wrong.
    """
    for module in program.graph_module.modules():
        for node in getattr(module, "graph", program.graph).nodes:
            for key in ("stack_trace", "nn_module_stack", "source_fn_stack"):
                node.meta.pop(key, None)
    for name, value in list(program.constants.items()):
        if isinstance(value, Tensor):
            program.constants[name] = value.clone()
    return program


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress warnings and logs of torch's exporters about torch's own code."""
    logs = [logging.getLogger(name) for name in ("torch.export", "torch.onnx", "torch._inductor")]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)


def writes(content: Callable[..., bytes]):
    """Turn a function (model, metadata, **options) → sealed content of a file into the function that writes the file.

    The new function has the arguments that all formats share, and those of the old one's options.
    """

    def export(
        model: ContactLagrangian,
        path: PathLike,
        *,
        h: float,
        box: Mapping[str, Sequence[float]] | None = None,
        units: Sequence[str] = (),
        metadata: Mapping[str, Any] | None = None,
        newton_iterations: int = MAX_ITERATIONS,
        **options: Any,
    ) -> Path:
        entries = describe(model, h, box, units, newton_iterations, metadata or {})
        return write_trusted(path, content(model, entries, **options))

    _, _, *own = inspect.signature(content).parameters.values()
    signature: Any = inspect.signature(export)
    known = [x for x in signature.parameters.values() if x.kind is not x.VAR_KEYWORD]
    # setattr, because pyright knows no such attribute of a function.
    setattr(export, "__signature__", signature.replace(parameters=[*known, *own]))  # noqa: B010
    for name in ("__module__", "__name__", "__qualname__", "__doc__"):
        setattr(export, name, getattr(content, name))
    return export
