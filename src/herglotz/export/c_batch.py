"""The step in C for a register of samples at a time: networks and features vectorise over samples."""

from __future__ import annotations

BATCH = """
#define NAME_BATCHED
typedef struct {
  NAME_lanes q[NAME_N], p[NAME_N], s, sigma;
} NAME_wide_state;

typedef struct {
  NAME_wide_potential_t V;
  NAME_lanes low_q[NAME_N], low_p[NAME_N], low_s, low_sigma, h, root;
{%if linear}
  NAME_lanes E;
{%if stiff}
  NAME_lanes inverse[NAME_N * NAME_N];
{%end}
{%else}
  NAME_lanes move[3][NAME_N];
  real miss[2][NAME_LANES];
  int known[NAME_LANES];
{%end}
} NAME_wide_track;

static inline void NAME_wide_track_start(const NAME_wide_state *state, NAME_wide_track *track) {
  const NAME_lanes zero = NAME_spread(R(0.0));
  int i;
  NAME_wide_potential(state->q, &track->V);
  for (i = 0; i < NAME_N; i++) track->low_q[i] = track->low_p[i] = zero;
  track->low_s = track->low_sigma = track->h = track->root = zero;
{%if linear}
  track->E = zero;
{%if stiff}
  for (i = 0; i < NAME_N * NAME_N; i++) track->inverse[i] = zero;
{%end}
{%else}
  for (i = 0; i < NAME_N; i++) track->move[0][i] = track->move[1][i] = track->move[2][i] = zero;
  for (i = 0; i < NAME_LANES; i++) {
    track->known[i] = 0;
    track->miss[0][i] = track->miss[1][i] = R(0.0);
  }
{%end}
}

static inline NAME_lanes NAME_wide_add(NAME_lanes x, NAME_lanes change, NAME_lanes *low) {
  const NAME_lanes add = change + *low, back = x + add - x;
  NAME_lanes sum = x + add;
  int w;
  *low = (x - (sum - back)) + (add - back);
  for (w = 0; w < NAME_LANES; w++) sum[w] = NAME_flush(sum[w]);
  return sum;
}

{%if !linear}
/* J = L U without exchanging rows, and x = -J^-1 F; a lane where that fails does not converge. */
static inline void NAME_wide_factorise(NAME_lanes A[NAME_N][NAME_N]) {
  int i, j, k;
  for (k = 0; k < NAME_N; k++) {
    A[k][k] = R(1.0) / A[k][k];
    for (i = k + 1; i < NAME_N; i++) {
      A[i][k] *= A[k][k];
      for (j = k + 1; j < NAME_N; j++) A[i][j] -= A[i][k] * A[k][j];
    }
  }
}

static inline void NAME_wide_direction(NAME_lanes A[NAME_N][NAME_N], const NAME_lanes F[NAME_N],
    NAME_lanes x[NAME_N]) {
  int i, j;
  for (i = 0; i < NAME_N; i++) {
    x[i] = -F[i];
    for (j = 0; j < i; j++) x[i] -= A[i][j] * x[j];
  }
  for (i = NAME_N - 1; i >= 0; i--) {
    for (j = i + 1; j < NAME_N; j++) x[i] -= A[i][j] * x[j];
    x[i] *= A[i][i];
  }
}

static inline void NAME_wide_length(const NAME_lanes x[NAME_N], real size[NAME_LANES]) {
  int i, w;
  for (w = 0; w < NAME_LANES; w++) size[w] = R(0.0);
  for (i = 0; i < NAME_N; i++)
    for (w = 0; w < NAME_LANES; w++) size[w] = FABS(x[i][w]) > size[w] ? FABS(x[i][w]) : size[w];
}

/* Newton without halved moves: `open` lanes that need more than that stay open, for NAME_advance to solve. Lanes do not
   influence one another: one that has converged is not moved again, and keeps or renews J by its own sizes. */
static inline void NAME_wide_solve(const NAME_wide_problem *P, NAME_wide_terms *t, int open[NAME_LANES],
    real residual[NAME_LANES]) {
  NAME_lanes A[NAME_N][NAME_N], delta[NAME_N];
  real scale[NAME_LANES], size[NAME_LANES], merit[NAME_LANES], before[NAME_LANES], last[NAME_LANES];
  int renew[NAME_LANES], i, j, w, iteration, left, order = 2;
  for (i = 0; i < NAME_N; i++) {
    t->rest[i] = NAME_spread(R(0.0));
    for (j = 0; j < NAME_N; j++) A[i][j] = t->rest[i];
  }
  for (left = 0, w = 0; w < NAME_LANES; w++) {
    renew[w] = 1;
    scale[w] = last[w] = before[w] = R(0.0);
    left += open[w];
  }
  for (iteration = 0; iteration == 0 || (left && iteration < 8); iteration++) {
    NAME_wide_evaluate(P, order, t);
    if (iteration == 0) {
      for (i = 0; i < NAME_N; i++)
        for (j = 0; j < NAME_N; j++) A[i][j] = t->J[i][j];
      NAME_wide_factorise(A);
    } else if (order == 2) {
      NAME_wide_factorise(t->J);
      for (i = 0; i < NAME_N; i++)
        for (j = 0; j < NAME_N; j++)
          for (w = 0; w < NAME_LANES; w++)
            if (renew[w]) A[i][j][w] = t->J[i][j][w];
    }
    NAME_wide_direction(A, t->F, delta);
    NAME_wide_length(delta, size);
    NAME_wide_length(t->F, merit);
    if (iteration == 0) {
      NAME_lanes q1[NAME_N];
      real other[NAME_LANES];
      for (i = 0; i < NAME_N; i++) q1[i] = P->q0[i] + t->move[i];
      NAME_wide_length(P->q0, scale);
      NAME_wide_length(q1, other);
      for (w = 0; w < NAME_LANES; w++) {
        scale[w] = other[w] > scale[w] ? other[w] : scale[w];
        scale[w] = size[w] > scale[w] ? size[w] : scale[w];
      }
    }
    for (order = 1, w = 0; w < NAME_LANES; w++) {
      real rounding = P->h[w] * NAME_top_speed;
      if (!open[w]) continue;
      residual[w] = size[w];
      rounding = NAME_floor * (scale[w] > rounding ? scale[w] : rounding);
      if (size[w] <= NAME_tolerance * scale[w] || (iteration > 0 && merit[w] > before[w] &&
          last[w] <= rounding && size[w] <= rounding)) {
        open[w] = 0;
        left--;
        for (i = 0; i < NAME_N; i++) t->rest[i][w] = delta[i][w];
        continue;
      }
      if (!NAME_finite(size[w]) || (iteration > 0 && merit[w] > before[w])) {
        open[w] = 2;  /* not solved this way */
        left--;
        continue;
      }
      renew[w] = size[w] > NAME_near * scale[w] || (iteration > 0 && size[w] > R(0.1) * last[w]);
      if (renew[w]) order = 2;
      last[w] = size[w];
      before[w] = merit[w];
      for (i = 0; i < NAME_N; i++) t->move[i][w] += delta[i][w];
    }
  }
}
{%end}

/* Lane w by itself: what NAME_wide_advance cannot solve. */
static inline int NAME_wide_alone(NAME_wide_state *state, real h, {%if inputs}const real *u, {%end}int w,
    real *residual) {
  NAME_state one;
  NAME_track track;
  int i, status;
  for (i = 0; i < NAME_N; i++) {
    one.q[i] = state->q[i][w];
    one.p[i] = state->p[i][w];
  }
  one.s = state->s[w];
  one.sigma = state->sigma[w];
  NAME_track_start(&one, &track);
  status = NAME_advance(&one, &track, h, {%if inputs}u, {%end}residual);
  for (i = 0; i < NAME_N; i++) {
    state->q[i][w] = one.q[i];
    state->p[i][w] = one.p[i];
  }
  state->s[w] = one.s;
  state->sigma[w] = one.sigma;
  return status;
}

/* NAME_advance for every lane whose status is 0; a lane that fails gets its status and keeps its state. */
static inline void NAME_wide_advance(NAME_wide_state *state, NAME_wide_track *track, const real h[NAME_LANES],
    {%if inputs}const real *const u[NAME_LANES], {%end}int status[NAME_LANES], real residual[NAME_LANES]) {
  NAME_wide_problem P;
  NAME_wide_terms t;
  NAME_wide_state next;
  NAME_wide_potential_t V1;
  NAME_lanes dp[NAME_N], ds, sum = NAME_spread(R(0.0)), low_q[NAME_N], low_p[NAME_N], low_s, low_sigma;
  int open[NAME_LANES], i, w, redo = 0, left = 0;
  for (w = 0; w < NAME_LANES; w++) left += open[w] = status[w] == NAME_CONVERGED;
  if (!left) return;
  for (w = 0; w < NAME_LANES; w++) {
    residual[w] = R(0.0);
    if (h[w] != track->h[w]) {
      track->h[w] = h[w];
      track->root[w] = EXP(R(-0.5) * NAME_rate * h[w]);
{%if linear}
      track->E[w] = EXPM1(-NAME_rate * h[w]);
{%if stiff}
      {
        real inverse[NAME_N * NAME_N];
        NAME_invert(h[w], track->root[w], inverse);
        for (i = 0; i < NAME_N * NAME_N; i++) track->inverse[i][w] = inverse[i];
      }
{%end}
{%else}
      track->known[w] = 0;
{%end}
    }
  }
  for (i = 0; i < NAME_N; i++) {
    P.q0[i] = state->q[i];
    P.p0[i] = state->p[i];
    low_q[i] = track->low_q[i];
    low_p[i] = track->low_p[i];
  }
  low_s = track->low_s;
  low_sigma = track->low_sigma;
  P.s0 = state->s;
  P.h = track->h;
  P.V0 = track->V;
{%if inputs}
  for (w = 0; w < NAME_LANES; w++) {
    real push[NAME_N];
    NAME_push(u[w], push);
    for (i = 0; i < NAME_N; i++) P.push[i][w] = push[i];
  }
{%end}
  NAME_wide_leapfrog(&P, track->root, {%if stiff}track->inverse, {%end}t.move);
{%if linear}
  t.E = track->E;
  t.root = track->root;
  t.c = R(1.0) + t.E;
  t.K = NAME_spread(R(0.0));
{%if stiff}
  NAME_wide_friction(&P, &t);
  for (i = 0; i < NAME_N * NAME_N; i++)
    t.K += NAME_mass[i] * t.move[i / NAME_N] * t.move[i % NAME_N] / (R(2.0) * P.h);
{%else}
  for (i = 0; i < NAME_N; i++) t.K += t.root * (P.p0[i] - P.h / R(2.0) * P.V0.slope[i]) * t.move[i] / R(2.0);
{%end}
  for (w = 0; w < NAME_LANES; w++) open[w] = 0;
{%else}
  {
    NAME_lanes guess[2][NAME_N];
    for (i = 0; i < NAME_N; i++) {
      guess[0][i] = t.move[i];
      guess[1][i] = R(3.0) * (track->move[0][i] - track->move[1][i]) + track->move[2][i];
      for (w = 0; w < NAME_LANES; w++)
        if (track->known[w] >= 3 && track->miss[1][w] < track->miss[0][w]) t.move[i][w] = guess[1][i][w];
    }
    NAME_wide_solve(&P, &t, open, residual);
    for (i = 0; i < NAME_N; i++) {
      track->move[2][i] = track->move[1][i];
      track->move[1][i] = track->move[0][i];
      track->move[0][i] = t.move[i] + t.rest[i];
      guess[0][i] -= t.move[i];
      guess[1][i] -= t.move[i];
    }
    NAME_wide_length(guess[0], track->miss[0]);
    NAME_wide_length(guess[1], track->miss[1]);
    for (w = 0; w < NAME_LANES; w++) track->known[w] += track->known[w] < 3;
  }
{%end}
  for (i = 0; i < NAME_N; i++)
{%if linear}
    next.q[i] = NAME_wide_add(P.q0[i], t.move[i], &low_q[i]);
{%else}
    next.q[i] = NAME_wide_add(P.q0[i], track->move[0][i], &low_q[i]);
{%end}
  NAME_wide_potential(next.q, &V1);
  NAME_wide_increments(&P, &t, &V1, dp, &ds);
  for (i = 0; i < NAME_N; i++) {
    next.p[i] = NAME_wide_add(P.p0[i], dp[i], &low_p[i]);
    sum += NAME_wide_fabs(t.move[i]) + NAME_wide_fabs(dp[i]) + NAME_wide_fabs(next.q[i]);
  }
  next.s = NAME_wide_add(P.s0, ds, &low_s);
  next.sigma = NAME_wide_add(state->sigma, t.E * state->sigma, &low_sigma);
  sum += NAME_wide_fabs(ds);
  for (w = 0; w < NAME_LANES; w++) {
    if (status[w] == NAME_CONVERGED && !open[w] && NAME_finite(sum[w]) && t.c[w] > R(0.0)) continue;
    redo = 1;
    open[w] = 1;
    for (i = 0; i < NAME_N; i++) {
      next.q[i][w] = state->q[i][w];
      next.p[i][w] = state->p[i][w];
      low_q[i][w] = low_p[i][w] = R(0.0);
    }
    next.s[w] = state->s[w];
    next.sigma[w] = state->sigma[w];
    low_s[w] = low_sigma[w] = R(0.0);
{%if !linear}
    track->known[w] = 0;
{%end}
    if (status[w] == NAME_CONVERGED) status[w] = NAME_wide_alone(&next, h[w], {%if inputs}u[w], {%end}w, &residual[w]);
  }
  if (redo) NAME_wide_potential(next.q, &V1);
  *state = next;
  for (i = 0; i < NAME_N; i++) {
    track->low_q[i] = low_q[i];
    track->low_p[i] = low_p[i];
  }
  track->low_s = low_s;
  track->low_sigma = low_sigma;
  track->V = V1;
}
"""
