"""A traced graph as nodes of ONNX, written by torch.onnx's own functions and by those of `OPERATIONS`.

`OPERATIONS` has what torch.onnx does not have, or writes with numbers of 32 bits or as slow nodes. An entry takes the
arguments of the operation of torch, tensors as values of the ONNX graph, and returns the result, or a list of results.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx_ir as ir
import torch
from onnx_ir.tensor_adapters import from_torch_dtype
from onnxscript.function_libs.torch_lib import ops as _registered  # noqa: F401  it fills the registry
from onnxscript.function_libs.torch_lib.registration import default_registry
from onnxscript.onnx_opset import opset20
from torch import fx

from herglotz.codegen.trace import Example
from herglotz.errors import InputError
from herglotz.export.inline import graph_of_key, results_of

aten = torch.ops.aten
op: Any = opset20
# An `onnx_ir.Value`; onnxscript records operators on values.
Value = Any


def constant(value: Any, dtype: ir.DataType) -> Value:
    """A number or an array of this dtype. torch.onnx would round a Python number to 32 bits first."""
    return op.Constant(value=ir.tensor(value, dtype=dtype))


def integers(*values: int) -> Value:
    """A list of integers: axes, indices or a shape."""
    return op.Constant(value_ints=list(values))


def weighted(kind: Callable[..., Value]) -> Callable[..., Value]:
    """`add` or `sub` of x and α y."""

    def written(x: Value, y: Value | float, alpha: float = 1) -> Value:
        y = constant(y, x.dtype) if isinstance(y, (int, float)) else y
        return kind(x, y if alpha == 1 else op.Mul(constant(alpha, x.dtype), y))

    return written


def subtracted_from(x: Value, number: float, alpha: float = 1) -> Value:
    """`rsub`: number − α x."""
    return op.Sub(constant(number, x.dtype), x if alpha == 1 else op.Mul(constant(alpha, x.dtype), x))


def added_product(x: Value, a: Value, b: Value, value: float = 1) -> Value:
    """`addcmul`: x + value · a · b."""
    product = op.Mul(a, b)
    if value == -1:
        return op.Sub(x, product)
    return op.Add(x, product if value == 1 else op.Mul(constant(value, x.dtype), product))


def filled_like(x: Value, number: float, dtype: int = -1, **_: Any) -> Value:
    """`full_like`."""
    return op.Expand(constant(number, x.dtype if dtype == -1 else ir.DataType(dtype)), op.Shape(x))


def gathered(x: Value, places: Sequence[Value | None]) -> Value:
    """`index`; along the first axis as a Gather: the general form runs at a tenth of the speed."""
    if len(places) == 1:
        return op.Gather(x, places[0])
    return default_registry["aten::index.Tensor"].overloads[0](x, places)


def without_nan(x: Value, nan: float = 0.0, posinf: float | None = None, neginf: float | None = None) -> Value:
    """`nan_to_num`."""
    largest, y = float(np.finfo(x.dtype.numpy()).max), x
    for infinity, number in ((math.inf, posinf), (-math.inf, neginf)):
        found = math.copysign(largest, infinity) if number is None else number
        y = op.Where(op.Equal(x, constant(infinity, x.dtype)), constant(found, x.dtype), y)
    return op.Where(op.IsNaN(x), constant(nan, x.dtype), y)


def log1p(x: Value, dtype: ir.DataType | None = None) -> Value:
    """log(1 + x) = x log(u)/(u − 1) with u = 1 + x rounded (Kahan), x where u = 1."""
    one = constant(1.0, dtype or x.dtype)
    u = op.Add(one, x)
    same = op.Equal(u, one)
    return op.Where(same, x, op.Div(op.Mul(x, op.Log(u)), op.Where(same, one, op.Sub(u, one))))


def expm1(x: Value) -> Value:
    """e^x − 1 = 2t/(1 − t), t = tanh(x/2), where x is small."""
    one, two = constant(1.0, x.dtype), constant(2.0, x.dtype)
    t = op.Tanh(op.Div(x, two))
    small = op.Div(op.Mul(two, t), op.Sub(one, t))
    return op.Where(op.Less(op.Abs(x), constant(0.5, x.dtype)), small, op.Sub(op.Exp(x), one))


def atanh(x: Value) -> Value:
    """Artanh x = log(1 + 2x/(1 − x))/2: onnxruntime has Atanh in float32 only."""
    ratio = op.Div(op.Mul(constant(2.0, x.dtype), x), subtracted_from(x, 1.0))
    return op.Mul(constant(0.5, x.dtype), log1p(ratio, x.dtype))


def log_sigmoid(x: Value) -> list[Value]:
    """`log_sigmoid_forward`: log σ(x) = min(x, 0) − log(1 + d), d = e^{−|x|}, and d, the second result of torch."""
    decay = op.Exp(op.Neg(op.Abs(x)))
    return [op.Sub(op.Min(x, constant(0.0, x.dtype)), log1p(decay, x.dtype)), decay]


def log_sigmoid_backward(g: Value, x: Value, _: Value) -> Value:
    """The derivative g σ(−x) of log σ(x)."""
    return op.Mul(g, op.Sigmoid(op.Neg(x)))


def sigmoid_backward(g: Value, y: Value) -> Value:
    """The derivative g y (1 − y), y = σ(x)."""
    return op.Mul(g, op.Mul(y, subtracted_from(y, 1.0)))


def tanh_backward(g: Value, y: Value) -> Value:
    """The derivative g (1 − y²), y = tanh x."""
    return op.Mul(g, op.Sub(constant(1.0, y.dtype), op.Mul(y, y)))


def threshold_backward(g: Value, x: Value, threshold: float) -> Value:
    """The derivative of relu: g where x lies above the threshold, else 0."""
    return op.Where(op.Greater(x, constant(threshold, x.dtype)), g, constant(0.0, x.dtype))


def product(a: Value, b: Value) -> Value:
    """`mm` as a Gemm, because onnxruntime turns a number beside a MatMul into an attribute of 32 bits."""
    return op.Gemm(a, b)


def products(a: Value, b: Value) -> Value:
    """`bmm`, as an Einsum: a Gemm has no batch."""
    return op.Einsum(a, b, equation="bij,bjk->bik")


def product_with_vector(a: Value, b: Value) -> Value:
    """`mv`."""
    return op.Squeeze(op.Gemm(a, op.Unsqueeze(b, integers(1))), integers(1))


def split(x: Value, sizes: Sequence[int], dim: int = 0) -> list[Value]:
    """`split_with_sizes` as slices: torch.onnx writes a sequence, which onnxruntime copies."""
    ends = np.cumsum(sizes).tolist()
    return [
        op.Slice(x, integers(end - size), integers(end), integers(dim)) for size, end in zip(sizes, ends, strict=True)
    ]


def entry_backward(g: Value, sizes: Sequence[Any], dim: int, index: int) -> Value:
    """`select_backward`, the derivative of one entry of an axis: zeros around g."""
    first = index % sizes[dim]
    return _among_zeros(op.Unsqueeze(g, integers(dim)), dim, (first, sizes[dim] - first - 1), g.dtype)


def entries_backward(g: Value, sizes: Sequence[Any], dim: int, start: int, end: int, step: int) -> Value:
    """`slice_backward`, the derivative of entries side by side: zeros around g."""
    if step != 1:
        raise InputError(f"ONNX export does not know a slice_backward of step {step}; export to --format pt2 or c")
    first, last, _ = slice(start, end).indices(sizes[dim])
    return _among_zeros(g, dim, (first, sizes[dim] - last), g.dtype)


def _among_zeros(g: Value, dim: int, counts: tuple[int, int], dtype: ir.DataType) -> Value:
    return op.Pad(g, integers(*counts), constant(0.0, dtype), integers(dim))


def diagonal_matrix(x: Value, *places: int) -> Value:
    """`diag_embed`."""
    if places:
        raise InputError(f"ONNX export does not know a diag_embed at {places}; export to --format pt2 or c")
    return op.Mul(op.Unsqueeze(x, integers(-1)), constant(np.eye(x.shape[-1]), x.dtype))


def inverse(A: Value, **_: Any) -> list[Value]:
    """`linalg_inv_ex` of mass matrices (..., n, n) by Gauss-Jordan elimination without row exchanges, and status 0."""
    n = A.shape[-1]
    eye, rows, columns, J = np.eye(n), integers(-2), integers(-1), A
    for k in range(n):
        ends = integers(k), integers(k + 1)
        column = op.Slice(J, *ends, columns)
        pivot = op.Slice(column, *ends, rows)
        others = op.Mul(J, constant(1 - eye[k : k + 1], A.dtype))
        cleared = op.Add(others, constant(np.outer(eye[k], eye[k]), A.dtype))
        row = op.Div(op.Slice(cleared, *ends, rows), pivot)
        J = op.Sub(cleared, op.Mul(op.Sub(column, constant(eye[k][:, None], A.dtype)), row))
    return [J, op.Constant(value_int=0)]


OPERATIONS: dict[Any, Callable[..., Any]] = {
    aten.__and__.Tensor: op.And,
    aten.__or__.Tensor: op.Or,
    aten.add.Tensor: weighted(op.Add),
    aten.addcmul.default: added_product,
    aten.atanh.default: atanh,
    aten.bmm.default: products,
    aten.diag_embed.default: diagonal_matrix,
    aten.expm1.default: expm1,
    aten.full_like.default: filled_like,
    aten.index.Tensor: gathered,
    aten.linalg_inv_ex.default: inverse,
    aten.log1p.default: log1p,
    aten.log_sigmoid_backward.default: log_sigmoid_backward,
    aten.log_sigmoid_forward.default: log_sigmoid,
    aten.mm.default: product,
    aten.mv.default: product_with_vector,
    aten.nan_to_num.default: without_nan,
    aten.rsub.Scalar: subtracted_from,
    aten.select_backward.default: entry_backward,
    aten.sigmoid_backward.default: sigmoid_backward,
    aten.slice_backward.default: entries_backward,
    aten.split_with_sizes.default: split,
    aten.sub.Tensor: weighted(op.Sub),
    aten.tanh_backward.default: tanh_backward,
    aten.threshold_backward.default: threshold_backward,
}

Values = dict[fx.Node, Any]
# Types of options about memory, which ONNX does not have.
OF_STORAGE = (torch.device, torch.layout, torch.memory_format)


def translated(arguments: Sequence[Any], key: int) -> list[Any]:
    """Write the graph of an operator (`herglotz.export.inline`) into the present ONNX graph; return its results."""
    graph = graph_of_key(key)
    values: Values = {}
    places = iter(arguments)
    for node in graph.code.nodes:
        if node.op == "placeholder":
            values[node] = next(places)
        elif node.target is operator.getitem:
            source, index = node.args
            values[node] = values[source][index]
        elif node.op == "call_function":
            options = {k: x for k, x in node.kwargs.items() if x is not None and not isinstance(x, OF_STORAGE)}
            values[node] = function_of(node.target)(*_given(node.args, values), **_given(options, values))
            _describe(values[node], node.meta["example"], graph.batch)
    # Each result has a name of its own, also where the graph returns one of its arguments.
    return [op.Identity(values[x]) for x in results_of(graph)]


def function_of(target: Any) -> Callable[..., Any]:
    """The function that writes an operation of torch.

    Raise InputError where neither torch.onnx nor `OPERATIONS` has the operation.
    """
    if target in OPERATIONS:
        return OPERATIONS[target]
    name = f"_operator::{target.__name__}" if target is operator.mul else target.name()
    if name not in default_registry or not default_registry[name].overloads:
        raise InputError(f"ONNX export does not know the operation {target}; export to --format pt2 or c")
    return default_registry[name].overloads[0]


def _given(x: Any, values: Values) -> Any:
    """An argument with values in place of nodes."""
    if isinstance(x, fx.Node):
        return values[x]
    if isinstance(x, dict):
        return {name: _given(y, values) for name, y in x.items()}
    if isinstance(x, (list, tuple)):
        return [_given(y, values) for y in x]
    return int(from_torch_dtype(x)) if isinstance(x, torch.dtype) else x


def _describe(value: Any, example: Any, batch: int) -> None:
    """Note the dtype and shape of a result, which the functions that take the result read."""
    if isinstance(example, (list, tuple)) and not isinstance(example, Example):
        for x, y in zip(value, example, strict=True):
            _describe(x, y, batch)
    elif isinstance(example, Example):
        value.dtype = from_torch_dtype(example.dtype)
        value.shape = ir.Shape([None if x and x % batch == 0 else x for x in example.shape])
    else:
        value.dtype, value.shape = ir.DataType.INT64, ir.Shape([])
