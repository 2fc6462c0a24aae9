
/* Vector-Jacobian products: from the derivatives of a number by the states after a step or a rollout, its derivatives by
   the state before. Rows are (q, p, s). */

/* Of one step from `before` to `after`, which hz_step has made with the same h and so on: from the derivatives `of` the
   state after it, (2 hz_N + 1),

   by_state   (2 hz_N + 1)  by the state before it; may be `of` itself
   by_h       one number
   by_input   (hz_M), where the model takes inputs
   by_theta   (hz_P), where numbers are set at run time

   Any of them may be null; they are written on success only. hz_DIVERGED where one is not finite. */
static inline int hz_step_vjp(const hz_state *before, const hz_state *after, hz_real h,
    hz_TAKES_U hz_TAKES_THETA const hz_real *of, hz_real *by_state,
    hz_WITH_U(hz_real *by_input) hz_WITH_THETA(hz_real *by_theta) hz_real *by_h) {
  enum { SIZE = 2 * hz_N + 1, WIDTH = SIZE + 1 + hz_INPUTS + hz_P };
  hz_problem P;
  hz_real pulled[WIDTH], move[hz_N];
  int i;
  if (hz_before(before, h)) return hz_before(before, h);
  if (hz_before(after, h) || hz_BAD_U(u)) return hz_DIVERGED;
  if (hz_BAD_THETA(theta)) return hz_BAD_INPUT;
  hz_pose(before, after, h, hz_WITH_U(u) hz_WITH_THETA(theta) &P, move);
  hz_pull(&P, move, of, pulled);
  for (i = 0; i < WIDTH; i++)
    if (!hz_finite(pulled[i])) return hz_DIVERGED;
  for (i = 0; by_state && i < SIZE; i++) by_state[i] = pulled[i];
  if (by_h) *by_h = pulled[SIZE];
#if hz_INPUTS
  for (i = 0; by_input && i < hz_M; i++) by_input[i] = pulled[SIZE + 1 + i];
#endif
#if hz_P
  for (i = 0; by_theta && i < hz_P; i++) by_theta[i] = pulled[WIDTH - hz_P + i];
#endif
  return hz_CONVERGED;
}

/* Of a rollout of `steps` equal steps whose states hz_rollout has kept (every = 1): q, p (steps + 1, hz_N), s (steps +
   1). of_q, of_p and of_s, of the same shapes, hold the derivatives by each of these states, the start included; null
   means 0. by_state is that by the start, by_h (one number) the sum over all steps, and so is by_theta; by_input is
   (steps, hz_M). Any of them may be null; they hold derivatives only where the returned status is 0. */
static inline int hz_rollout_vjp(hz_real h, hz_TAKES_U hz_TAKES_THETA long steps, const hz_real *q, const hz_real *p,
    const hz_real *s, const hz_real *of_q, const hz_real *of_p, const hz_real *of_s, hz_real *by_state,
    hz_WITH_U(hz_real *by_input) hz_WITH_THETA(hz_real *by_theta) hz_real *by_h) {
  hz_real of[2 * hz_N + 1], one_h;
#if hz_P
  hz_real one_theta[hz_P];
#endif
  hz_state before, after;
  long k;
  int i, status;
  for (i = 0; i < 2 * hz_N + 1; i++) of[i] = hz_R(0.0);
  if (by_h) *by_h = hz_R(0.0);
#if hz_P
  for (i = 0; by_theta && i < hz_P; i++) by_theta[i] = hz_R(0.0);
#endif
  if (steps < 0) return hz_BAD_INPUT;
  before.sigma = hz_R(1.0);
  for (k = steps; k >= 0; k--) {
    if (k < steps) after = before;
    for (i = 0; i < hz_N; i++) {
      before.q[i] = q[k * hz_N + i];
      before.p[i] = p[k * hz_N + i];
    }
    before.s = s[k];
    if (k < steps) {
      status = hz_step_vjp(&before, &after, h, hz_WITH_U(u ? u + k * hz_M : 0) hz_WITH_THETA(theta) of, of,
          hz_WITH_U(by_input ? by_input + k * hz_M : 0) hz_WITH_THETA(one_theta) &one_h);
      if (status) return status;
      if (by_h) *by_h += one_h;
#if hz_P
      for (i = 0; by_theta && i < hz_P; i++) by_theta[i] += one_theta[i];
#endif
    }
    for (i = 0; i < hz_N; i++) {
      of[i] += of_q ? of_q[k * hz_N + i] : hz_R(0.0);
      of[hz_N + i] += of_p ? of_p[k * hz_N + i] : hz_R(0.0);
    }
    of[2 * hz_N] += of_s ? of_s[k] : hz_R(0.0);
  }
  for (i = 0; i < 2 * hz_N + 1; i++) {
    if (!hz_finite(of[i])) return hz_DIVERGED;
    if (by_state) by_state[i] = of[i];
  }
  return hz_CONVERGED;
}
