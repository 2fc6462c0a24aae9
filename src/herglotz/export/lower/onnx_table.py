"""What each operation of a traced program is in ONNX; loops first, then one function or name an operation."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import fx

from herglotz.errors import InputError
from herglotz.export.lower import onnx_functions as functions, onnx_ops as ops
from herglotz.export.lower.onnx_writer import Writer, described, kind_of, needed, order_of

aten = torch.ops.aten
SIMPLE = {
    aten.abs.default: "Abs", aten.neg.default: "Neg", aten.sin.default: "Sin", aten.cos.default: "Cos",
    aten.exp.default: "Exp", aten.tanh.default: "Tanh", aten.sqrt.default: "Sqrt", aten.sigmoid.default: "Sigmoid",
    aten.sign.default: "Sign", aten.relu.default: "Relu",
    aten.reciprocal.default: "Reciprocal", aten.round.default: "Round", aten.bitwise_not.default: "Not",
    aten.isnan.default: "IsNaN", aten.add.Scalar: "Add", aten.mul.Scalar: "Mul",
    aten.add.Tensor: "Add", aten.sub.Tensor: "Sub", aten.mul.Tensor: "Mul", aten.div.Tensor: "Div",
    aten.maximum.default: "Max", aten.minimum.default: "Min",
    aten.bitwise_and.Tensor: "And", aten.bitwise_or.Tensor: "Or",
    aten.__and__.Tensor: "And", aten.__or__.Tensor: "Or", aten.eq.Scalar: "Equal", aten.eq.Tensor: "Equal",
    aten.le.Tensor: "LessOrEqual", aten.le.Scalar: "LessOrEqual", aten.lt.Tensor: "Less", aten.lt.Scalar: "Less",
    aten.ge.Tensor: "GreaterOrEqual", aten.ge.Scalar: "GreaterOrEqual", aten.gt.Tensor: "Greater",
    aten.gt.Scalar: "Greater", aten.where.self: "Where", aten.where.ScalarSelf: "Where",
    aten.where.ScalarOther: "Where", aten.where.Scalar: "Where", aten.pow.Tensor_Scalar: "Pow",
    aten.pow.Tensor_Tensor: "Pow",
}  # fmt: skip
SAME = (aten.clone.default, aten.detach.default, aten.alias.default)
# Written where one of their outputs is taken; zeros nowhere, see `_is_zero`.
LATER = (
    aten.unbind.int, aten.log_sigmoid_forward.default, aten.split_with_sizes.default, aten.linalg_inv_ex.default,
    aten.zeros.default,
)  # fmt: skip


def write(w: Writer, program: fx.GraphModule, values: Sequence[Any]) -> list[str]:
    """The nodes of a program at the values of its placeholders (names or known tensors); the names of its outputs."""
    nodes = list(program.graph.nodes)
    w.values |= dict(zip((x for x in nodes if x.op == "placeholder"), values, strict=True))
    outputs: list[str] = []
    for node in nodes:
        if node.op == "get_attr":
            w.values[node] = getattr(program, node.target)
        elif node.op == "call_function" and node.users and node.target not in LATER:
            w.values[node] = _translate(w, node)
        elif node.op == "output":
            found: Any = node.args[0]
            outputs = [w.name(x) for x in (found if isinstance(found, (tuple, list)) else [found])]
    return outputs


def _translate(w: Writer, node: Any) -> Any:
    target: Any = node.target
    if target in SAME:
        return w.values[node.args[0]]
    if target in SIMPLE:
        if target == aten.add.Tensor and _is_zero(node.args[1]):
            return w.values[node.args[0]]
        dtype = ops.common_dtype(node)
        names = [w.beside(x, node, dtype) for x in node.args]
        if (scale := node.kwargs.get("alpha", 1)) != 1:
            names[1] = w.emit("Mul", names[1], w.beside(scale, node, dtype))
        return w.emit(SIMPLE[target], *names)
    if target not in TABLE:
        raise InputError(f"ONNX export does not know the operation {target}; export to --format pt2 or c")
    return TABLE[target](w, node)


def _while(w: Writer, node: Any) -> list[str]:
    """A loop that turns while its condition holds: ONNX's Loop, with the condition evaluated before and in it."""
    from onnx import TensorProto, helper

    condition, body, carry, fixed = node.args
    condition, body = w.values[condition], w.values[body]
    start, fixed = [w.name(x) for x in carry], [w.values[x] for x in fixed]
    (on,) = write(w, condition, [*start, *fixed])
    inner, value, empty = w.inner(), helper.make_tensor_value_info, helper.make_empty_tensor_value_info
    inside = [inner.fresh() for _ in start]
    turned = inner.results(write(inner, body, [*inside, *fixed]), inside)
    (more,) = inner.results(write(inner, condition, [*turned, *fixed]), turned)
    graph = helper.make_graph(
        needed(inner.nodes, (more, *turned)), "turn",
        [value(w.fresh(), TensorProto.INT64, []), value(w.fresh(), TensorProto.BOOL, []), *map(empty, inside)],
        [value(more, TensorProto.BOOL, []), *map(empty, turned)],
    )  # fmt: skip
    return w.several("Loop", ["", on, *start], len(start), body=graph)


def _scan(w: Writer, node: Any) -> list[str]:
    """A loop over the rows of its inputs: ONNX's Scan."""
    from onnx import helper

    body, carry, rows, fixed = node.args
    body = w.values[body]
    start, table, fixed = [w.name(x) for x in carry], [w.name(x) for x in rows], [w.values[x] for x in fixed]
    inner, value = w.inner(), helper.make_tensor_value_info
    inside = [inner.fresh() for _ in (*start, *table)]
    out = inner.results(write(inner, body, [*inside, *fixed]), inside)
    given, (results,) = (body.graph.find_nodes(op=x) for x in ("placeholder", "output"))
    inputs, outputs = (
        [value(x, kind_of(described(y).dtype), _free(described(y).shape)) for x, y in zip(names, nodes, strict=False)]
        for names, nodes in ((inside, given), (out, results.args[0]))
    )
    graph = helper.make_graph(needed(inner.nodes, out), "step", inputs, outputs)
    return w.several("Scan", [*start, *table], len(out), body=graph, num_scan_inputs=len(table))


def _free(shape: Sequence[Any]) -> list[int | None]:
    """The sizes that are fixed, in the file's order."""
    return [x if isinstance(x, int) else None for x in (shape[i] for i in order_of(shape))]


def _is_zero(x: Any) -> bool:
    """Whether this is the zero that `RolloutModule` adds for inductor's sake."""
    return isinstance(x, fx.Node) and x.target == aten.zeros.default


# One line an operation; those that are one of ONNX are in SIMPLE.
TABLE: dict[Any, Callable[[Writer, Any], Any]] = {
    torch.ops.higher_order.while_loop: _while,
    torch.ops.higher_order.scan: _scan,
    aten.slice.Tensor: ops.write_slice,
    aten.select.int: ops.write_select,
    operator.getitem: ops.write_item,
    aten.unsqueeze.default: ops.write_unsqueezed,
    aten.squeeze.dim: ops.write_squeezed,
    aten.index_select.default: ops.write_select,
    aten.index.Tensor: ops.write_index,
    aten.cat.default: ops.write_cat,
    aten.stack.default: ops.write_stack,
    aten.mm.default: ops.write_matmul,
    aten.mv.default: ops.write_matmul,
    aten.bmm.default: ops.write_matmul,
    aten.tanh_backward.default: functions.write_tanh_backward,
    aten.permute.default: lambda w, n: ops.permuted(w, n, [i % len(n.args[1]) for i in n.args[1]]),
    aten._to_copy.default: lambda w, n: w.emit("Cast", w.name(n.args[0]), to_=kind_of(described(n).dtype)),
    aten.empty_like.default: lambda w, n: w.like(n, 0),
    aten.unflatten.int: ops.write_unflatten,
    aten.transpose.int: ops.write_transposed,
    aten.reshape.default: ops.write_reshaped,
    aten.view.default: ops.write_reshaped,
    aten.expand.default: ops.write_expanded,
    aten.sym_size.int: ops.write_size,
    operator.mul: lambda w, n: w.emit("Mul", *(w.integers(x) if isinstance(x, int) else w.name(x) for x in n.args)),
    aten.rsub.Scalar: lambda w, n: w.emit("Sub", w.name(n.args[1], described(n).dtype), w.name(n.args[0])),
    aten.ne.Scalar: lambda w, n: w.emit(
        "Not", w.emit("Equal", w.name(n.args[0]), w.name(n.args[1], ops.common_dtype(n)))
    ),
    aten.ne.Tensor: lambda w, n: w.emit("Not", w.emit("Equal", w.name(n.args[0]), w.name(n.args[1]))),
    aten.amax.default: ops.write_reduced("ReduceMax"),
    aten.sum.dim_IntList: ops.write_reduced("ReduceSum"),
    aten.all.dim: ops.write_all,
    aten.all.default: ops.write_all,
    aten.addcmul.default: ops.write_addcmul,
    aten.to.dtype: lambda w, n: w.emit("Cast", w.name(n.args[0]), to_=kind_of(n.args[1])),
    aten.addmm.default: ops.write_addmm,
    aten.repeat.default: ops.write_repeated,
    aten.zeros_like.default: lambda w, n: w.like(n, 0),
    aten.ones_like.default: lambda w, n: w.like(n, 1),
    aten.full_like.default: lambda w, n: w.like(n, n.args[1]),
    aten.new_zeros.default: ops.write_zeros,
    aten.isfinite.default: lambda w, n: w.finite(n.args[0]),
    aten.nan_to_num.default: functions.write_nan_to_num,
    aten.expm1.default: functions.write_expm1,
    aten.atanh.default: functions.write_atanh,
    aten.log_sigmoid_backward.default: functions.write_log_sigmoid_backward,
    aten.sigmoid_backward.default: functions.write_sigmoid_backward,
    aten.threshold_backward.default: functions.write_threshold_backward,
    aten.select_backward.default: ops.write_padded,
    aten.slice_backward.default: ops.write_padded,
    aten.diag_embed.default: ops.write_diagonal,
    aten.diagonal.default: ops.write_diagonal_of,
}
