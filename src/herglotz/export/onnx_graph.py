"""The ONNX graph of a rollout: pieces exported by torch, joined by a loop over steps around a loop of Newton."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.export.equation import Equations, example
from herglotz.export.module import Box, Newton, RolloutModule, Track, outside
from herglotz.export.onnx_ops import Writer
from herglotz.export.trace import traced
from herglotz.models import ContactLagrangian

OPSET = 20
SOLVE = ("count", "done", "x", "delta", "merit", "fraction", "scale", "p1", "L", "c1")  # the carry of `Newton`
TRACK = ("known", "q", "p", "s", "v0", "v1", "v2", "lost_q", "lost_s")  # the carry of `Track`
OUTPUTS = ("q", "p", "s", "c", "residual", "status", "outside")


class Begin(nn.Module):
    """Guess and the carry of Newton before its first iteration."""

    def __init__(self, newton: Newton, track: Track):
        super().__init__()
        self.newton, self.track = newton, track

    def forward(self, *carry: Tensor) -> tuple[Tensor, ...]:
        """The carry of the track and h → that of Newton, without its count."""
        guess = self.track.guess(carry[:-1], carry[-1])
        return self.newton.start(carry[1], carry[3], guess)[1:]


class Iterate(nn.Module):
    """One Newton iteration, and whether another is needed."""

    def __init__(self, newton: Newton):
        super().__init__()
        self.newton = newton

    def forward(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        """`rest` is the carry, then u."""
        problem, constants = (q, p, s, h, *rest[len(SOLVE) :]), self.newton.equation.constants
        carry = self.newton.iterate(problem, rest[: len(SOLVE)], constants)
        return self.newton.unfinished(carry[0], carry[1]), *carry


class End(nn.Module):
    """Momentum, action, status and the next carry."""

    def __init__(self, track: Track, box: Box | None):
        super().__init__()
        self.track, self.box = track, box

    def forward(self, *x: Tensor) -> tuple[Tensor, ...]:
        """The carry of the track, h and what Newton found → the next carry, c, residual, status[, outside]."""
        before, h, solved = x[: len(TRACK)], x[len(TRACK)], x[len(TRACK) + 1 :]
        carry, out = self.track.advance(before, h, solved)
        return *carry, *out[3:], *outside(self.box, before[1:4], out[:3])


def rollout_graph(model: ContactLagrangian, entries: Mapping[str, Any], properties: Mapping[str, str]) -> bytes:
    """The serialised model; `entries` is the file's metadata."""
    import onnx
    from onnx import TensorProto, helper

    real = TensorProto.DOUBLE if entries["dtype"] == "float64" else TensorProto.FLOAT
    n, m = entries["dof"], entries["inputs"]
    names = OUTPUTS if entries["box"] is not None else OUTPUTS[:-1]
    with torch.no_grad():
        begin, iterate, end = _pieces(model, entries)
    node = helper.make_node
    solve = _loop_body(
        "newton", iterate.nodes, ["i", "going", *(f"{x}_in" for x in SOLVE)], ["more", *(f"{x}_out" for x in SOLVE)]
    )
    starts = [f"{x}_0" for x in SOLVE[1:]]
    body = [
        node("Gather", ["h", "k"], ["h_k"], axis=0),
        *([node("Gather", ["u", "k"], ["u_k"], axis=0)] if m else []),
        *begin.nodes,
        node("Loop", ["", "yes", "zero", *starts], [f"{x}_end" for x in SOLVE], body=solve),
        *end.nodes,
        node("Identity", ["yes"], ["next"]),
        *(node("Identity", [f"{x}_next"], [f"{x}_row"]) for x in "qps"),
    ]
    carried = [f"{x}_next" for x in TRACK]
    rows = ["q_row", "p_row", "s_row", "c_row", "residual_row", "status_row", "outside_row"][: len(names)]
    outer = _loop_body("steps", body, ["k", "on", *(f"{x}_k" for x in TRACK)], ["next", *carried, *rows])
    nodes = [
        node("Shape", ["h"], ["h_shape"]),
        node("Gather", ["h_shape", "zero"], ["K"], axis=0),
        node("Mul", ["q", "nothing"], ["rest"]),
        node("Mul", ["s", "nothing"], ["none"]),
        node("Loop", ["K", "yes", "zero", "q", "p", "s", "rest", "rest", "rest", "rest", "none"],
             [*(f"{x}_last" for x in TRACK), *(f"{x}_all" for x in names)], body=outer),
        *(node("Identity", [f"{x}_all"], [f"{x}_out" if x in "qps" else x]) for x in names),
    ]  # fmt: skip
    constants = [
        helper.make_tensor("zero", TensorProto.INT64, [], [0]),
        helper.make_tensor("yes", TensorProto.BOOL, [], [True]),
        helper.make_tensor("nothing", real, [], [0.0]),
    ]
    for piece in (begin, iterate, end):
        constants += piece.constants
    value = helper.make_tensor_value_info
    inputs = [value("q", real, ["B", n]), value("p", real, ["B", n]), value("s", real, ["B"])]
    inputs += [value("h", real, ["K", "B"])] + ([value("u", real, ["K", "B", m])] if m else [])
    kinds = {"status": TensorProto.UINT8, "outside": TensorProto.UINT8}
    outputs = [
        value(f"{x}_out" if x in "qps" else x, kinds.get(x, real), ["K", "B", n] if x in "qp" else ["K", "B"])
        for x in names
    ]
    graph = helper.make_graph(nodes, "herglotz_rollout", inputs, outputs, constants)
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="herglotz")
    proto.ir_version = min(proto.ir_version, 10)
    helper.set_model_props(proto, dict(properties))
    onnx.checker.check_model(proto)
    return proto.SerializeToString()


def _pieces(model: ContactLagrangian, entries: Mapping[str, Any]) -> tuple[Writer, ...]:
    """`Begin`, `Iterate` and `End` as ONNX nodes, named so that the loops join them."""
    equations = Equations.of(model)
    rollout = RolloutModule(equations, entries["newton_iterations"], entries["box"])
    newton, track = rollout.newton, rollout.track
    q, p, s, h, *u = example(equations.model, entries["h"])
    carry, solve = track.start(q, p, s), newton.start(q, s, p)
    _, done, delta, move, merit, _, _, p1, L, c1 = solve
    before, end = [*(f"{x}_k" for x in TRACK), "h_k"], [f"{x}_end" for x in ("x", "delta", "merit", "done", *SOLVE[7:])]
    after = [*(f"{x}_next" for x in TRACK), "c_row", "residual_row", "status_row", "outside_row"]
    state = ["q_k", "p_k", "s_k", "h_k"]
    return (
        _piece(Begin(newton, track), (*carry, h), before, [f"{x}_0" for x in SOLVE[1:]], "b_"),
        _piece(
            Iterate(newton),
            (q, p, s, h, *solve, *u),
            [*state, *(f"{x}_in" for x in SOLVE), *(["u_k"] if u else [])],
            ["more", *(f"{x}_out" for x in SOLVE)],
            "n_",
        ),
        _piece(
            End(track, rollout.box),
            (*carry, h, delta, move, merit, done, p1, L, c1),
            [*before, *end],
            after[: len(after) - (rollout.box is None)],
            "e_",
        ),
    )


def _piece(
    module: nn.Module, arguments: tuple[Tensor, ...], inputs: Sequence[str], outputs: Sequence[str], prefix: str
) -> Writer:
    """Nodes and constants of a module, its inputs and outputs called as told, everything else prefixed."""
    writer = Writer(prefix, arguments[-1].dtype)
    writer.write(traced(module, arguments), inputs, outputs)
    return writer


def _loop_body(label: str, nodes: Sequence[Any], inputs: Sequence[str], outputs: Sequence[str]) -> Any:
    """The graph inside a Loop: iteration, condition and carry in; condition, carry and rows out."""
    from onnx import TensorProto, helper

    scalars = {inputs[0]: TensorProto.INT64, inputs[1]: TensorProto.BOOL, outputs[0]: TensorProto.BOOL}

    def described(names: Sequence[str]) -> list[Any]:
        """Only the scalars need a type; those of the others are inferred."""
        return [
            helper.make_tensor_value_info(x, scalars[x], []) if x in scalars else helper.make_empty_tensor_value_info(x)
            for x in names
        ]

    return helper.make_graph(list(nodes), label, described(inputs), described(outputs))
