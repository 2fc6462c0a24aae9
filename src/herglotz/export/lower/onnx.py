"""A model as one `.onnx` file that steps with onnxruntime and numpy alone: both loops are inside."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor
from torch.export import ExportedProgram
from torch.export.graph_signature import InputKind

from herglotz.data.seal import sealed_onnx
from herglotz.errors import InputError, refuse
from herglotz.export.lower.onnx_table import write
from herglotz.export.lower.onnx_writer import Constants, Writer, described, kind_of, needed, reads
from herglotz.export.metadata import KEY, to_json
from herglotz.export.programs import programs_of, quiet, writes
from herglotz.models import ContactLagrangian

OPSET = 20  # of 2023: onnxruntime 1.17 and later
OUTPUTS = ("q_out", "p_out", "s_out", "c", "residual", "status", "outside")


@writes
def export_onnx(model: ContactLagrangian, entries: dict[str, Any], *, unroll: int | None = None) -> bytes:
    """Write K steps (q, p, s, h) → (q, p, s, c, residual, status[, outside]) of the model's flow as an ONNX graph.

    Inputs q, p (B, n), s (B,) and h (K, B), a row a step; K = 1 is one step. Outputs q, p (K, B, n), the others (K, B):
    what steps 1 … K give. Batch size and number of steps are free. A model with inputs takes u (K, B, m) after h.
    A failed step has a status other than 0, and NaN from there on. The entry `herglotz_init` of the model's metadata is
    a second, small ONNX model in base 64: the state from two positions, q0, q1 (B, n), s0, h (B,)[, u] → p, s at q1;
    `herglotz_legendre` has p = L_v and L_vv at q, v (B, n), s, h (B,).

    With `unroll`, a number of Newton's iterations, the file is one step without a loop, for importers that take none:
    h (B,), u (B, m), and outputs (B, n) and (B,). A step that needs more iterations has the status MAX_ITERATIONS.

    The arguments and the path that is returned are those of `export_pt2`, and so is the output `outside`. Raise
    InputError if onnx is not installed, an argument is not usable, or the file cannot be written.
    """
    try:
        import onnx  # noqa: F401
    except ImportError as error:
        raise InputError(f"ONNX export needs {error.name}; install it with: pip install 'herglotz[export]'") from None
    if unroll is not None:
        refuse({f"unroll must be a number of iterations of at least 2, got {unroll}; 6 suits most models": unroll < 2})
        entries = entries | {"newton_iterations": unroll, "unrolled": True}
    text, main = to_json(entries), "rollout" if unroll is None else "model"
    with quiet():
        programs = programs_of(model, entries, (main, "linearise", "init", "legendre"))
    u = ("u",) if entries["inputs"] else ()
    said = OUTPUTS if entries["box"] is not None else OUTPUTS[:-1]
    further = {"init": (("q0", "q1", "s0", "h"), ("p", "s")), "linearise": (("q", "p", "s", "h"), (*said, "jacobian"))}
    properties = {KEY: text}
    further = {name: ((*inputs, *u), outputs) for name, (inputs, outputs) in further.items()}
    legendre = ("L_v", "L_vv", "grip", "grip_by_v") if entries["model"].get("sticking") else ("L_v", "L_vv")
    further["legendre"] = ("q", "v", "s", "h"), legendre
    for name, (inputs, outputs) in further.items():
        second = graph_of(programs[name], inputs, outputs, {})
        properties[f"{KEY}_{name}"] = base64.b64encode(second).decode()
    content = graph_of(programs[main], ("q", "p", "s", "h", *u), said, properties)
    return sealed_onnx(content)


def graph_of(
    program: ExportedProgram, inputs: Sequence[str], outputs: Sequence[str], properties: Mapping[str, str]
) -> bytes:
    """A program as a serialised ONNX model; K steps and B samples are free sizes."""
    import onnx
    from onnx import helper

    values, shapes = _placeholders(program, inputs)
    writer = Writer(Constants(), described(shapes[inputs[0]]).dtype)
    values = [writer.stored(x, described(shapes[x]).shape) if isinstance(x, str) else x for x in values]
    found = write(writer, program.graph_module, values)
    places: Any = next(x for x in program.graph.nodes if x.op == "output").args[0]
    for name, x, place in zip(outputs, found, places, strict=True):
        writer.emit("Identity", writer.plain(x, described(place).shape), to=name)
    described_outputs = dict(zip(outputs, places, strict=True))
    nodes = needed(writer.nodes, outputs)
    read = set().union(*map(reads, nodes))
    graph = helper.make_graph(
        nodes, "herglotz",
        [_info(name, described(x)) for name, x in shapes.items()],
        [_info(name, described(x)) for name, x in described_outputs.items()],
        [x for x in writer.constants.tensors if x.name in read],
    )  # fmt: skip
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="herglotz")
    proto.ir_version = min(proto.ir_version, 10)
    helper.set_model_props(proto, dict(properties))
    onnx.checker.check_model(proto)
    return proto.SerializeToString()


def _placeholders(program: ExportedProgram, inputs: Sequence[str]) -> tuple[list[Any], dict[str, Any]]:
    """What the placeholders of a program stand for: known tensors, or the names of the file's inputs."""
    values, named = [], {}
    left = iter(inputs)
    known = {**program.state_dict, **program.constants}
    nodes = (x for x in program.graph.nodes if x.op == "placeholder")
    for node, spec in zip(nodes, program.graph_signature.input_specs, strict=True):
        if spec.kind == InputKind.USER_INPUT:
            name = next(left)
            named[name] = node
            values.append(name)
        else:
            values.append(known[str(spec.target)])
    return values, named


def _info(name: str, value: Tensor) -> Any:
    """The description of an input or output: free sizes are called K (steps) and B (samples)."""
    from onnx import helper

    free = iter(("K", "B")[-sum(not isinstance(x, int) for x in value.shape) :])
    return helper.make_tensor_value_info(
        name, kind_of(value.dtype), [x if isinstance(x, int) else next(free) for x in value.shape]
    )
