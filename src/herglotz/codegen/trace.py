"""A function of tensors as a lean graph that holds for any batch size: one trace serves every format."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, fx, nn
from torch.fx.node import map_aggregate
from torch.utils._python_dispatch import TorchDispatchMode

from herglotz.errors import InputError

aten = torch.ops.aten
# Batch sizes of examples: a multiple of the batch size in a shape is the batch. A graph is run with `OTHER` samples,
# too, and traced anew with the next size where that shows a shape to be no batch. Memory grows with the size: a step of
# 32 coordinates takes 0.8 GB with 37 samples, 13 GB with 1021.
PRIMES = (37, 41, 43, 47, 53, 59, 61, 1021)
OTHER = 3
# Multiples of the batch size up to this one are sizes that depend on the batch, as in shapes (rows · B, …).
MAX_MULTIPLE = 2**20
# Operations that return their first argument unchanged if shape and dtype stay.
SAME = (
    aten.alias.default, aten.to.device, aten.to.dtype, aten.to.dtype_layout, aten.expand.default, aten.reshape.default,
    aten.view.default, aten.slice.Tensor, aten.clone.default, aten.detach.default, aten.contiguous.default,
    aten.broadcast_to.default, aten._unsafe_view.default,
)  # fmt: skip
# A view is valid for the strides of the example only, because a copy before the view may have been left out. `sgn`,
# which derivatives of |x| use, is `sign` of a real number. An operation in place becomes the operation that returns a
# new tensor, most often of the same name without the last underscore.
INSTEAD: dict[Any, Any] = {
    aten.view.default: aten.reshape.default,
    aten._unsafe_view.default: aten.reshape.default,
    aten.fill_.Scalar: aten.full_like.default,
    aten.zero_.default: aten.zeros_like.default,
    aten.sgn.default: aten.sign.default,
}
# Operations that return a Python number, which a graph cannot hold.
READS = (aten._local_scalar_dense.default, aten.equal.default)
# Operations in place that write no number.
SHAPE_ONLY = ("squeeze_", "unsqueeze_", "transpose_", "t_", "as_strided_")


class Graph(nn.Module):
    """A traced function f(*inputs) of `code`(*inputs, *constants); loops take the constants as operands.

    Every node has meta "example": the node's result in the trace, with `batch` samples, tensors as `Example`.
    """

    def __init__(self, code: fx.Graph, constants: Sequence[Tensor], batch: int):
        super().__init__()
        self.code = code
        self.batch = batch
        # The replacement of `code` by `herglotz.export.inline`.
        self.operator: Callable[..., Any] | None = None
        for i, value in enumerate(constants):
            self.register_buffer(f"constant_{i}", value)

    @property
    def constants(self) -> tuple[Tensor, ...]:
        """The constants that the graph reads besides its inputs."""
        return tuple(self.buffers())

    def call(self, *arguments: Tensor) -> Any:
        """Evaluate at inputs and constants."""
        return (self.operator or fx.Interpreter(self, graph=self.code).run)(*arguments)

    def forward(self, *inputs: Tensor) -> Any:
        """Evaluate at inputs."""
        return self.call(*inputs, *self.constants)


def traced(function: Callable[..., Any], arguments: tuple[Tensor, ...]) -> Graph:
    """The function as a graph without classes, repetitions and constant parts, for any batch size.

    The function takes and returns tensors whose batch is axis 0, and may differentiate by `torch.func`; `arguments` are
    examples, with a batch of `PRIMES[0]`. Of examples with a batch of 1 the graph holds for one sample alone.

    Raise InputError if the graph gives other numbers for another batch size.
    """
    while True:
        recorder = Recorder(arguments)
        with torch.no_grad():
            with recorder:
                outputs = function(*arguments)
            outputs = outputs if isinstance(outputs, tuple) else (outputs,)
            graph = recorder.graph_of(outputs)
            if graph.batch == 1 or _holds_for_any_batch(graph, arguments, outputs):
                _Examples(graph, graph=graph.code).run(*arguments, *graph.constants)
                return graph
        larger = next((prime for prime in PRIMES if prime > graph.batch), None)
        if larger is None:
            raise InputError(
                "what is computed for a sample depends on how many samples are computed with it, or on random numbers: "
                "a file would hold for one number of samples alone"
            )
        arguments = _of_batch(arguments, graph.batch, larger)


def _holds_for_any_batch(graph: Graph, arguments: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> bool:
    """Whether the graph gives the same numbers with fewer samples, so that no size was taken for the batch.

    Of an output without a batch, as derivatives by numbers that all samples share, the size alone is compared.
    """
    try:
        found = graph(*_of_batch(arguments, graph.batch, OTHER))
    except (RuntimeError, IndexError):
        return False
    expected = _of_batch(outputs, graph.batch, OTHER)
    batched = (y.ndim > 0 and len(y) == graph.batch for y in outputs)
    return all(
        _alike(x, y) if each else x.shape == y.shape for x, y, each in zip(found, expected, batched, strict=True)
    )


def _alike(x: Tensor, y: Tensor) -> bool:
    """Whether two tensors are equal but for rounding; a size that was taken for the batch changes the numbers."""
    if x.shape != y.shape or not y.numel():
        return x.shape == y.shape
    size = float(y.double().nan_to_num(posinf=0.0, neginf=0.0).abs().amax())
    return torch.allclose(x.double(), y.double(), rtol=0.0, atol=1e-3 * size, equal_nan=True)


def _of_batch(arguments: tuple[Tensor, ...], batch: int, size: int) -> tuple[Tensor, ...]:
    """The arguments with `size` samples, repeated where there are fewer; those without the batch unchanged."""
    times = -(-size // batch)
    return tuple(x.repeat(times, *(1,) * (x.ndim - 1))[:size] if x.ndim and len(x) == batch else x for x in arguments)


class Example(NamedTuple):
    """A tensor at the example's batch."""

    shape: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: torch.dtype


def _described(value: Any) -> Any:
    return Example(tuple(value.shape), value.stride(), value.dtype) if isinstance(value, Tensor) else value


class _Examples(fx.Interpreter):
    """Evaluates a graph and notes the result of every node."""

    def run_node(self, n: fx.Node) -> Any:
        value = super().run_node(n)
        n.meta["example"] = map_aggregate(value, _described)
        return value


class Recorder(TorchDispatchMode):
    """Records the operations by which torch computes the outputs from the inputs, as a graph.

    The recorder stands below autograd and `torch.func`, where derivatives are operations like any other. `make_fx` of
    torch records the same graph at four times the cost, because `make_fx` describes every value a second time.

    An operation whose arguments depend on no input and no batch size is not recorded; its result becomes a constant if
    a recorded operation reads the result. An operation that changes nothing is left out, and a repeated operation is a
    single node.
    """

    def __init__(self, inputs: Sequence[Tensor]):
        super().__init__()
        self.graph = fx.Graph()
        # Nodes by operation and arguments.
        self.calls: dict[tuple[Any, str], fx.Node] = {}
        # Nodes, and operations left out, by the id of their result, which `alive` keeps.
        self.nodes: dict[int, fx.Node] = {}
        self.unchanged: dict[int, tuple[Any, Any, Any]] = {}
        self.alive: list[Any] = []
        self.constants: dict[Any, tuple[fx.Node, Tensor]] = {}
        # Written storage → ids of the tensors whose nodes have the written numbers.
        self.current: dict[int, set[int]] = {}
        self.size: fx.Node | None = None
        # Inputs, then constants.
        self.places = [self.graph.placeholder(f"x{i}") for i in range(len(inputs))]
        for x, place in zip(inputs, self.places, strict=True):
            place.meta["example"] = _described(x)
            self._name(x, place)
        axis = next(i for i, x in enumerate(inputs) if x.ndim)
        self.batch, self.axis = len(inputs[axis]), self.places[axis]

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """False: torch would import its compiler, which takes 2 s, to exclude a mode that is never compiled."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation, and record the operation."""
        kwargs = kwargs or {}
        fixed = self._is_fixed((*args, *kwargs.values()))
        if fixed:
            result = func(*args, **kwargs)
            self.alive += [args, result]
            return result
        if func in READS:
            raise InputError(
                "a value is read while the step is traced (.item(), float(), bool(), or `if` on a tensor): a file "
                "would hold the branch of one sample for all; write it as torch.where"
            )
        # An operation in place is recorded before the operation runs: afterwards its argument has the new numbers.
        node = self._written(func, args, kwargs) if func._schema.is_mutable else None
        result = func(*args, **kwargs)
        self.alive += [args, result]
        if node is None:
            same = self._same(func, args, kwargs, result)
            if same is not None:
                self.unchanged[id(result)] = (func, args, kwargs)
            node = self._written(func, args, kwargs) if same is None else self._moved(same)
        elif func._schema.name.removeprefix("aten::") not in SHAPE_ONLY:
            self.current[_storage(result)] = set()
        self._name(result, node)
        return result

    def graph_of(self, outputs: Sequence[Tensor]) -> Graph:
        """The graph that ends in these tensors; each output is a tensor of its own."""
        left_out = [self.unchanged.get(id(x)) for x in outputs]
        ends = zip(outputs, left_out, strict=True)
        self.graph.output(tuple(self._moved(x) if how is None else self._written(*how) for x, how in ends))
        self.graph.eliminate_dead_code()
        for place, _ in self.constants.values():
            if not place.users:
                self.graph.erase_node(place)
        return Graph(self.graph, [value for place, value in self.constants.values() if place.users], self.batch)

    def _written(self, func: Any, args: Any, kwargs: Any) -> fx.Node:
        if func == aten.copy_.default:
            shape = [self._argument(size) for size in args[0].shape]
            return self._called(aten.expand.default, (self._moved(args[1]), shape))
        arguments, options = (map_aggregate(x, self._argument) for x in (args, kwargs))
        return self._called(INSTEAD.get(func) or _without_writing(func), arguments, options)

    def _called(self, operation: Any, arguments: Any, options: Any = {}) -> fx.Node:  # noqa: B006  not changed
        """The node of an operation; equal calls share a node, unless the operation draws random numbers."""
        key = (operation, repr((arguments, options)))
        if key not in self.calls or torch.Tag.nondeterministic_seeded in getattr(operation, "tags", ()):
            self.calls[key] = self.graph.call_function(operation, arguments, options)
        return self.calls[key]

    def _same(self, func: Any, args: Any, kwargs: Any, result: Any) -> Tensor | None:
        """The argument that the result equals: views of the same shape, x + 0 and 1 x."""
        if func == aten.add.Tensor:
            others = [x for x, y in (args, args[::-1]) if not kwargs and self._is_number(y, 0)]
        elif func == aten.mul.Tensor:
            others = [x for x, y in (args, args[::-1]) if self._is_number(y, 1)]
        elif func == aten.movedim.intlist:
            others = [args[0]] if args[1] == args[2] else []
        else:
            others = [args[0]] if func in SAME else []
        return next((x for x in others if (x.shape, x.dtype) == (result.shape, result.dtype)), None)

    def _is_number(self, x: Any, number: int) -> bool:
        """Whether x depends on no input, and every entry of x is the number."""
        if not isinstance(x, Tensor):
            return x == number
        if id(x) in self.nodes or x.is_meta:
            return False
        return number == 0 if x._is_zerotensor() else bool((x == number).all())

    def _is_fixed(self, arguments: Any) -> bool:
        """Whether the arguments depend neither on an input nor on the batch size."""
        if isinstance(arguments, (list, tuple)):
            return all(map(self._is_fixed, arguments))
        return id(arguments) not in self.nodes and not self._is_size(arguments)

    def _name(self, result: Any, node: Any) -> None:
        """Note the node of a result; the results in a tuple are items of the tuple's node."""
        if isinstance(result, Tensor):
            self.nodes[id(result)] = node
            self.alive.append(result)
            if (storage := _storage(result)) in self.current:
                self.current[storage].add(id(result))
        elif isinstance(result, (list, tuple)):
            for i, x in enumerate(result):
                self._name(x, self._called(operator.getitem, (node, i)))

    def _moved(self, value: Tensor) -> fx.Node:
        """The node of a tensor; a constant gets its node on first use.

        Raise InputError for a tensor whose numbers were written through another view of the same memory: its node
        still has the old numbers.
        """
        if id(value) not in self.current.get(_storage(value), {id(value)}):
            raise InputError(
                "a tensor is read whose numbers an operation writes in place through a view of it, which a trace does "
                "not follow; write the form that returns a new tensor (x.diagonal().fill_(1): torch.eye)"
            )
        if id(value) in self.nodes:
            return self.nodes[id(value)]
        # torch.func keeps the derivative of a constant without numbers.
        if value.is_meta or value._is_zerotensor():
            value = torch.zeros(value.shape, dtype=value.dtype)
        key = (value.dtype, tuple(value.shape), value.detach().cpu().contiguous().numpy().tobytes())
        if key not in self.constants:
            with self.graph.inserting_after(self.places[-1]):
                place = self.graph.placeholder(f"constant_{len(self.constants)}")
            self.places.append(place)
            self.constants[key] = (place, value.detach().clone(memory_format=torch.contiguous_format))
        return self.constants[key][0]

    def _argument(self, x: Any) -> Any:
        """An argument of a node: tensors, and multiples of the example's batch, are replaced by their nodes."""
        if isinstance(x, Tensor):
            return self._moved(x)
        if not self._is_size(x):
            return x
        if self.size is None:
            self.size = self.graph.call_function(aten.sym_size.int, (self.axis, 0))
        return self.size if x == self.batch else self._called(operator.mul, (self.size, x // self.batch))

    def _is_size(self, x: Any) -> bool:
        """Whether x is a multiple of the example's batch, unless that is 1."""
        return (
            self.batch > 1
            and isinstance(x, int)
            and not isinstance(x, bool)
            and 0 < x <= MAX_MULTIPLE * self.batch
            and x % self.batch == 0
        )


def _storage(x: Tensor) -> int:
    """An identifier of a tensor's memory; a tensor without memory has an identifier of its own."""
    return id(x) if x.is_meta or x._is_zerotensor() else x.untyped_storage()._cdata


def _without_writing(func: Any) -> Any:
    """The operation that returns the result of an operation in place; any other operation unchanged."""
    if not func._schema.is_mutable:
        return func
    name = func._schema.name.removeprefix("aten::")
    other = getattr(getattr(aten, name.removesuffix("_"), None), func._overloadname, None)
    if not name.endswith("_") or other is None:
        raise InputError(f"{func} writes in place, which files cannot step; use the form that returns a new tensor")
    return other
