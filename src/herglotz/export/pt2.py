"""A model as one `.pt2` file that steps with PyTorch alone, without this package."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from herglotz.data.files import PathLike, write_atomically
from herglotz.export.attempt import best_plan
from herglotz.export.equation import Equations, batched, example
from herglotz.export.inline import inlined, opaque
from herglotz.export.metadata import FORMAT, METADATA, describe, to_json, weights_digest
from herglotz.export.module import InitModule, RolloutModule, StepModule
from herglotz.export.newton import ITERATIONS
from herglotz.models import ContactLagrangian

__all__ = ["FORMAT", "METADATA", "export_pt2", "rollout_program", "weights_digest"]

EXAMPLE_STEPS = 13


def export_pt2(
    model: ContactLagrangian,
    path: PathLike,
    *,
    h: float,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    metadata: Mapping[str, Any] | None = None,
    newton_iterations: int = ITERATIONS,
) -> Path:
    """Write the model's flow as a `.pt2` file: graphs of tensor operations that any PyTorch of this version runs.

    It holds three programs. `model`, the one that `torch.export.load(path).module()` gives on a machine without
    herglotz, is one step (q, p, s, h) → (q1, p1, s1, c, residual, status[, outside]), differentiable in the state;
    `rollout` is K steps with both loops inside; `init` makes (p1, s1) from (q0, q1, s0, h). The batch size is free and
    every step h > 0 is accepted. A model with inputs takes u after h. With a box, outside is 1 where a step starts or
    ends beyond it, plus 2 where h is beyond `h_range`.

    Parameters
    ----------
    model
        In float32 or float64, which becomes the dtype of the file; not changed.
    path
        Where to write, atomically; the name should end in `.pt2`.
    h
        Typical step of the model, in the data's time unit: recorded, not imposed.
    box
        Where the model was fitted: q_low, q_high, p_low, p_high (n numbers each), s_low, s_high (one each).
    units
        Unit of each coordinate.
    metadata
        Further JSON-ready entries; they may not replace those written here. `h_range` = (low, high) makes the loaders
        refuse other steps, and the file flag them.
    newton_iterations
        Bound on the Newton iterations of a step, at least 2.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If h, box, units or metadata are not usable, or the file cannot be written.
    """
    entries = describe(model, h, box, units, newton_iterations, metadata or {})
    text = to_json(entries)
    with quiet():
        equations, arguments = Equations.of(model), example(model, h)
        programs = {
            "model": _program(
                StepModule(equations, newton_iterations, entries["box"], entries.get("h_range")), arguments
            ),
            "rollout": rollout_program(equations, entries),
            "init": init_program(equations, entries),
        }
        from torch.export.pt2_archive._package import package_pt2  # what torch.export.save calls for a single program

        buffer = io.BytesIO()
        package_pt2(buffer, exported_programs=programs, extra_files={METADATA: text})
    write_atomically(path, buffer.getvalue())
    return Path(path)


def rollout_program(model: ContactLagrangian | Equations, entries: Mapping[str, Any]) -> ExportedProgram:
    """`RolloutModule` as an exported program; `entries` is the file's metadata."""
    equations = Equations.of(model)
    arguments = example(equations.model, entries["h"])
    stacked = (x.expand(EXAMPLE_STEPS, *x.shape).clone() for x in arguments[3:])
    plan = best_plan(equations.model, entries["h"], entries["box"])
    module = RolloutModule(equations, entries["newton_iterations"], entries["box"], plan, entries.get("h_range"))
    return _program(module, (*arguments[:3], *stacked), stacked=3)


def init_program(model: ContactLagrangian | Equations, entries: Mapping[str, Any]) -> ExportedProgram:
    """`InitModule` as an exported program."""
    equations = Equations.of(model)
    return _program(InitModule(equations), example(equations.model, entries["h"]))


@contextmanager
def quiet() -> Iterator[None]:
    """Without the remarks that torch's exporters make on their own code."""
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


def _program(module: nn.Module, arguments: tuple[Tensor, ...], stacked: int | None = None) -> ExportedProgram:
    """Export for any batch size; arguments from `stacked` on have a leading axis of steps, free as well."""
    one = {0: Dim.DYNAMIC}
    count = len(arguments)
    split = count if stacked is None else stacked
    shapes = tuple(one if i < split else {0: Dim.DYNAMIC, 1: Dim.DYNAMIC} for i in range(count))
    with torch.no_grad(), opaque(module):
        program = torch.export.export(module, arguments, dynamic_shapes=batched(module, shapes))
    return _slim(inlined(program))


def _slim(program: ExportedProgram) -> ExportedProgram:
    """Drop stack traces (most of the file, and full of local paths) and give constants their own storage.

    Index tensors are views of one storage; torch saves such a group in one piece, and warns that it may be wrong.
    """
    for module in program.graph_module.modules():
        for node in getattr(module, "graph", program.graph).nodes:
            for key in ("stack_trace", "nn_module_stack", "source_fn_stack"):
                node.meta.pop(key, None)
    for name, value in list(program.constants.items()):
        if isinstance(value, Tensor):
            program.constants[name] = value.clone()
    return program
