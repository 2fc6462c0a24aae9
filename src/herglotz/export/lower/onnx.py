"""A model as one `.onnx` file that steps with onnxruntime and numpy alone."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

from torch.export import ExportedProgram

from herglotz.data.files import sealed_onnx
from herglotz.errors import InputError, refuse
from herglotz.export.metadata import KEY, to_json
from herglotz.export.programs import programs_of, quiet, writes
from herglotz.models import ContactLagrangian

# The opset of 2023, for onnxruntime 1.17 and later.
OPSET = 20
OUTPUTS = ("q_out", "p_out", "s_out", "c", "residual", "status", "outside")


@writes
def export_onnx(model: ContactLagrangian, entries: dict[str, Any], *, unroll: int | None = None) -> bytes:
    """Write K steps (q, p, s, h) → (q, p, s, c, residual, status[, outside]) of the model's flow as an ONNX graph.

    Inputs are q, p (B, n), s (B,) and h (K, B), a row a step; K = 1 is one step. Outputs are q, p (K, B, n) and the
    others (K, B), the results of steps 1 … K. Batch size and number of steps are free. A model with inputs takes u
    (K, B, m) after h. A failed step has a status other than 0, and the state is NaN from this step on. Entries of the
    model's metadata are further, small ONNX models in base 64: `herglotz_init` is the state from two positions,
    q0, q1 (B, n), s0, h (B,)[, u] → p, s at q1; `herglotz_linearise` is a step and its Jacobian; `herglotz_legendre` is
    L_v and L_vv at q, v (B, n), s, h (B,).

    With `unroll`, a number of Newton's iterations, the file is one step without a loop, for importers that take no
    loops: h (B,), u (B, m), and outputs (B, n) and (B,). A step that needs more iterations has the status
    MAX_ITERATIONS.

    The arguments, the returned path and the output `outside` are those of `export_pt2`. Raise InputError if onnx is not
    installed, an argument is not usable, or the file cannot be written.
    """
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise InputError(f"ONNX export needs {error.name}; install it with: pip install 'herglotz[export]'") from None
    if unroll is not None:
        refuse({f"unroll must be a number of iterations of at least 2, got {unroll}; 6 suits most models": unroll < 2})
        entries = entries | {"newton_iterations": unroll, "unrolled": True}
    properties, main = {KEY: to_json(entries)}, "rollout" if unroll is None else "model"
    with quiet():
        programs = programs_of(model, entries, (main, "linearise", "init", "legendre"), inlines=False)
    problem = ("q", "p", "s", "h", *(("u",) if entries["inputs"] else ()))
    outputs = OUTPUTS if entries["box"] is not None else OUTPUTS[:-1]
    friction = ("grip", "grip_by_v") if entries["model"].get("sticking") else ()
    further: dict[str, tuple[Sequence[str], Sequence[str]]] = {
        "init": (("q0", "q1", "s0", *problem[3:]), ("p", "s")),
        "linearise": (problem, (*outputs, "jacobian")),
        "legendre": (("q", "v", "s", "h"), ("L_v", "L_vv", *friction)),
    }
    for name, (inputs, results) in further.items():
        properties[f"{KEY}_{name}"] = base64.b64encode(graph_of(programs[name], inputs, results, {})).decode()
    return sealed_onnx(graph_of(programs[main], problem, outputs, properties))


def graph_of(
    program: ExportedProgram, inputs: Sequence[str], outputs: Sequence[str], properties: Mapping[str, str]
) -> bytes:
    """A program as a serialised ONNX model; K steps and B samples are free sizes.

    The traced graphs of the program are operators (`herglotz.export.inline.opaque`), which `onnx_operations.translated`
    writes: torch.onnx would evaluate every operation three times with symbolic shapes.
    """
    import torch.onnx
    from onnx import helper
    from onnx_ir import Shape, passes
    from onnx_ir.passes import common

    from herglotz.export.lower.onnx_operations import OPERATIONS, translated

    # No operation around the graphs needs a decomposition; torch would trace both loops twice more to find this out.
    program.run_decompositions = lambda _: program  # pyright: ignore[reportAttributeAccessIssue]
    table = {**OPERATIONS, torch.ops.herglotz.graph.default: translated}
    try:
        with quiet():
            made: Any = torch.onnx.export(
                program, dynamo=True, optimize=False, verbose=False, opset_version=OPSET,
                input_names=inputs, output_names=outputs, custom_translation_table=table,
            )  # fmt: skip
    except torch.onnx.OnnxExporterError as error:
        raise _reason(error) from error
    for node in made.model.graph.all_nodes():
        # The node's place in the source would be most of the file, with local paths in it.
        node.metadata_props.clear()
    constants = common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)
    outside = common.LiftSubgraphInitializersToMainGraphPass()
    tidied = constants, outside, common.DeduplicateInitializersPass(), common.IdentityEliminationPass()
    passes.Sequential(*tidied, common.RemoveUnusedNodesPass())(made.model)
    for value in (*made.model.graph.inputs, *made.model.graph.outputs):
        free = iter(("K", "B")[-sum(not isinstance(x, int) for x in value.shape) :])
        value.shape = Shape([x if isinstance(x, int) else next(free) for x in value.shape])
    proto = made.model_proto
    del proto.graph.value_info[:]
    proto.producer_name, proto.ir_version = "herglotz", min(proto.ir_version, 10)
    helper.set_model_props(proto, dict(properties))
    return _runnable(proto.SerializeToString())


def _runnable(content: bytes) -> bytes:
    """The model; raise InputError where onnxruntime lacks an operation: it has many in float32 only."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.graph_optimization_level, options.log_severity_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL, 4
    try:
        ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        # The exceptions of onnxruntime have no common class.
        raise InputError(f"ONNX export: {error}; export to --format pt2 or c") from error
    return content


def _reason(error: Exception) -> InputError:
    """The first cause: the refusal of one of our own operations, or an operation that torch.onnx lacks."""
    while isinstance(error.__cause__, Exception):
        error = error.__cause__
    if isinstance(error, InputError):
        return error
    return InputError(f"ONNX export: {error}; export to --format pt2 or c")
