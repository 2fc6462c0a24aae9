"""A model as one `.onnx` file that steps with onnxruntime and numpy alone: both loops are inside."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data.files import PathLike, read_bytes, write_atomically
from herglotz.errors import InputError
from herglotz.export.equation import Equations
from herglotz.export.loader import ExportedStepper
from herglotz.export.metadata import describe, from_json, to_json
from herglotz.export.newton import ITERATIONS
from herglotz.models import ContactLagrangian

KEY = "herglotz"  # of our entries among the model's metadata
INIT = "herglotz_init"  # of the start from two positions there: a second model, in base 64


def export_onnx(
    model: ContactLagrangian,
    path: PathLike,
    *,
    h: float,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    metadata: Mapping[str, Any] | None = None,
    newton_iterations: int = ITERATIONS,
) -> Path:
    """Write K steps (q, p, s, h) → (q, p, s, c, residual, status[, outside]) of the model's flow as an ONNX graph.

    Inputs q, p (B, n), s (B,) and h (K, B), a row a step; K = 1 is one step. Outputs q, p (K, B, n), the others (K, B):
    what steps 1 … K give. Batch size and number of steps are free. A model with inputs takes u (K, B, m) after h.
    A failed step has a status other than 0, and NaN from there on. The entry `herglotz_init` of the model's metadata is
    a second, small ONNX model in base 64: the state from two positions, q0, q1 (B, n), s0, h (B,)[, u] → p, s at q1.

    Parameters
    ----------
    model, path, h, box, units, metadata, newton_iterations
        As in `export_pt2`. With a box there is one more output, `outside`: 1 where a step starts or ends outside,
        plus 2 where h is outside an `h_range` in the metadata.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If onnx is not installed, an argument is not usable, or the file cannot be written.
    """
    try:
        import onnx  # noqa: F401
    except ImportError as error:
        raise InputError(f"ONNX export needs {error.name}; install it with: pip install 'herglotz[export]'") from None
    entries = describe(model, h, box, units, newton_iterations, metadata or {})
    text = to_json(entries)
    from herglotz.export.onnx_model import init_graph, rollout_graph

    equations = Equations.of(model)
    start = base64.b64encode(init_graph(equations, entries)).decode()
    write_atomically(path, rollout_graph(equations, entries, {KEY: text, INIT: start}))
    return Path(path)


def load_onnx(path: PathLike) -> ExportedStepper:
    """Read a file that `export_onnx` wrote; it runs on as many threads as torch does.

    Raises
    ------
    InputError
        If onnxruntime is not installed, or the file is missing, damaged, not one of ours, or of another version.
    """
    content = read_bytes(path)
    try:
        import onnxruntime as ort
    except ImportError:
        raise InputError(f"{path}: needs onnxruntime; install it with: pip install onnxruntime") from None
    options = ort.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # a tenth faster for tensors of a few numbers, and no slower for others
    options.log_severity_level = 4  # an exception says it; its log line would be a second
    try:
        session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        found = session.get_modelmeta().custom_metadata_map
        text, start = found.get(KEY), base64.b64decode(found.get(INIT, ""))
        starter = ort.InferenceSession(start, options, providers=["CPUExecutionProvider"]) if start else None
    except Exception as error:  # onnxruntime has a dozen exception classes and no common one
        line = (str(error).strip().splitlines() or [""])[0]
        raise InputError(f"{path}: is not a readable .onnx file ({line[:120]}); export the model again") from None
    metadata = from_json(text, path)
    programs = {"rollout": _program(session)}
    if starter is not None:
        programs["init"] = _program(starter)
    return ExportedStepper(programs, metadata, str(path), "onnx")


def _program(session: Any) -> Callable[..., tuple[Tensor, ...]]:
    """A session as a function of tensors."""
    names = [x.name for x in session.get_inputs()]

    def run(*arguments: Tensor) -> tuple[Tensor, ...]:
        feeds = {name: x.detach().numpy() for name, x in zip(names, arguments, strict=True)}
        return tuple(torch.from_numpy(x) for x in session.run(None, feeds))

    return run
