/* Numbers and registers of numbers: the series of elementary functions, and what differs between the two. */

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

static inline hz_real hz_choose(hz_real a, hz_real b, hz_real x, hz_real y) { return a > b ? x : y; }

/* Whether x <= limit is false, as of NaN. */
static inline int hz_above(hz_real x, hz_real limit) { return !(x <= limit); }

/* The nearest whole number, 0 of NaN, which an integer holds; 2^k. */
typedef int hz_count;
static inline hz_real hz_whole(hz_real x, hz_count *k) {
  x = x == x ? x : hz_R(0.0);
  *k = (int)(x + (x < hz_R(0.0) ? hz_R(-0.5) : hz_R(0.5)));
  return (hz_real)*k;
}

static inline hz_real hz_power(hz_count k) {
  hz_pun two;
  two.bits = (hz_bits_t)(k + hz_BIAS) << hz_MANTISSA;
  return two.number;
}

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
typedef int hz_wide_count __attribute__((vector_size(hz_LANE_BYTES / sizeof(hz_real) * sizeof(int))));
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

static inline hz_lanes hz_wide_fabs(hz_lanes x) { return hz_select((hz_masks)(x < hz_spread(hz_R(0.0))), -x, x); }

/* Of any number: one sum without branches, because GCC makes a tree of a branch for each lane. */
static inline int hz_wide_above(hz_lanes x, hz_real limit) {
  const hz_masks where = ~(hz_masks)(x <= hz_spread(limit));
  hz_signed_t any = 0;
  int w;
  for (w = 0; w < hz_LANES; w++) any |= where[w];
  return any != 0;
}

static inline hz_lanes hz_wide_whole(hz_lanes x, hz_wide_count *k) {
  const hz_lanes zero = hz_spread(hz_R(0.0)), half = hz_spread(hz_R(0.5));
  x = hz_select((hz_masks)(x == x), x, zero);
  *k = __builtin_convertvector(x + hz_select((hz_masks)(x < zero), -half, half), hz_wide_count);
  return __builtin_convertvector(*k, hz_lanes);
}

static inline hz_lanes hz_wide_power(hz_wide_count k) {
  return (hz_lanes)(__builtin_convertvector(k + hz_BIAS, hz_masks) << hz_MANTISSA);
}
#endif
