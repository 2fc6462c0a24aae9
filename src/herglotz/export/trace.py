"""A function of tensors as a lean graph that holds for any batch size: one trace serves every format."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, fx, nn
from torch.fx.node import map_aggregate

aten = torch.ops.aten
PRIMES = (1021, 1031, 1033, 1039, 1049, 1051)
LARGEST = 4096  # multiples of the batch looked for in shapes: (rows · B, …)
SAME = (  # what leaves its first argument as it is, wherever shape and dtype stay
    aten.alias.default, aten.to.device, aten.to.dtype, aten.to.dtype_layout, aten.expand.default, aten.reshape.default,
    aten.view.default, aten.slice.Tensor, aten.clone.default, aten.detach.default, aten.contiguous.default,
    aten.broadcast_to.default, aten.movedim.intlist,
)  # fmt: skip
# A view holds for the strides of the example only, as a copy may have gone since; what writes in place becomes a value.
INSTEAD: dict[Any, Any] = {
    aten.view.default: aten.reshape.default,
    aten._unsafe_view.default: aten.reshape.default,
    aten.sub_.Tensor: aten.sub.Tensor,
    aten.fill_.Scalar: aten.full_like.default,
}


class Graph(nn.Module):
    """A traced function f(*inputs) of `code`(*inputs, *constants); loops take the constants as operands.

    Every node has meta "example": what it gave when it was traced, tensors as `Example`.

    Parameters
    ----------
    code
        The graph; its last inputs are the constants.
    constants
        Their values.
    batch
        The batch it was traced with.
    """

    def __init__(self, code: fx.GraphModule, constants: Sequence[Tensor], batch: int):
        super().__init__()
        self.code = code
        self.batch = batch
        self.operator: Callable[..., Any] | None = None  # what `herglotz.export.inline` puts in its place
        for i, value in enumerate(constants):
            self.register_buffer(f"constant_{i}", value)

    @property
    def constants(self) -> tuple[Tensor, ...]:
        """What the graph reads besides its inputs."""
        return tuple(self.buffers())

    def call(self, *arguments: Tensor) -> Any:
        """Evaluate at inputs and constants."""
        return (self.operator or self.code)(*arguments)

    def forward(self, *inputs: Tensor) -> Any:
        """Evaluate at inputs."""
        return self.call(*inputs, *self.constants)

    def first(self, count: int) -> Graph:
        """The same graph with its first outputs only, and nothing that the others alone need."""
        graph = fx.Graph()
        outputs: Any = graph.graph_copy(self.code.graph, {})
        graph.output(outputs[:count])
        graph.eliminate_dead_code()
        return Graph(*without_unused(graph, self.constants), self.batch)


def example_batch(sizes: set[int]) -> int:
    """A prime that divides none of the sizes in the graph: wherever it shows in a shape, it is the batch."""
    return next(prime for prime in PRIMES if all(size % prime for size in sizes if size))


def traced(module: nn.Module, arguments: tuple[Tensor, ...], derivatives: bool = False) -> Graph:
    """The module as a graph without classes, repetitions and constant parts, for any batch size.

    Parameters
    ----------
    module
        Takes and returns tensors whose batch is axis 0; not changed.
    arguments
        Examples, with a batch from `example_batch`.
    derivatives
        Whether the module differentiates by `torch.func`: its operations are then recorded below those transforms, as
        smaller ones (`mm` and `addmm` for `linear`).
    """
    from torch._guards import TracingContext, tracing
    from torch._subclasses import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx

    with torch.no_grad():
        module(*arguments)  # fills index caches outside the trace
        # A mode of our own: without one, torch makes a new one for the description of every value, half of the time.
        with tracing(TracingContext(FakeTensorMode(allow_fallback_kernels=True))):
            found = make_fx(module, pre_dispatch=not derivatives)(*arguments)
        values = _values(found, arguments)
        lean = _lean(found, values, next(len(x) for x in arguments if x.ndim))
        values = _values(lean.code, (*arguments, *lean.constants))
    for node in lean.code.graph.nodes:
        node.meta["example"] = map_aggregate(values[node.name], _described)
    return lean


class Example(NamedTuple):
    """A tensor at the example's batch."""

    shape: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: torch.dtype


def _described(value: Any) -> Any:
    return Example(tuple(value.shape), value.stride(), value.dtype) if isinstance(value, Tensor) else value


def _values(graph_module: fx.GraphModule, arguments: tuple[Tensor, ...]) -> dict[str, Any]:
    """What every node gives for the examples."""
    values: dict[str, Any] = {}

    class Recorder(fx.Interpreter):
        def run_node(self, n: fx.Node) -> Any:
            values[n.name] = super().run_node(n)
            return values[n.name]

    Recorder(graph_module).run(*arguments)
    return values


def _lean(found: fx.GraphModule, values: dict[str, Any], batch: int) -> Graph:
    """Copy node by node: what no input reaches becomes a constant, what changes nothing is left out."""
    from torch._functorch.compile_utils import fx_graph_cse

    graph = fx.Graph()
    new: dict[fx.Node, Any] = {}
    fixed: set[fx.Node] = set()  # nodes that no input reaches
    constants: dict[Any, tuple[fx.Node, Tensor]] = {}
    places = [node for node in found.graph.nodes if node.op == "placeholder"]
    for node in places:
        new[node] = graph.placeholder(node.name)
    axis = next(node for node in places if values[node.name].ndim)
    size: list[fx.Node] = []

    def symbol(value: int) -> Any:
        """A multiple of the batch, as the graph computes it."""
        if not size:
            size.append(graph.call_function(aten.sym_size.int, (new[axis], 0)))
        return size[0] if value == batch else graph.call_function(operator.mul, (size[0], value // batch))

    def moved(node: fx.Node) -> Any:
        """The node in the new graph; a constant on its first use."""
        if node not in fixed:
            return new[node]
        value = values[node.name]
        if not isinstance(value, Tensor):
            return value
        if value.is_meta:  # the derivative of a constant, which torch.func keeps without numbers
            value = torch.zeros(value.shape, dtype=value.dtype)
        key = (value.dtype, tuple(value.shape), value.detach().cpu().contiguous().numpy().tobytes())
        if key not in constants:
            with graph.inserting_before(new[places[0]]):
                place = graph.placeholder(f"constant_{len(constants)}")
            constants[key] = (place, value.detach().clone(memory_format=torch.contiguous_format))
        return constants[key][0]

    for node in found.graph.nodes:
        if node.op == "placeholder":
            continue
        if node.op == "get_attr" or (node.op == "call_function" and _unreached(node, fixed, batch)):
            fixed.add(node)
            continue
        if node.op == "output":
            found_out: Any = node.args[0]
            graph.output(tuple(moved(x) for x in (found_out if isinstance(found_out, (tuple, list)) else [found_out])))
            continue
        if _changes_nothing(node, values):
            new[node] = moved(node.args[0])
            continue
        if node.target == aten.copy_.default:  # into zeros that nothing else reads
            shape = _with_batch(list(values[node.name].shape), batch, symbol)
            new[node] = graph.call_function(aten.expand.default, (moved(node.args[1]), shape))
            continue
        arguments = fx.map_arg(node.args, moved)
        arguments, options = (_with_batch(x, batch, symbol) for x in (arguments, node.kwargs))
        new[node] = _gathered(graph, node, values, arguments) or graph.create_node(
            "call_function", INSTEAD.get(node.target, node.target), arguments, fx.map_arg(options, moved), node.name
        )
    graph = fx_graph_cse(graph)
    graph.eliminate_dead_code()
    order = [node for node in graph.nodes if node.op == "placeholder"]
    kept = {place.name: value for place, value in constants.values()}
    _inputs_first(graph, [x for x in order if x.name not in kept], [x for x in order if x.name in kept])
    return Graph(*without_unused(graph, [kept[x.name] for x in order if x.name in kept]), batch)


def _unreached(node: fx.Node, fixed: set[fx.Node], batch: int) -> bool:
    """Whether neither an input nor the batch size decides the value."""
    sized: list[int] = []
    _with_batch((node.args, node.kwargs), batch, lambda value: sized.append(value))
    return not sized and all(x in fixed for x in node.all_input_nodes)


def _changes_nothing(node: fx.Node, values: dict[str, Any]) -> bool:
    if node.target not in SAME or any(user.op == "output" for user in node.users):
        return False
    (x, *_), y = node.all_input_nodes, values[node.name]
    before = values[x.name]
    if node.target == aten.movedim.intlist:
        _, source, target = node.args
        return bool(source == target)
    return before.shape == y.shape and before.dtype == y.dtype


def _with_batch(x: Any, batch: int, symbol: Any) -> Any:
    """The arguments with every multiple of the example's batch replaced."""
    if isinstance(x, (list, tuple)):
        return type(x)(_with_batch(y, batch, symbol) for y in x) if type(x) in (list, tuple) else [
            _with_batch(y, batch, symbol) for y in x
        ]  # fmt: skip
    if isinstance(x, dict):
        return {key: _with_batch(y, batch, symbol) for key, y in x.items()}
    if isinstance(x, int) and not isinstance(x, bool) and 0 < x <= LARGEST * batch and x % batch == 0:
        return symbol(x)
    return x


def _gathered(graph: fx.Graph, node: fx.Node, values: dict[str, Any], arguments: Any) -> fx.Node | None:
    """x[index] along the first axis as `index_select`: ONNX runs the general form at a tenth of the speed."""
    places: Any = node.args[1] if len(node.args) > 1 else ()
    if node.target != aten.index.Tensor or len(places) != 1:
        return None
    index = places[0]
    shape = list(values[index.name].shape)
    x, (place,) = arguments
    flat = place if len(shape) == 1 else graph.call_function(aten.reshape.default, (place, [-1]))
    new = graph.call_function(aten.index_select.default, (x, 0, flat))
    return new if len(shape) == 1 else graph.call_function(aten.unflatten.int, (new, 0, shape))


def _inputs_first(graph: fx.Graph, inputs: list[fx.Node], constants: list[fx.Node]) -> None:
    """Placeholders in the order of the arguments."""
    first = next(iter(graph.nodes))
    for node in reversed(inputs + constants):
        if node is not first:
            first.prepend(node)
            first = node


def without_unused(graph: fx.Graph, constants: Sequence[Tensor]) -> tuple[fx.GraphModule, list[Tensor]]:
    """Constants that nobody reads are dropped; they are the last placeholders."""
    places = [node for node in graph.nodes if node.op == "placeholder"]
    places = places[len(places) - len(constants) :]
    kept = [value for node, value in zip(places, constants, strict=True) if node.users]
    for node in places:
        if not node.users:
            graph.erase_node(node)
    return fx.GraphModule(nn.Module(), graph), kept
