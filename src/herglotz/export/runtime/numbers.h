/* Numbers: finite or not by their bits, the largest of a few, sums that keep what rounding takes. */

#if hz_SINGLE
typedef unsigned int hz_bits_t;
#define hz_EXPONENT 0x7f800000u
#define hz_QUIET 0x7fc00000u
#define hz_TINY 1e-35
#else
typedef unsigned long long hz_bits_t;
#define hz_EXPONENT 0x7ff0000000000000ull
#define hz_QUIET 0x7ff8000000000000ull
#define hz_TINY 1e-290
#endif
#define hz_R(x) ((hz_real)(x)) /* a constant of the number type */

/* Inspected as integers: under -ffast-math compilers delete x != x. `volatile` hides that x came from arithmetic that
   they may assume to be finite. */
#if (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0) || defined(_M_FP_FAST)
#define hz_HIDDEN volatile
#else
#define hz_HIDDEN
#endif

typedef union {
  hz_real number;
  hz_bits_t bits;
} hz_pun;

static inline int hz_finite(hz_real x) {
  hz_HIDDEN hz_pun pun;
  pun.number = x;
  return (pun.bits & hz_EXPONENT) != hz_EXPONENT;
}

static inline hz_real hz_nan(void) {
  hz_HIDDEN hz_pun pun;
  pun.bits = hz_QUIET;
  return pun.number;
}

static inline int hz_all_finite(const hz_real x[hz_N]) {
  int i, good = 1;
  for (i = 0; i < hz_N; i++) good &= hz_finite(x[i]);
  return good;
}

/* The largest |x_i|. */
static inline hz_real hz_length(const hz_real x[hz_N]) {
  hz_real size = hz_R(0.0);
  int i;
  for (i = 0; i < hz_N; i++) size = hz_fabs(x[i]) > size ? hz_fabs(x[i]) : size;
  return size;
}

/* Zero where a number is so small that its square and its products are not normal numbers any more: a motion that has
   come to rest would otherwise step many times slower. */
static inline hz_real hz_flush(hz_real x) { return hz_fabs(x) < hz_R(hz_TINY) ? hz_R(0.0) : x; }

/* x + change, with what its rounding loses kept in `low` for the next time. */
static inline hz_real hz_add(hz_real x, hz_real change, hz_real *low) {
  const hz_real add = change + *low, sum = x + add, back = sum - x;
  *low = (x - (sum - back)) + (add - back);
  return hz_flush(sum);
}
