/* Elementary functions without branches, which compilers vectorise, for a number and for a register; those of <math.h>
   where a formula does not hold. */

static inline REAL FN_cut(REAL x, hz_real limit) {
  const REAL most = SPREAD(limit);
  x = FN_choose(x, most, most, x);
  return FN_choose(-most, x, -most, x);
}

/* exp(r) - 1 and 2^k where y = k ln 2 + r with |r| <= ln(2)/2, for |y| <= hz_FAR: a few units in the last place, without
   branches or calls. Needs IEEE 754 numbers. NaN gives NaN. */
static inline REAL FN_reduced(REAL y, REAL *power) {
  FN_count k;
  const REAL whole = FN_whole(y * hz_R(1.44269504088896340736), &k);
  const REAL r = (y - whole * hz_R(hz_LN2_HIGH)) - whole * hz_R(hz_LN2_LOW);
  *power = FN_power(k);
  return r + r * r * hz_EXP_TERMS(r);
}

/* exp(y) - 1 for |y| cut off at hz_LIMIT. */
static inline REAL FN_growth(REAL y) {
  REAL two;
  const REAL e = FN_reduced(FN_cut(y, hz_R(hz_LIMIT)), &two);
  return two * e + (two - hz_R(1.0));
}

static inline REAL FN_expm1(REAL x) {
  const REAL size = FN_fabs(x);
  REAL y = FN_growth(x);
  int w;
  for (w = 0; w < FN_WIDTH && FN_above(size, hz_R(hz_LIMIT)); w++)
    if (hz_above(FN_LANE(size, w), hz_R(hz_LIMIT))) FN_LANE(y, w) = hz_expm1_of(FN_LANE(x, w));
  return y;
}

static inline REAL FN_exp(REAL x) {
  const REAL size = FN_fabs(x);
  REAL two, y = FN_reduced(FN_cut(x, hz_R(hz_FAR)), &two);
  int w;
  y = two * y + two;
  for (w = 0; w < FN_WIDTH && FN_above(size, hz_R(hz_FAR)); w++)
    if (hz_above(FN_LANE(size, w), hz_R(hz_FAR))) FN_LANE(y, w) = hz_exp_of(FN_LANE(x, w));
  return y;
}

static inline REAL FN_tanh(REAL x) {
  const REAL e = FN_growth(hz_R(2.0) * x);
  return e / (e + hz_R(2.0));
}

static inline REAL FN_sigmoid(REAL x) { return hz_R(0.5) + hz_R(0.5) * FN_tanh(hz_R(0.5) * x); }

/* log(1 + e^x), by log(1 + y) = 2 artanh(y / (2 + y)) with y = e^-|x|. */
static inline REAL FN_softplus(REAL x) {
  const REAL y = hz_R(1.0) + FN_growth(-FN_fabs(x)), r = y / (hz_R(2.0) + y), z = r * r, zero = SPREAD(hz_R(0.0));
  return FN_choose(x, zero, x, zero) + hz_R(2.0) * r * hz_ARTANH_TERMS(z);
}

/* artanh(x), by its series where |x| <= 1/3. */
static inline REAL FN_atanh(REAL x) {
  const REAL z = x * x;
  REAL y = x * hz_ARTANH_TERMS(z);
  int w;
  for (w = 0; w < FN_WIDTH && FN_above(z, hz_R(0.1111111111111111)); w++)
    if (hz_above(FN_LANE(z, w), hz_R(0.1111111111111111))) FN_LANE(y, w) = hz_atanh_of(FN_LANE(x, w));
  return y;
}
