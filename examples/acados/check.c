/* A file that `herglotz export RUN --format acados --out arm.c` wrote, without acados: its Jacobian beside differences.

     cc -std=c99 -Istand_in -DMODEL='"arm.c"' -DNAME=arm check.c -o check -lm && ./check

   Prints the largest of |J − differences|; exits with 1 above 1e-6 of the largest entry of J, or after a failed step. */

#include MODEL
#include <stdio.h>

#define JOINED(a, b) a##b
#define OF(a, b) JOINED(a, b)
#define FUN OF(NAME, _disc_fun)
#define JAC OF(NAME, _disc_fun_jac)
enum { NX = OF(NAME, _SIZE), NU = OF(NAME, _c_M), NV = NX + NU };

/* (u, x) stand in one vector, as in acados; x1 and the transposed Jacobian (rows of u, then of x) come out. */
static int evaluated(double *ux, double *x1, double *jac) {
  struct blasfeo_dvec given = {ux, NV}, found = {x1, NX};
  struct blasfeo_dmat matrix = {jac, NV, NX};
  struct blasfeo_dvec_args x = {&given, NU}, u = {&given, 0}, out = {&found, 0};
  struct blasfeo_dmat_args slopes = {&matrix, 0, 0};
  void *in[] = {&x, &u}, *results[] = {&out, &slopes};
  return jac ? JAC(in, results, 0) : FUN(in, results, 0);
}

int main(void) {
  const double d = 1e-5;
  double ux[NV], low[NX], high[NX], x1[NX], jac[NV * NX], worst = 0.0, largest = 0.0;
  int i, j;
  for (i = 0; i < NV; i++) ux[i] = 0.1 + 0.05 * i;
  if (evaluated(ux, x1, jac)) return 1;
  for (i = 0; i < NV; i++) {
    const double at = ux[i];
    ux[i] = at + d;
    if (evaluated(ux, high, 0)) return 1;
    ux[i] = at - d;
    if (evaluated(ux, low, 0)) return 1;
    ux[i] = at;
    for (j = 0; j < NX; j++) {
      const double slope = jac[i + NV * j], miss = fabs(slope - (high[j] - low[j]) / (2.0 * d));
      if (miss > worst) worst = miss;
      if (fabs(slope) > largest) largest = fabs(slope);
    }
  }
  printf("%g\n", worst);
  return worst <= 1e-6 * largest ? 0 : 1;
}
