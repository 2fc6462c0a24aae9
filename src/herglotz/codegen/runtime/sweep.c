/* Free runs over segments of a trajectory with their derivatives: the compiled half of `herglotz.training.kernel`.

   The code before this file depends on the model: hz_N coordinates, hz_M inputs, hz_P parameters, hz_D numbers of a
   state that the motion depends on (q, p, and s where s enters), and the functions hz_evaluate, hz_finish, hz_derive
   and, with set-valued dry friction, hz_rest, which skip statements behind gates that hz_prepare leaves closed
   (`codegen/gated.py`). */

#define hz_X (2 * hz_N + 1)
enum { hz_MAX_ITERATIONS = 60 };
/* A move of Newton's iteration below this part of the size is the last: convergence is quadratic, so that the next move
   would be rounding. */
#define hz_LAST 1e-8

/* The largest |x_i|; NaN if one is NaN. */
static inline double hz_largest(const double x[hz_N]) {
  double most = 0;
  int i;
  for (i = 0; i < hz_N; i++) most = fabs(x[i]) > most || x[i] != x[i] ? fabs(x[i]) : most;
  return most;
}

/* x = J^-1 b by elimination with row exchange; 0 where J is singular. */
static inline int hz_solve(const double J[hz_N * hz_N], const double b[hz_N], double x[hz_N]) {
  double A[hz_N][hz_N + 1];
  int i, j, k;
  for (i = 0; i < hz_N; i++) {
    for (j = 0; j < hz_N; j++) A[i][j] = J[i * hz_N + j];
    A[i][hz_N] = b[i];
  }
  for (k = 0; k < hz_N; k++) {
    int top = k;
    for (i = k + 1; i < hz_N; i++)
      if (fabs(A[i][k]) > fabs(A[top][k])) top = i;
    if (!(fabs(A[top][k]) > 0)) return 0;
    for (j = k; j <= hz_N; j++) {
      const double y = A[k][j];
      A[k][j] = A[top][j];
      A[top][j] = y;
    }
    for (i = k + 1; i < hz_N; i++) {
      const double f = A[i][k] / A[k][k];
      for (j = k; j <= hz_N; j++) A[i][j] -= f * A[k][j];
    }
  }
  for (i = hz_N - 1; i >= 0; i--) {
    x[i] = A[i][hz_N];
    for (j = i + 1; j < hz_N; j++) x[i] -= A[i][j] * x[j];
    x[i] /= A[i][i];
  }
  return 1;
}

/* The merit that a move has to lower: |F| over the diagonal of J where the iteration began, in units of q. */
static inline double hz_merit(const double F[hz_N], const double scale[hz_N]) {
  double y[hz_N];
  int i;
  for (i = 0; i < hz_N; i++) y[i] = F[i] / scale[i];
  return hz_largest(y);
}

/* The increment of a step by Newton's iteration with backtracking, from a guess. Return 1, or 0 if there is no step. */
static int hz_increment(const double x[hz_X], double h, const double *u, const double *theta, const double *constants,
                        const char *gate, const double *fixed, double delta[hz_N]) {
  double z[hz_N], F[hz_N], J[hz_N * hz_N], move[hz_N], scale[hz_N], merit;
  const double still = 1e-15 * hz_largest(x);
  int i, iteration, good = 0;
#if hz_STICKS
  double stiffness[hz_N], bound[hz_N];
  hz_rest(x, h, u, theta, constants, gate, fixed, z, stiffness, bound);
#define hz_AT(z) hz_evaluate(x, z, h, u, theta, constants, stiffness, bound, gate, fixed, F, J)
#else
  for (i = 0; i < hz_N; i++) z[i] = delta[i];
#define hz_AT(z) hz_evaluate(x, z, h, u, theta, constants, gate, fixed, F, J)
#endif
  hz_AT(z);
  for (i = 0; i < hz_N; i++) scale[i] = fabs(J[i * hz_N + i]) > 0 ? fabs(J[i * hz_N + i]) : 1;
  merit = hz_merit(F, scale);
  for (iteration = 0; iteration < hz_MAX_ITERATIONS && !good; iteration++) {
    double trial[hz_N], size, part = 1;
    if (!hz_solve(J, F, move)) return 0;
    size = hz_largest(move);
    if (!(size < 1e100)) return 0;
    if (size <= hz_LAST * hz_largest(z) + still) {
      for (i = 0; i < hz_N; i++) z[i] -= move[i];
      good = 1;
      break;
    }
    for (;; iteration++) {
      double now;
      for (i = 0; i < hz_N; i++) trial[i] = z[i] - part * move[i];
      hz_AT(trial);
      now = hz_merit(F, scale);
      if (now < merit || part * size <= still) {
        merit = now;
        break;
      }
      if (iteration >= hz_MAX_ITERATIONS) return 0;
      part /= 2;
    }
    for (i = 0; i < hz_N; i++) z[i] = trial[i];
  }
#undef hz_AT
  if (!good) return 0;
  for (i = 0; i < hz_N; i++) {
#if hz_STICKS
    delta[i] = z[i] > bound[i] ? z[i] - bound[i] : z[i] < -bound[i] ? z[i] + bound[i] : 0;
#else
    delta[i] = z[i];
#endif
  }
  return 1;
}

/* Z <- A Z + dPhi/dtheta, (D, F + D): the derivatives of the next state by the free parameters and the start.
   G becomes its columns of these parameters, (D, F). A parameter acts through F as c p0 does. */
static void hz_carry(const double *restrict A, double *restrict G, double c, long F, const long *restrict chosen,
                     double *restrict Z, double *restrict Y) {
  const long W = F + hz_D;
  double by[hz_D][hz_N];
  long a;
  int i, j;
  for (i = 0; i < hz_D; i++)
    for (j = 0; j < hz_N; j++) by[i][j] = A[i * hz_D + hz_N + j] / c;
  for (i = 0; i < hz_D; i++)
    for (a = 0; a < F; a++) Y[i * F + a] = G[i * hz_P + chosen[a]];
  memcpy(G, Y, (size_t)(hz_D * F) * sizeof(double));
  for (a = 0; a < W; a++) {
    double z[hz_D], y[hz_D];
    for (j = 0; j < hz_D; j++) z[j] = Z[j * W + a];
    for (i = 0; i < hz_D; i++) {
      y[i] = 0;
      for (j = 0; j < hz_D; j++) y[i] += A[i * hz_D + j] * z[j];
    }
    for (i = 0; i < hz_D; i++) Z[i * W + a] = y[i];
  }
  for (a = 0; a < F; a++)
    for (i = 0; i < hz_D; i++) {
      double more = i >= hz_N ? G[i * F + a] : 0;
      for (j = 0; j < hz_N; j++) more += by[i][j] * G[j * F + a];
      Z[i * W + a] += more;
    }
}

/* The residuals of a sample, r = weight (q - y), and their rows, both times the root of the robust weight. */
static void hz_observe(const double *x, const double *Z, long W, const double *y, const double *weight, double freedom,
                       double *r, double *rows) {
  int i;
  for (i = 0; i < hz_N; i++) {
    const double miss = weight[i] * (x[i] - y[i]);
    const double root = freedom > 0 ? sqrt((freedom + 1) / (freedom + miss * miss)) : 1;
    r[i] = root * miss;
    if (rows) {
      const double by = root * weight[i], *z = Z + i * W;
      double *row = rows + i * W;
      long a;
      for (a = 0; a < W; a++) row[a] = by * z[a];
    }
  }
}

/* Free runs over S segments; the first model step of each is begin[s]. Return -1, or the segment that has no step.

   x (S, X): the start of each segment, then its end.  delta (S, N): a guess of its first increment, then its last
   increment.  sample[k]: the sample at the end of model step k, or -1; first[s]: the sample at the start.
   states: (X,) at every node; the nodes of segment s start at place[s].
   Z (S, D, W), W = F + D: derivatives of x by the free parameters `chosen` and the start; NULL: no derivatives.
   r (N, n), rows (N, n, W) of the samples from `offset` on;  B (S, D, F), T (S, D, D), g (S, D): the products of the
   columns by the start with those by parameters and by the start, and with the residuals, summed over a segment. */
long hz_sweep(long S, const long *begin, const double *h, const double *u, const double *theta, const double *constants,
              long F, const long *chosen, const long *sample, const long *first, const double *y, const double *weight,
              double freedom, long offset, const long *place, double *x, double *delta, double *states, double *Z,
              double *r, double *rows, double *B, double *T, double *g) {
  const long W = F + hz_D;
  double *const Y = Z ? (double *)malloc((size_t)(hz_D * W) * sizeof(double)) : 0;
  long s, k, at, failed = -1;
  int i, j;
  char on[hz_P], gate[hz_GATES];
  double fixed[hz_FIXED];
  if (Z && !Y) return 0;
  for (i = 0; i < hz_P; i++) on[i] = theta[i] != 0;
  for (k = 0; k < F; k++) on[chosen[k]] = 1;
  hz_prepare(theta, constants, on, gate, fixed);
  for (s = 0; s < S && failed < 0; s++) {
    double *const here = x + s * hz_X, *const own = delta + s * hz_N, *const D = Z ? Z + s * hz_D * W : 0;
    double before = begin[s] < begin[s + 1] ? h[begin[s]] : 1;
    /* The start, then the end of every step. */
    for (k = begin[s] - 1; k < begin[s + 1]; k++) {
      if (k >= begin[s]) {
        const double *const input = hz_M ? u + k * hz_M : 0;
        double end[hz_N + 1], A[hz_D * hz_D], G[hz_D * hz_P], c;
        for (i = 0; i < hz_N; i++) own[i] *= h[k] / before;
        before = h[k];
        if (!hz_increment(here, h[k], input, theta, constants, gate, fixed, own)) {
          failed = s;
          break;
        }
        if (D) {
          hz_derive(here, own, h[k], input, theta, constants, gate, fixed, end, A, &c, G);
          hz_carry(A, G, c, F, chosen, D, Y);
        } else {
          hz_finish(here, own, h[k], input, theta, constants, gate, fixed, end);
        }
        for (i = 0; i < hz_N; i++) {
          here[i] += own[i];
          here[hz_N + i] = end[i];
        }
        here[2 * hz_N] += end[hz_N];
        if (!(hz_largest(here) < 1e100)) {
          failed = s;
          break;
        }
      }
      for (i = 0; i < hz_X; i++) states[(place[s] + k + 1 - begin[s]) * hz_X + i] = here[i];
      at = k < begin[s] ? first[s] : sample[k];
      if (at < 0) continue;
      if (D) {
        double *const row = rows + (at - offset) * hz_N * W;
        hz_observe(here, D, W, y + at * hz_N, weight + at * hz_N, freedom, r + at * hz_N, row);
        for (i = 0; i < hz_N; i++) {
          const double *const by = row + i * W + F;
          for (j = 0; j < hz_D; j++) {
            double *const b = B + (s * hz_D + j) * F, *const t = T + (s * hz_D + j) * hz_D, w = by[j];
            long a;
            for (a = 0; a < F; a++) b[a] += w * row[i * W + a];
            for (a = 0; a < hz_D; a++) t[a] += w * by[a];
            g[s * hz_D + j] += w * r[at * hz_N + i];
          }
        }
      }
    }
  }
  free(Y);
  return failed;
}
