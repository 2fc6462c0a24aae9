
/* CasADi's external functions with x = (q, p, s): x1 = NAME_step(x, u, h) is one step, x1 = NAME_hold(x, u, h) a time h
   of the fewest equal steps that are no longer than the typical one; jac_NAME_step and jac_NAME_hold are their Jacobians by
   the implicit-function theorem. Compiled with -DNAME_HORIZON=50, NAME_shoot is NAME_hold of 50 columns x and u at once:
   registers of columns are stepped at once, and the Jacobian has a block for each. Matrices are column by column. All
   functions return 0, or 1 where a step has no solution: CasADi then raises an error, and a line search steps back. */

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

static const casadi_int NAME_scalar[3] = {1, 1, 1}; /* rows, columns, dense */

/* An argument that is null is 0. */
static hz_real NAME_entry(const casadi_real *x, int i) { return x ? (hz_real)x[i] : hz_R(0.0); }

/* A number of steps for hz_job; -1, which is no job, where an int does not hold it. */
static long NAME_whole(double steps) { return steps < 2147483647.0 ? (long)steps : -1; }

/* Column k of the states and inputs. */
static void NAME_read(const casadi_real **arg, int k, hz_state *state, hz_real *u) {
  int i;
  for (i = 0; i < hz_N; i++) {
    state->q[i] = NAME_entry(arg[0], k * NAME_SIZE + i);
    state->p[i] = NAME_entry(arg[0], k * NAME_SIZE + hz_N + i);
  }
  state->s = NAME_entry(arg[0], k * NAME_SIZE + 2 * hz_N);
  state->sigma = hz_R(1.0);
  for (i = 0; i < hz_M; i++) u[i] = NAME_entry(arg[1], k * hz_M + i);
}

#if hz_DERIVATIVES
/* `count` dense blocks on a diagonal, as CasADi has them: rows, columns, where each column begins, the row of each
   entry. Written whole at each call, the same each time. */
static const casadi_int *NAME_diagonal(casadi_int count, casadi_int width, casadi_int *pattern) {
  casadi_int column, i;
  pattern[0] = NAME_SIZE * count;
  pattern[1] = width * count;
  pattern[2] = 0;
  for (column = 0; column < width * count; column++) {
    pattern[3 + column] = NAME_SIZE * (column + 1);
    for (i = 0; i < NAME_SIZE; i++)
      pattern[3 + width * count + NAME_SIZE * column + i] = NAME_SIZE * (column / width) + i;
  }
  return pattern;
}
#endif
