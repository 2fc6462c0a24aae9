"""The step in C: elimination, Newton with backtracking, the guess, and one step of a run."""

from __future__ import annotations

ELIMINATION = """
{%if !linear}
/* J and its factors: rows exchanged by partial pivoting. */
typedef struct {
  real lu[NAME_N][NAME_N];
  int row[NAME_N];
} NAME_factors;

/* 0, or NAME_SINGULAR where a pivot is zero or not a number. */
static inline int NAME_factorise(real J[NAME_N][NAME_N], NAME_factors *A) {
{%if scalar}
  A->lu[0][0] = J[0][0];
  return FABS(J[0][0]) > R(0.0) ? NAME_CONVERGED : NAME_SINGULAR;
{%else}
  int i, j, k, best;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) A->lu[i][j] = J[i][j];
  for (k = 0; k < NAME_N; k++) {
    for (best = k, i = k + 1; i < NAME_N; i++)
      if (FABS(A->lu[i][k]) > FABS(A->lu[best][k])) best = i;
    A->row[k] = best;
    for (j = 0; j < NAME_N; j++) {
      real other = A->lu[best][j];
      A->lu[best][j] = A->lu[k][j];
      A->lu[k][j] = other;
    }
    if (!(FABS(A->lu[k][k]) > R(0.0))) return NAME_SINGULAR;
    for (i = k + 1; i < NAME_N; i++) {
      A->lu[i][k] /= A->lu[k][k];
      for (j = k + 1; j < NAME_N; j++) A->lu[i][j] -= A->lu[i][k] * A->lu[k][j];
    }
  }
  return NAME_CONVERGED;
{%end}
}

/* x = -J^-1 F. */
static inline void NAME_direction(const NAME_factors *A, const real F[NAME_N], real x[NAME_N]) {
{%if scalar}
  x[0] = -F[0] / A->lu[0][0];
{%else}
  int i, j;
  for (i = 0; i < NAME_N; i++) x[i] = -F[i];
  for (i = 0; i < NAME_N; i++) {
    real other = x[A->row[i]];
    x[A->row[i]] = x[i];
    x[i] = other;
  }
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < i; j++) x[i] -= A->lu[i][j] * x[j];
  for (i = NAME_N - 1; i >= 0; i--) {
    for (j = i + 1; j < NAME_N; j++) x[i] -= A->lu[i][j] * x[j];
    x[i] /= A->lu[i][i];
  }
{%end}
}

/* Solve F(q1) = 0 from the guess in t->move. A trial point close to the last one keeps J (its contraction is checked),
   a move that does not lessen |F| is halved, and rounding ends the iteration. */
static inline int NAME_solve(const NAME_problem *P, NAME_terms *t, real *residual) {
  NAME_factors A;
  NAME_terms trial;
  real delta[NAME_N], next[NAME_N], q1[NAME_N], scale, merit, length = R(1.0), size;
  int i, iteration, exact = 1;
  *residual = R(0.0);
  for (i = 0; i < NAME_N; i++) t->rest[i] = trial.rest[i] = R(0.0);
  NAME_evaluate(P, 2, t);
  merit = NAME_length(t->F);
  if (!NAME_all_finite(t->F)) return NAME_DIVERGED;
  if (NAME_factorise(t->J, &A)) return NAME_SINGULAR;
  NAME_direction(&A, t->F, delta);
  for (i = 0; i < NAME_N; i++) q1[i] = P->q0[i] + t->move[i];
  scale = NAME_length(P->q0);
  size = NAME_length(q1);
  scale = size > scale ? size : scale;
  size = NAME_length(delta);
  scale = size > scale ? size : scale;
  for (iteration = 0; iteration < NAME_max_iterations; iteration++) {
    real trial_merit, trial_size;
    int order;
    *residual = size = NAME_length(delta);
    if (!NAME_all_finite(delta)) return NAME_SINGULAR;
    if (size <= NAME_tolerance * scale) {
      for (i = 0; i < NAME_N; i++) t->rest[i] = delta[i];
      return NAME_CONVERGED;
    }
    order = length == R(1.0) && size <= NAME_near * scale ? 1 : 2;
    for (i = 0; i < NAME_N; i++) trial.move[i] = t->move[i] + length * delta[i];
    NAME_evaluate(P, order, &trial);
    trial_merit = NAME_length(trial.F);
    if (NAME_all_finite(trial.F) && trial_merit <= (R(1.0) - R(1e-4) * length) * merit) {
      int kept = order == 1;
      if (kept) {
        NAME_direction(&A, trial.F, next);
        trial_size = NAME_length(next);
        if (trial_size > R(0.1) * size && trial_size > NAME_tolerance * scale) {
          NAME_evaluate(P, 2, &trial);
          kept = 0;
        }
      }
      if (!kept) {
        if (NAME_factorise(trial.J, &A)) return NAME_SINGULAR;
        NAME_direction(&A, trial.F, next);
      }
      *t = trial;
      for (i = 0; i < NAME_N; i++) delta[i] = next[i];
      merit = trial_merit;
      length = R(1.0);
      exact = !kept;
    } else if (size <= NAME_floor * (scale > P->h * NAME_top_speed ? scale : P->h * NAME_top_speed)) {
      return NAME_CONVERGED;
    } else if (!exact) {
      NAME_evaluate(P, 2, t);
      if (NAME_factorise(t->J, &A)) return NAME_SINGULAR;
      NAME_direction(&A, t->F, delta);
      exact = 1;
    } else {
      length /= R(2.0);
    }
  }
  *residual = NAME_length(delta);
  return *residual <= NAME_tolerance * scale ? NAME_CONVERGED : NAME_MAX_ITERATIONS;
}
{%end}
"""

LEAPFROG = """
{%if stiff}
/* q1 - q0 of a model whose step equation is linear in it: c (p0 - h/2 (V0' - G u)) = sqrt(c) (m + sqrt(c) h/2 b)
   (q1 - q0) / h, with the inverse of the last matrix. */
static inline void NAME_leapfrog(const NAME_problem *P, real root, const real inverse[NAME_N * NAME_N],
    real move[NAME_N]) {
  int i, j;
  for (i = 0; i < NAME_N; i++) {
    move[i] = SPREAD(0.0);
    for (j = 0; j < NAME_N; j++)
      move[i] += inverse[i * NAME_N + j] *
          (P->p0[j] - P->h / R(2.0) * (P->V0.slope[j]{%if inputs} - P->push[j]{%end}));
    move[i] *= P->h * root;
  }
}
{%else}
/* q1 - q0 of the model without networks in q1: c p0 - (h/2) c V0' = sqrt(c) m (q1 - q0) / h. */
{%if baseline}
static inline void NAME_leapfrog(const NAME_problem *P, real root, real move[NAME_N]) {
  int i, j;
  for (i = 0; i < NAME_N; i++) {
    move[i] = SPREAD(0.0);
    for (j = 0; j < NAME_N; j++)
      move[i] += NAME_inverse_mass[i * NAME_N + j] * (P->p0[j] - P->h / R(2.0) * P->V0.slope[j]);
    move[i] *= P->h * root;
  }
}
{%else}
static inline void NAME_leapfrog(const NAME_problem *P, real root, real move[NAME_N]) {
  int i;
  (void)P;
  (void)root;
  for (i = 0; i < NAME_N; i++) move[i] = SPREAD(0.0);
}
{%end}
{%end}
"""

ADVANCE = """
{%if stiff}
/* (m + sqrt(c) h/2 b)^-1, by elimination with exchanged rows; not finite where there is none. */
static inline void NAME_invert(real h, real root, real inverse[NAME_N * NAME_N]) {
  real A[NAME_N][2 * NAME_N], pivot;
  int i, j, k, best;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) {
      A[i][j] = NAME_mass[i * NAME_N + j] + (i == j ? root * h / R(2.0) * NAME_viscous[i] : R(0.0));
      A[i][NAME_N + j] = i == j ? R(1.0) : R(0.0);
    }
  for (k = 0; k < NAME_N; k++) {
    for (best = k, i = k + 1; i < NAME_N; i++)
      if (FABS(A[i][k]) > FABS(A[best][k])) best = i;
    pivot = A[best][k];
    for (j = 0; j < 2 * NAME_N; j++) {
      const real other = A[best][j] / pivot;
      A[best][j] = A[k][j];
      A[k][j] = other;
    }
    for (i = 0; i < NAME_N; i++) {
      const real factor = A[i][k];
      if (i != k)
        for (j = 0; j < 2 * NAME_N; j++) A[i][j] -= factor * A[k][j];
    }
  }
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) inverse[i * NAME_N + j] = A[i][NAME_N + j];
}

{%end}
/* What a run of steps carries along: V(q), what rounding took from q, p, s and sigma in the additions so far, and, for
   the guess, the last moves. */
typedef struct {
  NAME_potential_t V;
  real low_q[NAME_N], low_p[NAME_N], low_s, low_sigma, h, root;
{%if linear}
  real E;
{%if stiff}
  real inverse[NAME_N * NAME_N];
{%end}
{%else}
  real move[3][NAME_N], miss[2];
  int known;
{%end}
} NAME_track;

static inline void NAME_track_start(const NAME_state *state, NAME_track *track) {
  int i;
  NAME_potential(state->q, &track->V);
  for (i = 0; i < NAME_N; i++) track->low_q[i] = track->low_p[i] = R(0.0);
  track->low_s = track->low_sigma = track->h = track->root = R(0.0);
{%if linear}
  track->E = R(0.0);
{%if stiff}
  for (i = 0; i < NAME_N * NAME_N; i++) track->inverse[i] = R(0.0);
{%end}
{%else}
  for (i = 0; i < NAME_N; i++) track->move[0][i] = track->move[1][i] = track->move[2][i] = R(0.0);
  track->known = 0;
  track->miss[0] = track->miss[1] = R(0.0);
{%end}
}

{%if inputs}
/* G (u - u0); no inputs where u is null. */
static inline void NAME_push(const real *u, real push[NAME_N]) {
  int i, j;
  for (i = 0; i < NAME_N; i++) {
    push[i] = u ? NAME_input_offset[i] : R(0.0);
    for (j = 0; u && j < NAME_M; j++) push[i] += NAME_input_map[i * NAME_M + j] * u[j];
  }
}
{%end}

/* x + change, with what its rounding loses kept in `low` for the next time. */
static inline real NAME_add(real x, real change, real *low) {
  const real add = change + *low, sum = x + add, back = sum - x;
  *low = (x - (sum - back)) + (add - back);
  return NAME_flush(sum);
}

/* One step of a run: NAME_step without its checks of the input, faster by what `track` carries. Start the track again
   whenever anything but this function has changed the state. */
static inline int NAME_advance(NAME_state *state, NAME_track *track, real h,
    {%if inputs}const real *u, {%end}real *residual) {
  NAME_problem P;
  NAME_terms t;
  NAME_potential_t V1;
  real q1[NAME_N], low[NAME_N], dp[NAME_N], ds, sum = R(0.0);
  int i, status = NAME_CONVERGED;
  for (i = 0; i < NAME_N; i++) {
    P.q0[i] = state->q[i];
    P.p0[i] = state->p[i];
  }
  P.s0 = state->s;
  P.h = h;
  P.V0 = track->V;
{%if inputs}
  NAME_push(u, P.push);
{%end}
  *residual = R(0.0);
{%if linear}
  if (h != track->h) {
    track->h = h;
    track->root = EXP(R(-0.5) * NAME_rate * h);
    track->E = EXPM1(-NAME_rate * h);
{%if stiff}
    NAME_invert(h, track->root, track->inverse);
{%end}
  }
  t.E = track->E;
  t.root = track->root;
  t.c = R(1.0) + t.E;
  t.K = R(0.0);
{%if stiff}
  NAME_leapfrog(&P, t.root, track->inverse, t.move);
  NAME_friction(&P, &t);
  for (i = 0; i < NAME_N * NAME_N; i++)
    t.K += NAME_mass[i] * t.move[i / NAME_N] * t.move[i % NAME_N] / (R(2.0) * h);
{%else}
  NAME_leapfrog(&P, t.root, t.move);
  for (i = 0; i < NAME_N; i++) t.K += t.root * (P.p0[i] - h / R(2.0) * P.V0.slope[i]) * t.move[i] / R(2.0);
{%end}
  for (i = 0; i < NAME_N; i++) {
    low[i] = track->low_q[i];
    q1[i] = NAME_add(P.q0[i], t.move[i], &low[i]);
  }
{%else}
  {
    real guess[2][NAME_N], miss;
    int j, better;
    if (h != track->h) {
      track->h = h;
      track->root = EXP(R(-0.5) * NAME_rate * h);
      track->known = 0;
    }
    NAME_leapfrog(&P, track->root, guess[0]);
    for (i = 0; i < NAME_N; i++)  /* the cubic through the last four positions */
      guess[1][i] = R(3.0) * (track->move[0][i] - track->move[1][i]) + track->move[2][i];
    better = track->known >= 3 && track->miss[1] < track->miss[0];
    for (i = 0; i < NAME_N; i++) t.move[i] = guess[better][i];
    status = NAME_solve(&P, &t, residual);
    if (status) return status;
    for (j = 0; j < 2; j++) {
      for (track->miss[j] = R(0.0), i = 0; i < NAME_N; i++) {
        miss = FABS(t.move[i] - guess[j][i]);
        if (miss > track->miss[j]) track->miss[j] = miss;
      }
    }
    for (i = 0; i < NAME_N; i++) {
      track->move[2][i] = track->move[1][i];
      track->move[1][i] = track->move[0][i];
      track->move[0][i] = t.move[i] + t.rest[i];
      low[i] = track->low_q[i];
      q1[i] = NAME_add(P.q0[i], track->move[0][i], &low[i]);
    }
    if (track->known < 3) track->known++;
  }
{%end}
  NAME_potential(q1, &V1);
  NAME_increments(&P, &t, &V1, dp, &ds);
  for (i = 0; i < NAME_N; i++) sum += FABS(t.move[i]) + FABS(dp[i]) + FABS(q1[i]);
  if (!NAME_finite(sum + FABS(ds))) return NAME_DIVERGED;
  if (!(t.c > R(0.0))) return NAME_SINGULAR;
  for (i = 0; i < NAME_N; i++) {
    state->q[i] = q1[i];
    track->low_q[i] = low[i];
    state->p[i] = NAME_add(P.p0[i], dp[i], &track->low_p[i]);
  }
  state->s = NAME_add(P.s0, ds, &track->low_s);
  state->sigma = NAME_add(state->sigma, t.E * state->sigma, &track->low_sigma);
  track->V = V1;
  return status;
}
"""
