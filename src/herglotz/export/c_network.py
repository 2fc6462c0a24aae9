"""The networks of a model as C: vectorisable tanh, weights, value, gradient and its tangents."""

from __future__ import annotations

from itertools import pairwise
from math import factorial

from torch import Tensor

from herglotz.export.c_template import numbers, render
from herglotz.models.network import Network

# (largest |2x|, ln 2 in two parts, exponent bias, mantissa bits, terms of the series) of each type
_TANH = {
    "float64": ("40.0", "6.93147180369123816490e-01", "1.90821492927058770002e-10", 1023, 52, 13),
    "float32": ("20.0", "6.93359375e-01", "-2.12194440e-04", 127, 23, 7),
}

_ARITHMETIC = """
/* tanh x = e / (e + 2) with e = exp(2x) - 1 = 2^k (exp(r) - 1) + 2^k - 1 and |r| <= ln(2)/2: a few units in the last
   place, and without branches or calls, so that compilers vectorise loops of it. Needs IEEE 754 numbers. NaN stays. */
static inline real NAME_tanh(real x) {
  union { real f; @BITS@ i; } two;
  real y = R(2.0) * x, r, e;
  int k;
  y = y > R(@LIMIT@) ? R(@LIMIT@) : y;
  y = y < R(-@LIMIT@) ? R(-@LIMIT@) : y;
  r = y == y ? y * R(1.44269504088896340736) : R(0.0);
  k = (int)(r + (r < R(0.0) ? R(-0.5) : R(0.5)));
  r = (y - (real)k * R(@HIGH@)) - (real)k * R(@LOW@);
  e = R(@LAST@);
@SERIES@
  e = r + r * r * e;
  two.i = (@BITS@)(k + @BIAS@) << @MANTISSA@;
  e = two.f * e + (two.f - R(1.0));
  return e / (e + R(2.0));
}

/* y_k += sum_j w_jk x_j where k runs fastest: nothing is summed across lanes. With GCC's and clang's vector
   types sums stay in registers: left alone, some compilers vectorise the wrong loop and lose a factor of ten. */
static inline void NAME_product(int inputs, int outputs, const real *w, const real *x, real *NAME_RESTRICT y) {
  int j, k = 0;
#ifdef __GNUC__
  typedef real lanes __attribute__((vector_size(32), aligned(sizeof(real)), may_alias));
  enum { L = (int)(32 / sizeof(real)) };
  for (; k + 4 * L <= outputs; k += 4 * L) {
    lanes *to = (lanes *)(y + k), a = to[0], b = to[1], c = to[2], d = to[3];
    for (j = 0; j < inputs; j++) {
      const lanes *from = (const lanes *)(w + j * outputs + k);
      a += from[0] * x[j];
      b += from[1] * x[j];
      c += from[2] * x[j];
      d += from[3] * x[j];
    }
    to[0] = a;
    to[1] = b;
    to[2] = c;
    to[3] = d;
  }
  for (; k + L <= outputs; k += L) {
    lanes *to = (lanes *)(y + k), a = to[0];
    for (j = 0; j < inputs; j++) a += *(const lanes *)(w + j * outputs + k) * x[j];
    to[0] = a;
  }
#endif
  for (; k < outputs; k++)
    for (j = 0; j < inputs; j++) y[k] += w[j * outputs + k] * x[j];
}
"""

_HEAD = """
/* The @WHICH@ network of @M@ features x: value, gradient dx{%if tangents}, and the derivatives ddx of that gradient
   along `count` directions tx{%end}: forward, then backward through the layers. */
static inline void NAME_@WHICH@_network(const real x[@M@], real *value, real dx[@M@]{%if tangents},
    int count, real tx[NAME_N][@M@], real ddx[NAME_N][@M@]{%end}) {
"""


def arithmetic(dtype: str) -> str:
    """`tanh` and the parts of a matrix product in C for one number type."""
    limit, high, low, bias, mantissa, terms = _TANH[dtype]
    series = "\n".join(f"  e = e * r + R({1 / factorial(k)!r});" for k in range(terms - 1, 1, -1))
    values = {
        "BITS": "unsigned long long" if dtype == "float64" else "unsigned int",
        "LIMIT": limit,
        "HIGH": high,
        "LOW": low,
        "LAST": repr(1 / factorial(terms)),
        "SERIES": series,
        "BIAS": str(bias),
        "MANTISSA": str(mantissa),
    }
    return render(_ARITHMETIC, values)


def network(which: str, net: Network, dtype: str, *, tangents: bool) -> str:
    """Weights (in both layouts) and the function NAME_`which`_network."""
    weights = [w.detach().cpu().double() for w in net.weights]
    biases = [b.detach().cpu().double() for b in net.biases]
    depth, m = len(biases), weights[0].shape[1]
    parts = [f"\n/* Weights of the {which} network: w is (outputs, inputs), t its transpose. */\n"]
    for layer in range(depth):
        parts += [
            _array(f"NAME_{which}_w{layer}", weights[layer], dtype),
            _array(f"NAME_{which}_t{layer}", weights[layer].T, dtype),
            _array(f"NAME_{which}_b{layer}", biases[layer], dtype),
        ]
    parts.append(_array(f"NAME_{which}_last", weights[depth], dtype))
    parts.append(render(_HEAD, {"WHICH": which, "M": str(m)}, {"tangents": tangents}))
    parts.append(_body(which, [m] + [len(b) for b in biases], tangents))
    return "".join(parts)


def _body(which: str, sizes: list[int], tangents: bool) -> str:
    """Forward and backward through the layers, written out; sizes = (features, width, ..., width)."""
    depth = len(sizes) - 1
    depth = len(sizes) - 1
    top, last = depth - 1, sizes[-1]
    C: list[str] = []
    for k, size in enumerate(sizes[1:]):
        C.append(f"real a{k}[{size}], u{k}[{size}], g{k}[{size}];  /* activation, its adjoint, its argument's */")
        if tangents:
            below_top = "" if k == top else f" tu{k}[{size}],"
            C.append(f"real ta{k}[{size}],{below_top} tg{k}[{size}];  /* their derivatives */")
    C += ["int k;", "real sum = R(0.0);"]
    if tangents:
        C.append("int j;")
    for layer, (a, b) in enumerate(pairwise(sizes)):
        below = "x" if layer == 0 else f"a{layer - 1}"
        C.append(f"for (k = 0; k < {b}; k++) a{layer}[k] = NAME_{which}_b{layer}[k];")
        C.append(_product(a, b, f"NAME_{which}_t{layer}", below, f"a{layer}"))
        C.append(f"for (k = 0; k < {b}; k++) a{layer}[k] = NAME_tanh(a{layer}[k]);")
    C.append(f"for (k = 0; k < {last}; k++) sum += NAME_{which}_last[k] * a{top}[k];")
    C.append("*value = sum;")
    C.append(f"for (k = 0; k < {last}; k++) u{top}[k] = NAME_{which}_last[k];")
    for layer in reversed(range(depth)):
        a, b = sizes[layer], sizes[layer + 1]
        below = "dx" if layer == 0 else f"u{layer - 1}"
        C.append(f"for (k = 0; k < {b}; k++) g{layer}[k] = u{layer}[k] * (R(1.0) - a{layer}[k] * a{layer}[k]);")
        C.append(f"for (k = 0; k < {a}; k++) {below}[k] = R(0.0);")
        C.append(_product(b, a, f"NAME_{which}_w{layer}", f"g{layer}", below))
    if tangents:
        C.append("for (j = 0; j < count; j++) {")
        C += [f"  {line}" for line in _tangents(which, sizes)]
        C.append("}")
    return "".join(f"  {line}\n" for line in C) + "}\n"


def _tangents(which: str, sizes: list[int]) -> list[str]:
    """Along direction j: a′ = (1 − a²) (W a′ of the layer below), then g = u (1 − a²) gives u′ (1 − a²) − 2 a a′ u."""
    C: list[str] = []
    top = len(sizes) - 2
    for layer, (a, b) in enumerate(pairwise(sizes)):
        below = "tx[j]" if layer == 0 else f"ta{layer - 1}"
        C.append(f"for (k = 0; k < {b}; k++) ta{layer}[k] = R(0.0);")
        C.append(_product(a, b, f"NAME_{which}_t{layer}", below, f"ta{layer}"))
        C.append(f"for (k = 0; k < {b}; k++) ta{layer}[k] *= R(1.0) - a{layer}[k] * a{layer}[k];")
    for layer in reversed(range(top + 1)):
        a, b = sizes[layer], sizes[layer + 1]
        below = "ddx[j]" if layer == 0 else f"tu{layer - 1}"
        first = "" if layer == top else f"tu{layer}[k] * (R(1.0) - a{layer}[k] * a{layer}[k]) "
        C.append(f"for (k = 0; k < {b}; k++)")
        C.append(f"  tg{layer}[k] = {first}- R(2.0) * a{layer}[k] * ta{layer}[k] * u{layer}[k];")
        C.append(f"for (k = 0; k < {a}; k++) {below}[k] = R(0.0);")
        C.append(_product(b, a, f"NAME_{which}_w{layer}", f"tg{layer}", below))
    return C


def _product(inputs: int, outputs: int, w: str, x: str, y: str) -> str:
    """Y += x w for a matrix w of (inputs, outputs)."""
    return f"NAME_product({inputs}, {outputs}, {w}, {x}, {y});"


def _array(name: str, values: Tensor, dtype: str) -> str:
    flat = values.reshape(-1).tolist()
    return f"static const real {name}[{len(flat)}] = {{{numbers(flat, dtype)}}};\n"
