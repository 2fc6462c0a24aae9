"""Nodes of an ONNX graph and of the graphs inside it: names, constants, and the values of a traced program."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import count
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx

from herglotz.errors import InputError

aten = torch.ops.aten
NUMPY = {
    torch.float64: np.float64, torch.float32: np.float32, torch.int64: np.int64, torch.int32: np.int32,
    torch.uint8: np.uint8, torch.bool: np.bool_,
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

    A value has its axes in the order of `order_of`. `real` is the dtype of numbers where no tensor says otherwise; all
    writers of a file share the `numbers` of its names.
    """

    def __init__(self, constants: Constants, real: torch.dtype, numbers: Iterator[int] | None = None):
        self.constants, self.real = constants, real
        self.numbers = count() if numbers is None else numbers
        self.nodes: list[Any] = []
        self._made: dict[Any, str] = {}
        self._permuted: dict[str, tuple[str, Sequence[int]]] = {}
        self.around: Writer | None = None
        self.own: set[str] = set()  # the names of this graph
        self.folded: set[fx.Node] = set()  # products that are held with the axes before they were flattened
        self.values: dict[fx.Node, Any] = {}  # names, known tensors, or the names of an operation's several outputs

    def inner(self) -> Writer:
        """A writer for a graph inside this one, which sees all names of this one."""
        inner = Writer(self.constants, self.real, self.numbers)
        inner.around = self
        return inner

    def emit(self, kind: str, *inputs: str, to: str | None = None, **attributes: Any) -> str:
        """One node, or the one that has computed the same; its output's name.

        What nothing inside a loop decides is computed before the loop.
        """
        from onnx import helper

        if to is None and self.around is not None and self.own.isdisjoint(inputs):
            return self.around.emit(kind, *inputs, **attributes)
        key = (kind, inputs, repr(attributes))
        if to is None and key in self._made:
            return self._made[key]
        to = self._made[key] = to or self.fresh()
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
        name = f"x{next(self.numbers)}"
        self.own.add(name)
        return name

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

    def beside(self, x: Any, node: Any, dtype: torch.dtype | None = None, scale: float = 1) -> str:
        """An operand of an operation entry by entry, whose axes meet those of the result `node`; known ones scaled.

        A number beside more than a matrix is written as often as there are rows: onnxruntime makes one that is beside a
        MatMul an attribute of it, of 32 bits.
        """
        shape, known = described(node).shape, self.known(x)
        behind = len(shape) - 1 - order_of(shape)[-1] if shape else 0  # axes of the result behind the batch
        if known is not None:
            return self._known_beside(known if scale == 1 else known * scale, shape, behind)
        if not isinstance(x, fx.Node):
            dtype = dtype or self.real
            return self.rows(x, shape, dtype) if len(shape) > 2 else self.name(x, dtype)
        own = described(x).shape
        require(not own or not behind or any(not isinstance(size, int) for size in own), node)  # no batch: it is known
        while x.target == aten.unsqueeze.default and axis_of(x.args[1], x) == 0 and described(x).shape != shape:
            x = x.args[0]  # another operand has the axis in front
        return self.name(x)

    def _known_beside(self, known: Tensor, shape: Sequence[Any], behind: int) -> str:
        """A known operand beside a result of this shape, which has so many axes behind the batch."""
        if known.numel() == 1 and len(shape) > 2:
            return self.rows(known.item(), shape, known.dtype)
        if behind and known.ndim:
            place = known.ndim - 1 - behind  # of the axis that meets the batch
            known = known[..., None] if place < 0 else known.movedim(place, -1)
        return self.name(known)

    def rows(self, number: float, shape: Sequence[Any], dtype: torch.dtype) -> str:
        """A number in the axes of a shape that are fixed."""
        fixed = [shape[i] if isinstance(shape[i], int) else 1 for i in order_of(shape)]
        return self.constant(np.full(fixed, number), NUMPY[dtype])

    def stored(self, name: str, shape: Sequence[Any]) -> str:
        """A value whose axes are in the program's order."""
        return self.permuted(name, order_of(shape))

    def plain(self, name: str, shape: Sequence[Any]) -> str:
        """A value with its axes in the program's order again."""
        order = order_of(shape)
        return self.permuted(name, [order.index(i) for i in range(len(order))])

    def permuted(self, name: str, axes: Sequence[int]) -> str:
        """The axes in another order; two orders in turn are one."""
        if name in self._permuted:
            name, first = self._permuted[name]
            axes = [first[i] for i in axes]
        if list(axes) == sorted(axes):
            return name
        new = self.emit("Transpose", name, perm=list(axes))
        self._permuted[new] = (name, axes)
        return new

    def results(self, names: Sequence[str], inputs: Sequence[str]) -> list[str]:
        """Names that this graph makes, each once: what it only passes on gets a node."""
        made = {y for node in self.nodes for y in node.output}
        seen: set[str] = set(inputs)
        out = []
        for name in names:
            if name in seen or name not in made:
                name = self.emit("Identity", name, to=self.fresh())
            seen.add(name)
            out.append(name)
        return out


def require(holds: bool, node: Any) -> None:
    """Raise InputError where somebody's own term has an operation in a form that is not written."""
    if not holds:
        raise InputError(f"ONNX export does not know this form of {node.target}; export to --format pt2 or c")


def order_of(shape: Sequence[Any]) -> list[int]:
    """The axes of a value in the order in which the file holds them: the batch, the last free one, comes last.

    Operations on (n, B) and (B,) then run over whole rows of memory, which onnxruntime needs: for (1024, 2) times
    (1024, 1) it takes 25 µs, for (2, 1024) times (1024,) 2 µs.
    """
    axes = list(range(len(shape)))
    free = [i for i, size in enumerate(shape) if not isinstance(size, int)]
    return [*(i for i in axes if i != free[-1]), free[-1]] if free else axes


def axis_of(axis: Any, x: Any) -> int:
    """Where the file holds an axis of a value."""
    order = order_of(described(x).shape)
    return order.index(axis % len(order))


def needed(nodes: Sequence[Any], outputs: Sequence[str]) -> list[Any]:
    """The nodes that the outputs need."""
    wanted, kept = set(outputs), []
    for node in reversed(nodes):
        if wanted.intersection(node.output):
            kept.append(node)
            wanted |= reads(node)
    return kept[::-1]


def reads(node: Any) -> set[str]:
    """The names that a node and the graphs inside it read."""
    inside = (x for attribute in node.attribute for x in attribute.g.node)
    return {*node.input, *(name for x in inside for name in reads(x))}


def described(x: Any) -> Any:
    """Shape and dtype of a value in the program."""
    return x.meta["val"]


def kind_of(dtype: torch.dtype) -> int:
    """ONNX's number of a dtype."""
    from onnx import helper

    return int(helper.np_dtype_to_tensor_dtype(np.dtype(NUMPY[dtype])))
