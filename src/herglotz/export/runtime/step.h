/* One step of FN_WIDTH samples at once: elimination, Newton's method with backtracking, the guess, and the track of a
   run. A REAL holds a number of each sample, FN_LANE is the number of one sample. Samples do not influence one another.
   A header holds this file twice: for one sample, and for a register of samples. */

/* The track of a run of steps: V(q) and the numbers of h alone, both in P; the rounding errors of q, p, s and sigma from
   the additions so far; and, for the guess, the last moves. */
typedef struct {
  FN_problem P;
  REAL low_q[hz_N], low_p[hz_N], low_s, low_sigma;
#if hz_CONTINUES
  REAL move[3][hz_N];
  hz_real miss[2][FN_WIDTH];
  int known[FN_WIDTH];
#endif
} FN_track;

static inline void FN_track_start(const FN_state *state, hz_TAKES_THETA FN_track *track) {
  const REAL zero = SPREAD(hz_R(0.0));
  int i;
#if hz_P
  for (i = 0; i < hz_P; i++) track->P.theta[i] = SPREAD(theta ? theta->value[i] : hz_defaults.value[i]);
#endif
  FN_potential(state->q, hz_WITH_THETA(track->P.theta) &track->P.V0);
  track->P.h = zero;
  for (i = 0; i < hz_N; i++) track->low_q[i] = track->low_p[i] = zero;
  track->low_s = track->low_sigma = zero;
#if hz_CONTINUES
  for (i = 0; i < hz_N; i++) track->move[0][i] = track->move[1][i] = track->move[2][i] = zero;
  for (i = 0; i < FN_WIDTH; i++) {
    track->known[i] = 0;
    track->miss[0][i] = track->miss[1][i] = hz_R(0.0);
  }
#endif
}

/* x + change, with the rounding error kept in `low` for the next addition. Zero where the sum is so small that its
   square and its products are subnormal: a motion at rest would otherwise step many times slower. */
static inline REAL FN_add(REAL x, REAL change, REAL *low) {
  const REAL add = change + *low, sum = x + add, back = sum - x;
  *low = (x - (sum - back)) + (add - back);
  return FN_choose(SPREAD(hz_R(hz_TINY)), FN_fabs(sum), SPREAD(hz_R(0.0)), sum);
}

/* J and its factors. A single sample exchanges rows by partial pivoting. Samples in registers do not; where J needs an
   exchange, they do not converge. */
typedef struct {
  REAL lu[hz_N][hz_N];
  int row[hz_N];
} FN_factors;

static inline void FN_factorise(FN_factors *A) {
  int i, j, k;
  for (k = 0; k < hz_N; k++) {
    if (FN_WIDTH == 1 && hz_N > 1) {
      int best = k;
      for (i = k + 1; i < hz_N; i++)
        if (hz_fabs(FN_LANE(A->lu[i][k], 0)) > hz_fabs(FN_LANE(A->lu[best][k], 0))) best = i;
      A->row[k] = best;
      for (j = 0; j < hz_N; j++) {
        const REAL other = A->lu[best][j];
        A->lu[best][j] = A->lu[k][j];
        A->lu[k][j] = other;
      }
    }
    A->lu[k][k] = hz_R(1.0) / A->lu[k][k];
    for (i = k + 1; i < hz_N; i++) {
      A->lu[i][k] *= A->lu[k][k];
      for (j = k + 1; j < hz_N; j++) A->lu[i][j] -= A->lu[i][k] * A->lu[k][j];
    }
  }
}

/* x = -J^-1 F. */
static inline void FN_direction(const FN_factors *A, const REAL F[hz_N], REAL x[hz_N]) {
  int i, j;
  for (i = 0; i < hz_N; i++) x[i] = -F[i];
  for (i = 0; FN_WIDTH == 1 && i < hz_N - 1; i++) {
    const REAL other = x[A->row[i]];
    x[A->row[i]] = x[i];
    x[i] = other;
  }
  for (i = 0; i < hz_N; i++)
    for (j = 0; j < i; j++) x[i] -= A->lu[i][j] * x[j];
  for (i = hz_N - 1; i >= 0; i--) {
    for (j = i + 1; j < hz_N; j++) x[i] -= A->lu[i][j] * x[j];
    x[i] *= A->lu[i][i];
  }
}

/* The largest |x_i|. */
static inline void FN_length(const REAL x[hz_N], hz_real size[FN_WIDTH]) {
  int i, w;
  for (w = 0; w < FN_WIDTH; w++) size[w] = hz_R(0.0);
  for (i = 0; i < hz_N; i++)
    for (w = 0; w < FN_WIDTH; w++) {
      const hz_real one = hz_fabs(FN_LANE(x[i], w));
      size[w] = one > size[w] ? one : size[w];
    }
}

#if !hz_EXPLICIT
/* Solve F(q1) = 0 from the guess in t->move, where the status is 0. A point close to the last point keeps J, as long as
   the moves shrink; rounding ends the iteration. A move that does not lessen |F| is taken back: then J is evaluated again
   if it was an old one, else the move is halved. In registers a sample that needs this is left unsolved. */
static inline void FN_solve(const FN_problem *P, FN_terms *t, int status[FN_WIDTH], hz_real residual[FN_WIDTH]) {
  const int most = FN_WIDTH == 1 ? hz_max_iterations : 7;
  FN_factors A, now;
  REAL delta[hz_N], base[hz_N], taken[hz_N], q1[hz_N];
  hz_real scale[FN_WIDTH], size[FN_WIDTH], merit[FN_WIDTH], before[FN_WIDTH], last[FN_WIDTH];
  hz_real part[FN_WIDTH]; /* of the last move; 0 where any finite F is accepted */
  int open[FN_WIDTH], renew[FN_WIDTH], old[FN_WIDTH], i, w, iteration, left = 0, second = 1;
  for (i = 0; i < hz_N; i++) {
    t->rest[i] = base[i] = taken[i] = SPREAD(hz_R(0.0));
    A.row[i] = i;
  }
  for (i = 0; i < hz_N * hz_N; i++) A.lu[i / hz_N][i % hz_N] = SPREAD(hz_R(0.0));
  for (w = 0; w < FN_WIDTH; w++) {
    left += open[w] = status[w] == hz_CONVERGED;
    scale[w] = last[w] = before[w] = part[w] = hz_R(0.0);
    renew[w] = 1;
    old[w] = 0;
  }
  FN_evaluate(P, t);
  for (iteration = 0; left; iteration++) {
    if (second) {
      for (i = 0; i < hz_N * hz_N; i++) now.lu[i / hz_N][i % hz_N] = t->J[i];
      FN_factorise(&now);
      for (i = 0; i < hz_N * hz_N; i++)
        for (w = 0; w < FN_WIDTH; w++)
          if (renew[w]) FN_LANE(A.lu[i / hz_N][i % hz_N], w) = FN_LANE(now.lu[i / hz_N][i % hz_N], w);
      for (i = 0; FN_WIDTH == 1 && i < hz_N; i++) A.row[i] = now.row[i];
    }
    FN_direction(&A, t->F, delta);
    FN_length(delta, size);
    FN_length(t->F, merit);
    if (iteration == 0) {
      hz_real other[FN_WIDTH];
      for (i = 0; i < hz_N; i++) q1[i] = P->q0[i] + t->move[i];
      FN_length(P->q0, scale);
      FN_length(q1, other);
      for (w = 0; w < FN_WIDTH; w++) {
        scale[w] = other[w] > scale[w] ? other[w] : scale[w];
        scale[w] = size[w] > scale[w] ? size[w] : scale[w];
      }
    }
    for (second = 0, w = 0; w < FN_WIDTH; w++) {
      const hz_real fastest = FN_LANE(P->h, w) * hz_top_speed;
      const hz_real rounding = hz_floor * (scale[w] > fastest ? scale[w] : fastest);
      int finite = 1, better;
      if (!open[w]) continue;
      for (i = 0; FN_WIDTH == 1 && i < hz_N; i++) finite &= hz_finite(FN_LANE(t->F[i], w));
      better = finite && (part[w] == hz_R(0.0) || merit[w] <= (hz_R(1.0) - hz_R(1e-4) * part[w]) * before[w]);
      if (better) residual[w] = size[w];
      for (i = 0; better && FN_WIDTH == 1 && i < hz_N; i++) finite &= hz_finite(FN_LANE(delta[i], w));
      if (!finite && (better || iteration == 0)) {
        status[w] = better ? hz_SINGULAR : hz_DIVERGED;
        open[w] = 0;
      } else if (finite && (size[w] <= hz_tolerance * scale[w] ||
                               (!better && last[w] <= rounding && size[w] <= rounding))) {
        for (i = 0; i < hz_N; i++) FN_LANE(t->rest[i], w) = FN_LANE(delta[i], w);
        open[w] = 0;
      } else if (better && part[w] == hz_R(0.0) && iteration > 0 && last[w] <= rounding) {
        open[w] = 0; /* back from a move that rounding decided */
      } else if (better) {
        old[w] = !renew[w];
        renew[w] = size[w] > hz_near * scale[w] || (iteration > 0 && size[w] > hz_R(0.1) * last[w]);
        part[w] = hz_R(1.0);
        last[w] = size[w];
        before[w] = merit[w];
        for (i = 0; i < hz_N; i++) {
          if (FN_WIDTH == 1) base[i] = t->move[i];
          if (FN_WIDTH == 1) taken[i] = delta[i];
          FN_LANE(t->move[i], w) += FN_LANE(delta[i], w);
        }
      } else if (FN_WIDTH > 1) {
        status[w] = hz_MAX_ITERATIONS;
        open[w] = 0;
      } else {
        part[w] = old[w] || last[w] <= rounding ? hz_R(0.0) : part[w] / hz_R(2.0);
        for (i = 0; i < hz_N; i++) FN_LANE(t->move[i], w) = FN_LANE(base[i], w) + part[w] * FN_LANE(taken[i], w);
        renew[w] = 1;
        old[w] = 0;
      }
      if (open[w] && iteration == most) status[w] = hz_MAX_ITERATIONS;
      left -= !open[w];
      second |= open[w] && renew[w];
    }
    if (iteration == most) return;
    if (second)
      FN_evaluate(P, t);
    else if (left)
      FN_evaluate_first(P, t);
  }
}

#if hz_CONTINUES
/* The solution from the better of two guesses: the uncoupled leapfrog step, which t->move holds on entry, and the cubic
   through the last four positions. */
static inline void FN_solve_from_guess(FN_track *track, FN_terms *t, int status[FN_WIDTH], hz_real residual[FN_WIDTH]) {
  REAL guess[2][hz_N];
  int i, w;
  for (i = 0; i < hz_N; i++) {
    guess[0][i] = t->move[i];
    guess[1][i] = hz_R(3.0) * (track->move[0][i] - track->move[1][i]) + track->move[2][i];
    for (w = 0; w < FN_WIDTH; w++)
      if (track->known[w] >= 3 && track->miss[1][w] < track->miss[0][w])
        FN_LANE(t->move[i], w) = FN_LANE(guess[1][i], w);
  }
  FN_solve(&track->P, t, status, residual);
  for (i = 0; i < hz_N; i++) {
    track->move[2][i] = track->move[1][i];
    track->move[1][i] = track->move[0][i];
    track->move[0][i] = t->move[i] + t->rest[i];
    guess[0][i] -= t->move[i];
    guess[1][i] -= t->move[i];
  }
  FN_length(guess[0], track->miss[0]);
  FN_length(guess[1], track->miss[1]);
  for (w = 0; w < FN_WIDTH; w++) track->known[w] = status[w] ? 0 : track->known[w] + (track->known[w] < 3);
}
#endif
#endif

/* The move of Newton's unknown: the unknown itself or, where dry friction can hold a coordinate, the part of it beyond
   the bound. */
static inline REAL FN_moved(const FN_problem *P, int i, REAL z) {
#if hz_STICKING
  const REAL below = FN_choose(z, P->bound[i], P->bound[i], z);
  return z - FN_choose(-P->bound[i], below, -P->bound[i], below);
#else
  (void)P;
  (void)i;
  return z;
#endif
}

/* Read sample w of a state, and write it. */
static inline void FN_get(const FN_state *x, int w, hz_state *one) {
  int i;
  (void)w;
  for (i = 0; i < hz_N; i++) {
    one->q[i] = FN_LANE(x->q[i], w);
    one->p[i] = FN_LANE(x->p[i], w);
  }
  one->s = FN_LANE(x->s, w);
  one->sigma = FN_LANE(x->sigma, w);
}

static inline void FN_set(FN_state *x, int w, const hz_state *one) {
  int i;
  (void)w;
  for (i = 0; i < hz_N; i++) {
    FN_LANE(x->q[i], w) = one->q[i];
    FN_LANE(x->p[i], w) = one->p[i];
  }
  FN_LANE(x->s, w) = one->s;
  FN_LANE(x->sigma, w) = one->sigma;
}

/* Set hz_OUTSIDE_BOX for each finite state outside the box that the model was fitted in. Angles count modulo a turn. The
   action s grows without bound, and counts only where the motion depends on it. */
static inline void FN_mark_outside(const FN_state *x, int flags[FN_WIDTH]) {
#if hz_BOXED
  const REAL one = SPREAD(hz_R(1.0));
  REAL outside = SPREAD(hz_R(0.0));
  int i, w;
  for (i = 0; i < hz_N; i++) {
    REAL q = x->q[i];
    if (hz_is_angle[i]) {
      const hz_real turn = hz_R(6.28318530717958647693), middle = (hz_q_low[i] + hz_q_high[i]) / hz_R(2.0);
      q -= turn * FN_nearest((q - middle) * hz_R(0.15915494309189533577));
    }
    outside = FN_choose(q, SPREAD(hz_q_high[i]), one, FN_choose(SPREAD(hz_q_low[i]), q, one, outside));
    outside = FN_choose(x->p[i], SPREAD(hz_p_high[i]), one, FN_choose(SPREAD(hz_p_low[i]), x->p[i], one, outside));
  }
#if hz_CARRIES_S
  outside = FN_choose(x->s, SPREAD(hz_s_high), one, FN_choose(SPREAD(hz_s_low), x->s, one, outside));
#endif
  for (w = 0; w < FN_WIDTH; w++)
    if (FN_LANE(outside, w) > hz_R(0.0)) flags[w] |= hz_OUTSIDE_BOX;
#else
  (void)x;
  (void)flags;
#endif
}

#if hz_P
/* The parameters of sample w. */
static inline hz_parameters FN_theta(const FN_problem *P, int w) {
  hz_parameters theta;
  int i;
  (void)w;
  for (i = 0; i < hz_P; i++) theta.value[i] = FN_LANE(P->theta[i], w);
  return theta;
}

#endif
/* One step of every sample whose status is 0; a sample that fails gets its status and keeps its state. Samples that
   registers leave unsolved are solved one by one. */
static inline void FN_take(FN_state *state, FN_track *track, const hz_real h[FN_WIDTH],
    hz_WITH_U(const hz_real *const u[FN_WIDTH]) int status[FN_WIDTH], hz_real residual[FN_WIDTH]) {
  FN_problem *P = &track->P;
  FN_terms t;
  FN_potential_t V1;
  const REAL sigma = state->sigma;
  REAL x[hz_N], q1[hz_N], low[hz_N], dp[hz_N], ds, E, sum = SPREAD(hz_R(0.0));
  int failed[FN_WIDTH], i, w, again = 0, left = 0, changed = 0;
  for (w = 0; w < FN_WIDTH; w++) {
    left += status[w] == hz_CONVERGED;
    failed[w] = status[w];
    residual[w] = hz_R(0.0);
    if (h[w] != FN_LANE(P->h, w)) {
      FN_LANE(P->h, w) = h[w];
      changed = 1;
#if hz_CONTINUES
      track->known[w] = 0;
#endif
    }
  }
  if (!left) return;
  if (changed) FN_prepare(P);
  for (i = 0; i < hz_N; i++) {
    P->q0[i] = state->q[i];
    P->p0[i] = state->p[i];
  }
  P->s0 = state->s;
#if hz_INPUTS
  for (w = 0; w < FN_WIDTH; w++)
    for (i = 0; i < hz_INPUTS; i++) FN_LANE(P->u[i], w) = hz_taken(u[w], i);
#endif
  FN_begin(P, t.move);
#if hz_EXPLICIT
  for (i = 0; i < hz_N; i++) x[i] = t.move[i];
#elif hz_CONTINUES
  FN_solve_from_guess(track, &t, failed, residual);
  for (i = 0; i < hz_N; i++) x[i] = track->move[0][i];
#else
  FN_solve(P, &t, failed, residual);
  for (i = 0; i < hz_N; i++) x[i] = t.move[i] + t.rest[i];
#endif
  for (i = 0; i < hz_N; i++) {
    low[i] = track->low_q[i];
    q1[i] = FN_add(P->q0[i], FN_moved(P, i, x[i]), &low[i]);
  }
  FN_potential(q1, hz_WITH_THETA(P->theta) &V1);
  FN_gains(P, &t, x, &V1, dp, &ds, &E);
  for (i = 0; i < hz_N; i++) sum += (P->p0[i] + dp[i]) + q1[i]; /* what is not finite stays so in a sum */
  sum += (P->s0 + ds) + (sigma + E * sigma);
  for (i = 0; i < hz_N; i++) {
    state->q[i] = q1[i];
    track->low_q[i] = low[i];
    state->p[i] = FN_add(P->p0[i], dp[i], &track->low_p[i]);
  }
  state->s = FN_add(P->s0, ds, &track->low_s);
  state->sigma = FN_add(sigma, E * sigma, &track->low_sigma);
  for (w = 0; w < FN_WIDTH; w++) {
    hz_state one;
#if hz_P
    const hz_parameters theta = FN_theta(P, w);
#endif
    if (!failed[w] && !hz_finite(FN_LANE(sum, w))) failed[w] = hz_DIVERGED;
    if (!failed[w] && !(hz_R(1.0) + FN_LANE(E, w) > hz_R(0.0))) failed[w] = hz_SINGULAR;
    if (!failed[w]) continue;
    again = 1;
    for (i = 0; i < hz_N; i++) {
      one.q[i] = FN_LANE(P->q0[i], w);
      one.p[i] = FN_LANE(P->p0[i], w);
      FN_LANE(track->low_q[i], w) = FN_LANE(track->low_p[i], w) = hz_R(0.0);
    }
    one.s = FN_LANE(P->s0, w);
    one.sigma = FN_LANE(sigma, w);
    FN_LANE(track->low_s, w) = FN_LANE(track->low_sigma, w) = hz_R(0.0);
#if hz_CONTINUES
    track->known[w] = 0;
#endif
    if (FN_WIDTH == 1) status[w] = failed[w];
    else if (status[w] == hz_CONVERGED) status[w] = hz_alone(&one, h[w], hz_WITH_U(u[w]) hz_WITH_THETA(&theta) &residual[w]);
    FN_set(state, w, &one);
  }
  if (again) FN_potential(state->q, hz_WITH_THETA(P->theta) &V1);
  P->V0 = V1;
}
