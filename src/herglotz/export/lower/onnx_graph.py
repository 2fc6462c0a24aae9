"""A traced graph as nodes of ONNX, written by torch.onnx's own functions and by those of `OPERATIONS`."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import onnx_ir as ir
import torch
from onnx_ir.tensor_adapters import from_torch_dtype
from onnxscript.function_libs.torch_lib import ops as _  # noqa: F401  it fills the registry
from onnxscript.function_libs.torch_lib.registration import default_registry
from torch import fx

from herglotz.codegen.trace import Example
from herglotz.errors import InputError
from herglotz.export.inline import graph_of_key, results_of
from herglotz.export.lower.onnx_operations import OPERATIONS, op

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
