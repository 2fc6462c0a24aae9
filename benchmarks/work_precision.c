/* The methods that a learned stepper is compared with, in C: RK4 and DOP853 on q'' = f(q, v), with f of the true
   equations or a neural network. Compiled by work_precision.py with -DSYSTEM=... -DDOF=... -DWIDTH=...; `dop853_step.h`
   is generated there from the coefficients in scipy. `stepper.h` is the header of a learned stepper: it lends its
   layers, so that both networks run at the same speed. */
#include "stepper.h"
#include <tgmath.h>
#include <string.h>

#define N DOF
#define D (2 * N)
typedef herglotz_stepper_real real;

#if SYSTEM == 0 /* damped pendulum */
static inline void force(const real *y, real *a) { a[0] = -sin(y[0]) - (real)0.2 * y[1]; }
#elif SYSTEM == 1 /* double pendulum: M a = f; from p' = L_q - gamma p */
static inline void force(const real *y, real *a) {
  const real g = 9.81, gamma = 0.1, c = cos(y[0] - y[1]), s = sin(y[0] - y[1]);
  const real f0 = -s * y[3] * y[3] - 2 * g * sin(y[0]), f1 = s * y[2] * y[2] - g * sin(y[1]), det = 2 - c * c;
  a[0] = (f0 - c * f1) / det - gamma * y[2];
  a[1] = (2 * f1 - c * f0) / det - gamma * y[3];
}
#else /* a network: (sin q, cos q, v) -> tanh -> tanh -> a */
#define IN (3 * N)
static real W0[IN][WIDTH], b0[WIDTH], W1[WIDTH][WIDTH], b1[WIDTH], W2[N][WIDTH];
static real T0[WIDTH][IN], T1[WIDTH][WIDTH], T2[WIDTH][N]; /* transposes, for the product of the header */

void set_weights(const double *w) {
  int i, j;
  for (i = 0; i < IN; i++) for (j = 0; j < WIDTH; j++) W0[i][j] = (real)*w++;
  for (j = 0; j < WIDTH; j++) b0[j] = (real)*w++;
  for (i = 0; i < WIDTH; i++) for (j = 0; j < WIDTH; j++) W1[i][j] = (real)*w++;
  for (j = 0; j < WIDTH; j++) b1[j] = (real)*w++;
  for (i = 0; i < N; i++) for (j = 0; j < WIDTH; j++) W2[i][j] = (real)*w++;
  for (j = 0; j < WIDTH; j++) {
    for (i = 0; i < IN; i++) T0[j][i] = W0[i][j];
    for (i = 0; i < WIDTH; i++) T1[j][i] = W1[i][j];
    for (i = 0; i < N; i++) T2[j][i] = W2[i][j];
  }
}

static inline void force(const real *y, real *a) {
  real x[IN], u[WIDTH], v[WIDTH], slope[WIDTH];
  int i;
  for (i = 0; i < N; i++) {
    x[i] = sin(y[i]);
    x[N + i] = cos(y[i]);
    x[2 * N + i] = y[N + i];
    a[i] = 0;
  }
  memcpy(u, b0, sizeof u);
  herglotz_stepper_product(IN, WIDTH, W0[0], T0[0], x, u);
  herglotz_stepper_activate_tanh(WIDTH, u, slope, 0);
  memcpy(v, b1, sizeof v);
  herglotz_stepper_product(WIDTH, WIDTH, W1[0], T1[0], u, v);
  herglotz_stepper_activate_tanh(WIDTH, v, slope, 0);
  herglotz_stepper_product(WIDTH, N, T2[0], W2[0], v, a);
}
#endif

static long evaluations;

static inline void rhs(const real *y, real *f) {
  int i;
  for (i = 0; i < N; i++) f[i] = y[N + i];
  force(y, f + N);
  evaluations++;
}

static void rk4(real *y, real h, long steps) {
  real k1[D], k2[D], k3[D], k4[D], z[D];
  int d;
  while (steps--) {
    rhs(y, k1);
    for (d = 0; d < D; d++) z[d] = y[d] + h / 2 * k1[d];
    rhs(z, k2);
    for (d = 0; d < D; d++) z[d] = y[d] + h / 2 * k2[d];
    rhs(z, k3);
    for (d = 0; d < D; d++) z[d] = y[d] + h * k3[d];
    rhs(z, k4);
    for (d = 0; d < D; d++) y[d] += h / 6 * (k1[d] + 2 * (k2[d] + k3[d]) + k4[d]);
  }
}

#include "dop853_step.h" /* real attempt(y, f, h, tol, y_new, f_new): the error over the tolerance */

static real dop853(real *y, real T, real tol, real h) {
  real f[D], y_new[D], f_new[D], t = 0;
  rhs(y, f);
  while (t < T * (1 - (real)1e-12)) {
    const int last = h >= T - t;
    const real used = last ? T - t : h, error = attempt(y, f, used, tol, y_new, f_new);
    real factor = error > 0 ? (real)0.9 * (real)pow(error, -0.125) : 10;
    if (!(error < 1)) {
      h = used * (factor > (real)0.2 ? factor : (real)0.2);
      continue;
    }
    t += used;
    memcpy(y, y_new, sizeof y_new);
    memcpy(f, f_new, sizeof f_new);
    factor = factor > 10 ? 10 : factor;
    if (!last || used * factor < h) h = used * factor;
  }
  return h;
}

/* `samples` motions of `segments` segments of length dt each; out is (samples, segments, 2N). adaptive: x is the
   tolerance; else x is the number of RK4 steps in a segment. Returns the evaluations of f. */
long motions(long samples, long segments, double dt, int adaptive, double x, const double *start, double *out) {
  long b, k;
  int d;
  evaluations = 0;
  for (b = 0; b < samples; b++) {
    real y[D], h = (real)0.1;
    for (d = 0; d < D; d++) y[d] = (real)start[b * D + d];
    for (k = 0; k < segments; k++) {
      if (adaptive) h = dop853(y, (real)dt, (real)x, h);
      else rk4(y, (real)(dt / x), (long)x);
      for (d = 0; d < D; d++) out[(b * segments + k) * D + d] = y[d];
    }
  }
  return evaluations;
}
