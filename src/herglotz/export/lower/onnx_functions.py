"""Functions of one number that are not one operation of the same meaning in ONNX.

A function `write_*` writes the nodes for one operation of the program and gives the name of its result.
"""

from __future__ import annotations

from typing import Any

import torch

from herglotz.export.lower.onnx_writer import Writer, described, require


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


def write_threshold_backward(w: Writer, node: Any) -> str:
    """G where x lies above the threshold, else 0."""
    g, x, threshold = node.args
    above = w.emit("Greater", w.name(x), w.name(threshold, described(node).dtype))
    return w.emit("Where", above, w.name(g), w.name(0.0, described(node).dtype))
