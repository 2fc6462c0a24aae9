/* A symmetric positive definite block tridiagonal system of S blocks (d, d), with R right hand sides.

   diagonal (S, d, d); upper (S, d, d): the block to the right of each, 0 at the end of a trajectory; x (S, d, R): the
   right hand sides, then the solutions; work (S, d, d). Return -1, or the block that is not positive definite. */
long hz_eliminate(long S, long d, long R, const double *diagonal, const double *upper, double *x, double *work) {
  double *const pivot = (double *)malloc((size_t)(d * d) * sizeof(double));
  long s, i, j, k, a, bad = -1;
  if (!pivot) return 0;
  for (s = 0; s < S; s++) {
    double *const right = work + s * d * d, *const own = x + s * d * R;
    for (i = 0; i < d * d; i++) {
      pivot[i] = diagonal[s * d * d + i];
      right[i] = upper[s * d * d + i];
    }
    /* Eliminate the block to the left. */
    if (s > 0) {
      const double *const U = upper + (s - 1) * d * d, *const W = work + (s - 1) * d * d, *const last = x + (s - 1) * d * R;
      for (k = 0; k < d; k++)
        for (i = 0; i < d; i++) {
          const double by = U[k * d + i];
          if (by == 0) continue;
          for (j = 0; j < d; j++) pivot[i * d + j] -= by * W[k * d + j];
          for (a = 0; a < R; a++) own[i * R + a] -= by * last[k * R + a];
        }
    }
    /* Cholesky: the factor in the lower half. */
    for (j = 0; j < d && bad < 0; j++) {
      double y = pivot[j * d + j];
      for (k = 0; k < j; k++) y -= pivot[j * d + k] * pivot[j * d + k];
      if (!(y > 0)) bad = s;
      pivot[j * d + j] = sqrt(y);
      for (i = j + 1; i < d; i++) {
        y = pivot[i * d + j];
        for (k = 0; k < j; k++) y -= pivot[i * d + k] * pivot[j * d + k];
        pivot[i * d + j] = y / pivot[j * d + j];
      }
    }
    if (bad >= 0) break;
    for (i = 0; i < d; i++) {
      for (k = 0; k < i; k++) {
        const double by = pivot[i * d + k];
        for (a = 0; a < d; a++) right[i * d + a] -= by * right[k * d + a];
        for (a = 0; a < R; a++) own[i * R + a] -= by * own[k * R + a];
      }
      for (a = 0; a < d; a++) right[i * d + a] /= pivot[i * d + i];
      for (a = 0; a < R; a++) own[i * R + a] /= pivot[i * d + i];
    }
    for (i = d - 1; i >= 0; i--) {
      for (k = i + 1; k < d; k++) {
        const double by = pivot[k * d + i];
        for (a = 0; a < d; a++) right[i * d + a] -= by * right[k * d + a];
        for (a = 0; a < R; a++) own[i * R + a] -= by * own[k * R + a];
      }
      for (a = 0; a < d; a++) right[i * d + a] /= pivot[i * d + i];
      for (a = 0; a < R; a++) own[i * R + a] /= pivot[i * d + i];
    }
  }
  for (s = S - 2; s >= 0 && bad < 0; s--)
    for (i = 0; i < d; i++)
      for (k = 0; k < d; k++) {
        const double by = work[(s * d + i) * d + k];
        if (by == 0) continue;
        for (a = 0; a < R; a++) x[(s * d + i) * R + a] -= by * x[((s + 1) * d + k) * R + a];
      }
  free(pivot);
  return bad;
}
