/* Model predictive control around a file that `herglotz export --format casadi --name model` wrote, by one iteration a
   sample, without a library and without allocation.

     minimise  sum_k |x_k - X|^2_Q + |u_k|^2_R  +  |x_N - X|^2_E   over  x_{k+1} = model_hold(x_k, u_k, H),  |u_k| <= U,
               |x_k| <= B

   `rti_prepare` runs before the sample is there: Jacobians of all intervals, and a Riccati recursion whose problem at
   each interval keeps the bounds by an active set (differential dynamic programming with control limits: Tassa, Mansard
   and Todorov, ICRA 2014; Gauss-Newton, as a step has first derivatives). Bounds of states are a logarithmic barrier that
   goes on as a parabola from where `near` of the way to the bound is left (Hauser and Saccon, CDC 2006; Feller and
   Ebenbauer, IEEE Trans. Autom. Control 62, 2017), so that a motion beyond a bound has a cost, too, and leads back. Take
   for `near` what the model misses in an interval, over the bound: a plan that keeps the bound then never leaves it by
   much more. Before the first sample iterate until the plan keeps it. `rti_feedback` takes the measured state, runs the
   law through the model, and gives the input. Compile with: cc -O3 -march=native rti.c -lm (or -shared -fPIC). */

#include <math.h>
#include <string.h>

#ifndef RTI_MODEL
#define RTI_MODEL "model.c"
#endif
#include RTI_MODEL

#ifndef RTI_N
#define RTI_N 50 /* intervals of the horizon */
#endif
enum { N = RTI_N, NX = model_SIZE, NU = model_c_M };

typedef struct {
  double H;                                 /* length of an interval */
  double X[NX], Q[NX], E[NX], R[NU], U[NU]; /* the aim, the weights and the bounds; set before the first call */
  double B[NX], barrier, near;              /* bounds of states, 0 for none; the barrier's weight, and where it goes on */
  double x[N + 1][NX], u[N][NU];            /* the motion; x[0] and u are set before the first call */
  double K[N][NU][NX], k[N][NU];            /* the law du = k + K dx */
  double damping;                           /* Levenberg and Marquardt's, in units of R; 0 at first */
  double cost;
} rti;

/* The barrier of |x| <= bound, with its slope and curvature by x. */
static double barrier(const rti *o, double x, double bound, double *slope, double *curvature) {
  double value = 0.0;
  int side;
  *slope = *curvature = 0.0;
  for (side = -1; bound > 0.0 && side <= 1; side += 2) {
    const double d = 1.0 - side * x / bound, z = (d - 2.0 * o->near) / o->near;
    const int inside = d > o->near;
    value += o->barrier * (inside ? -log(d) : 0.5 * (z * z - 1.0) - log(o->near));
    *slope += o->barrier * side / bound * (inside ? 1.0 / d : -z / o->near);
    *curvature += o->barrier / (bound * bound) * (inside ? 1.0 / (d * d) : 1.0 / (o->near * o->near));
  }
  return value;
}

static double within(double x, double limit) { return x > limit ? limit : x < -limit ? -limit : x; }

/* x1 of an interval; 1 where a step does not exist. */
static int interval(const rti *o, const double *x, const double *u, double *x1) {
  const double *arg[3] = {x, u, &o->H};
  return model_hold(arg, &x1, 0, 0, 0);
}

/* The motion from a state: u + part k + K dx within the bounds, and what it costs; not a number where it ends early. */
static double follow(const rti *o, const double start[NX], double part, double x[N + 1][NX], double u[N][NU]) {
  double cost = 0.0, slope, curvature;
  int k, i, j;
  memcpy(x[0], start, sizeof x[0]);
  for (k = 0; k <= N; k++) {
    for (i = 0; i < NX; i++) {
      cost += (k < N ? o->Q[i] : o->E[i]) * (x[k][i] - o->X[i]) * (x[k][i] - o->X[i]);
      cost += barrier(o, x[k][i], o->B[i], &slope, &curvature);
    }
    if (k == N) return cost;
    for (i = 0; i < NU; i++) {
      double to = o->u[k][i] + part * o->k[k][i];
      for (j = 0; j < NX; j++) to += o->K[k][i][j] * (x[k][j] - o->x[k][j]);
      u[k][i] = within(to, o->U[i]);
      cost += o->R[i] * u[k][i] * u[k][i];
    }
    if (interval(o, x[k], u[k], x[k + 1])) break;
  }
  return NAN;
}

/* L Lt = M of the rows that are free, in place; 1 where M is not positive definite. */
static int factorise(double M[NU][NU], const int fixed[NU]) {
  int i, j, l;
  for (i = 0; i < NU; i++)
    for (j = 0; j <= i; j++) {
      if (fixed[i] || fixed[j]) M[i][j] = i == j ? 1.0 : 0.0;
      for (l = 0; l < j; l++) M[i][j] -= M[i][l] * M[j][l];
      if (i == j && !(M[i][i] > 0.0)) return 1;
      M[i][j] = i == j ? sqrt(M[i][i]) : M[i][j] / M[j][j];
    }
  return 0;
}

static void divide(double L[NU][NU], double b[NU]) {
  int i, j;
  for (i = 0; i < NU; i++) {
    for (j = 0; j < i; j++) b[i] -= L[i][j] * b[j];
    b[i] /= L[i][i];
  }
  for (i = NU - 1; i >= 0; i--) {
    for (j = i + 1; j < NU; j++) b[i] -= L[j][i] * b[j];
    b[i] /= L[i][i];
  }
}

/* du = k + K dx of least M du du / 2 + (f + F dx) du, with |u + du| <= U at dx = 0: inputs that the solution takes
   beyond a bound stay there, one more at a time. */
static int law(double M[NU][NU], double F[NU][NX], double f[NU], const double u[NU], const double U[NU], double k[NU],
    double K[NU][NX]) {
  int fixed[NU] = {0}, again = 1, i, j;
  double L[NU][NU], column[NU];
  for (i = 0; i < NU; i++) k[i] = 0.0;
  while (again) {
    for (i = 0; i < NU; i++) {
      column[i] = fixed[i] ? k[i] : -f[i];
      for (j = 0; j < NU; j++) {
        L[i][j] = M[i][j];
        if (!fixed[i] && fixed[j]) column[i] -= M[i][j] * k[j];
      }
    }
    if (factorise(L, fixed)) return 1;
    divide(L, column);
    for (again = 0, i = 0; i < NU; i++) {
      k[i] = within(u[i] + column[i], U[i]) - u[i];
      if (!fixed[i] && k[i] != column[i]) {
        const double beyond = fabs(u[i] + column[i]) - U[i];
        if (beyond > 1e-12 * U[i]) fixed[i] = again = 1;
        if (again) break;
      }
    }
  }
  for (j = 0; j < NX; j++) {
    for (i = 0; i < NU; i++) column[i] = fixed[i] ? 0.0 : -F[i][j];
    divide(L, column);
    for (i = 0; i < NU; i++) K[i][j] = column[i];
  }
  return 0;
}

/* The law about the motion. Returns 1 where a step has no derivative. */
int rti_prepare(rti *o) {
  double P[NX][NX] = {{0.0}}, p[NX], PA[NX][NX], PB[NX][NU], M[NU][NU], F[NU][NX], f[NU];
  double A[NX * NX], B[NX * NU], by_h[NX], *slopes[3] = {A, B, by_h}; /* column by column */
  double slope, curvature;
  int k, i, j, l;
  for (i = 0; i < NX; i++) {
    barrier(o, o->x[N][i], o->B[i], &slope, &curvature);
    P[i][i] = 2.0 * o->E[i] + curvature;
    p[i] = 2.0 * o->E[i] * (o->x[N][i] - o->X[i]) + slope;
  }
  for (k = N - 1; k >= 0; k--) {
    const double *arg[4] = {o->x[k], o->u[k], &o->H, o->x[k + 1]};
    if (jac_model_hold(arg, slopes, 0, 0, 0)) return 1;
    for (i = 0; i < NX; i++) {
      for (j = 0; j < NX; j++)
        for (PA[i][j] = 0.0, l = 0; l < NX; l++) PA[i][j] += P[i][l] * A[j * NX + l];
      for (j = 0; j < NU; j++)
        for (PB[i][j] = 0.0, l = 0; l < NX; l++) PB[i][j] += P[i][l] * B[j * NX + l];
    }
    for (i = 0; i < NU; i++) {
      f[i] = 2.0 * o->R[i] * o->u[k][i];
      for (j = 0; j < NU; j++) M[i][j] = i == j ? 2.0 * o->R[i] * (1.0 + o->damping) : 0.0;
      for (j = 0; j < NX; j++) F[i][j] = 0.0;
      for (l = 0; l < NX; l++) {
        f[i] += B[i * NX + l] * p[l];
        for (j = 0; j < NU; j++) M[i][j] += B[i * NX + l] * PB[l][j];
        for (j = 0; j < NX; j++) F[i][j] += B[i * NX + l] * PA[l][j];
      }
    }
    if (law(M, F, f, o->u[k], o->U, o->k[k], o->K[k])) return 1;
    for (i = 0; i < NX; i++) { /* the value at dx: of the law, bounds included */
      double row[NX];
      barrier(o, o->x[k][i], o->B[i], &slope, &curvature);
      slope += 2.0 * o->Q[i] * (o->x[k][i] - o->X[i]);
      for (l = 0; l < NX; l++) slope += A[i * NX + l] * p[l];
      for (j = 0; j < NX; j++) {
        row[j] = i == j ? 2.0 * o->Q[i] + curvature : 0.0;
        for (l = 0; l < NX; l++) row[j] += A[i * NX + l] * PA[l][j];
        for (l = 0; l < NU; l++) row[j] += F[l][i] * o->K[k][l][j];
      }
      for (l = 0; l < NU; l++) slope += F[l][i] * o->k[k][l];
      by_h[i] = slope;
      memcpy(P[i], row, sizeof row);
    }
    memcpy(p, by_h, sizeof p);
  }
  return 0;
}

/* The input for the measured state; the motion becomes that of the law from there. The whole law is taken where it
   costs less than its feedback alone, else a half of k, and so on. Returns 1 where the model has no motion from there. */
int rti_feedback(rti *o, const double measured[NX], double input[NU]) {
  double x[N + 1][NX], u[N][NU], part = 1.0;
  const double without = follow(o, measured, 0.0, x, u);
  for (; part > 1e-3; part /= 2.0)
    if ((o->cost = follow(o, measured, part, x, u)) <= without * (1.0 + 1e-13) || without != without) break;
  if (part > 1e-3) o->damping /= 10.0;
  else {
    o->cost = follow(o, measured, 0.0, x, u);
    o->damping = 10.0 * o->damping + 1.0;
  }
  if (o->cost != o->cost) return 1;
  memcpy(o->x, x, sizeof x);
  memcpy(o->u, u, sizeof u);
  memcpy(input, u[0], sizeof u[0]);
  return 0;
}

/* The motion one interval on; the last input is kept. Returns 1 where that step does not exist. */
int rti_shift(rti *o) {
  memmove(o->x[0], o->x[1], sizeof o->x - sizeof o->x[0]);
  memmove(o->u[0], o->u[1], sizeof o->u - sizeof o->u[0]);
  return interval(o, o->x[N - 1], o->u[N - 1], o->x[N]);
}
