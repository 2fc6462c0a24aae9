/* One step of a register of samples: networks and features vectorise over samples. */

typedef struct {
  hz_lanes q[hz_N], p[hz_N], s, sigma;
} hz_wide_state;

typedef struct {
  hz_wide_problem P;
  hz_lanes low_q[hz_N], low_p[hz_N], low_s, low_sigma;
#if !hz_EXPLICIT
  hz_lanes move[3][hz_N];
  hz_real miss[2][hz_LANES];
  int known[hz_LANES];
#endif
} hz_wide_track;

static inline void hz_wide_track_start(const hz_wide_state *state, hz_wide_track *track) {
  const hz_lanes zero = hz_spread(hz_R(0.0));
  int i;
  hz_wide_potential(state->q, &track->P.V0);
  track->P.h = zero;
  for (i = 0; i < hz_N; i++) track->low_q[i] = track->low_p[i] = zero;
  track->low_s = track->low_sigma = zero;
#if !hz_EXPLICIT
  for (i = 0; i < hz_N; i++) track->move[0][i] = track->move[1][i] = track->move[2][i] = zero;
  for (i = 0; i < hz_LANES; i++) {
    track->known[i] = 0;
    track->miss[0][i] = track->miss[1][i] = hz_R(0.0);
  }
#endif
}

static inline hz_lanes hz_wide_add(hz_lanes x, hz_lanes change, hz_lanes *low) {
  const hz_lanes add = change + *low, back = x + add - x;
  hz_lanes sum = x + add;
  int w;
  *low = (x - (sum - back)) + (add - back);
  for (w = 0; w < hz_LANES; w++) sum[w] = hz_flush(sum[w]);
  return sum;
}

#if !hz_EXPLICIT
/* J = L U without exchanging rows, and x = -J^-1 F; a lane where that fails does not converge. */
static inline void hz_wide_factorise(hz_lanes A[hz_N * hz_N]) {
  int i, j, k;
  for (k = 0; k < hz_N; k++) {
    A[k * hz_N + k] = hz_R(1.0) / A[k * hz_N + k];
    for (i = k + 1; i < hz_N; i++) {
      A[i * hz_N + k] *= A[k * hz_N + k];
      for (j = k + 1; j < hz_N; j++) A[i * hz_N + j] -= A[i * hz_N + k] * A[k * hz_N + j];
    }
  }
}

static inline void hz_wide_direction(const hz_lanes A[hz_N * hz_N], const hz_lanes F[hz_N], hz_lanes x[hz_N]) {
  int i, j;
  for (i = 0; i < hz_N; i++) {
    x[i] = -F[i];
    for (j = 0; j < i; j++) x[i] -= A[i * hz_N + j] * x[j];
  }
  for (i = hz_N - 1; i >= 0; i--) {
    for (j = i + 1; j < hz_N; j++) x[i] -= A[i * hz_N + j] * x[j];
    x[i] *= A[i * hz_N + i];
  }
}

static inline void hz_wide_length(const hz_lanes x[hz_N], hz_real size[hz_LANES]) {
  int i, w;
  for (w = 0; w < hz_LANES; w++) size[w] = hz_R(0.0);
  for (i = 0; i < hz_N; i++)
    for (w = 0; w < hz_LANES; w++) size[w] = hz_fabs(x[i][w]) > size[w] ? hz_fabs(x[i][w]) : size[w];
}

/* Newton without halved moves: `open` lanes that need more than that stay open, for hz_advance to solve. Lanes do not
   influence one another: one that has converged is not moved again, and keeps or renews J by its own sizes. */
static inline void hz_wide_solve(const hz_wide_problem *P, hz_wide_terms *t, int open[hz_LANES],
    hz_real residual[hz_LANES]) {
  hz_lanes A[hz_N * hz_N], delta[hz_N];
  hz_real scale[hz_LANES], size[hz_LANES], merit[hz_LANES], before[hz_LANES], last[hz_LANES];
  int renew[hz_LANES], i, w, iteration, left, second = 1;
  for (i = 0; i < hz_N; i++) t->rest[i] = hz_spread(hz_R(0.0));
  for (i = 0; i < hz_N * hz_N; i++) A[i] = hz_spread(hz_R(0.0));
  for (left = 0, w = 0; w < hz_LANES; w++) {
    renew[w] = 1;
    scale[w] = last[w] = before[w] = hz_R(0.0);
    left += open[w];
  }
  for (iteration = 0; iteration == 0 || (left && iteration < 8); iteration++) {
    if (second)
      hz_wide_evaluate(P, t);
    else
      hz_wide_evaluate_first(P, t);
    if (iteration == 0) {
      for (i = 0; i < hz_N * hz_N; i++) A[i] = t->J[i];
      hz_wide_factorise(A);
    } else if (second) {
      hz_wide_factorise(t->J);
      for (i = 0; i < hz_N * hz_N; i++)
        for (w = 0; w < hz_LANES; w++)
          if (renew[w]) A[i][w] = t->J[i][w];
    }
    hz_wide_direction(A, t->F, delta);
    hz_wide_length(delta, size);
    hz_wide_length(t->F, merit);
    if (iteration == 0) {
      hz_lanes q1[hz_N];
      hz_real other[hz_LANES];
      for (i = 0; i < hz_N; i++) q1[i] = P->q0[i] + t->move[i];
      hz_wide_length(P->q0, scale);
      hz_wide_length(q1, other);
      for (w = 0; w < hz_LANES; w++) {
        scale[w] = other[w] > scale[w] ? other[w] : scale[w];
        scale[w] = size[w] > scale[w] ? size[w] : scale[w];
      }
    }
    for (second = 0, w = 0; w < hz_LANES; w++) {
      hz_real rounding = P->h[w] * hz_top_speed;
      if (!open[w]) continue;
      residual[w] = size[w];
      rounding = hz_floor * (scale[w] > rounding ? scale[w] : rounding);
      if (size[w] <= hz_tolerance * scale[w] ||
          (iteration > 0 && merit[w] > before[w] && last[w] <= rounding && size[w] <= rounding)) {
        open[w] = 0;
        left--;
        for (i = 0; i < hz_N; i++) t->rest[i][w] = delta[i][w];
        continue;
      }
      if (!hz_finite(size[w]) || (iteration > 0 && merit[w] > before[w])) {
        open[w] = 2; /* not solved this way */
        left--;
        continue;
      }
      renew[w] = size[w] > hz_near * scale[w] || (iteration > 0 && size[w] > hz_R(0.1) * last[w]);
      if (renew[w]) second = 1;
      last[w] = size[w];
      before[w] = merit[w];
      for (i = 0; i < hz_N; i++) t->move[i][w] += delta[i][w];
    }
  }
}

/* As hz_solve_from_guess; `open` lanes that stay so are not solved. */
static inline void hz_wide_solve_from_guess(hz_wide_track *track, hz_wide_terms *t, int open[hz_LANES],
    hz_real residual[hz_LANES]) {
  hz_lanes guess[2][hz_N];
  int i, w;
  for (i = 0; i < hz_N; i++) {
    guess[0][i] = t->move[i];
    guess[1][i] = hz_R(3.0) * (track->move[0][i] - track->move[1][i]) + track->move[2][i];
    for (w = 0; w < hz_LANES; w++)
      if (!hz_STICKING && track->known[w] >= 3 && track->miss[1][w] < track->miss[0][w]) t->move[i][w] = guess[1][i][w];
  }
  hz_wide_solve(&track->P, t, open, residual);
  for (i = 0; i < hz_N; i++) {
    track->move[2][i] = track->move[1][i];
    track->move[1][i] = track->move[0][i];
    track->move[0][i] = t->move[i] + t->rest[i];
    guess[0][i] -= t->move[i];
    guess[1][i] -= t->move[i];
  }
  hz_wide_length(guess[0], track->miss[0]);
  hz_wide_length(guess[1], track->miss[1]);
  for (w = 0; w < hz_LANES; w++) track->known[w] += track->known[w] < 3;
}
#endif

/* Lane w of a register of states, and back. */
static inline void hz_wide_get(const hz_wide_state *x, int w, hz_state *one) {
  int i;
  for (i = 0; i < hz_N; i++) {
    one->q[i] = x->q[i][w];
    one->p[i] = x->p[i][w];
  }
  one->s = x->s[w];
  one->sigma = x->sigma[w];
}

static inline void hz_wide_set(hz_wide_state *x, int w, const hz_state *one) {
  int i;
  for (i = 0; i < hz_N; i++) {
    x->q[i][w] = one->q[i];
    x->p[i][w] = one->p[i];
  }
  x->s[w] = one->s;
  x->sigma[w] = one->sigma;
}

/* Lane w by itself: what hz_wide_advance cannot solve. */
static inline int hz_wide_alone(hz_wide_state *state, hz_real h, hz_TAKES_U int w, hz_real *residual) {
  hz_state one;
  hz_track track;
  int status;
  hz_wide_get(state, w, &one);
  hz_track_start(&one, &track);
  status = hz_advance(&one, &track, h, hz_WITH_U(u) residual);
  hz_wide_set(state, w, &one);
  return status;
}

/* hz_advance for every lane whose status is 0; a lane that fails gets its status and keeps its state. */
static inline void hz_wide_advance(hz_wide_state *state, hz_wide_track *track, const hz_real h[hz_LANES],
    hz_WITH_U(const hz_real *const u[hz_LANES])
    int status[hz_LANES], hz_real residual[hz_LANES]) {
  hz_wide_problem *P = &track->P;
  hz_wide_terms t;
  hz_wide_state next;
  hz_wide_potential_t V1;
  hz_lanes x[hz_N], dp[hz_N], ds, E, sum = hz_spread(hz_R(0.0)), low_q[hz_N], low_p[hz_N], low_s, low_sigma, moved;
  int open[hz_LANES], i, w, redo = 0, left = 0, changed = 0;
  for (w = 0; w < hz_LANES; w++) left += open[w] = status[w] == hz_CONVERGED;
  if (!left) return;
  for (w = 0; w < hz_LANES; w++) {
    residual[w] = hz_R(0.0);
    if (h[w] != P->h[w]) {
      P->h[w] = h[w];
      changed = 1;
#if !hz_EXPLICIT
      track->known[w] = 0;
#endif
    }
  }
  if (changed) hz_wide_prepare(P);
  for (i = 0; i < hz_N; i++) {
    P->q0[i] = state->q[i];
    P->p0[i] = state->p[i];
    low_q[i] = track->low_q[i];
    low_p[i] = track->low_p[i];
  }
  low_s = track->low_s;
  low_sigma = track->low_sigma;
  P->s0 = state->s;
#if hz_INPUTS
  for (w = 0; w < hz_LANES; w++) {
    hz_real push[hz_N];
    hz_push(u[w], push);
    for (i = 0; i < hz_N; i++) P->push[i][w] = push[i];
  }
#endif
  hz_wide_begin(P, t.move);
#if hz_EXPLICIT
  for (w = 0; w < hz_LANES; w++) open[w] = 0;
  for (i = 0; i < hz_N; i++) x[i] = t.move[i];
#else
  hz_wide_solve_from_guess(track, &t, open, residual);
  for (i = 0; i < hz_N; i++) x[i] = track->move[0][i];
#endif
  for (i = 0; i < hz_N; i++) {
    moved = x[i];
#if hz_STICKING /* as hz_moved */
    moved = hz_select((hz_masks)(moved > P->bound[i]), P->bound[i], moved);
    moved = x[i] - hz_select((hz_masks)(-P->bound[i] > moved), -P->bound[i], moved);
#endif
    next.q[i] = hz_wide_add(P->q0[i], moved, &low_q[i]);
  }
  hz_wide_potential(next.q, &V1);
  hz_wide_gains(P, &t, x, &V1, dp, &ds, &E);
  for (i = 0; i < hz_N; i++) {
    next.p[i] = hz_wide_add(P->p0[i], dp[i], &low_p[i]);
    sum += next.p[i] + next.q[i]; /* what is not finite stays so in a sum */
  }
  next.s = hz_wide_add(P->s0, ds, &low_s);
  next.sigma = hz_wide_add(state->sigma, E * state->sigma, &low_sigma);
  sum += next.s + next.sigma;
  for (w = 0; w < hz_LANES; w++) {
    hz_state one;
    if (status[w] == hz_CONVERGED && !open[w] && hz_finite(sum[w]) && hz_R(1.0) + E[w] > hz_R(0.0)) continue;
    redo = 1;
    hz_wide_get(state, w, &one);
    hz_wide_set(&next, w, &one);
    for (i = 0; i < hz_N; i++) low_q[i][w] = low_p[i][w] = hz_R(0.0);
    low_s[w] = low_sigma[w] = hz_R(0.0);
#if !hz_EXPLICIT
    track->known[w] = 0;
#endif
    if (status[w] == hz_CONVERGED) status[w] = hz_wide_alone(&next, h[w], hz_WITH_U(u[w]) w, &residual[w]);
  }
  if (redo) hz_wide_potential(next.q, &V1);
  *state = next;
  for (i = 0; i < hz_N; i++) {
    track->low_q[i] = low_q[i];
    track->low_p[i] = low_p[i];
  }
  track->low_s = low_s;
  track->low_sigma = low_sigma;
  P->V0 = V1;
}
