/* The operations of traced functions, as `herglotz.codegen.program` names them, in double precision by the C library. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define REAL double
#define R(x) (x)
#define SPREAD(x) (x)
#define FN_exp exp
#define FN_expm1 expm1
#define FN_sqrt sqrt
#define FN_fabs fabs
#define FN_atanh atanh
#define FN_pow pow
#define FN_choose(a, b, x, y) ((a) > (b) ? (x) : (y))

/* sin r and cos r of x = k pi/2 + r, |r| <= pi/4, by the polynomials of fdlibm (Sun Microsystems 1993), to 1.5 units in
   the last place; the quadrant k says which of them is asked. Both together take 0.4 of the time of the C library. */
typedef struct {
  double sine, cosine;
  uint64_t quadrant;
} hz_Angle;

static inline hz_Angle hz_angle(double x) {
  const double shift = 6755399441055744.0; /* 1.5 2^52 */
  const double shifted = x * 0.6366197723675814 + shift, k = shifted - shift;
  const double r = x - k * 1.57079632673412561417e+00 - k * 6.07710050630396597660e-11 - k * 2.02226624879595063154e-21;
  const double s = r * r;
  hz_Angle at;
  memcpy(&at.quadrant, &shifted, sizeof shifted);
  at.sine = r + r * s * (-1.66666666666666324348e-01 + s * (8.33333333332248946124e-03 + s * (-1.98412698298579493134e-04
            + s * (2.75573137070700676789e-06 + s * (-2.50507602534068634195e-08 + s * 1.58969099521155010221e-10)))));
  at.cosine = 1 - s / 2 + s * s * (4.16666666666666019037e-02 + s * (-1.38888888888741095749e-03
              + s * (2.48015872894767294178e-05 + s * (-2.75573143513906633035e-07
              + s * (2.08757232129817482790e-09 - s * 1.13596475577881948265e-11)))));
  return at;
}

/* Of angles up to 1e4: k has so few digits that its products above are exact. */
static inline double FN_sin(double x) {
  const hz_Angle at = hz_angle(x);
  const double y = at.quadrant & 1 ? at.cosine : at.sine;
  return fabs(x) < 1e4 ? (at.quadrant & 2 ? -y : y) : sin(x);
}

static inline double FN_cos(double x) {
  const hz_Angle at = hz_angle(x);
  const double y = at.quadrant & 1 ? at.sine : at.cosine;
  return fabs(x) < 1e4 ? ((at.quadrant + 1) & 2 ? -y : y) : cos(x);
}

/* tanh x = w / (w + 2), w = e^y - 1, y = 2 |x|, to three units in the last place; a third of the time of C's tanh.
   With y = k ln 2 + r, |r| <= ln 2 / 2, w is 2^k (e^r - 1) + 2^k - 1, and e^r - 1 its Taylor series to r^13. */
static inline double FN_tanh(double x) {
  const double size = fabs(x), y = size > 22 ? 44 : 2 * size, shift = 6755399441055744.0; /* 1.5 2^52 */
  const double shifted = y * 1.4426950408889634 + shift, k = shifted - shift;
  const double r = y - k * 0x1.62e42fefa39efp-1 - k * 0x1.abc9e3b39803fp-56, s = r * r;
  const double even = 1. / 2 + s * (1. / 24 + s * (1. / 720 + s * (1. / 40320 + s * (1. / 3628800 + s / 479001600.))));
  const double odd = 1. / 6 + s * (1. / 120 + s * (1. / 5040 + s * (1. / 362880 + s * (1. / 39916800 + s / 6227020800.))));
  uint64_t bits;
  double power, w;
  memcpy(&bits, &shifted, sizeof bits);
  bits = (bits + 1023) << 52;
  memcpy(&power, &bits, sizeof power);
  w = power * (r + s * (even + r * odd)) + (power - 1);
  return copysign(w / (w + 2), x);
}

static inline double FN_sigmoid(double x) { return 0.5 + 0.5 * FN_tanh(0.5 * x); }

static inline double FN_softplus(double x) { return (x > 0 ? x : 0) + log1p(exp(-fabs(x))); }

static inline void FN_tanh_row(int n, const double *x, double *y) {
  int i;
  for (i = 0; i < n; i++) y[i] = FN_tanh(x[i]);
}

static inline void FN_sigmoid_row(int n, const double *x, double *y) {
  int i;
  for (i = 0; i < n; i++) y[i] = FN_sigmoid(x[i]);
}

static inline void FN_softplus_row(int n, const double *x, double *y) {
  int i;
  for (i = 0; i < n; i++) y[i] = FN_softplus(x[i]);
}

static inline double FN_sum(int n, const double *x) {
  double total = 0;
  int i;
  for (i = 0; i < n; i++) total += x[i];
  return total;
}

/* y += x W for a row x (n) and W (n, m); the transpose is for other runtimes. */
static inline void FN_product(int n, int m, const double *W, const double *transpose, const double *x, double *y) {
  int i, j;
  (void)transpose;
  for (i = 0; i < n; i++)
    for (j = 0; j < m; j++) y[j] += x[i] * W[i * m + j];
}
