"""Operations of a traced program that are not one operation of the same meaning in ONNX.

A function `write_*` writes the nodes for one operation of the program and gives the name of its result.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import fx

from herglotz.errors import InputError
from herglotz.export.lower.onnx_writer import NUMPY, Writer, described

aten = torch.ops.aten
# Coordinates up to which a column is repeated by a product with ones before it meets a matrix: onnxruntime 1.24 takes
# 12 µs for (1024, 1) + (1024, 2), whose rows it adds one by one, 2 µs for two (1024, 2) and 2 to 3 µs for the product.
NARROW = 8


def common_dtype(node: Any) -> torch.dtype | None:
    """The dtype of plain numbers beside tensors: that of the last tensor (the first of `where` is its mask)."""
    tensors = [x for x in node.args if isinstance(x, fx.Node)]
    dtype = described(tensors[-1]).dtype
    if dtype != torch.bool:
        return dtype
    return described(node).dtype if described(node).dtype != torch.bool else None


def axis_of(axis: int, x: Any) -> int:
    """An axis counted from the front."""
    return axis % len(described(x).shape)


def is_within_sum(node: Any) -> bool:
    """Whether this is |x| on its way into sums, which ONNX has as one operation."""
    return node.target == aten.abs.default and all(x.target == aten.sum.dim_IntList for x in node.users)


def write_beside(w: Writer, node: Any, dtype: torch.dtype | None) -> list[str]:
    """The operands of an operation, with a column beside a narrow matrix as a matrix of equal columns."""
    shape = described(node).shape
    n = shape[-1] if len(shape) > 1 else 1
    names = [w.name(x, dtype) for x in node.args]
    for i, x in enumerate(node.args):
        if 1 < n <= NARROW and isinstance(x, fx.Node) and described(x).shape[1:] == (1,):
            names[i] = w.widened(names[i], described(x).dtype, n)
    return names


def write_scaled(w: Writer, node: Any) -> str | None:
    """A narrow matrix whose columns are multiplied by known numbers, as a product for the same reason; else None."""
    for x, row in (node.args, node.args[::-1]):
        known = w.known(row)
        if known is None or known.ndim != 1 or not 1 < len(known) <= NARROW or len(described(node).shape) != 2:
            continue
        if isinstance(x, fx.Node) and described(x).shape[-1] == len(known):
            return w.emit("Gemm", w.name(x), w.constant(torch.diag(known.detach()).numpy(), NUMPY[known.dtype]))
    return None


def require(holds: bool, node: Any) -> None:
    """Raise InputError where somebody's own term has an operation in a form that is not written."""
    if not holds:
        raise InputError(f"ONNX export does not know this form of {node.target}; export to --format pt2 or c")


def write_slice(w: Writer, node: Any) -> str:
    """x[start:end:step] along one axis."""
    x, axis, start, end, *step = node.args
    limits = [w.integers(k) for k in (start or 0, end, axis, *step)]
    return w.emit("Slice", w.name(x), *limits)


def write_select(w: Writer, node: Any) -> str:
    """One entry of an axis, which goes."""
    x, axis, index = node.args
    return w.emit("Gather", w.name(x), w.constant(index, np.int64), axis=axis_of(axis, x))


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
        x, sizes, axis = (*source.args, 0)[:3]
        w.values[source] = w.several("Split", (w.name(x), w.integers(*sizes)), len(sizes), axis=axis_of(axis, x))
        return w.values[source][index]
    if source.target == aten.linalg_inv_ex.default:
        require(index == 0, source)
        return write_inverse(w, source.args[0])
    require(source.target == aten.log_sigmoid_forward.default and index == 0, source)
    return write_log_sigmoid(w, source.args[0])


def write_inverse(w: Writer, x: Any) -> str:
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


def write_transposed(w: Writer, node: Any) -> str:
    """Two axes exchanged."""
    x, first, second = node.args
    perm = list(range(len(described(x).shape)))
    perm[first], perm[second] = perm[second], perm[first]
    return w.emit("Transpose", w.name(x), perm=perm)


def write_unflatten(w: Writer, node: Any) -> str:
    """The first axis as several."""
    x, axis, shape = node.args
    axis = axis_of(axis, x)
    require(axis == 0, node)
    tail = w.emit("Shape", w.name(x), start=1)
    return w.emit("Reshape", w.name(x), w.emit("Concat", w.sizes(shape), tail, axis=0))


def write_product(w: Writer, a: str, b: str, rank: int) -> str:
    """A B. Not MatMul where it can be helped: onnxruntime makes a number beside one an attribute of it, of 32 bits."""
    return w.emit("Gemm" if rank == 2 else "MatMul", a, b)


def write_matmul(w: Writer, node: Any) -> str:
    """A B; a vector B as a column, for which onnxruntime is ten times faster."""
    a, b = node.args
    ranks = len(described(a).shape), len(described(b).shape)
    if ranks == (2, 1):
        last = w.integers(1)
        return w.emit("Squeeze", w.emit("Gemm", w.name(a), w.emit("Unsqueeze", w.name(b), last)), last)
    return write_product(w, w.name(a), w.name(b), 2 if ranks == (2, 2) else 0)


def write_addcmul(w: Writer, node: Any) -> str:
    """A + value · b · c; the number goes into a constant factor where there is one."""
    value = node.kwargs.get("value", 1)
    known = w.known(node.args[2])
    a, b, c = write_beside(w, node, None)
    if value not in (1, -1):
        if known is None:
            c = w.emit("Mul", c, w.name(value, described(node).dtype))
        else:
            c = w.constant((known.detach() * value).numpy(), NUMPY[known.dtype])
    return w.emit("Sub" if value == -1 else "Add", a, w.emit("Mul", b, c))


def write_stack(w: Writer, node: Any) -> str:
    """Tensors along a new axis."""
    parts: Any = node.args[0]
    axis: Any = node.args[1] if len(node.args) > 1 else 0
    axis = axis % (len(described(parts[0]).shape) + 1)
    return w.emit("Concat", *(w.emit("Unsqueeze", w.name(x), w.integers(axis)) for x in parts), axis=axis)


def write_cat(w: Writer, node: Any) -> str:
    """Tensors along an axis they have."""
    parts: Any = node.args[0]
    return w.emit("Concat", *map(w.name, parts), axis=node.args[1] if len(node.args) > 1 else 0)


def write_reduced(kind: str) -> Callable[[Writer, Any], str]:
    """A reduction over axes."""

    def write(w: Writer, node: Any) -> str:
        x: Any = node.args[0]
        axes: Any = node.args[1]
        keep = int(bool(node.args[2])) if len(node.args) > 2 else 0
        axes = [axes] if isinstance(axes, int) else axes
        if is_within_sum(x):
            return w.emit("ReduceL1", w.name(x.args[0]), w.integers(*axes), keepdims=keep)
        return w.emit(kind, w.name(x), w.integers(*axes), keepdims=keep)

    return write


def write_truth(kind: str) -> Callable[[Writer, Any], str]:
    """Whether all (ReduceMin) or any (ReduceMax) entries are true."""

    def write(w: Writer, node: Any) -> str:
        axes = [w.integers(node.args[1])] if len(node.args) > 1 else []
        return w.emit(kind, w.name(node.args[0]), *axes, keepdims=0)

    return write


def write_addmm(w: Writer, node: Any) -> str:
    """C + A B."""
    c, a, b = node.args
    require(not node.kwargs, node)
    return w.emit("Gemm", w.name(a), w.name(b), w.name(c))


def write_index(w: Writer, node: Any) -> str:
    """Entries of one axis."""
    x, places = node.args
    ((axis, place),) = [(i, y) for i, y in enumerate(places) if y is not None]
    return w.emit("Gather", w.name(x), w.name(place), axis=axis)


def write_expm1(w: Writer, node: Any) -> str:
    """e^x − 1 = 2t/(1 − t), t = tanh(x/2), where x is small: ONNX has no expm1."""
    x, dtype = w.name(node.args[0]), described(node).dtype
    one, two = w.name(1.0, dtype), w.name(2.0, dtype)
    t = w.emit("Tanh", w.emit("Div", x, two))
    small = w.emit("Div", w.emit("Mul", two, t), w.emit("Sub", one, t))
    near = w.emit("Less", w.emit("Abs", x), w.name(0.5, dtype))
    return w.emit("Where", near, small, w.emit("Sub", w.emit("Exp", x), one))


def write_log1p(w: Writer, x: str, dtype: torch.dtype) -> str:
    """log(1 + x) = x log(u)/(u − 1) with u = 1 + x rounded (Kahan), x where u = 1."""
    one = w.name(1.0, dtype)
    u = w.emit("Add", one, x)
    same = w.emit("Equal", u, one)
    below = w.emit("Where", same, one, w.emit("Sub", u, one))
    return w.emit("Where", same, x, w.emit("Div", w.emit("Mul", x, w.emit("Log", u)), below))


def write_atanh(w: Writer, node: Any) -> str:
    """Artanh x = log(1 + 2x/(1 − x))/2: onnxruntime has it in float32 only."""
    x, dtype = w.name(node.args[0]), described(node).dtype
    ratio = w.emit("Div", w.emit("Mul", w.name(2.0, dtype), x), w.emit("Sub", w.name(1.0, dtype), x))
    return w.emit("Mul", w.name(0.5, dtype), write_log1p(w, ratio, dtype))


def write_log_sigmoid(w: Writer, node: Any) -> str:
    """Log σ(x) = min(x, 0) − log(1 + e^{−|x|})."""
    x, dtype = w.name(node), described(node).dtype
    decay = w.emit("Exp", w.emit("Neg", w.emit("Abs", x)))
    return w.emit("Sub", w.emit("Min", x, w.name(0.0, dtype)), write_log1p(w, decay, dtype))


def write_log_sigmoid_backward(w: Writer, node: Any) -> str:
    """G σ(−x)."""
    g, x, _ = node.args
    return w.emit("Mul", w.name(g), w.emit("Sigmoid", w.emit("Neg", w.name(x))))


def write_sigmoid_backward(w: Writer, node: Any) -> str:
    """G σ (1 − σ)."""
    g, value = (w.name(x) for x in node.args)
    slope = w.emit("Mul", value, w.emit("Sub", w.name(1.0, described(node).dtype), value))
    return w.emit("Mul", g, slope)


def write_nan_to_num(w: Writer, node: Any) -> str:
    """x, and a number where it is not finite."""
    x, nan, large = node.args
    require(nan == large, node)
    return w.emit("Where", w.finite(x), w.name(x), w.name(nan, described(node).dtype))


def write_tanh_backward(w: Writer, node: Any) -> str:
    """G (1 − t²)."""
    g, t = (w.name(x) for x in node.args)
    return w.emit("Mul", g, w.emit("Sub", w.name(1.0, described(node).dtype), w.emit("Mul", t, t)))


def write_diagonal(w: Writer, node: Any) -> str:
    """The matrix with that diagonal."""
    x: Any = node.args[0]
    eye = w.constant(np.eye(described(x).shape[-1]), NUMPY[described(x).dtype])
    return w.emit("Mul", w.emit("Unsqueeze", w.name(x), w.integers(-1)), eye)


def write_diagonal_of(w: Writer, node: Any) -> str:
    """The diagonal of the matrices (B, n, n)."""
    x: Any = node.args[0]
    n = described(x).shape[-1]
    rows = w.emit("Reshape", w.name(x), w.integers(-1, n * n))
    return w.emit("Gather", rows, w.integers(*range(0, n * n, n + 1)), axis=1)
