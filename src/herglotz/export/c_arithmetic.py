"""Number formats and activations in C: finite or not by their bits, and functions that compilers vectorise."""

from __future__ import annotations

from math import factorial

from herglotz.export.c_template import FUNCTIONS, render, widen

ACTIVATIONS = ("tanh", "softplus", "silu")
# (largest |y|, ln 2 in two parts, terms of the exponential series, terms of the logarithm) of each type
_SERIES = {
    "float64": ("40.0", "6.93147180369123816490e-01", "1.90821492927058770002e-10", 13, 17),
    "float32": ("20.0", "6.93359375e-01", "-2.12194440e-04", 7, 7),
}
_OWN = ("FLOOR", "TANH")  # not needed for registers, or written here
_BITS = {"float64": ("unsigned long long", 1023, 52), "float32": ("unsigned int", 127, 23)}

# Inspected as integers: under -ffast-math compilers delete x != x. `volatile` hides that x came from arithmetic that
# they may assume to be finite.
NUMBERS = """
#if (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0) || defined(_M_FP_FAST)
#define NAME_HIDDEN volatile
#else
#define NAME_HIDDEN
#endif

typedef union {
  real number;
  @BITS@ bits;
} NAME_pun;

/* By the bits, so that it holds under -ffast-math too. */
static inline int NAME_finite(real x) {
  NAME_HIDDEN NAME_pun pun;
  pun.number = x;
  return (pun.bits & (@BITS@)@EXPONENT@) != (@BITS@)@EXPONENT@;
}

static inline real NAME_nan(void) {
  NAME_HIDDEN NAME_pun pun;
  pun.bits = (@BITS@)@NAN@;
  return pun.number;
}

static inline int NAME_all_finite(const real x[NAME_N]) {
  int i, good = 1;
  for (i = 0; i < NAME_N; i++) good &= NAME_finite(x[i]);
  return good;
}

/* The largest |x_i|. */
static inline real NAME_length(const real x[NAME_N]) {
  real size = R(0.0);
  int i;
  for (i = 0; i < NAME_N; i++) size = FABS(x[i]) > size ? FABS(x[i]) : size;
  return size;
}

/* Zero where a number is so small that its square and its products are not normal numbers any more: a motion that has
   come to rest would otherwise step many times slower. */
static inline real NAME_flush(real x) {
  return FABS(x) < R(@TINY@) ? R(0.0) : x;
}
"""

LANES = """
#ifdef __GNUC__
/* Registers of numbers, as wide as the processor's, with GCC and clang: what they hold side by side is the units of a
   layer or, in batches, the samples. Any other compiler goes number by number. */
#if defined(__AVX512F__)
#define NAME_LANE_BYTES 64
#elif defined(__AVX__)
#define NAME_LANE_BYTES 32
#else
#define NAME_LANE_BYTES 16
#endif
typedef real NAME_lanes __attribute__((vector_size(NAME_LANE_BYTES), may_alias));
typedef real NAME_part __attribute__((vector_size(NAME_LANE_BYTES), aligned(sizeof(real)), may_alias));
typedef @BITS@ NAME_bits __attribute__((vector_size(NAME_LANE_BYTES)));
typedef int NAME_counts __attribute__((vector_size(NAME_LANE_BYTES / sizeof(real) * sizeof(int))));
enum { NAME_LANES = (int)(NAME_LANE_BYTES / sizeof(real)) };

static inline NAME_lanes NAME_spread(real x) {
  NAME_lanes y = {R(0.0)};
  return y + x;
}

static inline NAME_lanes NAME_choose(NAME_bits where, NAME_lanes a, NAME_lanes b) {
  return (NAME_lanes)((where & (NAME_bits)a) | (~where & (NAME_bits)b));
}

static inline NAME_lanes NAME_wide_growth(NAME_lanes y) {
  const NAME_lanes most = NAME_spread(R(@LIMIT@)), zero = NAME_spread(R(0.0)), half = NAME_spread(R(0.5));
  NAME_lanes r, e;
  NAME_counts k;
  NAME_bits two;
  y = NAME_choose((NAME_bits)(y > most), most, y);
  y = NAME_choose((NAME_bits)(y < -most), -most, y);
  r = NAME_choose((NAME_bits)(y == y), y * R(1.44269504088896340736), zero);
  r += NAME_choose((NAME_bits)(r < zero), -half, half);
  k = __builtin_convertvector(r, NAME_counts);
  {
    const NAME_lanes whole = __builtin_convertvector(k, NAME_lanes);
    r = (y - whole * R(@HIGH@)) - whole * R(@LOW@);
  }
  e = NAME_spread(R(@LAST@));
@SERIES@
  e = r + r * r * e;
  two = __builtin_convertvector(k + @BIAS@, NAME_bits) << @MANTISSA@;
  return (NAME_lanes)two * e + ((NAME_lanes)two - R(1.0));
}
#endif
"""

_GROWTH = """
/* exp(y) - 1 = 2^k (exp(r) - 1) + 2^k - 1 with |r| <= ln(2)/2, for |y| cut off at @LIMIT@: a few units in the last
   place, without branches or calls. Needs IEEE 754 numbers. NaN stays. */
static inline real NAME_growth(real y) {
  union { real f; @BITS@ i; } two;
  real r, e;
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
  return two.f * e + (two.f - R(1.0));
}
"""

_TANH = """
static inline real NAME_tanh(real x) {
  const real e = NAME_growth(R(2.0) * x);
  return e / (e + R(2.0));
}
"""

_LOG1P = """
/* log(1 + y) = 2 artanh(y / (2 + y)) for 0 <= y <= 1. */
static inline real NAME_log1p(real y) {
  const real r = y / (R(2.0) + y), z = r * r;
  real sum = SPREAD(@LAST@);
@SERIES@
  return R(2.0) * r * sum;
}
"""

# In place of its argument the value, its slope f and, unless it is null, the second derivative e.
_UNITS = {
    "tanh": """
static inline void NAME_unit_tanh(real *a, real *f, real *e) {
  const real T = NAME_tanh(*a);
  *a = T;
  *f = R(1.0) - T * T;
  if (e) *e = R(-2.0) * T * *f;
}
""",
    "softplus": """
static inline void NAME_unit_softplus(real *a, real *f, real *e) {
  const real z = *a, size = FABS(z), S = R(0.5) + R(0.5) * NAME_tanh(R(0.5) * z);
  *a = R(0.5) * (z + size) + NAME_log1p(R(1.0) + NAME_growth(-size));
  *f = S;
  if (e) *e = S * (R(1.0) - S);
}
""",
    "silu": """
static inline void NAME_unit_silu(real *a, real *f, real *e) {
  const real z = *a, S = R(0.5) + R(0.5) * NAME_tanh(R(0.5) * z);
  *a = z * S;
  *f = S * (R(1.0) + z * (R(1.0) - S));
  if (e) *e = S * (R(1.0) - S) * (R(2.0) + z * (R(1.0) - R(2.0) * S));
}
""",
}

_ACTIVATE = """
/* @WHICH@ of a layer in place; its slopes f and, unless it is null, second derivatives e. */
static inline void NAME_activate_@WHICH@(int count, real *a, real *f, real *e) {
  int k = 0;
#ifdef __GNUC__
  NAME_lanes x, y, z = NAME_spread(R(0.0));
  for (; k + NAME_LANES <= count; k += NAME_LANES) {
    x = *(NAME_part *)(a + k);
    NAME_wide_unit_@WHICH@(&x, &y, e ? &z : 0);
    *(NAME_part *)(a + k) = x;
    *(NAME_part *)(f + k) = y;
    if (e) *(NAME_part *)(e + k) = z;
  }
#endif
  for (; k < count; k++) NAME_unit_@WHICH@(a + k, f + k, e ? e + k : 0);
}
"""

_WIDE_ACTIVATE = """
static inline void NAME_wide_activate_@WHICH@(int count, NAME_lanes *a, NAME_lanes *f, NAME_lanes *e) {
  int k;
  for (k = 0; k < count; k++) NAME_wide_unit_@WHICH@(a + k, f + k, e ? e + k : 0);
}
"""

_WIDE_FUNCTION = """
static inline NAME_lanes NAME_wide_@NAME@(NAME_lanes x) {
  int w;
  for (w = 0; w < NAME_LANES; w++) x[w] = @CALL@(x[w]);
  return x;
}
"""


def number_tests(dtype: str) -> str:
    """Finite or not, largest entry, flush to zero."""
    bits, bias, mantissa = _BITS[dtype]
    exponent = (2 * bias + 1) << mantissa
    values = {
        "BITS": bits,
        "EXPONENT": f"{exponent}u" + ("ll" if dtype == "float64" else ""),
        "NAN": f"{exponent + (1 << (mantissa - 1))}u" + ("ll" if dtype == "float64" else ""),
        "TINY": "1e-290" if dtype == "float64" else "1e-35",
    }
    return render(NUMBERS, values)


def activations(names: set[str], dtype: str) -> str:
    """Registers, growth, tanh and the activations of `names`, for numbers and for registers."""
    limit, high, low, terms, log_terms = _SERIES[dtype]
    bits, bias, mantissa = _BITS[dtype]
    values = {
        "BITS": bits.replace("unsigned ", ""),
        "LIMIT": limit,
        "HIGH": high,
        "LOW": low,
        "LAST": repr(1 / factorial(terms)),
        "SERIES": _horner("e", "r", [1 / factorial(k) for k in range(terms - 1, 1, -1)]),
        "BIAS": str(bias),
        "MANTISSA": str(mantissa),
    }
    units = [_TANH]
    if "softplus" in names:
        odd = [1 / (2 * k + 1) for k in range(log_terms, -1, -1)]
        units.append(render(_LOG1P, {"LAST": repr(odd[0]), "SERIES": _horner("sum", "z", odd[1:])}))
    units += [_UNITS[name] for name in sorted(names)]
    functions = [render(_WIDE_FUNCTION, {"NAME": f.lower(), "CALL": f}) for f in FUNCTIONS if f not in _OWN]
    wide = ["\n#ifdef __GNUC__", *functions, widen("".join(units))]
    wide += [render(_WIDE_ACTIVATE, {"WHICH": name}) for name in sorted(names)]
    layers = [render(_ACTIVATE, {"WHICH": name}) for name in sorted(names)]
    growth = {**values, "BITS": bits}
    return "".join([render(_GROWTH, growth), *units, render(LANES, values), *wide, "#endif\n", *layers])


def _horner(sum_: str, x: str, coefficients: list[float]) -> str:
    return "\n".join(f"  {sum_} = {sum_} * {x} + R({c!r});" for c in coefficients)
