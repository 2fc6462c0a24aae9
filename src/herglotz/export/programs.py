"""The programs of an exported file for every format: a step, K steps, a start from positions, velocities."""

from __future__ import annotations

import inspect
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from herglotz.data.files import PathLike
from herglotz.export.equation import Equations, example
from herglotz.export.inline import inlined, opaque
from herglotz.export.metadata import describe
from herglotz.export.module import InitModule, LegendreModule, RolloutModule, StepModule
from herglotz.export.step import MAX_ITERATIONS, StepGraphs
from herglotz.export.trusted import write_trusted
from herglotz.models import ContactLagrangian

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
