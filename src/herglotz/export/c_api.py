"""The C functions a user calls: init, step, rollout and the box."""

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
  return h > R(0.0) && NAME_finite(h) && NAME_finite(NAME_length(state->q)) && NAME_finite(NAME_length(state->p)) &&
         NAME_finite(state->s) && state->sigma == state->sigma;
}

/* The state at q1 from two positions h apart: (q1, D2 L_d, s0 + L_d); sigma starts at 1. `out` is written on success
   only. Returns a status. */
static inline int NAME_init(const real q0[NAME_N], const real q1[NAME_N], real s0, real h, NAME_state *out) {
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
  if (!NAME_usable(&next, h) || !NAME_finite(NAME_length(q0))) return NAME_BAD_INPUT;
  NAME_potential(q0, &P.V0);
  NAME_potential(q1, &V1);
  NAME_evaluate(&P, 1, &t);
  NAME_legendre_plus(&P, &t, &V1, next.p, &next.s);
  if (!NAME_finite(NAME_length(next.p) + next.s)) return NAME_DIVERGED;
  *out = next;
  return NAME_outside_box(out);
}

/* One step of h > 0. The state changes on success only. `residual` (may be null) receives what is left of the step
   equation, |J^-1 F| in units of q. Returns a status, with NAME_OUTSIDE_BOX added where the step starts or ends
   outside the box. */
static inline int NAME_step(NAME_state *state, real h, real *residual) {
  NAME_track track;
  real left = R(0.0);
  int status, outside;
  if (residual) *residual = R(0.0);
  if (!NAME_usable(state, h)) return NAME_BAD_INPUT;
  outside = NAME_outside_box(state);
  NAME_track_start(state, &track);
  status = NAME_advance(state, &track, h, &left);
  if (residual) *residual = left;
  return status | outside | NAME_outside_box(state);
}

/* `steps` equal steps. Entry 0 of each output is the start, entry k the state after k * every steps; the outputs hold
   1 + steps / every entries (q, p: NAME_N numbers each) and may be null. Stops at the first failed step and returns its
   status: `state` is then the last good one and the entries not reached are NaN. Leaving the box stops nothing:
   NAME_OUTSIDE_BOX is added to what is returned. */
static inline int NAME_rollout(NAME_state *state, real h, long steps, long every, real *q_out, real *p_out,
    real *s_out) {
  NAME_track track;
  real residual;
  long k, entry;
  int i, status = NAME_CONVERGED, outside;
  if (steps < 0 || every < 1 || !NAME_usable(state, h)) return NAME_BAD_INPUT;
  outside = NAME_outside_box(state);
  NAME_track_start(state, &track);
  for (k = 0; k <= steps; k++) {
    if (k > 0 && !status) {
      status = NAME_advance(state, &track, h, &residual);
      outside |= NAME_outside_box(state);
    }
    if (k % every) continue;
    entry = k / every;
    for (i = 0; i < NAME_N; i++) {
      if (q_out) q_out[entry * NAME_N + i] = status ? (real)NAN : state->q[i];
      if (p_out) p_out[entry * NAME_N + i] = status ? (real)NAN : state->p[i];
    }
    if (s_out) s_out[entry] = status ? (real)NAN : state->s;
  }
  return status | outside;
}
"""
