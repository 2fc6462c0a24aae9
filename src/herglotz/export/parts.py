"""A traced graph in two, so that what the steps h alone decide is evaluated before the loop, for all steps at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, fx, nn

from herglotz.export.trace import Example, Graph, aten


def parted(graph: Graph, early: Sequence[bool]) -> tuple[Graph, Graph]:
    """What the `early` inputs alone decide, and the rest: first(*early inputs) → y, rest(*inputs, *y) → the outputs.

    The first part has only values of one number a sample, which are cheap to keep for every step.
    """
    own = graph.code.graph
    calls, places = [x for x in own.nodes if x.op == "call_function"], own.find_nodes(op="placeholder")
    inputs = places[: len(early)]
    constants = dict(zip(places[len(early) :], graph.constants, strict=True))
    given = [x for x, is_early in zip(inputs, early, strict=True) if is_early]
    first, both = _decided(calls, given, list(constants), graph.batch)
    again = {x for x in _read_outside(first) if x.target == aten.unsqueeze.default}  # costs nothing
    cut = [x for x in _read_outside(first - again) if x.op == "call_function"]
    results: Any = own.output_node().args[0]
    before = _graph(graph.batch, given, [x for x in calls if x in first or x in both], cut, constants)
    after = _graph(graph.batch, [*inputs, *cut], [x for x in calls if x not in first or x in again], results, constants)
    return before, after


def _read_outside(own: set[fx.Node]) -> list[fx.Node]:
    """Those that other nodes read, in the order of the graph."""
    return sorted(x for x in own if not own.issuperset(x.users))


def _decided(
    calls: Sequence[fx.Node], given: Sequence[fx.Node], constants: Sequence[fx.Node], batch: int
) -> tuple[set[fx.Node], set[fx.Node]]:
    """What the given inputs alone decide, them included, and what both parts have: constants and sizes."""
    first, both = set(given), set(constants)
    for node in calls:
        if isinstance(node.meta["example"], int):
            both.add(node)
        elif (first | both).issuperset(node.all_input_nodes) and _may_move(node, batch):
            first.add(node)
    return first, both


def _may_move(node: fx.Node, batch: int) -> bool:
    """Whether a value may be made before the loop; a copy stays, for results must be tensors of their own."""
    shape = node.meta["example"].shape if isinstance(node.meta["example"], Example) else ()
    return node.target != aten.clone.default and shape[:1] == (batch,) and math.prod(shape) == batch


def _graph(
    batch: int,
    inputs: Sequence[fx.Node],
    calls: Sequence[fx.Node],
    results: Sequence[fx.Node],
    constants: Mapping[fx.Node, Tensor],
) -> Graph:
    """These calls as a graph of these inputs."""
    graph, new = fx.Graph(), {}
    read = {*results, *(y for x in calls for y in x.all_input_nodes)}
    used = [x for x in constants if x in read]
    for x in (*inputs, *used):
        new[x] = graph.placeholder(f"x{len(new)}")
        new[x].meta = dict(x.meta)
    axis = next((new[x] for x in inputs if x.meta["example"].shape), None)
    for x in calls:
        # The batch is that of this part: the first one may have the samples of all steps.
        new[x] = graph.node_copy(x, lambda y, own=x.target == aten.sym_size.int: axis if own else new[y])
    graph.output(tuple(new[x] for x in results))
    graph.eliminate_dead_code()
    return Graph(fx.GraphModule(nn.Module(), graph), [constants[x] for x in used], batch)
