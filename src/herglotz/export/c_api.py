"""The C functions a user calls: init, step, rollout, their batches and the box."""

from __future__ import annotations

API = """
/* NAME_OUTSIDE_BOX where a state lies outside the box the model was fitted in (angles count modulo a turn), or 0. */
static inline int NAME_outside_box(const NAME_state *state) {
{%if box}
  int i;
  for (i = 0; i < NAME_N; i++) {
    real q = state->q[i];
    if (NAME_is_angle[i]) {
      const real turn = R(6.28318530717958647693), middle = (NAME_q_low[i] + NAME_q_high[i]) / R(2.0);
      q -= turn * FLOOR((q - middle) / turn + R(0.5));
    }
    if (!(q >= NAME_q_low[i] && q <= NAME_q_high[i])) return NAME_OUTSIDE_BOX;
    if (!(state->p[i] >= NAME_p_low[i] && state->p[i] <= NAME_p_high[i])) return NAME_OUTSIDE_BOX;
  }
  return state->s >= NAME_s_low && state->s <= NAME_s_high ? 0 : NAME_OUTSIDE_BOX;
{%else}
  (void)state;
  return 0;
{%end}
}

static inline int NAME_usable(const NAME_state *state, real h) {
  return NAME_finite(h) && h > R(0.0) && NAME_all_finite(state->q) && NAME_all_finite(state->p) &&
         NAME_finite(state->s) && NAME_finite(state->sigma);
}

{%if inputs}
static inline int NAME_inputs_finite(const real *u) {
  int j, good = 1;
  for (j = 0; j < NAME_M; j++) good &= NAME_finite(u[j]);
  return good;
}

{%end}
static inline int NAME_outside_h(real h) {
  return h >= NAME_h_low && h <= NAME_h_high ? 0 : NAME_OUTSIDE_H;
}

/* The state at q1 from two positions h apart: (q1, D2 L_d, s0 + L_d); sigma starts at 1. `out` is written on success
   only. Returns a status. */
static inline int NAME_init(const real q0[NAME_N], const real q1[NAME_N], real s0, real h,
    {%if inputs}const real *u, {%end}NAME_state *out) {
  NAME_problem P;
  NAME_terms t;
  NAME_potential_t V1;
  NAME_state next;
  int i;
  for (i = 0; i < NAME_N; i++) {
    P.q0[i] = q0[i];
    P.p0[i] = R(0.0);
    next.q[i] = q1[i];
    next.p[i] = t.move[i] = q1[i] - q0[i];
  }
  P.s0 = next.s = s0;
  P.h = h;
  next.sigma = R(1.0);
  if (!NAME_usable(&next, h) || !NAME_all_finite(q0)) return NAME_BAD_INPUT;
{%if inputs}
  if (u && !NAME_inputs_finite(u)) return NAME_BAD_INPUT;
  NAME_push(u, P.push);
{%end}
  NAME_potential(q0, &P.V0);
  NAME_potential(q1, &V1);
  NAME_evaluate(&P, 1, &t);
  NAME_legendre_plus(&P, &t, &V1, next.p, &next.s);
  if (!NAME_all_finite(next.p) || !NAME_finite(next.s)) return NAME_DIVERGED;
  *out = next;
  return NAME_outside_box(out) | NAME_outside_h(h);
}

/* One step of h > 0. The state changes on success only. `residual` (may be null) receives what is left of the step
   equation, |J^-1 F| in units of q. Returns a status, with NAME_OUTSIDE_BOX added where the step starts or ends
   outside the box and NAME_OUTSIDE_H where h is not one of the range the model was fitted for. */
static inline int NAME_step(NAME_state *state, real h, {%if inputs}const real *u, {%end}real *residual) {
  NAME_track track;
  real left = R(0.0);
  int status, outside;
  if (residual) *residual = R(0.0);
  if (!NAME_usable(state, h)) return NAME_BAD_INPUT;
{%if inputs}
  if (u && !NAME_inputs_finite(u)) return NAME_BAD_INPUT;
{%end}
  outside = NAME_outside_box(state) | NAME_outside_h(h);
  NAME_track_start(state, &track);
  status = NAME_advance(state, &track, h, {%if inputs}u, {%end}&left);
  if (residual) *residual = left;
  return status | outside | NAME_outside_box(state);
}

/* `steps` equal steps. {%if inputs}Inputs u (steps, NAME_M); none act where it is null. {%end}
   Entry 0 of each output is the start, entry k the state after k * every steps; the outputs hold
   1 + steps / every entries (q, p: NAME_N numbers each) and may be null. Stops at the first failed step and returns its
   status: `state` is then the last good one and the entries not reached are NaN. Leaving the box stops nothing:
   NAME_OUTSIDE_BOX is added to what is returned. */
static inline int NAME_rollout(NAME_state *state, real h,
    {%if inputs}const real *u, {%end}long steps, long every, real *q_out, real *p_out, real *s_out) {
  NAME_track track;
  real residual;
  long k, entry;
  int i, status = NAME_CONVERGED, outside;
  if (steps < 0 || every < 1 || !NAME_usable(state, h)) return NAME_BAD_INPUT;
  outside = NAME_outside_box(state) | NAME_outside_h(h);
  NAME_track_start(state, &track);
  for (k = 0; k <= steps; k++) {
    if (k > 0 && !status) {
{%if inputs}
      const real *now = u ? u + (k - 1) * NAME_M : 0;
      status = now && !NAME_inputs_finite(now) ? NAME_BAD_INPUT : NAME_advance(state, &track, h, now, &residual);
{%else}
      status = NAME_advance(state, &track, h, &residual);
{%end}
      outside |= NAME_outside_box(state);
    }
    if (k % every) continue;
    entry = k / every;
    for (i = 0; i < NAME_N; i++) {
      if (q_out) q_out[entry * NAME_N + i] = status ? NAME_nan() : state->q[i];
      if (p_out) p_out[entry * NAME_N + i] = status ? NAME_nan() : state->p[i];
    }
    if (s_out) s_out[entry] = status ? NAME_nan() : state->s;
  }
  return status | outside;
}
"""

BATCHES = """
{%if wide}
#ifdef NAME_LANE_BYTES
/* Samples b .. b + LANES of an array, the last one repeated where it ends; sets statuses and flags. */
static inline void NAME_wide_load(const NAME_state *states, long b, long count, real h, NAME_wide_state *x,
    int status[NAME_LANES], int flags[NAME_LANES]) {
  int i, w;
  for (w = 0; w < NAME_LANES; w++) {
    const NAME_state *one = states + (b + w < count ? b + w : count - 1);
    for (i = 0; i < NAME_N; i++) {
      x->q[i][w] = one->q[i];
      x->p[i][w] = one->p[i];
    }
    x->s[w] = one->s;
    x->sigma[w] = one->sigma;
    status[w] = NAME_usable(one, h) ? NAME_CONVERGED : NAME_BAD_INPUT;
    flags[w] = status[w] ? 0 : NAME_outside_box(one) | NAME_outside_h(h);
  }
}

static inline void NAME_wide_get(const NAME_wide_state *x, int w, NAME_state *one) {
  int i;
  for (i = 0; i < NAME_N; i++) {
    one->q[i] = x->q[i][w];
    one->p[i] = x->p[i][w];
  }
  one->s = x->s[w];
  one->sigma = x->sigma[w];
}
#endif
{%end}

/* NAME_rollout of `count` samples, each as it would go by itself up to rounding: registers of them are stepped at once.
   The outputs hold one sample after the other; statuses[b] receives what NAME_rollout would return. Any but `states`
   may be null. Returns the status of the first sample that failed, or 0, with the flags of any. */
static inline int NAME_rollout_batch(long count, NAME_state *states, real h,
    {%if inputs}const real *u, {%end}long steps, long every, real *q_out, real *p_out, real *s_out, int *statuses) {
  const long entries = steps >= 0 && every > 0 ? 1 + steps / every : 0;
  long b = 0;
  int worst = 0, flagged = 0;
{%if wide}
#ifdef NAME_LANE_BYTES
  real all_h[NAME_LANES];
  int n;
  for (n = 0; n < NAME_LANES; n++) all_h[n] = h;
  for (; entries && count > 1 && b < count; b += NAME_LANES) {
    NAME_wide_state x;
    NAME_wide_track track;
    NAME_state one;
    real residual[NAME_LANES];
    int status[NAME_LANES], flags[NAME_LANES], i, w;
    long k;
    NAME_wide_load(states, b, count, h, &x, status, flags);
    NAME_wide_track_start(&x, &track);
    for (k = 0; k <= steps; k++) {
{%if inputs}
      if (k > 0) {
        const real *now[NAME_LANES];
        for (w = 0; w < NAME_LANES; w++) {
          now[w] = u ? u + (((b + w < count ? b + w : count - 1) * steps) + k - 1) * NAME_M : 0;
          if (now[w] && !status[w] && !NAME_inputs_finite(now[w])) status[w] = NAME_BAD_INPUT;
        }
        NAME_wide_advance(&x, &track, all_h, now, status, residual);
      }
{%else}
      if (k > 0) NAME_wide_advance(&x, &track, all_h, status, residual);
{%end}
      if (!NAME_BOXED && k % every) continue;
      for (w = 0; w < NAME_LANES && b + w < count; w++) {
        const long at = (b + w) * entries + k / every;
        NAME_wide_get(&x, w, &one);
        if (!status[w]) flags[w] |= NAME_outside_box(&one);
        if (k % every) continue;
        for (i = 0; i < NAME_N; i++) {
          if (q_out) q_out[at * NAME_N + i] = status[w] ? NAME_nan() : one.q[i];
          if (p_out) p_out[at * NAME_N + i] = status[w] ? NAME_nan() : one.p[i];
        }
        if (s_out) s_out[at] = status[w] ? NAME_nan() : one.s;
      }
    }
    for (w = 0; w < NAME_LANES && b + w < count; w++) {
      NAME_wide_get(&x, w, states + b + w);
      if (!worst) worst = status[w];
      flagged |= flags[w];
      if (statuses) statuses[b + w] = status[w] | flags[w];
    }
  }
#endif
{%end}
  for (; b < count; b++) {
    const int status = NAME_rollout(states + b, h,
        {%if inputs}u ? u + b * steps * NAME_M : 0, {%end}steps, every, q_out ? q_out + b * entries * NAME_N : 0,
        p_out ? p_out + b * entries * NAME_N : 0, s_out ? s_out + b * entries : 0);
    if (!worst) worst = status & 15;
    flagged |= status & ~15;
    if (statuses) statuses[b] = status;
  }
  return worst | flagged;
}

/* NAME_step of `count` samples; `statuses` may be null. Returns as NAME_rollout_batch. */
static inline int NAME_step_batch(long count, NAME_state *states, real h,
    {%if inputs}const real *u, {%end}int *statuses) {
  return NAME_rollout_batch(count, states, h, {%if inputs}u, {%end}1, 1, 0, 0, 0, statuses);
}
"""
