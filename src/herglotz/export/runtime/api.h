/* The functions a user calls. */

/* hz_OUTSIDE_BOX where a state lies outside the box the model was fitted in (angles count modulo a turn), or 0. */
static inline int hz_outside_box(const hz_state *state) {
#if hz_BOXED
  int i;
  for (i = 0; i < hz_N; i++) {
    hz_real q = state->q[i];
    if (hz_is_angle[i]) {
      const hz_real turn = hz_R(6.28318530717958647693), middle = (hz_q_low[i] + hz_q_high[i]) / hz_R(2.0);
      q -= turn * hz_floor_of((q - middle) / turn + hz_R(0.5));
    }
    if (!(q >= hz_q_low[i] && q <= hz_q_high[i])) return hz_OUTSIDE_BOX;
    if (!(state->p[i] >= hz_p_low[i] && state->p[i] <= hz_p_high[i])) return hz_OUTSIDE_BOX;
  }
  return state->s >= hz_s_low && state->s <= hz_s_high ? 0 : hz_OUTSIDE_BOX;
#else
  (void)state;
  return 0;
#endif
}

static inline int hz_usable(const hz_state *state, hz_real h) {
  return hz_finite(h) && h > hz_R(0.0) && hz_all_finite(state->q) && hz_all_finite(state->p) && hz_finite(state->s) &&
         hz_finite(state->sigma);
}

#if hz_INPUTS
static inline int hz_inputs_finite(const hz_real *u) {
  int j, good = 1;
  for (j = 0; j < hz_M; j++) good &= hz_finite(u[j]);
  return good;
}
#define hz_BAD_U(u) ((u) && !hz_inputs_finite(u))
#define hz_U_OF_STEP(u, k) ((u) ? (u) + (k) * hz_M : 0)
#else
#define hz_BAD_U(u) 0
#endif

static inline int hz_outside_h(hz_real h) { return h >= hz_h_low && h <= hz_h_high ? 0 : hz_OUTSIDE_H; }

/* The state at q1 from two positions h apart: (q1, D2 L_d, s0 + L_d); sigma starts at 1. `out` is written on success
   only. Returns a status. */
static inline int hz_init(const hz_real q0[hz_N], const hz_real q1[hz_N], hz_real s0, hz_real h,
    hz_TAKES_U hz_state *out) {
  hz_problem P;
  hz_terms t;
  hz_potential_t V1;
  hz_state next;
  hz_real move[hz_N], dp[hz_N], ds, E;
  int i, pass;
  for (i = 0; i < hz_N; i++) {
    P.q0[i] = q0[i];
    P.p0[i] = hz_R(0.0);
    next.q[i] = q1[i];
    next.p[i] = t.move[i] = q1[i] - q0[i];
  }
  P.s0 = next.s = s0;
  P.h = h;
  next.sigma = hz_R(1.0);
  if (!hz_usable(&next, h) || !hz_all_finite(q0) || hz_BAD_U(u)) return hz_BAD_INPUT;
#if hz_INPUTS
  hz_push(u, P.push);
#endif
  hz_potential(q0, &P.V0);
  hz_potential(q1, &V1);
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

/* One step of h > 0. The state changes on success only. `residual` (may be null) receives what is left of the step
   equation, |J^-1 F| in units of q. Returns a status, with hz_OUTSIDE_BOX added where the step starts or ends outside
   the box and hz_OUTSIDE_H where h is not one of the range the model was fitted for. */
static inline int hz_step(hz_state *state, hz_real h, hz_TAKES_U hz_real *residual) {
  hz_track track;
  hz_real left = hz_R(0.0);
  int status, outside;
  if (residual) *residual = hz_R(0.0);
  if (!hz_usable(state, h) || hz_BAD_U(u)) return hz_BAD_INPUT;
  outside = hz_outside_box(state) | hz_outside_h(h);
  hz_track_start(state, &track);
  status = hz_advance(state, &track, h, hz_WITH_U(u) &left);
  if (residual) *residual = left;
  return status | outside | hz_outside_box(state);
}

#if hz_DERIVATIVES
/* hz_step with its derivatives, by the implicit-function theorem: rows are (q, p, s) after the step.

   by_state   (2 hz_N + 1, 2 hz_N + 1)  along (q, p, s) before it
   by_h       (2 hz_N + 1)
   by_input   (2 hz_N + 1, hz_M), where the model takes inputs

   Any of them and `residual` may be null; they are written on success only. */
static inline int hz_step_jacobian(hz_state *state, hz_real h, hz_TAKES_U hz_real *residual, hz_real *by_state,
    hz_WITH_U(hz_real *by_input) hz_real *by_h) {
  enum { SIZE = 2 * hz_N + 1, WIDTH = SIZE + 1 + hz_INPUTS * hz_N };
  const hz_state before = *state;
  hz_problem P;
  hz_real slopes[SIZE * WIDTH], move[hz_N];
  int i, j;
  const int status = hz_step(state, h, hz_WITH_U(u) residual);
  if (status & 15) return status;
  for (i = 0; i < hz_N; i++) {
    P.q0[i] = before.q[i];
    P.p0[i] = before.p[i];
    move[i] = state->q[i] - before.q[i];
  }
  P.s0 = before.s;
  P.h = h;
#if hz_INPUTS
  hz_push(u, P.push);
#endif
  hz_slopes(&P, move, slopes);
  for (i = 0; i < SIZE; i++) {
    for (j = 0; by_state && j < SIZE; j++) by_state[i * SIZE + j] = slopes[i * WIDTH + j];
    if (by_h) by_h[i] = slopes[i * WIDTH + SIZE];
#if hz_INPUTS
    for (j = 0; by_input && j < hz_M; j++) {
      int k;
      by_input[i * hz_M + j] = hz_R(0.0);
      for (k = 0; k < hz_N; k++)
        by_input[i * hz_M + j] += slopes[i * WIDTH + SIZE + 1 + k] * hz_input_map[k * hz_M + j];
    }
#endif
  }
  return status;
}
#endif

/* `steps` equal steps. Inputs u are (steps, hz_M), where the model takes some; none act where u is null.
   Entry 0 of each output is the start, entry k the state after k * every steps; the outputs hold
   1 + steps / every entries (q, p: hz_N numbers each) and may be null. Stops at the first failed step and returns its
   status: `state` is then the last good one and the entries not reached are NaN. Leaving the box stops nothing:
   hz_OUTSIDE_BOX is added to what is returned. */
static inline int hz_rollout(hz_state *state, hz_real h, hz_TAKES_U long steps, long every, hz_real *q_out,
    hz_real *p_out, hz_real *s_out) {
  hz_track track;
  hz_real residual;
  long k, entry;
  int i, status = hz_CONVERGED, outside;
  if (steps < 0 || every < 1 || !hz_usable(state, h)) return hz_BAD_INPUT;
  outside = hz_outside_box(state) | hz_outside_h(h);
  hz_track_start(state, &track);
  for (k = 0; k <= steps; k++) {
    if (k > 0 && !status) {
      status = hz_BAD_U(hz_U_OF_STEP(u, k - 1))
                   ? hz_BAD_INPUT
                   : hz_advance(state, &track, h, hz_WITH_U(hz_U_OF_STEP(u, k - 1)) &residual);
      outside |= hz_outside_box(state);
    }
    if (k % every) continue;
    entry = k / every;
    for (i = 0; i < hz_N; i++) {
      if (q_out) q_out[entry * hz_N + i] = status ? hz_nan() : state->q[i];
      if (p_out) p_out[entry * hz_N + i] = status ? hz_nan() : state->p[i];
    }
    if (s_out) s_out[entry] = status ? hz_nan() : state->s;
  }
  return status | outside;
}

#ifdef hz_BATCHED
/* Samples b .. b + LANES of an array, the last one repeated where it ends; sets statuses and flags. */
static inline void hz_wide_load(const hz_state *states, long b, long count, hz_real h, hz_wide_state *x,
    int status[hz_LANES], int flags[hz_LANES]) {
  int w;
  for (w = 0; w < hz_LANES; w++) {
    const hz_state *one = states + (b + w < count ? b + w : count - 1);
    hz_wide_set(x, w, one);
    status[w] = hz_usable(one, h) ? hz_CONVERGED : hz_BAD_INPUT;
    flags[w] = status[w] ? 0 : hz_outside_box(one) | hz_outside_h(h);
  }
}
#endif

/* hz_rollout of `count` samples, each as it would go by itself up to rounding: registers of them are stepped at once.
   The outputs hold one sample after the other; statuses[b] receives what hz_rollout would return. Any but `states` may
   be null. Returns the status of the first sample that failed, or 0, with the flags of any. */
static inline int hz_rollout_batch(long count, hz_state *states, hz_real h, hz_TAKES_U long steps, long every,
    hz_real *q_out, hz_real *p_out, hz_real *s_out, int *statuses) {
  const long entries = steps >= 0 && every > 0 ? 1 + steps / every : 0;
  long b = 0;
  int worst = 0, flagged = 0;
#ifdef hz_BATCHED
  hz_real all_h[hz_LANES];
  int n;
  for (n = 0; n < hz_LANES; n++) all_h[n] = h;
  for (; entries && count > 1 && b < count; b += hz_LANES) {
    hz_wide_state x;
    hz_wide_track track;
    hz_state one;
    hz_real residual[hz_LANES];
    int status[hz_LANES], flags[hz_LANES], i, w;
    long k;
    hz_wide_load(states, b, count, h, &x, status, flags);
    hz_wide_track_start(&x, &track);
    for (k = 0; k <= steps; k++) {
#if hz_INPUTS
      if (k > 0) {
        const hz_real *now[hz_LANES];
        for (w = 0; w < hz_LANES; w++) {
          now[w] = hz_U_OF_STEP(u, (b + w < count ? b + w : count - 1) * steps + k - 1);
          if (!status[w] && hz_BAD_U(now[w])) status[w] = hz_BAD_INPUT;
        }
        hz_wide_advance(&x, &track, all_h, now, status, residual);
      }
#else
      if (k > 0) hz_wide_advance(&x, &track, all_h, status, residual);
#endif
      if (!hz_BOXED && k % every) continue;
      for (w = 0; w < hz_LANES && b + w < count; w++) {
        const long at = (b + w) * entries + k / every;
        hz_wide_get(&x, w, &one);
        if (!status[w]) flags[w] |= hz_outside_box(&one);
        if (k % every) continue;
        for (i = 0; i < hz_N; i++) {
          if (q_out) q_out[at * hz_N + i] = status[w] ? hz_nan() : one.q[i];
          if (p_out) p_out[at * hz_N + i] = status[w] ? hz_nan() : one.p[i];
        }
        if (s_out) s_out[at] = status[w] ? hz_nan() : one.s;
      }
    }
    for (w = 0; w < hz_LANES && b + w < count; w++) {
      hz_wide_get(&x, w, states + b + w);
      if (!worst) worst = status[w];
      flagged |= flags[w];
      if (statuses) statuses[b + w] = status[w] | flags[w];
    }
  }
#endif
  for (; b < count; b++) {
    hz_real *const q = q_out ? q_out + b * entries * hz_N : 0, *const p = p_out ? p_out + b * entries * hz_N : 0;
    hz_real *const s = s_out ? s_out + b * entries : 0;
    const int status = hz_rollout(states + b, h, hz_WITH_U(hz_U_OF_STEP(u, b * steps)) steps, every, q, p, s);
    if (!worst) worst = status & 15;
    flagged |= status & ~15;
    if (statuses) statuses[b] = status;
  }
  return worst | flagged;
}

/* hz_step of `count` samples; `statuses` may be null. Returns as hz_rollout_batch. */
static inline int hz_step_batch(long count, hz_state *states, hz_real h, hz_TAKES_U int *statuses) {
  return hz_rollout_batch(count, states, h, hz_WITH_U(u) 1, 1, 0, 0, 0, statuses);
}
