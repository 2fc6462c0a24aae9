"""Nodes of an ONNX graph and of the graphs inside it: names, constants, and the values of a traced program."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import count
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx

NUMPY = {
    torch.float64: np.float64, torch.float32: np.float32, torch.int64: np.int64, torch.uint8: np.uint8,
    torch.bool: np.bool_,
}  # fmt: skip


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

    `real` is the dtype of plain numbers where no tensor says otherwise; all writers of a file share the `numbers` of
    its names.
    """

    def __init__(self, constants: Constants, real: torch.dtype, numbers: Iterator[int] | None = None):
        self.constants, self.real = constants, real
        self.numbers = count() if numbers is None else numbers
        self.nodes: list[Any] = []
        self._wide: dict[tuple[str, int], str] = {}
        self.values: dict[fx.Node, Any] = {}  # names, known tensors, or the names of an operation's several outputs

    def inner(self) -> Writer:
        """A writer for a graph inside this one, which sees all names of this one."""
        return Writer(self.constants, self.real, self.numbers)

    def emit(self, kind: str, *inputs: str, to: str | None = None, **attributes: Any) -> str:
        """One node; its output's name."""
        from onnx import helper

        to = to or self.fresh()
        attributes = {key.removesuffix("_"): value for key, value in attributes.items()}
        self.nodes.append(helper.make_node(kind, list(inputs), [to], **attributes))
        return to

    def several(self, kind: str, inputs: Sequence[str], outputs: int, **attributes: Any) -> list[str]:
        """One node with several outputs; their names."""
        from onnx import helper

        to = [self.fresh() for _ in range(outputs)]
        self.nodes.append(helper.make_node(kind, list(inputs), to, **attributes))
        return to

    def fresh(self) -> str:
        """A name that no other value of the file has."""
        return f"x{next(self.numbers)}"

    def constant(self, value: Any, dtype: Any) -> str:
        """A constant of numpy's dtype."""
        return self.constants.name(np.array(value, dtype=dtype))

    def integers(self, *values: int) -> str:
        """Axes, indices, a shape."""
        return self.constant(list(values), np.int64)

    def known(self, x: Any) -> Tensor | None:
        """The tensor where it is a constant of the program."""
        value = self.values.get(x) if isinstance(x, fx.Node) else x
        return value if isinstance(value, Tensor) else None

    def name(self, x: Any, dtype: torch.dtype | None = None) -> str:
        """The name of a value; a number becomes a constant of the given dtype."""
        value = self.values[x] if isinstance(x, fx.Node) else x
        if isinstance(value, str):
            return value
        if isinstance(value, Tensor):
            return self.constant(value.detach().numpy(), NUMPY[value.dtype])
        return self.constant(value, NUMPY[dtype or self.real])

    def sizes(self, shape: Sequence[Any]) -> str:
        """A shape some of whose entries the graph computes."""
        if all(isinstance(x, int) for x in shape):
            return self.integers(*shape)
        parts = [self.integers(x) if isinstance(x, int) else self.name(x) for x in shape]
        return self.emit("Concat", *parts, axis=0) if len(parts) > 1 else parts[0]

    def like(self, node: Any, value: float) -> str:
        """A tensor of the shape of the node's first argument, filled."""
        shape = self.emit("Shape", self.name(node.args[0]))
        return self.emit("Expand", self.constant(value, NUMPY[described(node).dtype]), shape)

    def finite(self, x: Any) -> str:
        """Whether |x| < ∞, which is false of NaN too."""
        return self.emit("Less", self.emit("Abs", self.name(x)), self.name(math.inf, described(x).dtype))

    def widened(self, column: str, dtype: torch.dtype, n: int) -> str:
        """A column (B, 1) as n equal ones, made once in a graph."""
        if (column, n) not in self._wide:
            real = self.real if dtype == torch.bool else dtype
            ones = self.constant(np.ones((1, n)), NUMPY[real])
            column_of = self.emit("Cast", column, to_=kind_of(real)) if dtype == torch.bool else column
            wide = self.emit("Gemm", column_of, ones)
            wide = self.emit("Cast", wide, to_=kind_of(dtype)) if dtype == torch.bool else wide
            self._wide[column, n] = wide
        return self._wide[column, n]

    def own(self, names: Sequence[str], inputs: Sequence[str]) -> list[str]:
        """Names that this graph makes, each once: what it only passes on gets a node."""
        made = {y for node in self.nodes for y in node.output}
        seen: set[str] = set(inputs)
        out = []
        for name in names:
            if name in seen or name not in made:
                name = self.emit("Identity", name)
            seen.add(name)
            out.append(name)
        return out


def described(x: Any) -> Any:
    """Shape and dtype of a value in the program."""
    return x.meta["val"]


def kind_of(dtype: torch.dtype) -> int:
    """ONNX's number of a dtype."""
    from onnx import TensorProto

    return {
        torch.float64: TensorProto.DOUBLE, torch.float32: TensorProto.FLOAT, torch.int64: TensorProto.INT64,
        torch.int32: TensorProto.INT32, torch.bool: TensorProto.BOOL, torch.uint8: TensorProto.UINT8,
    }[dtype]  # fmt: skip
