
/* CasADi's external functions, casadi.external("NAME_step", ...): x1 = NAME_step(x, u, h) with x = (q, p, s), and
   jac_NAME_step, its Jacobian by the implicit-function theorem. Matrices are dense and column by column. Both return 0,
   or 1 where there is no step: CasADi raises an error then, and a line search of an optimiser steps back. */

#ifndef casadi_real
#define casadi_real double
#endif
#ifndef casadi_int
#define casadi_int long long int
#endif
#if defined(_WIN32)
#define NAME_VISIBLE __declspec(dllexport)
#else
#define NAME_VISIBLE
#endif
#ifdef __cplusplus
extern "C" {
#endif

enum { NAME_SIZE = 2 * hz_N + 1, NAME_IN = 2 + (hz_INPUTS > 0) };

static const casadi_int NAME_vector[3] = {NAME_SIZE, 1, 1}; /* rows, columns, dense */
static const casadi_int NAME_scalar[3] = {1, 1, 1};
#if hz_INPUTS
static const casadi_int NAME_input[3] = {hz_M, 1, 1};
#endif

/* An argument that is null is 0. */
static hz_real NAME_entry(const casadi_real *x, int i) { return x ? (hz_real)x[i] : hz_R(0.0); }

static void NAME_read(const casadi_real **arg, hz_state *state, hz_real *u, hz_real *h) {
  int i;
  for (i = 0; i < hz_N; i++) {
    state->q[i] = NAME_entry(arg[0], i);
    state->p[i] = NAME_entry(arg[0], hz_N + i);
  }
  state->s = NAME_entry(arg[0], 2 * hz_N);
  state->sigma = hz_R(1.0);
  for (i = 0; i < hz_M; i++) u[i] = NAME_entry(arg[1], i);
  *h = NAME_entry(arg[NAME_IN - 1], 0);
}

NAME_VISIBLE int NAME_step(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem) {
  hz_state state;
  hz_real u[hz_M + 1], h;
  int i;
  (void)iw;
  (void)w;
  (void)mem;
  NAME_read(arg, &state, u, &h);
  if (hz_step(&state, h, hz_WITH_U(u) 0) & 15) return 1;
  for (i = 0; res[0] && i < hz_N; i++) {
    res[0][i] = state.q[i];
    res[0][hz_N + i] = state.p[i];
  }
  if (res[0]) res[0][2 * hz_N] = state.s;
  return 0;
}

NAME_VISIBLE casadi_int NAME_step_n_in(void) { return NAME_IN; }
NAME_VISIBLE casadi_int NAME_step_n_out(void) { return 1; }

NAME_VISIBLE const char *NAME_step_name_in(casadi_int i) {
  return i == 0 ? "x" : i == NAME_IN - 1 ? "h" : i == 1 ? "u" : 0;
}
NAME_VISIBLE const char *NAME_step_name_out(casadi_int i) { return i == 0 ? "x1" : 0; }
NAME_VISIBLE casadi_real NAME_step_default_in(casadi_int i) { return i == NAME_IN - 1 ? hz_h : 0.0; }

NAME_VISIBLE const casadi_int *NAME_step_sparsity_in(casadi_int i) {
#if hz_INPUTS
  if (i == 1) return NAME_input;
#endif
  return i == 0 ? NAME_vector : i == NAME_IN - 1 ? NAME_scalar : 0;
}
NAME_VISIBLE const casadi_int *NAME_step_sparsity_out(casadi_int i) { return i == 0 ? NAME_vector : 0; }

NAME_VISIBLE int NAME_step_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w) {
  if (sz_arg) *sz_arg = NAME_IN;
  if (sz_res) *sz_res = 1;
  if (sz_iw) *sz_iw = 0;
  if (sz_w) *sz_w = 0;
  return 0;
}

#if hz_DERIVATIVES
static const casadi_int NAME_by_x[3] = {NAME_SIZE, NAME_SIZE, 1};
static const casadi_int NAME_unread[4] = {NAME_SIZE, 1, 0, 0}; /* no entries: x1, which the Jacobian does not read */
#if hz_INPUTS
static const casadi_int NAME_by_u[3] = {NAME_SIZE, hz_M, 1};
#endif

/* (x, u, h, x1) -> (d x1 / dx, d x1 / du, d x1 / dh) */
NAME_VISIBLE int jac_NAME_step(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem) {
  hz_state state;
  hz_real u[hz_M + 1], h, by_x[NAME_SIZE * NAME_SIZE], by_u[NAME_SIZE * (hz_M + 1)], by_h[NAME_SIZE];
  int i, j;
  (void)iw;
  (void)w;
  (void)mem;
  (void)by_u;
  NAME_read(arg, &state, u, &h);
  if (hz_step_jacobian(&state, h, hz_WITH_U(u) 0, by_x, hz_WITH_U(by_u) by_h) & 15) return 1;
  for (i = 0; i < NAME_SIZE; i++) {
    for (j = 0; res[0] && j < NAME_SIZE; j++) res[0][j * NAME_SIZE + i] = by_x[i * NAME_SIZE + j];
#if hz_INPUTS
    for (j = 0; res[1] && j < hz_M; j++) res[1][j * NAME_SIZE + i] = by_u[i * hz_M + j];
#endif
    if (res[NAME_IN - 1]) res[NAME_IN - 1][i] = by_h[i];
  }
  return 0;
}

NAME_VISIBLE casadi_int jac_NAME_step_n_in(void) { return NAME_IN + 1; }
NAME_VISIBLE casadi_int jac_NAME_step_n_out(void) { return NAME_IN; }

NAME_VISIBLE const char *jac_NAME_step_name_in(casadi_int i) { return i == NAME_IN ? "out_x1" : NAME_step_name_in(i); }
NAME_VISIBLE const char *jac_NAME_step_name_out(casadi_int i) {
  return i == 0 ? "jac_x1_x" : i == NAME_IN - 1 ? "jac_x1_h" : i == 1 ? "jac_x1_u" : 0;
}
NAME_VISIBLE casadi_real jac_NAME_step_default_in(casadi_int i) { return NAME_step_default_in(i); }

NAME_VISIBLE const casadi_int *jac_NAME_step_sparsity_in(casadi_int i) {
  return i == NAME_IN ? NAME_unread : NAME_step_sparsity_in(i);
}
NAME_VISIBLE const casadi_int *jac_NAME_step_sparsity_out(casadi_int i) {
#if hz_INPUTS
  if (i == 1) return NAME_by_u;
#endif
  return i == 0 ? NAME_by_x : i == NAME_IN - 1 ? NAME_vector : 0;
}

NAME_VISIBLE int jac_NAME_step_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w) {
  NAME_step_work(sz_arg, sz_res, sz_iw, sz_w);
  if (sz_arg) *sz_arg = NAME_IN + 1;
  if (sz_res) *sz_res = NAME_IN;
  return 0;
}
#endif

#ifdef __cplusplus
}
#endif
