"""What each operation of a traced program is in ONNX; loops first, then one function or name an operation."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import fx

from herglotz.errors import InputError
from herglotz.export.lower.onnx_writer import NUMPY, Writer, described, kind_of

aten = torch.ops.aten
SIMPLE = {
    aten.abs.default: "Abs", aten.neg.default: "Neg", aten.sin.default: "Sin", aten.cos.default: "Cos",
    aten.exp.default: "Exp", aten.tanh.default: "Tanh", aten.sqrt.default: "Sqrt", aten.sigmoid.default: "Sigmoid",
    aten.reciprocal.default: "Reciprocal", aten.round.default: "Round", aten.bitwise_not.default: "Not",
    aten.isnan.default: "IsNaN", aten.add.Scalar: "Add", aten.mul.Scalar: "Mul", aten.bmm.default: "MatMul",
    aten.add.Tensor: "Add", aten.sub.Tensor: "Sub", aten.mul.Tensor: "Mul", aten.div.Tensor: "Div",
    aten.maximum.default: "Max", aten.minimum.default: "Min",
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
    aten.unbind.int, aten.broadcast_tensors.default, aten.split_with_sizes.default, aten.linalg_inv_ex.default,
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
        elif node.op == "call_function" and node.users and node.target not in LATER and not _within(node):
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
        dtype = _common(node)
        names = [w.name(x, dtype) for x in node.args]
        if (scale := node.kwargs.get("alpha", 1)) != 1:
            names[1] = w.emit("Mul", names[1], w.name(scale, dtype))
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
    inside = [w.fresh() for _ in start]
    turned = inner.own(write(inner, body, [*inside, *fixed]), inside)
    (more,) = write(inner, condition, [*turned, *fixed])
    graph = helper.make_graph(
        inner.nodes, "turn",
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
    inside = [w.fresh() for _ in (*start, *table)]
    out = inner.own(write(inner, body, [*inside, *fixed]), inside)
    given, (results,) = (body.graph.find_nodes(op=x) for x in ("placeholder", "output"))
    infos = [
        [value(x, kind_of(described(y).dtype), _free(described(y).shape)) for x, y in zip(names, nodes, strict=False)]
        for names, nodes in ((inside, given), (out, results.args[0]))
    ]
    graph = helper.make_graph(inner.nodes, "step", *infos)
    return w.several("Scan", [*start, *table], len(out), body=graph, num_scan_inputs=len(table))


def _free(shape: Sequence[Any]) -> list[int | None]:
    """The sizes that are fixed."""
    return [x if isinstance(x, int) else None for x in shape]


def _is_zero(x: Any) -> bool:
    """Whether this is the zero that `RolloutModule` adds for inductor's sake."""
    return isinstance(x, fx.Node) and x.target == aten.zeros.default


def _common(node: Any) -> torch.dtype | None:
    """The dtype of plain numbers beside tensors: that of the last tensor (the first of `where` is its mask)."""
    tensors = [x for x in node.args if isinstance(x, fx.Node)]
    dtype = described(tensors[-1]).dtype
    if dtype != torch.bool:
        return dtype
    return described(node).dtype if described(node).dtype != torch.bool else None


def _axis(axis: int, x: Any) -> int:
    return axis % len(described(x).shape)


def _within(node: Any) -> bool:
    """Whether this is |x| on its way into sums, which ONNX has as one operation."""
    return node.target == aten.abs.default and all(x.target == aten.sum.dim_IntList for x in node.users)


def _slice(w: Writer, node: Any) -> str:
    x, axis, start, end, *step = node.args
    limits = [w.integers(k) for k in (start or 0, end, axis, *step)]
    return w.emit("Slice", w.name(x), *limits)


def _select(w: Writer, node: Any) -> str:
    x, axis, index = node.args
    return w.emit("Gather", w.name(x), w.constant(index, np.int64), axis=_axis(axis, x))


def _item(w: Writer, node: Any) -> str:
    """One output of an operation that has several."""
    source: Any = node.args[0]
    index: Any = node.args[1]
    if source in w.values:  # of a loop
        return w.values[source][index]
    if source.target == aten.unbind.int:
        x, axis = source.args[0], (source.args[1] if len(source.args) > 1 else 0)
        return w.emit("Gather", w.name(x), w.constant(index, np.int64), axis=_axis(axis, x))
    if source.target == aten.split_with_sizes.default:
        x, sizes, axis = source.args
        w.values[source] = w.several("Split", (w.name(x), w.integers(*sizes)), len(sizes), axis=_axis(axis, x))
        return w.values[source][index]
    if source.target == aten.linalg_inv_ex.default:
        assert index == 0
        return _inverse(w, source.args[0])
    assert source.target == aten.broadcast_tensors.default
    x, others = source.args[0][index], source.args[0]
    if described(x).shape == described(node).shape:
        return w.name(x)
    whole = next(y for y in others if described(y).shape == described(node).shape)
    return w.emit("Expand", w.name(x), w.emit("Shape", w.name(whole)))


def _inverse(w: Writer, x: Any) -> str:
    """The inverse of a mass matrix by Gauss and Jordan: ONNX has none, and such a matrix needs no row exchanges."""
    n, real = described(x).shape[-1], NUMPY[described(x).dtype]
    eye, last = np.eye(n), w.integers(-1)
    J = w.name(x)
    for k in range(n):
        column = w.emit("Slice", J, w.integers(k), w.integers(k + 1), last)  # (..., n, 1)
        pivot = w.emit("Slice", column, w.integers(k), w.integers(k + 1), w.integers(-2))
        held = w.emit("Mul", J, w.constant(1 - eye[k], real))
        cleared = w.emit("Add", held, w.constant(np.outer(eye[k], eye[k]), real))
        row = w.emit("Div", w.emit("Slice", cleared, w.integers(k), w.integers(k + 1), w.integers(-2)), pivot)
        J = w.emit("Sub", cleared, w.emit("Mul", w.emit("Sub", column, w.constant(eye[k][:, None], real)), row))
    return J


def _transposed(w: Writer, node: Any) -> str:
    x, first, second = node.args
    perm = list(range(len(described(x).shape)))
    perm[first], perm[second] = perm[second], perm[first]
    return w.emit("Transpose", w.name(x), perm=perm)


def _flattened(w: Writer, node: Any) -> str:
    """The axes from the first to the last named one in one."""
    x, first, last = (*node.args, -1)[:3]
    tail = described(x).shape[_axis(last, x) + 1 :]
    return w.emit("Reshape", w.name(x), w.integers(*[0] * _axis(first, x), -1, *tail))


def _moved(w: Writer, node: Any) -> str:
    x, source, target = node.args
    dims = len(described(x).shape)
    order = torch.empty(list(range(1, dims + 1)), device="meta").movedim(source, target).shape
    return w.emit("Transpose", w.name(x), perm=[size - 1 for size in order])


def _unflatten(w: Writer, node: Any) -> str:
    x, axis, shape = node.args
    axis = _axis(axis, x)
    assert axis == 0
    tail = w.emit("Shape", w.name(x), start=1)
    return w.emit("Reshape", w.name(x), w.emit("Concat", w.sizes(shape), tail, axis=0))


def _product(w: Writer, a: str, b: str, rank: int) -> str:
    """A B. Not MatMul where it can be helped: onnxruntime makes a number beside one an attribute of it, of 32 bits."""
    return w.emit("Gemm" if rank == 2 else "MatMul", a, b)


def _matmul(w: Writer, node: Any) -> str:
    """A B; a vector B as a column, for which onnxruntime is ten times faster."""
    a, b = node.args
    ranks = len(described(a).shape), len(described(b).shape)
    if ranks == (2, 1):
        last = w.integers(1)
        return w.emit("Squeeze", w.emit("Gemm", w.name(a), w.emit("Unsqueeze", w.name(b), last)), last)
    return _product(w, w.name(a), w.name(b), 2 if ranks == (2, 2) else 0)


def _linear(w: Writer, node: Any) -> str:
    x, weight, *bias = node.args
    known = w.known(weight)
    turned = (
        w.emit("Transpose", w.name(weight), perm=[1, 0]) if known is None
        else w.constant(known.detach().t().contiguous().numpy(), NUMPY[known.dtype])
    )  # fmt: skip
    added = w.name(bias[0]) if bias and bias[0] is not None else None
    if len(described(x).shape) == 2 and added is not None:
        return w.emit("Gemm", w.name(x), turned, added)
    product = _product(w, w.name(x), turned, len(described(x).shape))
    return product if added is None else w.emit("Add", product, added)


def _addcmul(w: Writer, node: Any) -> str:
    """A + value · b · c; the number goes into a constant factor where there is one."""
    a, b, c = node.args
    value = node.kwargs.get("value", 1)
    if value == -1:
        return w.emit("Sub", w.name(a), w.emit("Mul", w.name(b), w.name(c)))
    if value != 1:
        known = w.known(c)
        if known is None:
            c_name = w.emit("Mul", w.name(c), w.name(value, described(node).dtype))
        else:
            c_name = w.constant((known.detach() * value).numpy(), NUMPY[known.dtype])
        return w.emit("Add", w.name(a), w.emit("Mul", w.name(b), c_name))
    return w.emit("Add", w.name(a), w.emit("Mul", w.name(b), w.name(c)))


def _stack(w: Writer, node: Any) -> str:
    parts: Any = node.args[0]
    axis: Any = node.args[1] if len(node.args) > 1 else 0
    axis = axis % (len(described(parts[0]).shape) + 1)
    return w.emit("Concat", *(w.emit("Unsqueeze", w.name(x), w.integers(axis)) for x in parts), axis=axis)


def _cat(w: Writer, node: Any) -> str:
    parts: Any = node.args[0]
    return w.emit("Concat", *map(w.name, parts), axis=node.args[1] if len(node.args) > 1 else 0)


def _reduced(kind: str) -> Callable[[Writer, Any], str]:
    def write(w: Writer, node: Any) -> str:
        x: Any = node.args[0]
        axes: Any = node.args[1]
        keep = int(bool(node.args[2])) if len(node.args) > 2 else 0
        axes = [axes] if isinstance(axes, int) else axes
        if _within(x):
            return w.emit("ReduceL1", w.name(x.args[0]), w.integers(*axes), keepdims=keep)
        return w.emit(kind, w.name(x), w.integers(*axes), keepdims=keep)

    return write


def _truth(kind: str) -> Callable[[Writer, Any], str]:
    """Whether all (ReduceMin) or any (ReduceMax) entries are true."""

    def write(w: Writer, node: Any) -> str:
        axes = [w.integers(node.args[1])] if len(node.args) > 1 else []
        return w.emit(kind, w.name(node.args[0]), *axes, keepdims=0)

    return write


def _addmm(w: Writer, node: Any) -> str:
    """C + A B."""
    c, a, b = node.args
    assert not node.kwargs
    return w.emit("Gemm", w.name(a), w.name(b), w.name(c))


def _index(w: Writer, node: Any) -> str:
    x, places = node.args
    ((axis, place),) = [(i, y) for i, y in enumerate(places) if y is not None]
    return w.emit("Gather", w.name(x), w.name(place), axis=axis)


def _expm1(w: Writer, node: Any) -> str:
    """e^x − 1 = 2t/(1 − t), t = tanh(x/2), where x is small: ONNX has no expm1."""
    x, dtype = w.name(node.args[0]), described(node).dtype
    one, two = w.name(1.0, dtype), w.name(2.0, dtype)
    t = w.emit("Tanh", w.emit("Div", x, two))
    small = w.emit("Div", w.emit("Mul", two, t), w.emit("Sub", one, t))
    near = w.emit("Less", w.emit("Abs", x), w.name(0.5, dtype))
    return w.emit("Where", near, small, w.emit("Sub", w.emit("Exp", x), one))


def _log1p(w: Writer, x: str, dtype: torch.dtype) -> str:
    """log(1 + x) = x log(u)/(u − 1) with u = 1 + x rounded (Kahan), x where u = 1."""
    one = w.name(1.0, dtype)
    u = w.emit("Add", one, x)
    same = w.emit("Equal", u, one)
    below = w.emit("Where", same, one, w.emit("Sub", u, one))
    return w.emit("Where", same, x, w.emit("Div", w.emit("Mul", x, w.emit("Log", u)), below))


def _atanh(w: Writer, node: Any) -> str:
    """Artanh x = log(1 + 2x/(1 − x))/2: onnxruntime has it in float32 only."""
    x, dtype = w.name(node.args[0]), described(node).dtype
    ratio = w.emit("Div", w.emit("Mul", w.name(2.0, dtype), x), w.emit("Sub", w.name(1.0, dtype), x))
    return w.emit("Mul", w.name(0.5, dtype), _log1p(w, ratio, dtype))


def _log_sigmoid(w: Writer, node: Any) -> str:
    """Log σ(x) = min(x, 0) − log(1 + e^{−|x|})."""
    x, dtype = w.name(node.args[0]), described(node).dtype
    decay = w.emit("Exp", w.emit("Neg", w.emit("Abs", x)))
    return w.emit("Sub", w.emit("Min", x, w.name(0.0, dtype)), _log1p(w, decay, dtype))


def _nan_to_num(w: Writer, node: Any) -> str:
    x, nan, large = node.args
    assert nan == large
    return w.emit("Where", w.finite(x), w.name(x), w.name(nan, described(node).dtype))


def _tanh_backward(w: Writer, node: Any) -> str:
    """g (1 − t²)."""
    g, t = (w.name(x) for x in node.args)
    return w.emit("Mul", g, w.emit("Sub", w.name(1.0, described(node).dtype), w.emit("Mul", t, t)))


def _diagonal(w: Writer, node: Any) -> str:
    x: Any = node.args[0]
    eye = w.constant(np.eye(described(x).shape[-1]), NUMPY[described(x).dtype])
    return w.emit("Mul", w.emit("Unsqueeze", w.name(x), w.integers(-1)), eye)


TABLE: dict[Any, Callable[[Writer, Any], Any]] = {
    torch.ops.higher_order.while_loop: _while,
    torch.ops.higher_order.scan: _scan,
    aten.slice.Tensor: _slice,
    aten.select.int: _select,
    operator.getitem: _item,
    aten.unsqueeze.default: lambda w, n: w.emit("Unsqueeze", w.name(n.args[0]), w.integers(n.args[1])),
    aten.index_select.default: lambda w, n: w.emit("Gather", w.name(n.args[0]), w.name(n.args[2]), axis=n.args[1]),
    aten.index.Tensor: _index,
    aten.cat.default: _cat,
    aten.stack.default: _stack,
    aten.linear.default: _linear,
    aten.matmul.default: _matmul,
    aten.mm.default: _matmul,
    aten.mv.default: _matmul,
    aten.tanh_backward.default: _tanh_backward,
    aten.permute.default: lambda w, n: w.emit("Transpose", w.name(n.args[0]), perm=n.args[1]),
    aten._to_copy.default: lambda w, n: w.emit("Cast", w.name(n.args[0]), to_=kind_of(described(n).dtype)),
    aten.empty_like.default: lambda w, n: w.like(n, 0),
    aten.movedim.int: _moved,
    aten.movedim.intlist: _moved,
    aten.unflatten.int: _unflatten,
    aten.flatten.using_ints: _flattened,
    aten.transpose.int: _transposed,
    aten.reshape.default: lambda w, n: w.emit("Reshape", w.name(n.args[0]), w.sizes(n.args[1])),
    aten.view.default: lambda w, n: w.emit("Reshape", w.name(n.args[0]), w.sizes(n.args[1])),
    aten.expand.default: lambda w, n: w.emit(
        "Expand", w.name(n.args[0]), w.sizes([1 if x == -1 else x for x in n.args[1]])
    ),
    aten.sym_size.int: lambda w, n: w.emit("Shape", w.name(n.args[0]), start=n.args[1], end=n.args[1] + 1),
    operator.mul: lambda w, n: w.emit("Mul", *(w.integers(x) if isinstance(x, int) else w.name(x) for x in n.args)),
    aten.rsub.Scalar: lambda w, n: w.emit("Sub", w.name(n.args[1], described(n).dtype), w.name(n.args[0])),
    aten.ne.Scalar: lambda w, n: w.emit("Not", w.emit("Equal", w.name(n.args[0]), w.name(n.args[1], _common(n)))),
    aten.ne.Tensor: lambda w, n: w.emit("Not", w.emit("Equal", w.name(n.args[0]), w.name(n.args[1]))),
    aten.amax.default: _reduced("ReduceMax"),
    aten.sum.dim_IntList: _reduced("ReduceSum"),
    aten.all.dim: _truth("ReduceMin"),
    aten.all.default: _truth("ReduceMin"),
    aten.any.default: _truth("ReduceMax"),
    aten.addcmul.default: _addcmul,
    aten.to.dtype: lambda w, n: w.emit("Cast", w.name(n.args[0]), to_=kind_of(n.args[1])),
    aten.addmm.default: _addmm,
    aten.repeat.default: lambda w, n: w.emit("Tile", w.name(n.args[0]), w.integers(*n.args[1])),
    aten.zeros_like.default: lambda w, n: w.like(n, 0),
    aten.ones_like.default: lambda w, n: w.like(n, 1),
    aten.full_like.default: lambda w, n: w.like(n, n.args[1]),
    aten.new_zeros.default: lambda w, n: w.emit("Expand", w.name(0.0, described(n).dtype), w.sizes(n.args[1])),
    aten.isfinite.default: lambda w, n: w.finite(n.args[0]),
    aten.nan_to_num.default: _nan_to_num,
    aten.expm1.default: _expm1,
    aten.atanh.default: _atanh,
    aten.log_sigmoid.default: _log_sigmoid,
    aten.diag_embed.default: _diagonal,
}
