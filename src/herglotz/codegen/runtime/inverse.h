/* The inverse X of a matrix A (n, n), n <= hz_N, by elimination with exchanged rows; not finite where A has no
   inverse. */
static inline void FN_inverse(int n, const REAL *A, REAL *X) {
  REAL rows[hz_N][2 * hz_N], pivot;
  int i, j, k, best;
  for (i = 0; i < n; i++)
    for (j = 0; j < n; j++) {
      rows[i][j] = A[i * n + j];
      rows[i][n + j] = i == j ? R(1.0) : R(0.0);
    }
  for (k = 0; k < n; k++) {
    for (best = k, i = k + 1; i < n; i++)
      if (FN_fabs(rows[i][k]) > FN_fabs(rows[best][k])) best = i;
    pivot = rows[best][k];
    for (j = 0; j < 2 * n; j++) {
      const REAL other = rows[best][j] / pivot;
      rows[best][j] = rows[k][j];
      rows[k][j] = other;
    }
    for (i = 0; i < n; i++) {
      const REAL factor = rows[i][k];
      if (i != k)
        for (j = 0; j < 2 * n; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  for (i = 0; i < n; i++)
    for (j = 0; j < n; j++) X[i * n + j] = rows[i][n + j];
}
