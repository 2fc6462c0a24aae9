/* One step of one sample: elimination, Newton with backtracking, the guess, and what a run carries along. */

#if !hz_EXPLICIT
/* J and its factors: rows exchanged by partial pivoting. */
typedef struct {
  hz_real lu[hz_N][hz_N];
  int row[hz_N];
} hz_factors;

/* 0, or hz_SINGULAR where a pivot is zero or not a number. */
static inline int hz_factorise(const hz_real J[hz_N * hz_N], hz_factors *A) {
#if hz_N == 1
  A->lu[0][0] = J[0];
  return hz_fabs(J[0]) > hz_R(0.0) ? hz_CONVERGED : hz_SINGULAR;
#else
  int i, j, k, best;
  for (i = 0; i < hz_N; i++)
    for (j = 0; j < hz_N; j++) A->lu[i][j] = J[i * hz_N + j];
  for (k = 0; k < hz_N; k++) {
    for (best = k, i = k + 1; i < hz_N; i++)
      if (hz_fabs(A->lu[i][k]) > hz_fabs(A->lu[best][k])) best = i;
    A->row[k] = best;
    for (j = 0; j < hz_N; j++) {
      const hz_real other = A->lu[best][j];
      A->lu[best][j] = A->lu[k][j];
      A->lu[k][j] = other;
    }
    if (!(hz_fabs(A->lu[k][k]) > hz_R(0.0))) return hz_SINGULAR;
    for (i = k + 1; i < hz_N; i++) {
      A->lu[i][k] /= A->lu[k][k];
      for (j = k + 1; j < hz_N; j++) A->lu[i][j] -= A->lu[i][k] * A->lu[k][j];
    }
  }
  return hz_CONVERGED;
#endif
}

/* x = -J^-1 F. */
static inline void hz_direction(const hz_factors *A, const hz_real F[hz_N], hz_real x[hz_N]) {
#if hz_N == 1
  x[0] = -F[0] / A->lu[0][0];
#else
  int i, j;
  for (i = 0; i < hz_N; i++) x[i] = -F[i];
  for (i = 0; i < hz_N; i++) {
    const hz_real other = x[A->row[i]];
    x[A->row[i]] = x[i];
    x[i] = other;
  }
  for (i = 0; i < hz_N; i++)
    for (j = 0; j < i; j++) x[i] -= A->lu[i][j] * x[j];
  for (i = hz_N - 1; i >= 0; i--) {
    for (j = i + 1; j < hz_N; j++) x[i] -= A->lu[i][j] * x[j];
    x[i] /= A->lu[i][i];
  }
#endif
}

/* Solve F(q1) = 0 from the guess in t->move. A trial point close to the last one keeps J (its contraction is checked),
   a move that does not lessen |F| is halved, and rounding ends the iteration. */
static inline int hz_solve(const hz_problem *P, hz_terms *t, hz_real *residual) {
  hz_factors A;
  hz_terms trial;
  hz_real delta[hz_N], next[hz_N], q1[hz_N], scale, merit, length = hz_R(1.0), size;
  int i, iteration, exact = 1;
  *residual = hz_R(0.0);
  for (i = 0; i < hz_N; i++) t->rest[i] = trial.rest[i] = hz_R(0.0);
  hz_evaluate(P, t);
  merit = hz_length(t->F);
  if (!hz_all_finite(t->F)) return hz_DIVERGED;
  if (hz_factorise(t->J, &A)) return hz_SINGULAR;
  hz_direction(&A, t->F, delta);
  for (i = 0; i < hz_N; i++) q1[i] = P->q0[i] + t->move[i];
  scale = hz_length(P->q0);
  size = hz_length(q1);
  scale = size > scale ? size : scale;
  size = hz_length(delta);
  scale = size > scale ? size : scale;
  for (iteration = 0; iteration < hz_max_iterations; iteration++) {
    hz_real trial_merit;
    int kept;
    *residual = size = hz_length(delta);
    if (!hz_all_finite(delta)) return hz_SINGULAR;
    if (size <= hz_tolerance * scale) {
      for (i = 0; i < hz_N; i++) t->rest[i] = delta[i];
      return hz_CONVERGED;
    }
    kept = length == hz_R(1.0) && size <= hz_near * scale;
    for (i = 0; i < hz_N; i++) trial.move[i] = t->move[i] + length * delta[i];
    if (kept)
      hz_evaluate_first(P, &trial);
    else
      hz_evaluate(P, &trial);
    trial_merit = hz_length(trial.F);
    if (hz_all_finite(trial.F) && trial_merit <= (hz_R(1.0) - hz_R(1e-4) * length) * merit) {
      if (kept) {
        hz_real trial_size;
        hz_direction(&A, trial.F, next);
        trial_size = hz_length(next);
        if (trial_size > hz_R(0.1) * size && trial_size > hz_tolerance * scale) {
          hz_evaluate(P, &trial);
          kept = 0;
        }
      }
      if (!kept) {
        if (hz_factorise(trial.J, &A)) return hz_SINGULAR;
        hz_direction(&A, trial.F, next);
      }
      *t = trial;
      for (i = 0; i < hz_N; i++) delta[i] = next[i];
      merit = trial_merit;
      length = hz_R(1.0);
      exact = !kept;
    } else if (size <= hz_floor * (scale > P->h * hz_top_speed ? scale : P->h * hz_top_speed)) {
      return hz_CONVERGED;
    } else if (!exact) {
      hz_evaluate(P, t);
      if (hz_factorise(t->J, &A)) return hz_SINGULAR;
      hz_direction(&A, t->F, delta);
      exact = 1;
    } else {
      length /= hz_R(2.0);
    }
  }
  *residual = hz_length(delta);
  return *residual <= hz_tolerance * scale ? hz_CONVERGED : hz_MAX_ITERATIONS;
}
#endif

/* What a run of steps carries along: V(q) and what depends on h alone, both in P; what rounding took from q, p, s and
   sigma in the additions so far; and, for the guess, the last moves. */
typedef struct {
  hz_problem P;
  hz_real low_q[hz_N], low_p[hz_N], low_s, low_sigma;
#if !hz_EXPLICIT
  hz_real move[3][hz_N], miss[2];
  int known;
#endif
} hz_track;

static inline void hz_track_start(const hz_state *state, hz_track *track) {
  int i;
  hz_potential(state->q, &track->P.V0);
  track->P.h = hz_R(0.0);
  for (i = 0; i < hz_N; i++) track->low_q[i] = track->low_p[i] = hz_R(0.0);
  track->low_s = track->low_sigma = hz_R(0.0);
#if !hz_EXPLICIT
  for (i = 0; i < hz_N; i++) track->move[0][i] = track->move[1][i] = track->move[2][i] = hz_R(0.0);
  track->known = 0;
  track->miss[0] = track->miss[1] = hz_R(0.0);
#endif
}

#if hz_INPUTS
/* G (u - u0); no inputs where u is null. */
static inline void hz_push(const hz_real *u, hz_real push[hz_N]) {
  int i, j;
  for (i = 0; i < hz_N; i++) {
    push[i] = u ? hz_input_offset[i] : hz_R(0.0);
    for (j = 0; u && j < hz_M; j++) push[i] += hz_input_map[i * hz_M + j] * u[j];
  }
}
#define hz_TAKES_U const hz_real *u,
#define hz_WITH_U(argument) argument,
#else
#define hz_TAKES_U
#define hz_WITH_U(argument)
#endif

/* The move of what Newton has solved for: the move itself or, where dry friction can hold a coordinate, a number z of
   which the move is what lies beyond the bound. */
static inline hz_real hz_moved(const hz_problem *P, int i, hz_real z) {
#if hz_STICKING
  const hz_real below = z > P->bound[i] ? P->bound[i] : z;
  return z - (-P->bound[i] > below ? -P->bound[i] : below);
#else
  (void)P;
  (void)i;
  return z;
#endif
}

#if !hz_EXPLICIT
/* The solution from the better of two guesses: t->move arrives as the step without what couples q1, and the other is
   the cubic through the last four positions. */
static inline int hz_solve_from_guess(hz_track *track, hz_terms *t, hz_real *residual) {
  hz_real guess[2][hz_N], miss;
  int i, j, better, status;
  for (i = 0; i < hz_N; i++) {
    guess[0][i] = t->move[i];
    guess[1][i] = hz_R(3.0) * (track->move[0][i] - track->move[1][i]) + track->move[2][i];
  }
  better = !hz_STICKING && track->known >= 3 && track->miss[1] < track->miss[0];
  for (i = 0; i < hz_N; i++) t->move[i] = guess[better][i];
  status = hz_solve(&track->P, t, residual);
  if (status) return status;
  for (j = 0; j < 2; j++) {
    for (track->miss[j] = hz_R(0.0), i = 0; i < hz_N; i++) {
      miss = hz_fabs(t->move[i] - guess[j][i]);
      if (miss > track->miss[j]) track->miss[j] = miss;
    }
  }
  for (i = 0; i < hz_N; i++) {
    track->move[2][i] = track->move[1][i];
    track->move[1][i] = track->move[0][i];
    track->move[0][i] = t->move[i] + t->rest[i];
  }
  if (track->known < 3) track->known++;
  return status;
}
#endif

/* One step of a run: hz_step without its checks of the input, faster by what `track` carries. Start the track again
   whenever anything but this function has changed the state. */
static inline int hz_advance(hz_state *state, hz_track *track, hz_real h, hz_TAKES_U hz_real *residual) {
  hz_problem *P = &track->P;
  hz_terms t;
  hz_potential_t V1;
  hz_real x[hz_N], q1[hz_N], low[hz_N], dp[hz_N], ds, E, sum = hz_R(0.0);
  int i;
  for (i = 0; i < hz_N; i++) {
    P->q0[i] = state->q[i];
    P->p0[i] = state->p[i];
  }
  P->s0 = state->s;
#if hz_INPUTS
  hz_push(u, P->push);
#endif
  *residual = hz_R(0.0);
  if (h != P->h) {
    P->h = h;
    hz_prepare(P);
#if !hz_EXPLICIT
    track->known = 0;
#endif
  }
  hz_begin(P, t.move);
#if hz_EXPLICIT
  for (i = 0; i < hz_N; i++) x[i] = t.move[i];
#else
  {
    const int status = hz_solve_from_guess(track, &t, residual);
    if (status) return status;
  }
  for (i = 0; i < hz_N; i++) x[i] = track->move[0][i];
#endif
  for (i = 0; i < hz_N; i++) {
    low[i] = track->low_q[i];
    q1[i] = hz_add(P->q0[i], hz_moved(P, i, x[i]), &low[i]);
  }
  hz_potential(q1, &V1);
  hz_gains(P, &t, x, &V1, dp, &ds, &E);
  for (i = 0; i < hz_N; i++) sum += (P->p0[i] + dp[i]) + q1[i]; /* what is not finite stays so in a sum */
  sum += (P->s0 + ds) + (state->sigma + E * state->sigma);
  if (!hz_finite(sum)) return hz_DIVERGED;
  if (!(hz_R(1.0) + E > hz_R(0.0))) return hz_SINGULAR;
  for (i = 0; i < hz_N; i++) {
    state->q[i] = q1[i];
    track->low_q[i] = low[i];
    state->p[i] = hz_add(P->p0[i], dp[i], &track->low_p[i]);
  }
  state->s = hz_add(P->s0, ds, &track->low_s);
  state->sigma = hz_add(state->sigma, E * state->sigma, &track->low_sigma);
  P->V0 = V1;
  return hz_CONVERGED;
}
