"""A traced graph cut in two: what a loop can make once for all its turns, and what it has to do in each."""

from __future__ import annotations

from math import prod
from typing import Any

from torch import fx

from herglotz.export.trace import Example, Graph, without_unused


def hoisted(graph: Graph, index: int) -> tuple[Graph | None, Graph]:
    """The graph cut in two: what input `index` alone decides, one number a sample each, and the rest.

    Loops make the first part, of the step size, once for all steps: a function of that input. The second part has
    its results in place of that input, after the other inputs.
    """
    nodes = list(graph.code.graph.nodes)
    places = [node for node in nodes if node.op == "placeholder"]
    source, fixed = places[index], set(places[len(places) - len(graph.constants) :])
    alone: dict[fx.Node, bool] = {source: True}  # whether the input is among what decides the value
    alone |= dict.fromkeys(fixed, False)
    for node in nodes:
        example = node.meta.get("example")
        small = isinstance(example, Example) and len(example.shape) < 3 and prod(example.shape) <= graph.batch
        if node.op == "call_function" and small and all(x in alone for x in node.all_input_nodes):
            alone[node] = any(alone[x] for x in node.all_input_nodes)
    decided = [node for node in nodes if alone.get(node)]
    wanted = [node for node in decided if any(user not in alone for user in node.users)]
    kept = [node for node in wanted if node is source or node not in places]
    first, rest = fx.Graph(), fx.Graph()
    copied = {node: _place(first, node) for node in (source, *places[len(places) - len(fixed) :])}
    for node in nodes:
        if node in alone and node not in copied and node.op == "call_function":
            copied[node] = _copy(first, node, copied)
    first.output(tuple(copied[node] for node in kept))
    first.eliminate_dead_code()
    moved: dict[fx.Node, Any] = {
        node: _place(rest, node) for node in places[: len(places) - len(fixed)] if node is not source
    }
    moved |= {node: _place(rest, node) for node in kept}
    moved |= {node: _place(rest, node) for node in places[len(places) - len(fixed) :]}
    for node in nodes:
        if node.op == "call_function" and node not in moved and not alone.get(node):
            moved[node] = _copy(rest, node, moved)
        elif node.op == "output":
            rest.output(fx.map_arg(node.args[0], lambda x: moved[x]))
    rest.eliminate_dead_code()
    constants = graph.constants
    parts = tuple(Graph(*without_unused(x, constants), graph.batch) for x in (first, rest))
    return (parts[0] if kept else None), parts[1]


def _place(graph: fx.Graph, node: fx.Node) -> fx.Node:
    new = graph.placeholder(node.name)
    new.meta["example"] = node.meta["example"]
    return new


def _copy(graph: fx.Graph, node: fx.Node, copied: dict[fx.Node, Any]) -> fx.Node:
    new = graph.node_copy(node, lambda x: copied[x])
    new.meta = {"example": node.meta["example"]}
    return new
