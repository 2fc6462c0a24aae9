"""The networks of a model as C: weights, value, gradient and its tangents."""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor

from herglotz.export.c_template import numbers, render
from herglotz.models.network import Network

PRODUCT = """
/* y_k += sum_j w_jk x_j, where w is (inputs, outputs) and t its transpose. Long rows of outputs are summed side by
   side, without sums across lanes; a few outputs of many inputs are dot products. With GCC's and clang's vector types
   sums stay in registers: left alone, some compilers vectorise the wrong loop and lose a factor of ten. */
static inline void NAME_product(int inputs, int outputs, const real *w, const real *t, const real *x,
    real *NAME_RESTRICT y) {
  int j, k = 0;
#ifdef __GNUC__
  enum { L = NAME_LANES };
  for (; k + 4 * L <= outputs; k += 4 * L) {
    NAME_part *to = (NAME_part *)(y + k);
    NAME_lanes a = to[0], b = to[1], c = to[2], d = to[3];
    NAME_lanes e = NAME_spread(R(0.0)), f = e, g = e, o = e;
    for (j = 0; j + 2 <= inputs; j += 2) {
      const NAME_part *from = (const NAME_part *)(w + j * outputs + k);
      const NAME_part *next = (const NAME_part *)(w + (j + 1) * outputs + k);
      a += from[0] * x[j];
      b += from[1] * x[j];
      c += from[2] * x[j];
      d += from[3] * x[j];
      e += next[0] * x[j + 1];
      f += next[1] * x[j + 1];
      g += next[2] * x[j + 1];
      o += next[3] * x[j + 1];
    }
    if (j < inputs) {
      const NAME_part *from = (const NAME_part *)(w + j * outputs + k);
      a += from[0] * x[j];
      b += from[1] * x[j];
      c += from[2] * x[j];
      d += from[3] * x[j];
    }
    to[0] = a + e;
    to[1] = b + f;
    to[2] = c + g;
    to[3] = d + o;
  }
  for (; k + L <= outputs; k += L) {
    NAME_part *to = (NAME_part *)(y + k);
    NAME_lanes a = to[0], b = NAME_spread(R(0.0)), c = b, d = b;
    const real *from = w + k;
    for (j = 0; j + 4 <= inputs; j += 4, from += 4 * outputs) {
      a += *(const NAME_part *)from * x[j];
      b += *(const NAME_part *)(from + outputs) * x[j + 1];
      c += *(const NAME_part *)(from + 2 * outputs) * x[j + 2];
      d += *(const NAME_part *)(from + 3 * outputs) * x[j + 3];
    }
    for (; j < inputs; j++, from += outputs) a += *(const NAME_part *)from * x[j];
    to[0] = (a + b) + (c + d);
  }
  if (inputs >= L) {
    const real *row = t + k * inputs;
    for (; k < outputs; k++, row += inputs) {
      NAME_lanes sum = NAME_spread(R(0.0));
      int half, i;
      for (j = 0; j + L <= inputs; j += L) sum += *(const NAME_part *)(row + j) * *(const NAME_part *)(x + j);
      for (half = L / 2; half > 0; half /= 2)
        for (i = 0; i < half; i++) sum[i] += sum[i + half];
      for (; j < inputs; j++) sum[0] += row[j] * x[j];
      y[k] += sum[0];
    }
  }
#endif
  (void)t;
  for (; k < outputs; k++) {
    real sum = y[k];
    for (j = 0; j < inputs; j++) sum += w[j * outputs + k] * x[j];
    y[k] = sum;
  }
}
"""

WIDE_PRODUCT = """
/* The same for a register of samples: eight sums at a time stay in registers. */
static inline void NAME_wide_product(int inputs, int outputs, const real *w, const real *t, const NAME_lanes *x,
    NAME_lanes *NAME_RESTRICT y) {
  int j, k = 0;
  (void)t;
  for (; k + 8 <= outputs; k += 8) {
    NAME_lanes a = y[k], b = y[k + 1], c = y[k + 2], d = y[k + 3];
    NAME_lanes e = y[k + 4], f = y[k + 5], g = y[k + 6], o = y[k + 7];
    for (j = 0; j < inputs; j++) {
      const real *from = w + j * outputs + k;
      const NAME_lanes v = x[j];
      a += from[0] * v;
      b += from[1] * v;
      c += from[2] * v;
      d += from[3] * v;
      e += from[4] * v;
      f += from[5] * v;
      g += from[6] * v;
      o += from[7] * v;
    }
    y[k] = a;
    y[k + 1] = b;
    y[k + 2] = c;
    y[k + 3] = d;
    y[k + 4] = e;
    y[k + 5] = f;
    y[k + 6] = g;
    y[k + 7] = o;
  }
  for (; k < outputs; k++) {
    NAME_lanes sum = y[k];
    for (j = 0; j < inputs; j++) sum += w[j * outputs + k] * x[j];
    y[k] = sum;
  }
}
"""

_HEAD = """
/* The @WHICH@ network of @M@ features x: value, gradient dx{%if tangents}, and the derivatives ddx of that gradient
   along `count` directions tx{%end}: forward, then backward through the layers. */
static inline void NAME_@WHICH@_network({%if several}int out, {%end}const real x[@M@],
    real *value, real dx[@M@]{%if tangents},
    int count, real tx[NAME_N][@M@], real ddx[NAME_N][@M@]{%end}) {
"""


def weights(which: str, net: Network, dtype: str) -> str:
    """The weights of a network in both layouts, as C constants."""
    matrices = [w.detach().cpu().double() for w in net.weights]
    parts = [f"\n/* Weights of the {which} network: w is (outputs, inputs), t its transpose. */\n"]
    for layer, bias in enumerate(net.biases):
        parts += [
            _array(f"NAME_{which}_w{layer}", matrices[layer], dtype),
            _array(f"NAME_{which}_t{layer}", matrices[layer].T, dtype),
            _array(f"NAME_{which}_b{layer}", bias.detach().cpu().double(), dtype),
        ]
    parts.append(_array(f"NAME_{which}_last", matrices[-1], dtype))
    return "".join(parts)


def network(which: str, net: Network, activation: str, *, tangents: bool, several: bool = False) -> str:
    """The function NAME_`which`_network, as a template; with `several` outputs it gives the one of number `out`."""
    m = net.weights[0].shape[1]
    head = render(_HEAD, {"WHICH": which, "M": str(m)}, {"tangents": tangents, "several": several})
    return head + _body(which, [m] + [len(b) for b in net.biases], activation, tangents, several)


def _body(which: str, sizes: list[int], activation: str, tangents: bool, several: bool) -> str:
    """Forward and backward through the layers, written out; sizes = (features, width, ..., width)."""
    depth = len(sizes) - 1
    top, last = depth - 1, sizes[-1]
    weight = f"NAME_{which}_last[out * {last} + k]" if several else f"NAME_{which}_last[k]"
    C: list[str] = []
    for k, size in enumerate(sizes[1:]):
        C.append(f"real a{k}[{size}], f{k}[{size}], u{k}[{size}], g{k}[{size}];  /* value, slope, adjoints of both */")
        if tangents:
            inner = "" if k == top else f", ta{k}[{size}], tu{k}[{size}]"
            C.append(f"real e{k}[{size}], tz{k}[{size}], tg{k}[{size}]{inner};")
    C += ["int k;", "real sum = SPREAD(0.0);"]
    if tangents:
        C.append("int j;")
    for layer, (a, b) in enumerate(pairwise(sizes)):
        below = "x" if layer == 0 else f"a{layer - 1}"
        C.append(f"for (k = 0; k < {b}; k++) a{layer}[k] = NAME_{which}_b{layer}[k] + SPREAD(0.0);")
        C.append(_product(a, b, f"NAME_{which}_t{layer}", below, f"a{layer}"))
        bend = f"count > 0 ? e{layer} : 0" if tangents else "0"
        C.append(f"NAME_activate_{activation}({b}, a{layer}, f{layer}, {bend});")
    C.append(f"for (k = 0; k < {last}; k++) sum += {weight} * a{top}[k];")
    C.append("*value = sum;")
    C.append(f"for (k = 0; k < {last}; k++) u{top}[k] = {weight} + SPREAD(0.0);")
    for layer in reversed(range(depth)):
        a, b = sizes[layer], sizes[layer + 1]
        below = "dx" if layer == 0 else f"u{layer - 1}"
        C.append(f"for (k = 0; k < {b}; k++) g{layer}[k] = u{layer}[k] * f{layer}[k];")
        C.append(f"for (k = 0; k < {a}; k++) {below}[k] = SPREAD(0.0);")
        C.append(_product(b, a, f"NAME_{which}_w{layer}", f"g{layer}", below))
    if tangents:
        C.append("for (j = 0; j < count; j++) {")
        C += [f"  {line}" for line in _tangents(which, sizes)]
        C.append("}")
    return "".join(f"  {line}\n" for line in C) + "}\n"


def _tangents(which: str, sizes: list[int]) -> list[str]:
    """Along direction j: z′ = W a′ of the layer below, a′ = f z′; then g = u f gives g′ = u′ f + u e z′."""
    C: list[str] = []
    top = len(sizes) - 2
    for layer, (a, b) in enumerate(pairwise(sizes)):
        below = "tx[j]" if layer == 0 else f"ta{layer - 1}"
        C.append(f"for (k = 0; k < {b}; k++) tz{layer}[k] = SPREAD(0.0);")
        C.append(_product(a, b, f"NAME_{which}_t{layer}", below, f"tz{layer}"))
        if layer < top:
            C.append(f"for (k = 0; k < {b}; k++) ta{layer}[k] = tz{layer}[k] * f{layer}[k];")
    for layer in reversed(range(top + 1)):
        a, b = sizes[layer], sizes[layer + 1]
        below = "ddx[j]" if layer == 0 else f"tu{layer - 1}"
        first = "" if layer == top else f"tu{layer}[k] * f{layer}[k] + "
        C.append(f"for (k = 0; k < {b}; k++) tg{layer}[k] = {first}u{layer}[k] * e{layer}[k] * tz{layer}[k];")
        C.append(f"for (k = 0; k < {a}; k++) {below}[k] = SPREAD(0.0);")
        C.append(_product(b, a, f"NAME_{which}_w{layer}", f"tg{layer}", below))
    return C


def _product(inputs: int, outputs: int, w: str, x: str, y: str) -> str:
    """Y += x w for a matrix w of (inputs, outputs); the other layout goes with it (less than ten layers)."""
    t = w[:-2] + {"t": "w", "w": "t"}[w[-2]] + w[-1]
    return f"NAME_product({inputs}, {outputs}, {w}, {t}, {x}, {y});"


def _array(name: str, values: Tensor, dtype: str) -> str:
    flat = values.reshape(-1).tolist()
    return f"static const real {name}[{len(flat)}] = {{{numbers(flat, dtype)}}};\n"
