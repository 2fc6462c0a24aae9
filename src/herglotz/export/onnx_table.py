"""What each operation of a traced graph is in ONNX, where it is not one operation of the same meaning."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from herglotz.export.onnx_ops import NUMPY, Writer, _axis, _common, _of, _within, aten, kind_of


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
    if source.target == aten.unbind.int:
        x, axis = source.args[0], (source.args[1] if len(source.args) > 1 else 0)
        return w.emit("Gather", w.name(x), w.constant(index, np.int64), axis=_axis(axis, x))
    if source.target == aten.split_with_sizes.default:
        if source not in w._parts:
            x, sizes, axis = source.args
            names = (w.name(x), w.integers(*sizes))
            w._parts[source] = w.several("Split", names, len(sizes), axis=_axis(axis, x))
        return w._parts[source][index]
    if source.target == aten.linalg_inv_ex.default:
        assert index == 0
        return _inverse(w, source.args[0])
    assert source.target == aten.broadcast_tensors.default
    x, others = source.args[0][index], source.args[0]
    if _of(x).shape == _of(node).shape:
        return w.name(x)
    whole = next(y for y in others if _of(y).shape == _of(node).shape)
    return w.emit("Expand", w.name(x), w.emit("Shape", w.name(whole)))


def _inverse(w: Writer, x: Any) -> str:
    """The inverse of a mass matrix by Gauss and Jordan: ONNX has none, and such a matrix needs no row exchanges."""
    n, real = _of(x).shape[-1], NUMPY[_of(x).dtype]
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
    perm = list(range(len(_of(x).shape)))
    perm[first], perm[second] = perm[second], perm[first]
    return w.emit("Transpose", w.name(x), perm=perm)


def _flattened(w: Writer, node: Any) -> str:
    """The axes from one on to the last in one."""
    x, axis = node.args
    return w.emit("Reshape", w.name(x), w.integers(*[0] * _axis(axis, x), -1))


def _moved(w: Writer, node: Any) -> str:
    x, source, target = node.args
    dims = len(_of(x).shape)
    order = torch.empty(list(range(1, dims + 1)), device="meta").movedim(source, target).shape
    return w.emit("Transpose", w.name(x), perm=[size - 1 for size in order])


def _unflatten(w: Writer, node: Any) -> str:
    x, axis, shape = node.args
    axis = _axis(axis, x)
    assert axis == 0
    tail = w.emit("Shape", w.name(x), start=1)
    return w.emit("Reshape", w.name(x), w.emit("Concat", w.integers(*shape), tail, axis=0))


def _product(w: Writer, a: str, b: str, rank: int) -> str:
    """A B. Not MatMul where it can be helped: onnxruntime makes a number beside one an attribute of it, of 32 bits."""
    return w.emit("Gemm" if rank == 2 else "MatMul", a, b)


def _matmul(w: Writer, node: Any) -> str:
    a, b = node.args
    rank = 2 if len(_of(a).shape) == len(_of(b).shape) == 2 else 0
    return _product(w, w.name(a), w.name(b), rank)


def _linear(w: Writer, node: Any) -> str:
    x, weight, *bias = node.args
    known = w._values.get(weight)
    turned = (
        w.emit("Transpose", w.name(weight), perm=[1, 0]) if known is None
        else w.constant(known.t().contiguous().numpy(), NUMPY[known.dtype])
    )  # fmt: skip
    added = w.name(bias[0]) if bias and bias[0] is not None else None
    if len(_of(x).shape) == 2 and added is not None:
        return w.emit("Gemm", w.name(x), turned, added)
    product = _product(w, w.name(x), turned, len(_of(x).shape))
    return product if added is None else w.emit("Add", product, added)


def _addcmul(w: Writer, node: Any) -> str:
    """A + value · b · c; the number goes into a constant factor where there is one."""
    a, b, c = node.args
    value = node.kwargs.get("value", 1)
    if value == -1:
        return w.emit("Sub", w.name(a), w.emit("Mul", w.name(b), w.name(c)))
    if value != 1:
        known = w._values.get(c)
        if known is None:
            c_name = w.emit("Mul", w.name(c), w.name(value, _of(node).dtype))
        else:
            c_name = w.constant((known * value).numpy(), NUMPY[known.dtype])
        return w.emit("Add", w.name(a), w.emit("Mul", w.name(b), c_name))
    return w.emit("Add", w.name(a), w.emit("Mul", w.name(b), w.name(c)))


def _stack(w: Writer, node: Any) -> str:
    parts: Any = node.args[0]
    axis: Any = node.args[1] if len(node.args) > 1 else 0
    axis = axis % (len(_of(parts[0]).shape) + 1)
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
    x, dtype = w.name(node.args[0]), _of(node).dtype
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
    x, dtype = w.name(node.args[0]), _of(node).dtype
    ratio = w.emit("Div", w.emit("Mul", w.name(2.0, dtype), x), w.emit("Sub", w.name(1.0, dtype), x))
    return w.emit("Mul", w.name(0.5, dtype), _log1p(w, ratio, dtype))


def _log_sigmoid(w: Writer, node: Any) -> str:
    """Log σ(x) = min(x, 0) − log(1 + e^{−|x|})."""
    x, dtype = w.name(node.args[0]), _of(node).dtype
    decay = w.emit("Exp", w.emit("Neg", w.emit("Abs", x)))
    return w.emit("Sub", w.emit("Min", x, w.name(0.0, dtype)), _log1p(w, decay, dtype))


def _nan_to_num(w: Writer, node: Any) -> str:
    x, nan, large = node.args
    assert nan == large
    return w.emit("Where", w.finite(x), w.name(x), w.name(nan, _of(node).dtype))


def _diagonal(w: Writer, node: Any) -> str:
    x: Any = node.args[0]
    eye = w.constant(np.eye(_of(x).shape[-1]), NUMPY[_of(x).dtype])
    return w.emit("Mul", w.emit("Unsqueeze", w.name(x), w.integers(-1)), eye)


TABLE: dict[Any, Callable[[Writer, Any], str]] = {
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
    operator.mul: lambda w, n: w.emit("Mul", w.name(n.args[0]), w.integers(n.args[1])),
    aten.rsub.Scalar: lambda w, n: w.emit("Sub", w.name(n.args[1], _of(n).dtype), w.name(n.args[0])),
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
    aten.new_zeros.default: lambda w, n: w.emit("Expand", w.name(0.0, _of(n).dtype), w.sizes(n.args[1])),
    aten.isfinite.default: lambda w, n: w.finite(n.args[0]),
    aten.nan_to_num.default: _nan_to_num,
    aten.expm1.default: _expm1,
    aten.atanh.default: _atanh,
    aten.log_sigmoid.default: _log_sigmoid,
    aten.diag_embed.default: _diagonal,
}
