
/* CasADi's external functions with x = (q, p, s): x1 = NAME_step(x, u, h) is one step, x1 = NAME_hold(x, u, h) a time h
   of as few equal steps as are no longer than the typical one; jac_NAME_step and jac_NAME_hold are their Jacobians by
   the implicit-function theorem. Matrices are dense and column by column. All return 0, or 1 where there is no step: CasADi
   raises an error then, and a line search of an optimiser steps back. */

#ifndef casadi_real
#define casadi_real double
#endif
#ifndef casadi_int
#define casadi_int long long int
#endif
#ifdef __cplusplus
#define NAME_LINKAGE extern "C"
#else
#define NAME_LINKAGE
#endif
#if defined(_WIN32)
#define NAME_VISIBLE NAME_LINKAGE __declspec(dllexport)
#else
#define NAME_VISIBLE NAME_LINKAGE
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

#if hz_DERIVATIVES
static const casadi_int NAME_by_x[3] = {NAME_SIZE, NAME_SIZE, 1};
static const casadi_int NAME_unread[4] = {NAME_SIZE, 1, 0, 0}; /* no entries: x1, which the Jacobian does not read */
#if hz_INPUTS
static const casadi_int NAME_by_u[3] = {NAME_SIZE, hz_M, 1};
#endif
#endif
