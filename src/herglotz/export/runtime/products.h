/* Matrix products and sums of long rows. */

/* y_k += sum_j w_jk x_j, where w is (inputs, outputs) and t its transpose. Long rows of outputs are summed side by
   side, without sums across lanes; a few outputs of many inputs are dot products. Vector types
   keep sums in registers: without them some compilers vectorise the wrong loop and lose a factor of ten. */
static inline void hz_product(int inputs, int outputs, const hz_real *w, const hz_real *t, const hz_real *x,
    hz_real *hz_RESTRICT y) {
  int j, k = 0;
#ifdef hz_LANE_BYTES
  enum { L = hz_LANES };
  for (; k + 4 * L <= outputs; k += 4 * L) {
    hz_part *to = (hz_part *)(y + k);
    hz_lanes a = to[0], b = to[1], c = to[2], d = to[3];
    hz_lanes e = hz_spread(hz_R(0.0)), f = e, g = e, o = e;
    for (j = 0; j + 2 <= inputs; j += 2) {
      const hz_part *from = (const hz_part *)(w + j * outputs + k);
      const hz_part *next = (const hz_part *)(w + (j + 1) * outputs + k);
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
      const hz_part *from = (const hz_part *)(w + j * outputs + k);
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
    hz_part *to = (hz_part *)(y + k);
    hz_lanes a = to[0], b = hz_spread(hz_R(0.0)), c = b, d = b;
    const hz_real *from = w + k;
    for (j = 0; j + 4 <= inputs; j += 4, from += 4 * outputs) {
      a += *(const hz_part *)from * x[j];
      b += *(const hz_part *)(from + outputs) * x[j + 1];
      c += *(const hz_part *)(from + 2 * outputs) * x[j + 2];
      d += *(const hz_part *)(from + 3 * outputs) * x[j + 3];
    }
    for (; j < inputs; j++, from += outputs) a += *(const hz_part *)from * x[j];
    to[0] = (a + b) + (c + d);
  }
  if (inputs >= L) {
    const hz_real *row = t + k * inputs;
    for (; k < outputs; k++, row += inputs) {
      hz_lanes sum = hz_spread(hz_R(0.0));
      int half, i;
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

/* The inverse X of a matrix A (n, n), n <= hz_N, by elimination with exchanged rows; not finite where A has no
   inverse. */
static inline void hz_inverse(int n, const hz_real *A, hz_real *X) {
  hz_real rows[hz_N][2 * hz_N], pivot;
  int i, j, k, best;
  for (i = 0; i < n; i++)
    for (j = 0; j < n; j++) {
      rows[i][j] = A[i * n + j];
      rows[i][n + j] = i == j ? hz_R(1.0) : hz_R(0.0);
    }
  for (k = 0; k < n; k++) {
    for (best = k, i = k + 1; i < n; i++)
      if (hz_fabs(rows[i][k]) > hz_fabs(rows[best][k])) best = i;
    pivot = rows[best][k];
    for (j = 0; j < 2 * n; j++) {
      const hz_real other = rows[best][j] / pivot;
      rows[best][j] = rows[k][j];
      rows[k][j] = other;
    }
    for (i = 0; i < n; i++) {
      const hz_real factor = rows[i][k];
      if (i != k)
        for (j = 0; j < 2 * n; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  for (i = 0; i < n; i++)
    for (j = 0; j < n; j++) X[i * n + j] = rows[i][n + j];
}

#if defined(hz_LANE_BYTES) && hz_WIDE
/* hz_product for a register of samples, eight sums at a time. */
static inline void hz_wide_product(int inputs, int outputs, const hz_real *w, const hz_real *t, const hz_lanes *x,
    hz_lanes *hz_RESTRICT y) {
  int j, k = 0;
  (void)t;
  for (; k + 8 <= outputs; k += 8) {
    hz_lanes a = y[k], b = y[k + 1], c = y[k + 2], d = y[k + 3];
    hz_lanes e = y[k + 4], f = y[k + 5], g = y[k + 6], o = y[k + 7];
    for (j = 0; j < inputs; j++) {
      const hz_real *from = w + j * outputs + k;
      const hz_lanes v = x[j];
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
