/* The functions a user calls. */

/* hz_OUTSIDE_BOX where a state lies outside the box the model was fitted in, or 0. */
static inline int hz_outside_box(const hz_state *state) {
  int flags[1] = {0};
  hz_mark_outside(state, flags);
  return flags[0];
}

/* One step of a run: hz_step without its checks of the input, faster because `track` keeps numbers of the last steps.
   Start the track again whenever anything but this function has changed the state. */
static inline int hz_advance(hz_state *state, hz_track *track, hz_real h, hz_TAKES_U hz_real *residual) {
  int status[1] = {hz_CONVERGED};
  hz_take(state, track, &h, hz_WITH_U(&u) status, residual);
  return status[0];
}

static inline int hz_alone(hz_state *state, hz_real h, hz_TAKES_U hz_TAKES_THETA hz_real *residual) {
  hz_track track;
  hz_track_start(state, hz_WITH_THETA(theta) &track);
  return hz_advance(state, &track, h, hz_WITH_U(u) residual);
}

/* The equation of a step from `before`, and the move from there to `after`. */
static inline void hz_pose(const hz_state *before, const hz_state *after, hz_real h, hz_TAKES_U hz_TAKES_THETA hz_problem *P,
    hz_real move[hz_N]) {
  int i;
  for (i = 0; i < hz_N; i++) {
    P->q0[i] = before->q[i];
    P->p0[i] = before->p[i];
    move[i] = after->q[i] - before->q[i];
  }
  P->s0 = before->s;
  P->h = h;
#if hz_P
  if (!theta) theta = &hz_defaults;
  for (i = 0; i < hz_P; i++) P->theta[i] = theta->value[i];
#endif
#if hz_INPUTS
  for (i = 0; i < hz_INPUTS; i++) P->u[i] = hz_taken(u, i);
#endif
}

/* The state at q1 from two positions h apart: (q1, D2 L_d, s0 + L_d); sigma starts at 1. `out` is written on success
   only. Returns a status. */
static inline int hz_init(const hz_real q0[hz_N], const hz_real q1[hz_N], hz_real s0, hz_real h,
    hz_TAKES_U hz_TAKES_THETA hz_state *out) {
  hz_problem P;
  hz_terms t;
  hz_potential_t V1;
  hz_state first, next;
  hz_real move[hz_N], dp[hz_N], ds, E;
  int i, pass;
  for (i = 0; i < hz_N; i++) {
    first.q[i] = q0[i];
    next.q[i] = q1[i];
    first.p[i] = hz_R(0.0);
    next.p[i] = q1[i] - q0[i]; /* checked with the rest */
  }
  first.s = next.s = s0;
  first.sigma = next.sigma = hz_R(1.0);
  if (hz_before(&first, h) || hz_before(&next, h) || hz_BAD_U(u) || hz_BAD_THETA(theta)) return hz_BAD_INPUT;
  hz_pose(&first, &next, h, hz_WITH_U(u) hz_WITH_THETA(theta) &P, t.move);
  hz_potential(q0, hz_WITH_THETA(P.theta) &P.V0);
  hz_potential(q1, hz_WITH_THETA(P.theta) &V1);
  hz_prepare(&P);
  for (pass = 0; pass < 2; pass++) { /* first c, and the momentum p0 that the step starts with; then the step's end */
    hz_begin(&P, move);
#if hz_STICKING
    for (i = 0; i < hz_N; i++) {
      t.move[i] = q1[i] - q0[i];
      if (t.move[i] != hz_R(0.0)) t.move[i] += t.move[i] > hz_R(0.0) ? P.bound[i] : -P.bound[i];
    }
#endif
    hz_evaluate_first(&P, &t);
    hz_gains(&P, &t, t.move, &V1, dp, &ds, &E);
    for (i = 0; !pass && i < hz_N; i++) P.p0[i] = -t.F[i] / (hz_R(1.0) + E);
  }
  for (i = 0; i < hz_N; i++) next.p[i] = P.p0[i] + dp[i];
  next.s = s0 + ds;
  if (!hz_all_finite(next.p) || !hz_finite(next.s)) return hz_DIVERGED;
  *out = next;
  return hz_outside_box(out) | hz_outside_h(h);
}

/* One step of h > 0. The state changes on success only. `residual` (may be null) receives the residual of the step
   equation, |J^-1 F| in units of q. Returns a status, with hz_OUTSIDE_BOX added where the step starts or ends outside
   the box and hz_OUTSIDE_H where h is outside the range that the model was fitted for. */
static inline int hz_step(hz_state *state, hz_real h, hz_TAKES_U hz_TAKES_THETA hz_real *residual) {
  hz_real left = hz_R(0.0);
  int status = hz_before(state, h);
  if (!status && hz_BAD_THETA(theta)) status = hz_BAD_INPUT;
  if (!status && hz_BAD_U(u)) status = hz_DIVERGED;
  if (!status) {
    status = hz_outside_box(state) | hz_outside_h(h);
    status |= hz_alone(state, h, hz_WITH_U(u) hz_WITH_THETA(theta) &left) | hz_outside_box(state);
  }
  if (residual) *residual = left;
  return status;
}

#if hz_DERIVATIVES
/* The derivatives of a step from `before` to `after`, as of hz_step_jacobian. Returns 0, or hz_DIVERGED where one is not
   finite: then none is written. */
static inline int hz_step_slopes(const hz_state *before, const hz_state *after, hz_real h, hz_TAKES_U hz_TAKES_THETA hz_real *by_state,
    hz_WITH_U(hz_real *by_input) hz_WITH_THETA(hz_real *by_theta) hz_real *by_h) {
  enum { SIZE = 2 * hz_N + 1, WIDTH = SIZE + 1 + hz_INPUTS + hz_P };
  hz_problem P;
  hz_real slopes[SIZE * WIDTH], move[hz_N];
  int i, j;
  hz_pose(before, after, h, hz_WITH_U(u) hz_WITH_THETA(theta) &P, move);
  hz_slopes(&P, move, slopes);
  for (i = 0; i < SIZE * WIDTH; i++)
    if (!hz_finite(slopes[i])) return hz_DIVERGED; /* the step exists, but a derivative is beyond the largest number */
  for (i = 0; i < SIZE; i++) {
    for (j = 0; by_state && j < SIZE; j++) by_state[i * SIZE + j] = slopes[i * WIDTH + j];
    if (by_h) by_h[i] = slopes[i * WIDTH + SIZE];
#if hz_P
    for (j = 0; by_theta && j < hz_P; j++) by_theta[i * hz_P + j] = slopes[i * WIDTH + WIDTH - hz_P + j];
#endif
#if hz_INPUTS
    for (j = 0; by_input && j < hz_M; j++) by_input[i * hz_M + j] = slopes[i * WIDTH + SIZE + 1 + j];
#endif
  }
  return 0;
}

/* hz_step with its derivatives, by the implicit-function theorem: rows are (q, p, s) after the step.

   by_state   (2 hz_N + 1, 2 hz_N + 1)  along (q, p, s) before it
   by_h       (2 hz_N + 1)
   by_input   (2 hz_N + 1, hz_M), where the model takes inputs

   Any of them and `residual` may be null; they are written on success only. A derivative that is not finite is
   hz_DIVERGED, and the state stays. */
static inline int hz_step_jacobian(hz_state *state, hz_real h, hz_TAKES_U hz_TAKES_THETA hz_real *residual, hz_real *by_state,
    hz_WITH_U(hz_real *by_input) hz_WITH_THETA(hz_real *by_theta) hz_real *by_h) {
  const hz_state before = *state;
  const int status = hz_step(state, h, hz_WITH_U(u) hz_WITH_THETA(theta) residual);
  if (status & 15) return status;
  if (!hz_step_slopes(&before, state, h, hz_WITH_U(u) hz_WITH_THETA(theta) by_state, hz_WITH_U(by_input) hz_WITH_THETA(by_theta) by_h))
    return status;
  *state = before;
  return hz_DIVERGED;
}
#endif

/* Step samples b, b + 1, ... of `count`, as many at once as registers hold; returns their number. */
static inline int hz_run_some(hz_state *states, long b, long count, const hz_job *job, int status[hz_SIDE],
    int *flags) {
#ifdef hz_BATCHED
  const int some = count - b < hz_SIDE ? (int)(count - b) : hz_SIDE;
  if (count > 1) {
    hz_wide_run(states, b, some, job, status, flags);
    return some;
  }
#endif
  (void)count;
  hz_run(states, b, 1, job, status, flags);
  return 1;
}

/* A job of `count` samples, all with the step *job->h; statuses and the returned status are those of hz_rollout_batch. */
static inline int hz_run_batch(long count, hz_state *states, const hz_job *job, int *statuses) {
  const int possible = job->steps >= 0 && job->every > 0 && !hz_BAD_THETA(job->theta);
  int worst = 0, flagged = 0, status[hz_SIDE], flags[hz_SIDE], some, w;
  long b;
  for (b = 0; b < count; b += some) {
    for (w = 0; w < hz_SIDE && b + w < count; w++) {
      status[w] = possible ? hz_before(states + b + w, *job->h) : hz_BAD_INPUT;
      flags[w] = status[w] ? 0 : hz_outside_h(*job->h);
    }
    some = possible ? hz_run_some(states + b, b, count, job, status, flags) : 1;
    for (w = 0; w < some; w++) {
      if (!worst) worst = status[w];
      flagged |= flags[w];
      if (statuses) statuses[b + w] = status[w] | flags[w];
    }
  }
  return worst | flagged;
}

/* hz_rollout of `count` samples, in registers of samples; each result equals hz_rollout of one sample up to rounding.
   Inputs u are (count, steps, hz_M). The outputs hold one sample after the other; statuses[b] receives what hz_rollout
   would return. Any but `states` may be null. Returns the status of the first sample that failed, or 0, with the flags
   of any. */
static inline int hz_rollout_batch(long count, hz_state *states, hz_real h, hz_TAKES_U hz_TAKES_THETA long steps, long every,
    hz_real *q_out, hz_real *p_out, hz_real *s_out, int *statuses) {
  const hz_job job = {steps, every, &h, 0, 0, hz_WITH_U(u) hz_WITH_U(steps * hz_M) hz_WITH_U(hz_M)
                      hz_WITH_THETA(theta) q_out, p_out, s_out, 0, 0, 0};
  return hz_run_batch(count, states, &job, statuses);
}

/* `steps` equal steps. Inputs u are (steps, hz_M), where the model takes some; none act where u is null.
   Entry 0 of each output is the start, entry k the state after k * every steps; the outputs hold
   1 + steps / every entries (q, p: hz_N numbers each) and may be null. Stops at the first failed step and returns its
   status: `state` is then the last good one and the entries not reached are NaN. Leaving the box does not
   stop the rollout: hz_OUTSIDE_BOX is added to the returned status. */
static inline int hz_rollout(hz_state *state, hz_real h, hz_TAKES_U hz_TAKES_THETA long steps, long every, hz_real *q_out,
    hz_real *p_out, hz_real *s_out) {
  return hz_rollout_batch(1, state, h, hz_WITH_U(u) hz_WITH_THETA(theta) steps, every, q_out, p_out, s_out, 0);
}

/* hz_step of `count` samples; `statuses` may be null. Returns as hz_rollout_batch. */
static inline int hz_step_batch(long count, hz_state *states, hz_real h, hz_TAKES_U hz_TAKES_THETA int *statuses) {
  return hz_rollout_batch(count, states, h, hz_WITH_U(u) hz_WITH_THETA(theta) 1, 1, 0, 0, 0, statuses);
}
