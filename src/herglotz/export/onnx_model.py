"""Whole ONNX models: the rollout, and the start from two positions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from herglotz.export.attempt import best_plan
from herglotz.export.box import Box
from herglotz.export.equation import Equations, example
from herglotz.export.module import InitModule
from herglotz.export.one_step import OneStep, Report
from herglotz.export.onnx_graph import RolloutWriter
from herglotz.export.onnx_ops import Constants, Writer, kind_of
from herglotz.export.onnx_pieces import Pieces
from herglotz.export.trace import traced
from herglotz.models import ContactLagrangian

OPSET = 20
OUTPUTS = ("q_out", "p_out", "s_out", "c", "residual", "status", "outside")


def rollout_graph(
    model: ContactLagrangian | Equations, entries: Mapping[str, Any], properties: Mapping[str, str]
) -> bytes:
    """The serialised rollout; `entries` is the file's metadata."""
    dtype = getattr(torch, entries["dtype"])
    n, m = entries["dof"], entries["inputs"]
    equations = Equations.of(model)
    with torch.no_grad():
        plan = best_plan(equations.model, entries["h"], entries["box"])
        one = OneStep(equations, entries["newton_iterations"], plan, whole=False)
        box = Box.of(entries["box"], equations.model, entries.get("h_range"))
        pieces = Pieces(one, Report(box), equations.model, entries["h"])
        writer = RolloutWriter(pieces, n, dtype)
        out = writer.write()
    inputs = {"q": ["B", n], "p": ["B", n], "s": ["B"], "h": ["K", "B"]} | ({"u": ["K", "B", m]} if m else {})
    outputs = {x: ["K", "B", n] if x in ("q_out", "p_out") else ["K", "B"] for x in OUTPUTS[: len(out)]}
    return _model(
        writer.main, inputs, dict(zip(outputs, zip(out, outputs.values(), strict=True), strict=True)), properties
    )


def init_graph(model: ContactLagrangian | Equations, entries: Mapping[str, Any]) -> bytes:
    """The serialised start from two positions: q0, q1 (B, n), s0, h (B,)[, u (B, m)] → p (B, n), s (B,) at q1."""
    n, m = entries["dof"], entries["inputs"]
    equations = Equations.of(model)
    writer = Writer(Constants(), getattr(torch, entries["dtype"]), "x")
    inputs = {"q0": ["B", n], "q1": ["B", n], "s0": ["B"], "h": ["B"]} | ({"u": ["B", m]} if m else {})
    with torch.no_grad():
        p, s = writer.write(traced(InitModule(equations), example(equations.model, entries["h"])), list(inputs))
    return _model(writer, inputs, {"p": (p, ["B", n]), "s": (s, ["B"])}, {})


def _model(
    writer: Writer, inputs: Mapping[str, Any], outputs: Mapping[str, tuple[str, Any]], properties: Mapping[str, str]
) -> bytes:
    """What a writer wrote, with names and shapes of what goes in and comes out."""
    import onnx
    from onnx import TensorProto, helper

    value, real = helper.make_tensor_value_info, kind_of(writer.real)
    kinds = {"status": TensorProto.UINT8, "outside": TensorProto.UINT8}
    for name, (x, _) in outputs.items():
        writer.emit("Identity", x, to=name)
    graph = helper.make_graph(
        writer.nodes, "herglotz",
        [value(name, real, shape) for name, shape in inputs.items()],
        [value(name, kinds.get(name, real), shape) for name, (_, shape) in outputs.items()],
        writer.constants.tensors,
    )  # fmt: skip
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="herglotz")
    proto.ir_version = min(proto.ir_version, 10)
    helper.set_model_props(proto, dict(properties))
    onnx.checker.check_model(proto)
    return proto.SerializeToString()
