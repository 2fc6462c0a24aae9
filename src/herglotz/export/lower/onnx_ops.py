"""Operations of a traced program that are not one operation of the same meaning in ONNX.

A function `write_*` writes the nodes for one operation of the program and gives the name of its result.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import fx

from herglotz.export.lower import onnx_functions
from herglotz.export.lower.onnx_writer import NUMPY, Writer, axis_of, described, order_of, require

aten = torch.ops.aten


def common_dtype(node: Any) -> torch.dtype | None:
    """The dtype of plain numbers beside tensors: that of the last tensor (the first of `where` is its mask)."""
    tensors = [x for x in node.args if isinstance(x, fx.Node)]
    dtype = described(tensors[-1]).dtype
    if dtype != torch.bool:
        return dtype
    return described(node).dtype if described(node).dtype != torch.bool else None


def write_slice(w: Writer, node: Any) -> str:
    """x[start:end:step] along one axis."""
    x, axis, start, end, *step = node.args
    limits = [w.integers(k) for k in (start or 0, end, axis_of(axis, x), *step)]
    return w.emit("Slice", w.name(x), *limits)


def write_select(w: Writer, node: Any) -> str:
    """Entries of one axis by their numbers, or one entry, whose axis goes."""
    x, axis, index = node.args
    return w.emit("Gather", w.name(x), w.name(index, torch.int64), axis=axis_of(axis, x))


def write_item(w: Writer, node: Any) -> str:
    """One output of an operation that has several."""
    source: Any = node.args[0]
    index: Any = node.args[1]
    if source in w.values:  # of a loop
        return w.values[source][index]
    if source.target == aten.unbind.int:
        x, axis = source.args[0], (source.args[1] if len(source.args) > 1 else 0)
        return w.emit("Gather", w.name(x), w.constant(index, np.int64), axis=axis_of(axis, x))
    if source.target == aten.split_with_sizes.default:
        x, sizes = source.args[:2]
        axis = axis_of(source.args[2] if len(source.args) > 2 else 0, x)
        w.values[source] = w.several("Split", (w.name(x), w.integers(*sizes)), len(sizes), axis=axis)
        return w.values[source][index]
    if source.target == aten.linalg_inv_ex.default:
        require(index == 0, source)
        return write_inverse(w, source.args[0])
    require(source.target == aten.log_sigmoid_forward.default, source)
    if index == 1:  # torch's own working memory, which `write_log_sigmoid_backward` does without
        require(all(x.target == aten.log_sigmoid_backward.default for x in node.users), source)
        return ""
    return onnx_functions.write_log_sigmoid(w, source.args[0])


def write_inverse(w: Writer, x: Any) -> str:
    """The inverse of a mass matrix by Gauss and Jordan: ONNX has none, and such a matrix needs no row exchanges."""
    n, real = described(x).shape[-1], NUMPY[described(x).dtype]
    eye = np.eye(n)
    rows, columns = w.integers(axis_of(-2, x)), w.integers(axis_of(-1, x))
    # Constants (n, n) meet (..., n, n), held as (..., n, n, batch).
    meeting = (lambda y: y[..., None]) if axis_of(-1, x) + 1 < len(described(x).shape) else (lambda y: y)
    J = w.name(x)
    for k in range(n):
        ends = w.integers(k), w.integers(k + 1)
        column = w.emit("Slice", J, *ends, columns)
        pivot = w.emit("Slice", column, *ends, rows)
        held = w.emit("Mul", J, w.constant(meeting(1 - eye[k : k + 1]), real))
        cleared = w.emit("Add", held, w.constant(meeting(np.outer(eye[k], eye[k])), real))
        row = w.emit("Div", w.emit("Slice", cleared, *ends, rows), pivot)
        J = w.emit(
            "Sub", cleared, w.emit("Mul", w.emit("Sub", column, w.constant(meeting(eye[k][:, None]), real)), row)
        )
    return J


def write_transposed(w: Writer, node: Any) -> str:
    """Two axes exchanged."""
    x, first, second = node.args
    axes = list(range(len(described(x).shape)))
    axes[first], axes[second] = axes[second], axes[first]
    return permuted(w, node, axes)


def permuted(w: Writer, node: Any, axes: list[int]) -> str:
    """Axis i of the result is axis axes[i] of the first argument."""
    x: Any = node.args[0]
    own = order_of(described(x).shape)
    return w.permuted(w.name(x), [own.index(axes[i]) for i in order_of(described(node).shape)])


def write_reshaped(w: Writer, node: Any) -> str:
    """The same numbers in another shape."""
    x, shape = node.args
    if x in w.folded:  # a product of more axes
        return w.name(x)
    before, after = (described(y).shape for y in (x, node))
    name, tail, batch = w.name(x), list(after[1:]), (order_of(before)[-1:], order_of(after)[-1:])
    if batch == ([1], [0]) and list(before[2:]) == tail:  # all steps as one batch
        return w.emit("Reshape", w.permuted(name, [*range(1, len(after)), 0, len(after)]), w.integers(*tail, -1))
    if batch == ([0], [1]) and list(before[1:]) == tail[1:]:  # and back
        whole = w.emit("Reshape", name, w.sizes([*tail[1:], *shape[:2]]))
        return w.permuted(whole, [len(before) - 1, *range(len(before) - 1), len(before)])
    return w.stored(w.emit("Reshape", w.plain(name, before), w.sizes(shape)), after)


def write_expanded(w: Writer, node: Any) -> str:
    """Entries repeated along axes of one entry."""
    x, shape = node.args
    order = order_of(described(node).shape)
    return w.emit("Expand", w.beside(x, node), w.sizes([1 if shape[i] == -1 else shape[i] for i in order]))


def write_zeros(w: Writer, node: Any) -> str:
    """Zeros of a shape that the graph computes."""
    order, shape = order_of(described(node).shape), node.args[1]
    return w.emit("Expand", w.name(0.0, described(node).dtype), w.sizes([shape[i] for i in order]))


def write_repeated(w: Writer, node: Any) -> str:
    """The whole, several times along its axes."""
    x, times = node.args
    require(len(times) == len(described(x).shape), node)
    return w.emit("Tile", w.name(x), w.integers(*(times[i] for i in order_of(described(node).shape))))


def write_unsqueezed(w: Writer, node: Any) -> str:
    """Another axis of one entry."""
    return w.emit("Unsqueeze", w.name(node.args[0]), w.integers(axis_of(node.args[1], node)))


def write_squeezed(w: Writer, node: Any) -> str:
    """Without an axis of one entry; an axis of more, or the batch, stays."""
    x, axis = node.args
    one = described(x).shape[axis] == 1
    return w.emit("Squeeze", w.name(x), w.integers(axis_of(axis, x))) if one else w.name(x)


def write_size(w: Writer, node: Any) -> str:
    """The size of an axis."""
    x, axis = node.args
    place = axis_of(axis, x)
    return w.emit("Shape", w.name(x), start=place, end=place + 1)


def write_unflatten(w: Writer, node: Any) -> str:
    """The first axis as several."""
    x, axis, shape = node.args
    require(axis == 0 and isinstance(described(x).shape[0], int), node)
    tail = w.emit("Shape", w.name(x), start=1)
    return w.emit("Reshape", w.name(x), w.emit("Concat", w.sizes(shape), tail, axis=0))


def write_matmul(w: Writer, node: Any) -> str:
    """A B. Of a batch A and one B, with the batch last, that is Bᵀ A, of as many axes as A had before it was flattened.

    Gemm where it can be: for a number beside a MatMul see `Writer.beside`.
    """
    a, b = node.args
    whole = unfolded(node)
    if whole is not None:
        w.folded.add(node)
        return w.emit("MatMul", transposed(w, b), w.name(whole))
    free = [not isinstance(size, int) for size in described(a).shape]
    fixed = all(isinstance(size, int) for size in described(b).shape)
    if len(described(b).shape) == 1:
        require(fixed and free == [True, False], node)
        known = w.known(b)
        row = w.emit("Unsqueeze", w.name(b), w.integers(0)) if known is None else w.name(known[None])
        return w.emit("Squeeze", w.emit("Gemm", row, w.name(a)), w.integers(0))
    if fixed and free == [True, False]:
        return w.emit("Gemm", transposed(w, b), w.name(a))
    if fixed and free == [False, True, False] and described(a).shape[0] > 1:
        return w.emit("MatMul", transposed(w, b), w.name(a))
    plain = (w.plain(w.name(x), described(x).shape) for x in (a, b))
    return w.stored(w.emit("Gemm" if len(free) == 2 else "MatMul", *plain), described(node).shape)


def transposed(w: Writer, x: Any) -> str:
    """A matrix without a batch, its last two axes exchanged."""
    known = w.known(x)
    if known is not None:
        return w.name(known.mT)
    axes = list(range(len(described(x).shape)))
    return w.permuted(w.name(x), [*axes[:-2], axes[-1], axes[-2]])


def unfolded(node: Any) -> Any:
    """A, where A B of (..., k) was flattened to two axes for a product and is (..., m) again after it; else None."""
    flat, b = node.args
    if node.target != aten.mm.default or flat.target != aten.reshape.default:
        return None
    whole, wide = flat.args[0], described(b).shape
    shape = described(whole).shape
    if (
        len(shape) < 3
        or math.prod(x for x in shape[:-1] if isinstance(x, int)) == 1
        or shape[-1] != wide[0]
        or isinstance(shape[-2], int)
        or not isinstance(wide[0], int)
    ):
        return None
    after = [*shape[:-1], wide[1]]
    same = (x.target == aten.reshape.default and list(described(x).shape) == after for x in node.users)
    return whole if all(same) else None


def write_addcmul(w: Writer, node: Any) -> str:
    """A + value · b · c; the number goes into a constant factor where there is one."""
    value = node.kwargs.get("value", 1)
    known = w.known(node.args[2])
    a, b, c = (w.beside(x, node) for x in node.args)
    if value not in (1, -1):
        if known is None:
            c = w.emit("Mul", c, w.beside(value, node, described(node).dtype))
        else:
            c = w.beside(node.args[2], node, scale=value)
    return w.emit("Sub" if value == -1 else "Add", a, w.emit("Mul", b, c))


def write_stack(w: Writer, node: Any) -> str:
    """Tensors along a new axis."""
    parts: Any = node.args[0]
    axis: Any = node.args[1] if len(node.args) > 1 else 0
    axis = axis_of(axis, node)
    return w.emit("Concat", *(w.emit("Unsqueeze", w.name(x), w.integers(axis)) for x in parts), axis=axis)


def write_cat(w: Writer, node: Any) -> str:
    """Tensors along an axis they have."""
    parts: Any = node.args[0]
    return w.emit("Concat", *map(w.name, parts), axis=axis_of(node.args[1] if len(node.args) > 1 else 0, node))


def write_reduced(kind: str) -> Callable[[Writer, Any], str]:
    """A reduction over axes."""

    def write(w: Writer, node: Any) -> str:
        x: Any = node.args[0]
        axes: Any = node.args[1]
        keep = int(bool(node.args[2])) if len(node.args) > 2 else 0
        axes = [axis_of(axis, x) for axis in ([axes] if isinstance(axes, int) else axes)]
        return w.emit(kind, w.name(x), w.integers(*axes), keepdims=keep)

    return write


def write_all(w: Writer, node: Any) -> str:
    """Whether all entries are true."""
    axes = [w.integers(axis_of(node.args[1], node.args[0]))] if len(node.args) > 1 else []
    return w.emit("ReduceMin", w.name(node.args[0]), *axes, keepdims=0)


def write_addmm(w: Writer, node: Any) -> str:
    """C + A B."""
    c, a, b = node.args
    free = [not isinstance(size, int) for x in (a, b) for size in described(x).shape]
    require(not node.kwargs and free == [True, False, False, False], node)
    return w.emit("Gemm", transposed(w, b), w.name(a), w.beside(c, node))


def write_index(w: Writer, node: Any) -> str:
    """Entries of one axis."""
    x, places = node.args
    chosen = [(i, y) for i, y in enumerate(places) if y is not None]
    require(len(chosen) == 1, node)
    ((axis, place),) = chosen
    return w.emit("Gather", w.name(x), w.name(place), axis=axis_of(axis, x))


def write_diagonal(w: Writer, node: Any) -> str:
    """The matrix with that diagonal."""
    x: Any = node.args[0]
    require(len(node.args) == 1, node)
    eye = torch.eye(described(x).shape[-1], dtype=described(x).dtype)
    whole = w.emit("Unsqueeze", w.name(x), w.integers(axis_of(-1, node)))
    return w.emit("Mul", whole, w.name(eye[..., None] if axis_of(-1, node) + 1 < len(described(node).shape) else eye))


def write_diagonal_of(w: Writer, node: Any) -> str:
    """The diagonal of the matrices (B, n, n)."""
    x: Any = node.args[0]
    n = described(x).shape[-1]
    require(order_of(described(x).shape) == [1, 2, 0] and node.args[1:] in ((0, -2, -1), (0, 1, 2)), node)
    rows = w.emit("Reshape", w.name(x), w.integers(n * n, -1))
    return w.emit("Gather", rows, w.integers(*range(0, n * n, n + 1)), axis=0)


def write_padded(w: Writer, node: Any) -> str:
    """Zeros with the first argument as one entry of an axis, or as a run of them: the derivative of taking these."""
    g, shape, axis, start, *end = node.args
    size, place, name = shape[axis], axis_of(axis, node), w.name(g)
    require(isinstance(size, int) and end[1:] in ([], [1]), node)
    first = start % size if start < 0 else start
    if end:
        last = min(end[0], size) if end[0] >= 0 else size + end[0]
    else:
        name, last = w.emit("Unsqueeze", name, w.integers(place)), first + 1
    zero = w.name(0.0, described(node).dtype)
    return w.emit("Pad", name, w.integers(first, size - last), zero, w.integers(place))
