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
  NAME_evaluate(P, 2, t);
  merit = NAME_length(t->F);
  if (!NAME_finite(merit)) return NAME_DIVERGED;
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
    if (!NAME_finite(size)) return NAME_SINGULAR;
    if (size <= NAME_tolerance * scale) return NAME_CONVERGED;
    order = length == R(1.0) && size <= NAME_near * scale ? 1 : 2;
    for (i = 0; i < NAME_N; i++) trial.move[i] = t->move[i] + length * delta[i];
    NAME_evaluate(P, order, &trial);
    trial_merit = NAME_length(trial.F);
    if (trial_merit <= (R(1.0) - R(1e-4) * length) * merit) {
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
    } else if (size <= NAME_floor * scale) {
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

ADVANCE = """
/* q1 - q0 of the model without networks in q1: c p0 - (h/2) c V0' = sqrt(c) m (q1 - q0) / h. */
{%if baseline}
static inline void NAME_leapfrog(const NAME_problem *P, real root, real move[NAME_N]) {
  int i, j;
  for (i = 0; i < NAME_N; i++) {
    move[i] = R(0.0);
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
  for (i = 0; i < NAME_N; i++) move[i] = R(0.0);
}
{%end}

/* What a run of steps carries along: V(q) and, for the guess, the last moves. */
typedef struct {
  NAME_potential_t V;
  real move[3][NAME_N], h, root, miss[2];
  int known;
} NAME_track;

static inline void NAME_track_start(const NAME_state *state, NAME_track *track) {
  int i;
  for (i = 0; i < NAME_N; i++) track->move[0][i] = track->move[1][i] = track->move[2][i] = R(0.0);
  NAME_potential(state->q, &track->V);
  track->h = R(0.0);
  track->known = 0;
  track->miss[0] = track->miss[1] = R(0.0);
}

/* One step of a run: NAME_step without its checks of the input, faster by what `track` carries. Start the track again
   whenever anything but this function has changed the state. */
static inline int NAME_advance(NAME_state *state, NAME_track *track, real h, real *residual) {
  NAME_problem P;
  NAME_terms t;
  NAME_state next;
  int i, status = NAME_CONVERGED;
  for (i = 0; i < NAME_N; i++) {
    P.q0[i] = state->q[i];
    P.p0[i] = state->p[i];
  }
  P.s0 = state->s;
  P.h = h;
  P.V0 = track->V;
  if (h != track->h) {
    track->h = h;
    track->root = EXP(R(-0.5) * NAME_rate * h);
    track->known = 0;
  }
{%if linear}
  t.root = track->root;
  t.c = t.root * t.root;
  NAME_leapfrog(&P, t.root, t.move);
  *residual = R(0.0);
  t.K = R(0.0);
  for (i = 0; i < NAME_N; i++) {  /* m (q1 - q0) / h, from the equation instead of the rounded move */
    t.momentum[i] = t.root * (P.p0[i] - h / R(2.0) * P.V0.slope[i]);
    t.K += t.momentum[i] * t.move[i] / R(2.0);
    next.q[i] = state->q[i] + t.move[i];
  }
{%else}
  {
    real guess[2][NAME_N], miss;
    int j, better;
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
      track->move[0][i] = t.move[i];
      next.q[i] = state->q[i] + t.move[i];
    }
    if (track->known < 3) track->known++;
  }
{%end}
  NAME_potential(next.q, &track->V);
  NAME_legendre_plus(&P, &t, &track->V, next.p, &next.s);
  next.sigma = state->sigma * t.c;
  if (!NAME_finite(NAME_length(next.q) + NAME_length(next.p) + next.s)) return NAME_DIVERGED;
  if (!(t.c > R(0.0))) return NAME_SINGULAR;
  *state = next;
  return status;
}
"""
