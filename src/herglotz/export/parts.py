"""A traced graph in two, so that what the steps h alone decide is evaluated before the loop, for all steps at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from torch import fx

from herglotz.codegen.trace import Example, Graph, assembled, aten


def parted(graph: Graph, early: Sequence[bool]) -> tuple[Graph, Graph]:
    """What the `early` inputs alone decide, and the rest: first(*early inputs) → y, rest(*inputs, *y) → the outputs.

    The first part has only values of one number a sample, which are cheap to keep for every step.
    """
    own = graph.code
    calls, places = [x for x in own.nodes if x.op == "call_function"], own.find_nodes(op="placeholder")
    inputs = places[: len(early)]
    constants = dict(zip(places[len(early) :], graph.constants, strict=True))
    given = [x for x, is_early in zip(inputs, early, strict=True) if is_early]
    first, both = _decided(calls, given, list(constants), graph.batch)
    again = {x for x in _read_outside(first) if x.target == aten.unsqueeze.default}  # costs nothing
    cut = [x for x in _read_outside(first - again) if x.op == "call_function"]
    results: Any = own.output_node().args[0]
    soon, later = [x for x in calls if x in first or x in both], [x for x in calls if x not in first - again]
    before = assembled(graph.batch, given, soon, cut, constants)
    return before, assembled(graph.batch, [*inputs, *cut], later, results, constants)


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
