"""The operations of a traced graph on arrays of numbers of a `Program`."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import fx

from herglotz.codegen.program import Atom, Compared, Program, Ref, add, fold_add, fold_multiply
from herglotz.codegen.trace import Graph
from herglotz.errors import InputError

aten = torch.ops.aten
MATHEMATICS: dict[str, Callable[[float], float]] = {
    "sin": math.sin, "cos": math.cos, "exp": math.exp, "expm1": math.expm1, "sqrt": math.sqrt, "atanh": math.atanh,
    "tanh": math.tanh, "fabs": abs, "sigmoid": lambda x: 1 / (1 + math.exp(-x)),
    "softplus": lambda x: max(x, 0.0) + math.log1p(math.exp(-abs(x))),
}  # fmt: skip
WHERE = (aten.where.self, aten.where.ScalarOther, aten.where.ScalarSelf, aten.where.Scalar)
# Functions with a kernel for a whole row.
ROWS = ("tanh", "sigmoid", "softplus")


def interpret(program: Program, graph: Graph, inputs: Sequence[Sequence[Ref]]) -> list[np.ndarray]:
    """The outputs of a graph as arrays of atoms, for one sample: the batch axis has size 1.

    The statements are appended to `program`; `inputs` are the numbers of each argument, in row-major order. An argument
    without the batch axis, such as parameters, keeps its shape.
    """
    nodes = list(graph.code.nodes)
    places = [node for node in nodes if node.op == "placeholder"]
    values: dict[fx.Node, Any] = {}
    for node, numbers in zip(places, inputs, strict=False):
        shape = node.meta["example"].shape
        shape = (1, *shape[1:]) if shape[0] == graph.batch else shape
        values[node] = _array(numbers).reshape(shape)
    for node, constant in zip(places[len(inputs) :], graph.constants, strict=True):
        array = constant.detach().cpu().numpy()
        values[node] = array.astype(object) if array.dtype.kind == "f" else array
    table = operations(program)
    known = lambda x: fx.map_arg(x, values.__getitem__)  # noqa: E731
    for node in (node for node in nodes if node.op == "call_function"):
        if node.target not in table:
            raise InputError(f"{node.target} cannot be written as C yet; export the model as .pt2 instead")
        options = {k: x for k, x in node.kwargs.items() if k in ("value", "alpha")}
        arguments = _squeezed(node) if node.target == aten.squeeze.dims else node.args
        values[node] = table[node.target](*known(arguments), **known(options))
    output = nodes[-1]
    return list(known(output.args[0]))


def _squeezed(node: fx.Node) -> tuple[fx.Node, tuple[int, ...]]:
    """The arguments of a squeeze with the axes that had size 1 in the trace: the batch, of size 1 here, stays."""
    x, axes = node.args
    assert isinstance(x, fx.Node)
    shape = x.meta["example"].shape
    return x, tuple(axis for axis in axes if shape[axis] == 1)  # pyright: ignore[reportGeneralTypeIssues, reportOptionalIterable]


def _array(atoms: Sequence[Atom]) -> np.ndarray:
    """An array of atoms: numpy would take a `Ref` for a row."""
    out = np.empty(len(atoms), object)
    for i, x in enumerate(atoms):
        out[i] = x
    return out


def _full(shape: Any, value: float) -> np.ndarray:
    return np.full(tuple(shape), float(value), object)


def operations(program: Program) -> dict[Any, Callable[..., Any]]:
    """The table of operations: the function on arrays of atoms for each operation of torch."""
    c = _Numbers(program)
    same = lambda x, *_, **__: x  # noqa: E731
    transposed = lambda x: x.T if x.ndim == 2 else np.swapaxes(x, -1, -2)  # noqa: E731
    table: dict[Any, Callable[..., Any]] = {
        aten.add.Tensor: c.add, aten.add.Scalar: c.add,
        aten.sub.Tensor: lambda x, y, alpha=1: c.subtract(x, c.multiply(y, alpha)),
        aten.rsub.Scalar: lambda x, y: c.subtract(y, x),
        aten.mul.Tensor: c.multiply, aten.mul.Scalar: c.multiply,
        aten.div.Tensor: c.divide, aten.div.Scalar: c.divide,
        aten.addcmul.default: c.add_product,
        aten.neg.default: lambda x: c.multiply(x, -1.0),
        aten.relu.default: lambda x: c.choose(c.greater(x, 0.0), x, 0.0),
        aten.threshold_backward.default: lambda g, x, least: c.choose(c.greater(x, float(least)), g, 0.0),
        aten.reciprocal.default: lambda x: c.divide(1.0, x),
        aten.pow.Tensor_Scalar: c.power,
        aten.pow.Tensor_Tensor: c.powers,
        aten.tanh_backward.default: lambda g, t: c.multiply(g, c.subtract(1.0, c.multiply(t, t))),
        aten.sigmoid_backward.default: lambda g, s: c.multiply(g, c.multiply(s, c.subtract(1.0, s))),
        aten.gt.Tensor: c.greater, aten.gt.Scalar: c.greater, **dict.fromkeys(WHERE, c.choose),
        aten.log_sigmoid_forward.default: lambda x: (
            c.multiply(c.function("softplus", c.multiply(x, -1.0)), -1.0), None,
        ),
        aten.log_sigmoid_backward.default: lambda g, x, _: c.multiply(g, c.function("sigmoid", c.multiply(x, -1.0))),
        aten.addmm.default: lambda b, x, w: c.add(c.product(x, w), b) if b.ndim > 1 else c.product(x, w, b),
        aten.mm.default: c.product, aten.bmm.default: c.product,
        aten.mv.default: c.product, aten.dot.default: c.product,
        aten.sum.dim_IntList: c.sum, aten.sum.default: lambda x: c.sum(x, list(range(x.ndim))),
        aten.linalg_inv_ex.default: lambda x, *_, **__: (c.inverse(x), None),
        aten._linalg_solve_ex.default: c.solve,
        aten.index_put.default: c.put,
        aten.select_backward.default: lambda g, shape, dim, i: _put_slice(g, shape, dim, i),
        aten.slice_backward.default: lambda g, shape, dim, a, b, step: _put_slice(g, shape, dim, slice(a, b, step)),
        # torch leaves out tensors of shape (0,), whatever the shape of the others.
        aten.cat.default: lambda xs, dim=0: np.concatenate([x for x in xs if x.shape != (0,)], dim),
        aten.stack.default: lambda xs, dim=0: np.stack(xs, dim),
        aten.unsqueeze.default: np.expand_dims, aten.select.int: lambda x, dim, i: np.take(x, i, axis=dim),
        aten.squeeze.dim: np.squeeze, aten.squeeze.dims: np.squeeze,
        aten.slice.Tensor: lambda x, dim=0, a=None, b=None, step=1: x[
            (slice(None),) * (dim % x.ndim) + (slice(a, b, step),)
        ],
        aten.transpose.int: np.swapaxes,
        aten.t.default: transposed, aten.permute.default: np.transpose,
        aten.expand.default: _expand,
        aten.reshape.default: lambda x, shape: x.reshape(shape),
        aten.repeat.default: np.tile,
        aten.unflatten.int: lambda x, dim, shape: x.reshape(*x.shape[: dim % x.ndim], *shape, *x.shape[dim % x.ndim + 1 :]),  # noqa: E501
        aten.unbind.int: lambda x, dim=0: [np.take(x, i, axis=dim) for i in range(x.shape[dim])],
        aten.split_with_sizes.default: lambda x, sizes, dim=0: np.split(x, np.cumsum(sizes)[:-1], axis=dim),
        aten.split.Tensor: lambda x, size, dim=0: np.split(x, range(size, x.shape[dim], size), axis=dim),
        aten.index.Tensor: lambda x, places: x[tuple(slice(None) if p is None else p for p in places)],
        aten.index_select.default: lambda x, dim, i: np.take(x, i, axis=dim),
        aten.sign.default: lambda x: c.choose(c.greater(x, 0.0), 1.0, c.choose(c.greater(0.0, x), -1.0, 0.0)),
        aten.diagonal.default: lambda x, offset, a, b: np.diagonal(x, offset, a, b),
        aten.diag_embed.default: _diagonal,
        aten.zeros_like.default: lambda x, **_: _full(x.shape, 0),
        aten.ones_like.default: lambda x, **_: _full(x.shape, 1),
        aten.empty_like.default: lambda x, **_: _full(x.shape, 0),
        aten.full_like.default: lambda x, v, **_: _full(x.shape, v),
        aten.new_zeros.default: lambda _, shape: _full(shape, 0), aten.zeros.default: lambda shape: _full(shape, 0),
        aten._new_zeros_with_same_feature_meta.default: lambda x, *_, **__: _full(x.shape, 0),
        aten.new_ones.default: lambda _, shape: _full(shape, 1),
        aten.sym_size.int: lambda x, dim: x.shape[dim], operator.getitem: lambda x, i: x[i], operator.mul: operator.mul,
    }  # fmt: skip
    table |= dict.fromkeys((aten.clone.default, aten._to_copy.default, aten.detach.default, aten.alias.default), same)
    for name in ("sin", "cos", "exp", "expm1", "sqrt", "atanh", "tanh", "sigmoid"):
        table[getattr(aten, name).default] = lambda x, name=name: c.function(name, x)
    table[aten.abs.default] = lambda x: c.function("fabs", x)
    return table


class _Numbers:
    """Arithmetic on arrays of atoms."""

    def __init__(self, program: Program):
        self.program = program

    def add(self, x: Any, y: Any, alpha: float = 1) -> np.ndarray:
        y = y if alpha == 1 else self.multiply(y, alpha)
        return self.program.elementwise("{0} + {1}", fold_add, _atoms(x), _atoms(y))

    def subtract(self, x: Any, y: Any) -> np.ndarray:
        def fold(a: Atom, b: Atom) -> Atom | None:
            if not isinstance(b, Ref) and (b == 0.0 or not isinstance(a, Ref)):
                return a if b == 0.0 else a - b
            return 0.0 if a is b else None

        x, y = np.broadcast_arrays(_atoms(x), _atoms(y))
        if all(not isinstance(a, Ref) and a == 0.0 for a in x.flat):
            return self.multiply(y, -1.0)
        return self.program.elementwise("{0} - {1}", fold, x, y)

    def add_product(self, a: Any, x: Any, y: Any, value: float = 1) -> np.ndarray:
        """The sum a + value x y, as a single operation unless a number can be left out."""
        a, x, y = np.broadcast_arrays(_atoms(a), _atoms(x), _atoms(y))
        simple = lambda v: not isinstance(v, Ref) and v in (0.0, 1.0, -1.0)  # noqa: E731
        whole = all(isinstance(v, Ref) for v in x.flat) and not any(simple(v) for v in y.flat)
        if abs(value) == 1 and whole and all(isinstance(v, Ref) or v != 0.0 for v in a.flat):
            form = "{0} + {1} * {2}" if value == 1 else "{0} - {1} * {2}"
            return self.program.elementwise(form, lambda *_: None, a, x, y)
        if value == -1:
            return self.subtract(a, self.multiply(x, y))
        return self.add(a, self.multiply(self.multiply(x, y), value))

    def multiply(self, x: Any, y: Any) -> np.ndarray:
        x, y = _atoms(x), _atoms(y)
        for a, b in ((x, y), (y, x)):
            if a.size == 1 and not isinstance(a.flat[0], Ref) and a.flat[0] == -1.0:
                shape = np.broadcast_shapes(x.shape, y.shape)
                negative = lambda v: None if isinstance(v, Ref) else -v  # noqa: E731
                return self.program.elementwise("-{0}", negative, np.broadcast_to(b, shape))
        return self.program.elementwise("{0} * {1}", fold_multiply, x, y)

    def divide(self, x: Any, y: Any) -> np.ndarray:
        def fold(a: Atom, b: Atom) -> Atom | None:
            if not isinstance(a, Ref) and (a == 0.0 or not isinstance(b, Ref)):
                return 0.0 if a == 0.0 else a / b
            return a if not isinstance(b, Ref) and b == 1.0 else None

        return self.program.elementwise("{0} / {1}", fold, _atoms(x), _atoms(y))

    def power(self, x: np.ndarray, exponent: float) -> np.ndarray:
        whole = int(exponent)
        if whole != exponent or abs(whole) > 16:
            fold = lambda a: None if isinstance(a, Ref) else a**exponent  # noqa: E731
            return self.program.elementwise(f"FN_pow({{0}}, R({float(exponent)}))", fold, x)
        out: Any = _full(x.shape, 1)
        for _ in range(abs(whole)):
            out = self.multiply(out, x)
        return out if whole >= 0 else self.divide(1.0, out)

    def powers(self, x: np.ndarray, exponents: np.ndarray) -> np.ndarray:
        """Powers with constant exponents, an exponent for each entry of the last axis."""
        x, by = np.broadcast_arrays(x, exponents)
        by = by.reshape(-1, x.shape[-1])
        if any(isinstance(e, Ref) for e in by.flat) or bool((by != by[:1]).any()):
            raise InputError("a power whose exponent is no constant cannot be written as C; export as .pt2 instead")
        return np.stack([self.power(x[..., k], float(e)) for k, e in enumerate(by[0])], -1)

    def function(self, name: str, x: np.ndarray) -> np.ndarray:
        fold = lambda a: None if isinstance(a, Ref) else MATHEMATICS[name](a)  # noqa: E731
        if name in ("sin", "cos") and (angles := self.program.angles) is not None:
            which = ("sin", "cos").index(name)
            return _array([angles.waves(a)[which] if isinstance(a, Ref) else fold(a) for a in x.flat]).reshape(x.shape)
        return self.program.elementwise(f"FN_{name}({{0}})", fold, x, kernel=f"FN_{name}_row" if name in ROWS else None)

    def greater(self, x: Any, y: Any) -> np.ndarray:
        x, y = np.broadcast_arrays(_atoms(x), _atoms(y))
        out = np.empty(x.shape, object)
        for i in np.ndindex(x.shape):
            out[i] = Compared(x[i], y[i]) if isinstance(x[i], Ref) or isinstance(y[i], Ref) else bool(x[i] > y[i])
        return out

    def choose(self, where: np.ndarray, x: Any, y: Any) -> np.ndarray:
        where, x, y = np.broadcast_arrays(where.astype(object), _atoms(x), _atoms(y))
        out = np.empty(x.shape, object)
        for i in np.ndindex(x.shape):
            condition, a, b = where[i], x[i], y[i]
            if not isinstance(condition, Compared) or a == b:
                out[i] = a if condition else b
                continue
            operands = (*condition, a, b)
            places = (f"{{{k}}}" if isinstance(v, Ref) else f"SPREAD({{{k}}})" for k, v in enumerate(operands))
            out[i] = self.program.scalar(f"FN_choose({', '.join(places)})", operands)
        return out

    def product(self, x: np.ndarray, w: np.ndarray, bias: np.ndarray | None = None) -> np.ndarray:
        """Matrix products as torch broadcasts them."""
        if x.ndim == 1:
            return self.product(x[None], w, bias)[0]
        if w.ndim == 1:
            return self.product(x, w[:, None], bias)[..., 0]
        outer = np.broadcast_shapes(x.shape[:-2], w.shape[:-2])
        x, w = np.broadcast_to(x, (*outer, *x.shape[-2:])), np.broadcast_to(w, (*outer, *w.shape[-2:]))
        out = np.empty((*outer, x.shape[-2], w.shape[-1]), object)
        b = None if bias is None else list(bias)
        for i in np.ndindex(*outer, x.shape[-2]):
            out[i] = _array(self.program.product(list(x[i]), w[i[:-1]], b))
        return out

    def sum(self, x: np.ndarray, axes: Sequence[int], keep: bool = False) -> np.ndarray:
        for axis in sorted((a % x.ndim for a in axes), reverse=True):
            moved = np.moveaxis(x, axis, -1)
            total = np.empty(moved.shape[:-1], object)
            for i in np.ndindex(total.shape):
                total[i] = self.program.sum(list(moved[i]))
            x = np.expand_dims(total, axis) if keep else total
        return x

    def solve(self, A: np.ndarray, b: np.ndarray, **_: Any) -> tuple[np.ndarray, None, None, None]:
        """A⁻¹ b, for a vector b (..., n) or columns (..., n, k)."""
        vector = b.ndim == A.ndim - 1
        x = self.product(self.inverse(A), b[..., None] if vector else b)
        return (x[..., 0] if vector else x), None, None, None

    def put(self, x: np.ndarray, places: Sequence[Any], value: np.ndarray, accumulate: bool = False) -> np.ndarray:
        """A copy of x with these values at these places, or with the values added."""
        index = tuple(slice(None) if place is None else place for place in places)
        at = np.arange(x.size).reshape(x.shape)[index]
        out, values = _atoms(x).ravel().copy(), np.broadcast_to(_atoms(value), at.shape)
        for i, number in zip(at.ravel(), values.ravel(), strict=True):
            out[i] = add(self.program, out[i], number) if accumulate else number
        return out.reshape(x.shape)

    def inverse(self, x: np.ndarray) -> np.ndarray:
        out = np.empty(x.shape, object)
        for i in np.ndindex(x.shape[:-2]):
            out[i] = _array(self.program.inverse(x[i])).reshape(x.shape[-2:])
        return out


def _put_slice(g: np.ndarray, shape: Sequence[int], dim: int, where: int | slice) -> np.ndarray:
    """Zeros of this shape with g at `where` of an axis."""
    out = _full(shape, 0)
    # numpy would store an array without axes as an array, not as its number.
    out[(*(slice(None),) * (dim % len(shape)), where)] = g if g.ndim else g[()]
    return out


def _atoms(x: Any) -> np.ndarray:
    """Numbers as an array of atoms."""
    if isinstance(x, np.ndarray):
        return x if x.dtype == object else x.astype(float).astype(object)
    # An array without axes is reduced to a `Ref`, which numpy would take for a row.
    return _array([x if isinstance(x, Ref) else float(x)]).reshape(())


def _expand(x: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    missing = len(shape) - x.ndim
    return np.broadcast_to(x, [x.shape[i - missing] if size == -1 else size for i, size in enumerate(shape)])


def _diagonal(x: np.ndarray, offset: int = 0, first: int = -2, second: int = -1) -> np.ndarray:
    if offset:
        raise InputError("diag_embed beside the diagonal cannot be written as C yet; export the model as .pt2 instead")
    out = _full((*x.shape, x.shape[-1]), 0)
    for i in range(x.shape[-1]):
        out[..., i, i] = x[..., i]
    return np.moveaxis(out, (-2, -1), (first, second))
