"""A traced graph in the words of ONNX: one function an operation, in the precision of the model."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx

from herglotz.errors import InputError
from herglotz.export.trace import Example, Graph

aten = torch.ops.aten
NUMPY = {
    torch.float64: np.float64, torch.float32: np.float32, torch.int64: np.int64, torch.uint8: np.uint8,
    torch.bool: np.bool_,
}  # fmt: skip
SIMPLE = {
    aten.abs.default: "Abs", aten.neg.default: "Neg", aten.sin.default: "Sin", aten.cos.default: "Cos",
    aten.exp.default: "Exp", aten.tanh.default: "Tanh", aten.sqrt.default: "Sqrt", aten.sigmoid.default: "Sigmoid",
    aten.reciprocal.default: "Reciprocal", aten.round.default: "Round", aten.bitwise_not.default: "Not",
    aten.add.Tensor: "Add", aten.sub.Tensor: "Sub", aten.mul.Tensor: "Mul", aten.div.Tensor: "Div",
    aten.maximum.default: "Max", aten.minimum.default: "Min", aten.matmul.default: "MatMul",
    aten.__and__.Tensor: "And", aten.__or__.Tensor: "Or", aten.eq.Scalar: "Equal", aten.eq.Tensor: "Equal",
    aten.le.Tensor: "LessOrEqual", aten.le.Scalar: "LessOrEqual", aten.lt.Tensor: "Less", aten.lt.Scalar: "Less",
    aten.ge.Tensor: "GreaterOrEqual", aten.ge.Scalar: "GreaterOrEqual", aten.gt.Tensor: "Greater",
    aten.gt.Scalar: "Greater", aten.where.self: "Where", aten.where.ScalarSelf: "Where",
    aten.where.ScalarOther: "Where", aten.where.Scalar: "Where", aten.pow.Tensor_Scalar: "Pow",
}  # fmt: skip
SAME = (aten.clone.default, aten.detach.default, aten.alias.default)
SEVERAL = (aten.unbind.int, aten.broadcast_tensors.default)  # written where one of their outputs is taken


class Writer:
    """Nodes and constants of one graph; a value is known by its name, a size by a tensor of one number.

    Parameters
    ----------
    prefix
        Of every name, so that several graphs go into one file.
    real
        dtype of plain numbers where no tensor says otherwise.
    """

    def __init__(self, prefix: str, real: torch.dtype):
        self.prefix, self.real = prefix, real
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._names: dict[Any, str] = {}
        self._shared: dict[Any, str] = {}

    def write(self, graph: Graph, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """The whole graph, its inputs and outputs called as told."""
        places = [x for x in graph.code.graph.nodes if x.op == "placeholder"]
        self._names = dict(zip(places, inputs, strict=False))
        self._values = dict(zip(places[len(inputs) :], graph.constants, strict=True))
        for node in graph.code.graph.nodes:
            if node.op == "call_function" and node.target not in SEVERAL:
                self._names[node] = self._translate(node)
            elif node.op == "output":
                for x, name in zip(node.args[0], outputs, strict=True):
                    self.emit("Identity", self.name(x), to=name)

    def emit(self, kind: str, *inputs: str, to: str | None = None, **attributes: Any) -> str:
        """One node; its output's name."""
        from onnx import helper

        to = to or f"{self.prefix}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [to], **attributes))
        return to

    def constant(self, value: Any, dtype: Any) -> str:
        """A constant of numpy's dtype; equal ones are shared."""
        from onnx import numpy_helper

        array = np.array(value, dtype=dtype)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._shared:
            self._shared[key] = f"{self.prefix}c{len(self.constants)}"
            self.constants.append(numpy_helper.from_array(array, self._shared[key]))
        return self._shared[key]

    def integers(self, *values: int) -> str:
        """Axes, indices, a shape."""
        return self.constant(list(values), np.int64)

    def name(self, x: Any, dtype: torch.dtype | None = None) -> str:
        """The name of a value; a number becomes a constant of the given dtype."""
        if isinstance(x, fx.Node):
            if x not in self._names:
                value = self._values[x]
                self._names[x] = self.constant(value.numpy(), NUMPY[value.dtype])
            return self._names[x]
        if isinstance(x, Tensor):
            return self.constant(x.numpy(), NUMPY[x.dtype])
        return self.constant(x, NUMPY[dtype or self.real])

    def sizes(self, shape: Sequence[Any]) -> str:
        """A shape some of whose entries the graph computes."""
        if all(isinstance(x, int) for x in shape):
            return self.integers(*shape)
        parts = [self.integers(x) if isinstance(x, int) else self.name(x) for x in shape]
        return self.emit("Concat", *parts, axis=0) if len(parts) > 1 else parts[0]

    def like(self, node: Any, value: float) -> str:
        """A tensor of the shape of the node's first argument, filled."""
        shape = self.emit("Shape", self.name(node.args[0]))
        return self.emit("Expand", self.constant(value, NUMPY[_of(node).dtype]), shape)

    def finite(self, x: Any) -> str:
        """Whether |x| < ∞, which is false of NaN too."""
        return self.emit("Less", self.emit("Abs", self.name(x)), self.name(math.inf, _of(x).dtype))

    def _translate(self, node: Any) -> str:
        target: Any = node.target
        if target in SAME:
            return self.name(node.args[0])
        if target in SIMPLE:
            dtype = _common(node)
            return self.emit(SIMPLE[target], *(self.name(x, dtype) for x in _in_order(node)))
        if target not in TABLE:
            raise InputError(f"ONNX export does not know the operation {target}; export to --format pt2 or c")
        return TABLE[target](self, node)


def _of(x: Any) -> Example:
    return x.meta["example"]


def _axis(axis: int, x: Any) -> int:
    return axis % len(_of(x).shape)


def _in_order(node: Any) -> tuple[Any, ...]:
    assert not node.kwargs.get("alpha"), "a scaled sum is not translated"
    return node.args


def _common(node: Any) -> torch.dtype | None:
    """The dtype of plain numbers beside tensors: that of the last tensor (the first of `where` is its mask)."""
    tensors = [x for x in node.args if isinstance(x, fx.Node)]
    dtype = _of(tensors[-1]).dtype
    if dtype != torch.bool:
        return dtype
    return _of(node).dtype if _of(node).dtype != torch.bool else None


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
    assert source.target == aten.broadcast_tensors.default
    x, others = source.args[0][index], source.args[0]
    if _of(x).shape == _of(node).shape:
        return w.name(x)
    whole = next(y for y in others if _of(y).shape == _of(node).shape)
    return w.emit("Expand", w.name(x), w.emit("Shape", w.name(whole)))


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


def _linear(w: Writer, node: Any) -> str:
    x, weight, *bias = node.args
    known = w._values.get(weight)
    turned = (
        w.emit("Transpose", w.name(weight), perm=[1, 0]) if known is None
        else w.constant(known.t().contiguous().numpy(), NUMPY[known.dtype])
    )  # fmt: skip
    product = w.emit("MatMul", w.name(x), turned)
    return w.emit("Add", product, w.name(bias[0])) if bias and bias[0] is not None else product


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
        axes: Any = node.args[1]
        keep = int(bool(node.args[2])) if len(node.args) > 2 else 0
        axes = [axes] if isinstance(axes, int) else axes
        return w.emit(kind, w.name(node.args[0]), w.integers(*axes), keepdims=keep)

    return write


def _all(w: Writer, node: Any) -> str:
    axes = [w.integers(node.args[1])] if len(node.args) > 1 else []
    number = _cast(w, w.name(node.args[0]), torch.int32)
    return _cast(w, w.emit("ReduceMin", number, *axes, keepdims=0), torch.bool)


def _cast(w: Writer, name: str, dtype: torch.dtype) -> str:
    from onnx import TensorProto, helper

    kinds = {
        torch.float64: TensorProto.DOUBLE, torch.float32: TensorProto.FLOAT, torch.int64: TensorProto.INT64,
        torch.int32: TensorProto.INT32, torch.bool: TensorProto.BOOL, torch.uint8: TensorProto.UINT8,
    }  # fmt: skip
    to = f"{w.prefix}{len(w.nodes)}"
    w.nodes.append(helper.make_node("Cast", [name], [to], to=kinds[dtype]))
    return to


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
    aten.movedim.int: _moved,
    aten.movedim.intlist: _moved,
    aten.unflatten.int: _unflatten,
    aten.reshape.default: lambda w, n: w.emit("Reshape", w.name(n.args[0]), w.sizes(n.args[1])),
    aten.view.default: lambda w, n: w.emit("Reshape", w.name(n.args[0]), w.sizes(n.args[1])),
    aten.expand.default: lambda w, n: w.emit(
        "Expand", w.name(n.args[0]), w.sizes([1 if x == -1 else x for x in n.args[1]])
    ),
    aten.sym_size.int: lambda w, n: w.emit("Shape", w.name(n.args[0]), start=n.args[1], end=n.args[1] + 1),
    operator.mul: lambda w, n: w.emit("Mul", w.name(n.args[0]), w.integers(n.args[1])),
    aten.rsub.Scalar: lambda w, n: w.emit("Sub", w.name(n.args[1], _of(n).dtype), w.name(n.args[0])),
    aten.ne.Scalar: lambda w, n: w.emit("Not", w.emit("Equal", w.name(n.args[0]), w.name(n.args[1], _common(n)))),
    aten.amax.default: _reduced("ReduceMax"),
    aten.sum.dim_IntList: _reduced("ReduceSum"),
    aten.all.dim: _all,
    aten.all.default: _all,
    aten.to.dtype: lambda w, n: _cast(w, w.name(n.args[0]), n.args[1]),
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
