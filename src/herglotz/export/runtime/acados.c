
/* What acados takes for discrete dynamics (dyn_ext_fun_type = 'generic', integrator_type = 'DISCRETE'): one step
   x1 = f(x, u) of NAME_c_h, the shooting interval, with x = (q, p, s). acados does not look at what these functions
   return, so a step that does not exist fills its output with NaN, which acados reports as a status of its own. There
   are no second derivatives: use hessian_approx = 'GAUSS_NEWTON'. */

#include "acados/utils/external_function_generic.h"
#include "blasfeo_d_aux.h"

#ifdef __cplusplus
extern "C" {
#endif

int NAME_disc_fun(void **in, void **out, void *params);
int NAME_disc_fun_jac(void **in, void **out, void *params);

enum { NAME_SIZE = 2 * hz_N + 1 };

/* A step of (in[0], in[1]) = (x, u) into out[0]; its derivatives, row by row, where they are asked for. */
static int NAME_evaluate(void **in, void **out, double *by_x, double *by_u) {
  struct blasfeo_dvec_args *x_in = (struct blasfeo_dvec_args *)in[0];
  struct blasfeo_dvec_args *x_out = (struct blasfeo_dvec_args *)out[0];
  double x[NAME_SIZE];
  hz_real A[NAME_SIZE * NAME_SIZE], u[hz_M + 1];
  hz_state state;
  int i, status;
#if hz_INPUTS
  struct blasfeo_dvec_args *u_in = (struct blasfeo_dvec_args *)in[1];
  double given[hz_M];
  hz_real B[NAME_SIZE * hz_M];
  blasfeo_unpack_dvec(hz_M, u_in->x, u_in->xi, given, 1);
  for (i = 0; i < hz_M; i++) u[i] = (hz_real)given[i];
#endif
  (void)u;
  (void)by_u;
  blasfeo_unpack_dvec(NAME_SIZE, x_in->x, x_in->xi, x, 1);
  for (i = 0; i < hz_N; i++) {
    state.q[i] = (hz_real)x[i];
    state.p[i] = (hz_real)x[hz_N + i];
  }
  state.s = (hz_real)x[2 * hz_N];
  state.sigma = hz_R(1.0);
  status = 15 & (by_x ? hz_step_jacobian(&state, hz_h, hz_WITH_U(u) 0, A, hz_WITH_U(B) 0)
                      : hz_step(&state, hz_h, hz_WITH_U(u) 0));
  if (status) hz_lose(&state);
  for (i = 0; i < hz_N; i++) {
    x[i] = state.q[i];
    x[hz_N + i] = state.p[i];
  }
  x[2 * hz_N] = state.s;
  blasfeo_pack_dvec(NAME_SIZE, x, 1, x_out->x, x_out->xi);
  for (i = 0; by_x && i < NAME_SIZE * NAME_SIZE; i++) by_x[i] = status ? hz_nan() : A[i];
#if hz_INPUTS
  for (i = 0; by_x && i < NAME_SIZE * hz_M; i++) by_u[i] = status ? hz_nan() : B[i];
#endif
  return status;
}

int NAME_disc_fun(void **in, void **out, void *params) {
  (void)params;
  return NAME_evaluate(in, out, 0, 0);
}

/* out[1] is (d x1 / du, d x1 / dx), transposed: rows are those of u, then of x. */
int NAME_disc_fun_jac(void **in, void **out, void *params) {
  struct blasfeo_dmat_args *jac = (struct blasfeo_dmat_args *)out[1];
  double by_x[NAME_SIZE * NAME_SIZE], by_u[NAME_SIZE * (hz_M + 1)];
  const int status = NAME_evaluate(in, out, by_x, by_u);
  (void)params;
#if hz_INPUTS
  blasfeo_pack_dmat(hz_M, NAME_SIZE, by_u, hz_M, jac->A, jac->ai, jac->aj);
#endif
  blasfeo_pack_dmat(NAME_SIZE, NAME_SIZE, by_x, NAME_SIZE, jac->A, jac->ai + hz_M, jac->aj);
  return status;
}

#ifdef __cplusplus
}
#endif
