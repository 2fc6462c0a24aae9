/* Sines and cosines of registers; functions, products and sums of rows. */

#ifdef hz_LANE_BYTES
/* The nearest whole number. Numbers beyond the integers of the processor are cut off: as angles they have no digits
   left. */
static inline hz_lanes hz_wide_nearest(hz_lanes x) {
  const hz_lanes zero = hz_spread(hz_R(0.0)), half = hz_spread(hz_R(0.5));
  x = hz_wide_cut(hz_select((hz_masks)(x == x), x, zero), hz_R(hz_SINGLE ? 1e9 : 1e18));
  return __builtin_convertvector(__builtin_convertvector(x + hz_select((hz_masks)(x < zero), -half, half), hz_masks), hz_lanes);
}

/* sin(x + quarters pi / 2) where |x| <= hz_TURNED: x = k pi / 2 + r with |r| <= pi / 4, about a unit in the last place. */
static inline hz_lanes hz_wide_wave(hz_lanes x, int quarters) {
  hz_wide_count k;
  const hz_lanes whole = hz_wide_whole(hz_wide_cut(x, hz_R(hz_TURNED)) * hz_R(0.63661977236758134308), &k);
  hz_lanes r, z, y;
  hz_masks turns;
  r = (x - whole * hz_R(hz_QUARTER_1)) - whole * hz_R(hz_QUARTER_2);
  r = (r - whole * hz_R(hz_QUARTER_3)) - whole * hz_R(hz_QUARTER_4);
  z = r * r;
  turns = __builtin_convertvector(k + quarters, hz_masks);
  y = hz_select((hz_masks)((turns & 1) != 0), hz_R(1.0) - (hz_R(0.5) * z - z * z * hz_COS_TERMS(z)),
      r + r * z * hz_SIN_TERMS(z));
  return hz_select((hz_masks)((turns & 2) != 0), -y, y);
}

static inline hz_lanes hz_wide_sin(hz_lanes x) {
  const hz_lanes size = hz_wide_fabs(x);
  hz_lanes y = hz_wide_wave(x, 0);
  int w;
  for (w = 0; w < hz_wide_WIDTH && hz_wide_above(size, hz_R(hz_TURNED)); w++)
    if (hz_above(hz_wide_LANE(size, w), hz_R(hz_TURNED))) hz_wide_LANE(y, w) = hz_sin(hz_wide_LANE(x, w));
  return y;
}

static inline hz_lanes hz_wide_cos(hz_lanes x) {
  const hz_lanes size = hz_wide_fabs(x);
  hz_lanes y = hz_wide_wave(x, 1);
  int w;
  for (w = 0; w < hz_wide_WIDTH && hz_wide_above(size, hz_R(hz_TURNED)); w++)
    if (hz_above(hz_wide_LANE(size, w), hz_R(hz_TURNED))) hz_wide_LANE(y, w) = hz_cos(hz_wide_LANE(x, w));
  return y;
}

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

/* y_k += sum_j w_jk x_j, where w is (inputs, outputs) and t its transpose. Long rows of outputs are summed side by
   side, without sums across lanes; a few outputs of many inputs are dot products. Vector types
   keep sums in registers: without them some compilers vectorise the wrong loop and lose a factor of ten. */
static inline void hz_product(int inputs, int outputs, const hz_real *w, const hz_real *t, const hz_real *x,
    hz_real *hz_RESTRICT y) {
  int j, k = 0;
#ifdef hz_LANE_BYTES
  enum { L = hz_LANES };
  const hz_lanes zero = hz_spread(hz_R(0.0));
  int i, half;
  for (; k + 4 * L <= outputs; k += 4 * L) {
    hz_part *to = (hz_part *)(y + k);
    hz_lanes even[4], odd[4];
    for (i = 0; i < 4; i++) {
      even[i] = to[i];
      odd[i] = zero;
    }
    for (j = 0; j + 2 <= inputs; j += 2) {
      const hz_part *from = (const hz_part *)(w + j * outputs + k);
      const hz_part *next = (const hz_part *)(w + (j + 1) * outputs + k);
      for (i = 0; i < 4; i++) {
        even[i] += from[i] * x[j];
        odd[i] += next[i] * x[j + 1];
      }
    }
    for (i = 0; j < inputs && i < 4; i++) even[i] += ((const hz_part *)(w + j * outputs + k))[i] * x[j];
    for (i = 0; i < 4; i++) to[i] = even[i] + odd[i];
  }
  for (; k + L <= outputs; k += L) {
    hz_part *to = (hz_part *)(y + k);
    hz_lanes sum[4] = {to[0], zero, zero, zero};
    const hz_real *from = w + k;
    for (j = 0; j + 4 <= inputs; j += 4, from += 4 * outputs)
      for (i = 0; i < 4; i++) sum[i] += *(const hz_part *)(from + i * outputs) * x[j + i];
    for (; j < inputs; j++, from += outputs) sum[0] += *(const hz_part *)from * x[j];
    to[0] = (sum[0] + sum[1]) + (sum[2] + sum[3]);
  }
  if (inputs >= L) {
    const hz_real *row = t + k * inputs;
    for (; k < outputs; k++, row += inputs) {
      hz_lanes sum = zero;
      for (j = 0; j + L <= inputs; j += L) sum += *(const hz_part *)(row + j) * *(const hz_part *)(x + j);
      for (half = L / 2; half > 0; half /= 2)
        for (i = 0; i < half; i++) sum[i] += sum[i + half];
      for (; j < inputs; j++) sum[0] += row[j] * x[j];
      y[k] += sum[0];
    }
  }
#endif
  (void)t;
  for (; k < outputs; k++) {
    hz_real sum = y[k];
    for (j = 0; j < inputs; j++) sum += w[j * outputs + k] * x[j];
    y[k] = sum;
  }
}

/* x_0 + x_1 + ... */
static inline hz_real hz_sum(int count, const hz_real *x) {
  hz_real sum = hz_R(0.0);
  int k = 0;
#ifdef hz_LANE_BYTES
  hz_lanes part = hz_spread(hz_R(0.0));
  int half, i;
  for (; k + hz_LANES <= count; k += hz_LANES) part += *(const hz_part *)(x + k);
  for (half = hz_LANES / 2; half > 0; half /= 2)
    for (i = 0; i < half; i++) part[i] += part[i + half];
  sum = part[0];
#endif
  for (; k < count; k++) sum += x[k];
  return sum;
}

#if defined(hz_LANE_BYTES) && hz_WIDE
/* hz_product for a register of samples, eight sums at a time. */
static inline void hz_wide_product(int inputs, int outputs, const hz_real *w, const hz_real *t, const hz_lanes *x,
    hz_lanes *hz_RESTRICT y) {
  int i, j, k = 0;
  (void)t;
  for (; k + 8 <= outputs; k += 8) {
    hz_lanes sum[8];
    for (i = 0; i < 8; i++) sum[i] = y[k + i];
    for (j = 0; j < inputs; j++)
      for (i = 0; i < 8; i++) sum[i] += w[j * outputs + k + i] * x[j];
    for (i = 0; i < 8; i++) y[k + i] = sum[i];
  }
  for (; k < outputs; k++) {
    hz_lanes sum = y[k];
    for (j = 0; j < inputs; j++) sum += w[j * outputs + k] * x[j];
    y[k] = sum;
  }
}

static inline hz_lanes hz_wide_sum(int count, const hz_lanes *x) {
  hz_lanes sum = hz_spread(hz_R(0.0));
  int k;
  for (k = 0; k < count; k++) sum += x[k];
  return sum;
}

static inline void hz_wide_inverse(int n, const hz_lanes *A, hz_lanes *X) {
  int i, w;
  for (w = 0; w < hz_LANES; w++) {
    hz_real one[hz_N * hz_N], other[hz_N * hz_N];
    for (i = 0; i < n * n; i++) one[i] = A[i][w];
    hz_inverse(n, one, other);
    for (i = 0; i < n * n; i++) X[i][w] = other[i];
  }
}
#endif
