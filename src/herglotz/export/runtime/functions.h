/* Elementary functions without branches, which compilers vectorise, for numbers, registers and rows. */

/* The exponential series (e^r - 1 - r) / r^2 and the series of artanh(r) / r, (sin r - r) / r^3 and (cos r - 1 + r^2 / 2)
   / r^4 in z = r^2; in double precision even and odd powers of the first two apart, which are computed side by side. pi / 2
   is a sum of four numbers; the first three are so short that products with whole numbers up to hz_TURNED are exact. */
#if hz_SINGLE
#define hz_LIMIT 20.0
#define hz_FAR 80.0
#define hz_LN2_HIGH 6.93359375e-01
#define hz_LN2_LOW -2.12194440e-04
#define hz_BIAS 127
#define hz_MANTISSA 23
#define hz_EXP_TERMS(r)                                                                                              \
  (((((hz_R(1.0 / 5040) * r + hz_R(1.0 / 720)) * r + hz_R(1.0 / 120)) * r + hz_R(1.0 / 24)) * r + hz_R(1.0 / 6)) * r + \
   hz_R(0.5))
#define hz_ARTANH_TERMS(z)                                                                                            \
  (((((((hz_R(1.0 / 15) * z + hz_R(1.0 / 13)) * z + hz_R(1.0 / 11)) * z + hz_R(1.0 / 9)) * z + hz_R(1.0 / 7)) * z +    \
     hz_R(1.0 / 5)) * z + hz_R(1.0 / 3)) * z + hz_R(1.0))
#define hz_TURNED 1e3
#define hz_QUARTER_1 1.570678710938e+00
#define hz_QUARTER_2 1.176148653030e-04
#define hz_QUARTER_3 9.920313459588e-10
#define hz_QUARTER_4 6.223372172e-14
#define hz_SIN_TERMS(z) (((hz_R(1.0 / 362880) * z - hz_R(1.0 / 5040)) * z + hz_R(1.0 / 120)) * z - hz_R(1.0 / 6))
#define hz_COS_TERMS(z) (((hz_R(-1.0 / 3628800) * z + hz_R(1.0 / 40320)) * z - hz_R(1.0 / 720)) * z + hz_R(1.0 / 24))
#else
#define hz_LIMIT 40.0
#define hz_FAR 700.0
#define hz_LN2_HIGH 6.93147180369123816490e-01
#define hz_LN2_LOW 1.90821492927058770002e-10
#define hz_BIAS 1023
#define hz_MANTISSA 52
#define hz_EXP_EVEN(z)                                                                                                 \
  (((((hz_R(1.0 / 479001600) * z + hz_R(1.0 / 3628800)) * z + hz_R(1.0 / 40320)) * z + hz_R(1.0 / 720)) * z +          \
    hz_R(1.0 / 24)) * z + hz_R(0.5))
#define hz_EXP_ODD(z)                                                                                                  \
  (((((hz_R(1.0 / 6227020800.0) * z + hz_R(1.0 / 39916800)) * z + hz_R(1.0 / 362880)) * z + hz_R(1.0 / 5040)) * z +    \
    hz_R(1.0 / 120)) * z + hz_R(1.0 / 6))
#define hz_EXP_TERMS(r) (hz_EXP_EVEN((r * r)) + r * hz_EXP_ODD((r * r)))
#define hz_ARTANH_EVEN(z)                                                                                              \
  ((((((((hz_R(1.0 / 33) * z + hz_R(1.0 / 29)) * z + hz_R(1.0 / 25)) * z + hz_R(1.0 / 21)) * z + hz_R(1.0 / 17)) * z + \
      hz_R(1.0 / 13)) * z + hz_R(1.0 / 9)) * z + hz_R(1.0 / 5)) * z + hz_R(1.0))
#define hz_ARTANH_ODD(z)                                                                                               \
  ((((((((hz_R(1.0 / 35) * z + hz_R(1.0 / 31)) * z + hz_R(1.0 / 27)) * z + hz_R(1.0 / 23)) * z + hz_R(1.0 / 19)) * z + \
      hz_R(1.0 / 15)) * z + hz_R(1.0 / 11)) * z + hz_R(1.0 / 7)) * z + hz_R(1.0 / 3))
#define hz_ARTANH_TERMS(z) (hz_ARTANH_EVEN((z * z)) + z * hz_ARTANH_ODD((z * z)))
#define hz_TURNED 1e5
#define hz_QUARTER_1 1.57079632673412561417e+00
#define hz_QUARTER_2 6.07710050630396597660e-11
#define hz_QUARTER_3 2.02226624871116645580e-21
#define hz_QUARTER_4 8.47842766036889956997e-32
#define hz_SIN_TERMS(z)                                                                                                \
  (((((((hz_R(1.0 / 355687428096000.0) * z - hz_R(1.0 / 1307674368000.0)) * z + hz_R(1.0 / 6227020800.0)) * z -        \
       hz_R(1.0 / 39916800)) * z + hz_R(1.0 / 362880)) * z - hz_R(1.0 / 5040)) * z + hz_R(1.0 / 120)) * z -            \
   hz_R(1.0 / 6))
#define hz_COS_TERMS(z)                                                                                                \
  ((((((hz_R(1.0 / 20922789888000.0) * z - hz_R(1.0 / 87178291200.0)) * z + hz_R(1.0 / 479001600)) * z -               \
      hz_R(1.0 / 3628800)) * z + hz_R(1.0 / 40320)) * z - hz_R(1.0 / 720)) * z + hz_R(1.0 / 24))
#endif

/* exp(r) - 1 and 2^k where y = k ln 2 + r with |r| <= ln(2)/2, for |y| <= hz_FAR: a few units in the last place, without
   branches or calls. Needs IEEE 754 numbers. NaN gives NaN. */
static inline hz_real hz_reduced(hz_real y, hz_real *power) {
  hz_pun two;
  hz_real r = y == y ? y * hz_R(1.44269504088896340736) : hz_R(0.0);
  const int k = (int)(r + (r < hz_R(0.0) ? hz_R(-0.5) : hz_R(0.5)));
  r = (y - (hz_real)k * hz_R(hz_LN2_HIGH)) - (hz_real)k * hz_R(hz_LN2_LOW);
  two.bits = (hz_bits_t)(k + hz_BIAS) << hz_MANTISSA;
  *power = two.number;
  return r + r * r * hz_EXP_TERMS(r);
}

/* exp(y) - 1 for |y| cut off at hz_LIMIT. */
static inline hz_real hz_growth(hz_real y) {
  hz_real two, e;
  y = y > hz_R(hz_LIMIT) ? hz_R(hz_LIMIT) : y;
  y = y < hz_R(-hz_LIMIT) ? hz_R(-hz_LIMIT) : y;
  e = hz_reduced(y, &two);
  return two * e + (two - hz_R(1.0));
}

static inline hz_real hz_expm1(hz_real x) { return hz_fabs(x) <= hz_R(hz_LIMIT) ? hz_growth(x) : hz_expm1_of(x); }

static inline hz_real hz_exp(hz_real x) {
  hz_real two, e;
  if (!(hz_fabs(x) <= hz_R(hz_FAR))) return hz_exp_of(x);
  e = hz_reduced(x, &two);
  return two * e + two;
}

static inline hz_real hz_tanh(hz_real x) {
  const hz_real e = hz_growth(hz_R(2.0) * x);
  return e / (e + hz_R(2.0));
}

static inline hz_real hz_sigmoid(hz_real x) { return hz_R(0.5) + hz_R(0.5) * hz_tanh(hz_R(0.5) * x); }

/* log(1 + e^x), by log(1 + y) = 2 artanh(y / (2 + y)) with y = e^-|x|. */
static inline hz_real hz_softplus(hz_real x) {
  const hz_real size = hz_fabs(x), y = hz_R(1.0) + hz_growth(-size), r = y / (hz_R(2.0) + y), z = r * r;
  return (x > hz_R(0.0) ? x : hz_R(0.0)) + hz_R(2.0) * r * hz_ARTANH_TERMS(z);
}

/* artanh(x), by its series where |x| <= 1/3. */
#define hz_SERIES hz_R(0.1111111111111111)
static inline hz_real hz_atanh(hz_real x) {
  const hz_real z = x * x;
  return z <= hz_SERIES ? x * hz_ARTANH_TERMS(z) : hz_atanh_of(x);
}

static inline hz_real hz_choose(hz_real a, hz_real b, hz_real x, hz_real y) { return a > b ? x : y; }

static inline hz_real hz_nearest(hz_real x) { return hz_floor_of(x + hz_R(0.5)); }

/* Registers of numbers, as wide as the processor's, with GCC and clang. A register holds the units of a layer or, in
   batches, the samples. Other compilers go number by number, and so do processors without such registers (Cortex-M),
   where they would only take stack. */
#ifdef __GNUC__
#if defined(__AVX512F__)
#define hz_LANE_BYTES 64
#elif defined(__AVX__)
#define hz_LANE_BYTES 32
#elif defined(__SSE2__) || defined(__aarch64__) || defined(__VSX__) || defined(__wasm_simd128__)
#define hz_LANE_BYTES 16
#endif
#endif

#ifdef hz_LANE_BYTES
#if hz_SINGLE
typedef int hz_signed_t;
#else
typedef long long hz_signed_t;
#endif
typedef hz_real hz_lanes __attribute__((vector_size(hz_LANE_BYTES), may_alias));
typedef hz_real hz_part __attribute__((vector_size(hz_LANE_BYTES), aligned(sizeof(hz_real)), may_alias));
typedef hz_signed_t hz_masks __attribute__((vector_size(hz_LANE_BYTES)));
typedef int hz_counts __attribute__((vector_size(hz_LANE_BYTES / sizeof(hz_real) * sizeof(int))));
enum { hz_LANES = (int)(hz_LANE_BYTES / sizeof(hz_real)), hz_wide_WIDTH = hz_LANES };
#define hz_wide_LANE(x, w) (x)[w]
typedef struct {
  hz_lanes q[hz_N], p[hz_N], s, sigma;
} hz_wide_state;

static inline hz_lanes hz_spread(hz_real x) {
  hz_lanes y = {hz_R(0.0)};
  return y + x;
}

static inline hz_lanes hz_select(hz_masks where, hz_lanes a, hz_lanes b) {
  return (hz_lanes)((where & (hz_masks)a) | (~where & (hz_masks)b));
}

static inline hz_lanes hz_wide_choose(hz_lanes a, hz_lanes b, hz_lanes x, hz_lanes y) {
  return hz_select((hz_masks)(a > b), x, y);
}

static inline hz_lanes hz_wide_reduced(hz_lanes y, hz_lanes *power) {
  const hz_lanes zero = hz_spread(hz_R(0.0)), half = hz_spread(hz_R(0.5));
  hz_lanes r = hz_select((hz_masks)(y == y), y * hz_R(1.44269504088896340736), zero), whole;
  hz_counts k;
  r += hz_select((hz_masks)(r < zero), -half, half);
  k = __builtin_convertvector(r, hz_counts);
  whole = __builtin_convertvector(k, hz_lanes);
  r = (y - whole * hz_R(hz_LN2_HIGH)) - whole * hz_R(hz_LN2_LOW);
  *power = (hz_lanes)(__builtin_convertvector(k + hz_BIAS, hz_masks) << hz_MANTISSA);
  return r + r * r * hz_EXP_TERMS(r);
}

static inline hz_lanes hz_wide_cut(hz_lanes y, hz_real limit) {
  const hz_lanes most = hz_spread(limit);
  y = hz_select((hz_masks)(y > most), most, y);
  return hz_select((hz_masks)(y < -most), -most, y);
}

/* The nearest whole number. Numbers beyond the integers of the processor are cut off: as angles they have no digits
   left. */
static inline hz_lanes hz_wide_nearest(hz_lanes x) {
  const hz_lanes zero = hz_spread(hz_R(0.0)), half = hz_spread(hz_R(0.5));
  x = hz_wide_cut(hz_select((hz_masks)(x == x), x, zero), hz_R(hz_SINGLE ? 1e9 : 1e18));
  return __builtin_convertvector(__builtin_convertvector(x + hz_select((hz_masks)(x < zero), -half, half), hz_masks), hz_lanes);
}

static inline hz_lanes hz_wide_growth(hz_lanes y) {
  hz_lanes two;
  const hz_lanes e = hz_wide_reduced(hz_wide_cut(y, hz_R(hz_LIMIT)), &two);
  return two * e + (two - hz_R(1.0));
}

static inline hz_lanes hz_wide_fabs(hz_lanes x) { return hz_select((hz_masks)(x < hz_spread(hz_R(0.0))), -x, x); }

static inline hz_lanes hz_wide_tanh(hz_lanes x) {
  const hz_lanes e = hz_wide_growth(hz_R(2.0) * x);
  return e / (e + hz_R(2.0));
}

static inline hz_lanes hz_wide_sigmoid(hz_lanes x) { return hz_R(0.5) + hz_R(0.5) * hz_wide_tanh(hz_R(0.5) * x); }

static inline hz_lanes hz_wide_softplus(hz_lanes x) {
  const hz_lanes size = hz_wide_fabs(x), y = hz_R(1.0) + hz_wide_growth(-size), r = y / (hz_R(2.0) + y), z = r * r;
  const hz_lanes zero = hz_spread(hz_R(0.0));
  return hz_select((hz_masks)(x > zero), x, zero) + hz_R(2.0) * r * hz_ARTANH_TERMS(z);
}

/* One sum without branches: of a branch for each lane GCC makes a tree. */
static inline int hz_any(hz_masks where) {
  hz_signed_t any = 0;
  int w;
  for (w = 0; w < hz_LANES; w++) any |= where[w];
  return any != 0;
}

/* y_w = f(x_w) by <math.h> where the formula before does not hold. */
#define hz_ELSE(holds, function)                                                          \
  do {                                                                                    \
    const hz_masks where = ~(hz_masks)(holds);                                            \
    int w;                                                                                \
    for (w = 0; hz_any(where) && w < hz_LANES; w++)                                      \
      if (where[w]) y[w] = function(x[w]);                                                \
  } while (0)
static inline hz_lanes hz_wide_atanh(hz_lanes x) {
  const hz_lanes z = x * x;
  hz_lanes y = x * hz_ARTANH_TERMS(z);
  hz_ELSE(z <= hz_spread(hz_SERIES), hz_atanh_of);
  return y;
}

static inline hz_lanes hz_wide_expm1(hz_lanes x) {
  hz_lanes y = hz_wide_growth(x);
  hz_ELSE(hz_wide_fabs(x) <= hz_spread(hz_R(hz_LIMIT)), hz_expm1_of);
  return y;
}

static inline hz_lanes hz_wide_exp(hz_lanes x) {
  hz_lanes two, y = hz_wide_reduced(hz_wide_cut(x, hz_R(hz_FAR)), &two);
  y = two * y + two;
  hz_ELSE(hz_wide_fabs(x) <= hz_spread(hz_R(hz_FAR)), hz_exp_of);
  return y;
}

/* sin(x + quarters pi / 2) where |x| <= hz_TURNED: x = k pi / 2 + r with |r| <= pi / 4, about a unit in the last place. */
static inline hz_lanes hz_wide_wave(hz_lanes x, int quarters) {
  const hz_lanes zero = hz_spread(hz_R(0.0)), half = hz_spread(hz_R(0.5));
  hz_lanes r = hz_wide_cut(x, hz_R(hz_TURNED)) * hz_R(0.63661977236758134308), whole, z, y;
  hz_masks turns;
  hz_counts k;
  r = hz_select((hz_masks)(r == r), r, zero);
  r += hz_select((hz_masks)(r < zero), -half, half);
  k = __builtin_convertvector(r, hz_counts);
  whole = __builtin_convertvector(k, hz_lanes);
  r = (x - whole * hz_R(hz_QUARTER_1)) - whole * hz_R(hz_QUARTER_2);
  r = (r - whole * hz_R(hz_QUARTER_3)) - whole * hz_R(hz_QUARTER_4);
  z = r * r;
  turns = __builtin_convertvector(k + quarters, hz_masks);
  y = hz_select((hz_masks)((turns & 1) != 0), hz_R(1.0) - (hz_R(0.5) * z - z * z * hz_COS_TERMS(z)),
      r + r * z * hz_SIN_TERMS(z));
  return hz_select((hz_masks)((turns & 2) != 0), -y, y);
}

static inline hz_lanes hz_wide_sin(hz_lanes x) {
  hz_lanes y = hz_wide_wave(x, 0);
  hz_ELSE(hz_wide_fabs(x) <= hz_spread(hz_R(hz_TURNED)), hz_sin);
  return y;
}

static inline hz_lanes hz_wide_cos(hz_lanes x) {
  hz_lanes y = hz_wide_wave(x, 1);
  hz_ELSE(hz_wide_fabs(x) <= hz_spread(hz_R(hz_TURNED)), hz_cos);
  return y;
}
#undef hz_ELSE

static inline hz_lanes hz_wide_sqrt(hz_lanes x) {
  int w;
  for (w = 0; w < hz_LANES; w++) x[w] = hz_sqrt(x[w]);
  return x;
}

static inline hz_lanes hz_wide_pow(hz_lanes x, hz_real power) {
  int w;
  for (w = 0; w < hz_LANES; w++) x[w] = hz_pow(x[w], power);
  return x;
}

#define hz_PARTS_OF(function) \
  for (; k + hz_LANES <= count; k += hz_LANES) *(hz_part *)(y + k) = hz_wide_##function(*(const hz_part *)(x + k));
#define hz_WIDE_ROW_OF(function)                                                               \
  static inline void hz_wide_##function##_row(int count, const hz_lanes *x, hz_lanes *y) {     \
    int k;                                                                                     \
    for (k = 0; k < count; k++) y[k] = hz_wide_##function(x[k]);                               \
  }
#else
#define hz_PARTS_OF(function)
#define hz_WIDE_ROW_OF(function)
#endif

/* y_k = f(x_k) for a whole row. */
#define hz_ROW_OF(function)                                                              \
  static inline void hz_##function##_row(int count, const hz_real *x, hz_real *y) {      \
    int k = 0;                                                                           \
    hz_PARTS_OF(function)                                                                \
    for (; k < count; k++) y[k] = hz_##function(x[k]);                                   \
  }                                                                                      \
  hz_WIDE_ROW_OF(function)
hz_ROW_OF(tanh)
hz_ROW_OF(sigmoid)
hz_ROW_OF(softplus)
#undef hz_ROW_OF
#undef hz_PARTS_OF
#undef hz_WIDE_ROW_OF
