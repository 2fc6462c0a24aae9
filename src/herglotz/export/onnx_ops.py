"""A traced graph in the words of ONNX: one function an operation, in the precision of the model."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
    aten.maximum.default: "Max", aten.minimum.default: "Min",
    aten.__and__.Tensor: "And", aten.__or__.Tensor: "Or", aten.eq.Scalar: "Equal", aten.eq.Tensor: "Equal",
    aten.le.Tensor: "LessOrEqual", aten.le.Scalar: "LessOrEqual", aten.lt.Tensor: "Less", aten.lt.Scalar: "Less",
    aten.ge.Tensor: "GreaterOrEqual", aten.ge.Scalar: "GreaterOrEqual", aten.gt.Tensor: "Greater",
    aten.gt.Scalar: "Greater", aten.where.self: "Where", aten.where.ScalarSelf: "Where",
    aten.where.ScalarOther: "Where", aten.where.Scalar: "Where", aten.pow.Tensor_Scalar: "Pow",
    aten.pow.Tensor_Tensor: "Pow",
}  # fmt: skip
SAME = (aten.clone.default, aten.detach.default, aten.alias.default)
SEVERAL = (
    aten.unbind.int,
    aten.broadcast_tensors.default,
    aten.split_with_sizes.default,
    aten.linalg_inv_ex.default,
)  # written where one of their outputs is taken


class Constants:
    """The constants of a file, each stored once: inner graphs see those of the outermost."""

    def __init__(self):
        self.tensors: list[Any] = []
        self._names: dict[Any, str] = {}

    def name(self, array: np.ndarray) -> str:
        """The name of one with these values."""
        from onnx import numpy_helper

        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._names:
            self._names[key] = f"c{len(self.tensors)}"
            self.tensors.append(numpy_helper.from_array(array, self._names[key]))
        return self._names[key]


class Writer:
    """Nodes of one graph; a value is known by its name, a size by a tensor of one number.

    Parameters
    ----------
    constants
        Where the file keeps them.
    real
        dtype of plain numbers where no tensor says otherwise.
    prefix
        Of every name, for one writer a graph.
    """

    def __init__(self, constants: Constants, real: torch.dtype, prefix: str):
        self.constants, self.real, self.prefix = constants, real, prefix
        self.nodes: list[Any] = []
        self._count = 0
        self._names: dict[Any, str] = {}
        self._parts: dict[Any, list[str]] = {}  # of operations with several outputs

    def write(self, graph: Graph, inputs: Sequence[str]) -> list[str]:
        """Evaluate a graph at inputs; the names of its outputs."""
        places = [x for x in graph.code.graph.nodes if x.op == "placeholder"]
        self._names, self._parts = dict(zip(places, inputs, strict=False)), {}
        self._values = dict(zip(places[len(inputs) :], graph.constants, strict=True))
        outputs: list[str] = []
        for node in graph.code.graph.nodes:
            if node.op == "call_function" and node.target not in SEVERAL and not _within(node):
                self._names[node] = self._translate(node)
            elif node.op == "output":
                outputs = [self.name(x) for x in node.args[0]]
        return outputs

    def emit(self, kind: str, *inputs: str, to: str | None = None, **attributes: Any) -> str:
        """One node; its output's name."""
        from onnx import helper

        to = to or self.fresh()
        attributes = {key.removesuffix("_"): value for key, value in attributes.items()}
        self.nodes.append(helper.make_node(kind, list(inputs), [to], **attributes))
        return to

    def several(self, kind: str, inputs: Sequence[str], count: int, **attributes: Any) -> list[str]:
        """One node with several outputs; their names."""
        from onnx import helper

        to = [self.fresh() for _ in range(count)]
        self.nodes.append(helper.make_node(kind, list(inputs), to, **attributes))
        return to

    def fresh(self) -> str:
        """A name that no other value has."""
        self._count += 1
        return f"{self.prefix}{self._count}"

    def constant(self, value: Any, dtype: Any) -> str:
        """A constant of numpy's dtype."""
        return self.constants.name(np.array(value, dtype=dtype))

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
            names = [self.name(x, dtype) for x in node.args]
            if (scale := node.kwargs.get("alpha", 1)) != 1:
                names[1] = self.emit("Mul", names[1], self.name(scale, dtype))
            return self.emit(SIMPLE[target], *names)
        from herglotz.export.onnx_table import TABLE  # its functions write with this class

        if target not in TABLE:
            raise InputError(f"ONNX export does not know the operation {target}; export to --format pt2 or c")
        return TABLE[target](self, node)


def _of(x: Any) -> Example:
    return x.meta["example"]


def _axis(axis: int, x: Any) -> int:
    return axis % len(_of(x).shape)


def _common(node: Any) -> torch.dtype | None:
    """The dtype of plain numbers beside tensors: that of the last tensor (the first of `where` is its mask)."""
    tensors = [x for x in node.args if isinstance(x, fx.Node)]
    dtype = _of(tensors[-1]).dtype
    if dtype != torch.bool:
        return dtype
    return _of(node).dtype if _of(node).dtype != torch.bool else None


def kind_of(dtype: torch.dtype) -> int:
    """ONNX's number of a dtype."""
    from onnx import TensorProto

    return {
        torch.float64: TensorProto.DOUBLE, torch.float32: TensorProto.FLOAT, torch.int64: TensorProto.INT64,
        torch.int32: TensorProto.INT32, torch.bool: TensorProto.BOOL, torch.uint8: TensorProto.UINT8,
    }[dtype]  # fmt: skip


def _within(node: Any) -> bool:
    """Whether this is |x| on its way into sums, which ONNX has as one operation."""
    return node.target == aten.abs.default and all(x.target == aten.sum.dim_IntList for x in node.users)
