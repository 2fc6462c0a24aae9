/* What a learned stepper is compared with, in C: RK4, DOP853 and leapfrog on y' = f(y), with f of the
   true equations or a neural network. Compiled by work_precision_rivals.py with -DSYSTEM=... -DDOF=... -Dreal=...;
   `dop853_step.h` is generated there from the coefficients in scipy. y is (q, v). */
#include <math.h>
#include <string.h>
#include <tgmath.h>

#define N DOF
#define D (2 * N)

static long evaluations; /* of f, or of the force */

#if FAST_SINE
/* Polynomials of the angle less whole turns, to about 1e-9. */
static inline void sine_cosine(real q, real *s, real *c) {
  const real turns = rint(q * (real)0.3183098861837907), r = q - turns * (real)3.141592653589793, r2 = r * r;
  const real sign = 1 - 2 * (turns - 2 * floor((real)0.5 * turns)), r4 = r2 * r2;
  *s = sign * r * (((real)SIN0 + r2 * (real)SIN1) + r4 * (((real)SIN2 + r2 * (real)SIN3) + r4 * ((real)SIN4 + r2 * (real)SIN5)));
  *c = sign * (((real)COS0 + r2 * (real)COS1) + r4 * (((real)COS2 + r2 * (real)COS3) + r4 * ((real)COS4 + r2 * (real)COS5)));
}
#else
static inline void sine_cosine(real q, real *s, real *c) {
  *s = sin(q);
  *c = cos(q);
}
#endif

#if SYSTEM == 0 /* pendulum */
#define GAMMA (real)0.2
#define SEPARABLE 1
static inline void pull(const real *q, real *a) {
  real c;
  sine_cosine(q[0], a, &c);
  a[0] = -a[0];
}
#endif

#if SYSTEM == 1 /* double pendulum: M a = f, from p' = L_q - gamma p; the constants are the true ones, or learned */
#ifndef M00
#define M00 2.0 /* K = (M00 v0^2 + 2 (M01 + MC cos(q0 - q1)) v0 v1 + M11 v1^2)/2, V = -G0 cos q0 - G1 cos q1 */
#define M01 0.0
#define MC 1.0
#define M11 1.0
#define G0 19.62
#define G1 9.81
#define RATE 0.1
#endif
static inline void slope(const real *y, real *f) {
  real s0, c0, s1, c1, m, s, f0, f1, det;
  sine_cosine(y[0], &s0, &c0);
  sine_cosine(y[1], &s1, &c1);
  s = (real)MC * (s0 * c1 - c0 * s1);
  m = (real)M01 + (real)MC * (c0 * c1 + s0 * s1);
  f0 = -s * y[3] * y[3] - (real)G0 * s0;
  f1 = s * y[2] * y[2] - (real)G1 * s1;
  det = 1 / ((real)(M00 * M11) - m * m);
  f[0] = y[2];
  f[1] = y[3];
  f[2] = ((real)M11 * f0 - m * f1) * det - (real)RATE * y[2];
  f[3] = ((real)M00 * f1 - m * f0) * det - (real)RATE * y[3];
}
#elif SYSTEM == 2 /* a network: (sin q, cos q, v) -> tanh -> ... -> a */
#define WIDTHS (LAYERS == 2 ? WIDTH : 1)
static real W0[IN][WIDTH], b0[WIDTH], W1[WIDTHS][WIDTH], b1[WIDTH], W2[N][WIDTH];

void set_weights(const double *w) {
  int i, j;
  for (i = 0; i < IN; i++) for (j = 0; j < WIDTH; j++) W0[i][j] = (real)*w++;
  for (j = 0; j < WIDTH; j++) b0[j] = (real)*w++;
  if (LAYERS == 2) {
    for (i = 0; i < WIDTHS; i++) for (j = 0; j < WIDTH; j++) W1[i][j] = (real)*w++;
    for (j = 0; j < WIDTH; j++) b1[j] = (real)*w++;
  }
  for (i = 0; i < N; i++) for (j = 0; j < WIDTH; j++) W2[i][j] = (real)*w++;
}

/* tanh, odd, from (x, x^3 ...) / ...: a continued fraction, cut where it rounds to 1. Error below 2e-8; no branch, so
   that a whole layer fits into a few registers. */
static inline void activate(real *x) {
  int j;
  for (j = 0; j < WIDTH; j++) {
    const real z = x[j] > (real)9 ? (real)9 : x[j] < (real)-9 ? (real)-9 : x[j], z2 = z * z;
    const real a = z * (((real)TANH_A0 + z2 * (real)TANH_A1) + z2 * z2 * (((real)TANH_A2 + z2 * (real)TANH_A3) + z2 * z2 * ((real)TANH_A4 + z2 * (real)TANH_A5)));
    const real b = ((real)TANH_B0 + z2 * (real)TANH_B1) + z2 * z2 * (((real)TANH_B2 + z2 * (real)TANH_B3) + z2 * z2 * ((real)TANH_B4 + z2 * (real)TANH_B5));
    x[j] = a / b;
  }
}

static inline void slope(const real *y, real *f) {
  real x[IN], u[WIDTH], v[WIDTH], *last = u;
  int i, j;
  for (i = 0; i < N; i++) {
    sine_cosine(y[i], x + i, x + N + i);
    x[IN - N + i] = f[i] = y[N + i];
  }
  for (j = 0; j < WIDTH; j++) u[j] = b0[j];
  for (i = 0; i < IN; i++) for (j = 0; j < WIDTH; j++) u[j] += x[i] * W0[i][j];
  activate(u);
  if (LAYERS == 2) {
    for (j = 0; j < WIDTH; j++) v[j] = b1[j];
    for (i = 0; i < WIDTHS; i++) for (j = 0; j < WIDTH; j++) v[j] += u[i] * W1[i][j];
    activate(v);
    last = v;
  }
  for (i = 0; i < N; i++) {
    real a = 0;
    for (j = 0; j < WIDTH; j++) a += last[j] * W2[i][j];
    f[N + i] = a;
  }
}
#else
static inline void slope(const real *y, real *f) {
  int i;
  pull(y, f + N);
  for (i = 0; i < N; i++) {
    f[i] = y[N + i];
    f[N + i] -= GAMMA * y[N + i];
  }
}
#endif

static inline void rhs(const real *y, real *f) {
  slope(y, f);
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

#ifdef SEPARABLE
/* damp(h/2) kick(h/2) drift(h) kick(h/2) damp(h/2), one force a step: the method of the explicit C stepper. */
static void leapfrog(real *y, real h, long steps) {
  const real root = exp(-GAMMA * h / 2);
  real a[N];
  int i;
  pull(y, a);
  evaluations++;
  while (steps--) {
    for (i = 0; i < N; i++) {
      y[N + i] = root * y[N + i] + h / 2 * a[i];
      y[i] += h * y[N + i];
    }
    pull(y, a);
    evaluations++;
    for (i = 0; i < N; i++) y[N + i] = root * (y[N + i] + h / 2 * a[i]);
  }
}
#endif

#include "dop853_step.h" /* attempt(y, f, h, tol, y_new, f_new): the error over the tolerance; fixed8(y, h, steps) */

static real dop853(real *y, real T, real tol, real h) {
  real f[D], y_new[D], f_new[D], t = 0;
  long tries = 0;
  rhs(y, f);
  while (t < T * (1 - (real)1e-6)) {
    const int last = h >= T - t;
    const real used = last ? T - t : h, error = attempt(y, f, used, tol, y_new, f_new);
    real factor = error > 0 ? (real)0.9 * (real)pow(error, (real)-0.125) : 10;
    if (++tries > 1000 || !isfinite(y[0])) { /* a network that runs away */
      y[0] = (real)NAN;
      return h;
    }
    if (!(error < 1)) {
      h = used * (factor > (real)0.2 ? factor : (real)0.2);
      if (!(h > T * (real)1e-9)) {
        y[0] = (real)NAN;
        return h;
      }
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

/* `samples` motions of `segments` segments of length dt each; out is (samples, segments, 2N). method 0: RK4, 1: DOP853,
   2: leapfrog, 3: DOP853 with equal steps and no error estimate. x is the tolerance of DOP853, else the number of steps
   in a segment. Each motion waits for the one before, as in a loop of control: `wait` is 0.
   Returns the evaluations of f. */
long motions(long samples, long segments, double dt, int method, double x, double wait,
    const double *start, double *out) {
  real y[D], h;
  long b, k;
  int d;
  evaluations = 0;
  for (d = 0; d < D; d++) y[d] = 0;
  for (b = 0; b < samples; b++) {
    const real last = isfinite(y[0]) ? (real)wait * y[0] : 0;
    for (d = 0; d < D; d++) y[d] = (real)start[b * D + d] + last;
    h = (real)(dt / 4);
    for (k = 0; k < segments; k++) {
      if (method == 0) rk4(y, (real)(dt / x), (long)x);
      else if (method == 1) h = dop853(y, (real)dt, (real)x, h);
      else if (method == 3) fixed8(y, (real)(dt / x), (long)x);
#ifdef SEPARABLE
      else leapfrog(y, (real)(dt / x), (long)x);
#endif
      if (out) for (d = 0; d < D; d++) out[(b * segments + k) * D + d] = y[d];
    }
  }
  return evaluations;
}
