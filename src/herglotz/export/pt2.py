"""A model as one `.pt2` file that steps with PyTorch alone, without this package."""

from __future__ import annotations

import copy
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.export import Dim, ExportedProgram

import herglotz
from herglotz.data.files import PathLike, write_atomically
from herglotz.errors import InputError
from herglotz.export.module import TOLERANCE, StepModule
from herglotz.models import ContactLagrangian

FORMAT = 1
METADATA = "metadata.json"
BOX_KEYS = tuple(f"{name}_{end}" for name in "qps" for end in ("low", "high"))
EXAMPLE_BATCH = 7  # equal to no other size in the graph, or torch.export takes the two for one


def export_pt2(
    model: ContactLagrangian,
    path: PathLike,
    *,
    h: float,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    metadata: Mapping[str, Any] | None = None,
    newton_iterations: int = 8,
) -> Path:
    """Write one step (q, p, s, h) → (q1, p1, s1, c, residual, status) of the model's flow as a `.pt2` file.

    The batch size is free, every step h > 0 is accepted, and the file holds weights, graph and metadata. It loads with
    `torch.export.load(path).module()` on a machine without herglotz, or with `load_pt2` here.

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
        Further JSON-ready entries; they may not replace those written here.
    newton_iterations
        Unrolled iterations; ignored (2) for a model whose step equation is linear in q1.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If h, box, units or metadata are not usable, or the file cannot be written.
    """
    entries = _metadata(model, h, box, units, newton_iterations, metadata or {})
    text = _json(entries)
    module = StepModule(copy.deepcopy(model).eval().requires_grad_(False), entries["newton_iterations"])
    program = _slim(_export(module, entries["dof"], h))
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={METADATA: text})
    write_atomically(path, buffer.getvalue())
    return Path(path)


def weights_digest(model: torch.nn.Module) -> str:
    """The sha256 (hex) of names, dtypes, shapes and values of a module's state."""
    sha = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        sha.update(f"{name} {value.dtype} {tuple(value.shape)};".encode())
        sha.update(value.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()


def _export(module: StepModule, dof: int, h: float) -> ExportedProgram:
    parameter = next(module.parameters())
    make = torch.Generator().manual_seed(0)
    options: dict[str, Any] = {"dtype": parameter.dtype, "device": parameter.device}
    q, p = (0.1 * torch.randn(EXAMPLE_BATCH, dof, generator=make).to(**options) for _ in range(2))
    arguments = (q, p, torch.zeros(EXAMPLE_BATCH, **options), torch.full((EXAMPLE_BATCH,), float(h), **options))
    with torch.no_grad():
        module(*arguments)  # fills the index caches of the jets with real tensors, before tracing makes fake ones
    shapes = tuple({0: Dim.AUTO} for _ in arguments)
    return torch.export.export(module, arguments, dynamic_shapes=shapes)


def _slim(program: ExportedProgram) -> ExportedProgram:
    """Drop stack traces (most of the file, and full of local paths) and give constants their own storage.

    Index tensors are views of one storage; torch saves such a group in one piece, and warns that it may be wrong.
    """
    for node in program.graph.nodes:
        for key in ("stack_trace", "nn_module_stack", "source_fn_stack"):
            node.meta.pop(key, None)
    for name, value in list(program.constants.items()):
        if isinstance(value, Tensor):
            program.constants[name] = value.clone()
    return program


def _metadata(
    model: ContactLagrangian,
    h: float,
    box: Mapping[str, Sequence[float]] | None,
    units: Sequence[str],
    newton_iterations: int,
    extra: Mapping[str, Any],
) -> dict[str, Any]:
    dtype = next(model.parameters()).dtype
    if dtype not in (torch.float32, torch.float64):
        raise InputError(f"export needs a float32 or float64 model, got {dtype}; convert it with .double()")
    if not (float(h) > 0 and float(h) < float("inf")):
        raise InputError(f"h must be a finite number > 0, got {h}")
    if units and len(units) != model.config.dof:
        raise InputError(f"units needs one entry a coordinate ({model.config.dof}), got {list(units)}")
    entries: dict[str, Any] = {
        "format": FORMAT,
        "herglotz_version": herglotz.__version__,
        "torch_version": str(torch.__version__),
        "model": model.config.to_dict(),
        "weights_sha256": weights_digest(model),
        "level": model.config.level,
        "dof": model.config.dof,
        "dtype": str(dtype).removeprefix("torch."),
        "h": float(h),
        "units": list(units),
        "angles": list(model.config.angles),
        "box": None if box is None else _box(box, model.config.dof),
        "newton_iterations": 2 if model.linear_in_q1 else newton_iterations,
        "newton_tolerance": TOLERANCE * torch.finfo(dtype).eps,
    }
    taken = sorted(set(extra) & set(entries))
    if taken:
        raise InputError(f"metadata may not replace {', '.join(taken)}; use another name")
    return {**entries, **extra}


def _box(box: Mapping[str, Sequence[float]], dof: int) -> dict[str, list[float]]:
    """The box with plain numbers, checked: q and p have n entries, s has one, low ≤ high."""
    if set(box) != set(BOX_KEYS):
        raise InputError(f"box needs exactly the keys {', '.join(BOX_KEYS)}; got {', '.join(sorted(box)) or 'none'}")
    plain = {key: [float(x) for x in torch.as_tensor(box[key], dtype=torch.float64).reshape(-1)] for key in BOX_KEYS}
    for key, values in plain.items():
        size = 1 if key.startswith("s") else dof
        if len(values) != size:
            raise InputError(f"box {key} needs {size} numbers, got {values}")
    for name in "qps":
        low, high = plain[f"{name}_low"], plain[f"{name}_high"]
        if not all(a <= b for a, b in zip(low, high, strict=True)):
            raise InputError(f"box {name}_low must not exceed {name}_high, got {low} and {high}")
    return plain


def _json(entries: dict[str, Any]) -> str:
    try:
        return json.dumps(entries, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"metadata cannot be written as JSON ({error}); use plain finite numbers and text") from None
