/* The number type, and tests of bits for numbers that are not finite. */

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

/* Bits, because compilers delete x != x under -ffast-math. `volatile` hides that x is a result of arithmetic, which
   compilers may assume to be finite. */
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

/* Functions named hz_ work on one sample, functions named hz_wide_ on a register of samples. */
#define hz_LANE(x, w) (x)
enum { hz_WIDTH = 1 };
