"""The step equation, its Jacobian, FL⁺ and a solved step's increments as a C template."""

from __future__ import annotations

# How K and its derivatives are called: numbers where the mass is constant, else a jet.
CONSTANT_MASS = {"K": "t->K", "K0_I": "-t->momentum[i]", "K1_I": "t->momentum[i]", "K1_J": "t->momentum[j]"}
CONSTANT_MASS |= {"K01": "-NAME_mass[i * NAME_N + j] / h"}
POSITION_MASS = {"K": "t->K.value", "K0_I": "t->K.d0[i]", "K1_I": "t->K.d1[i]", "K1_J": "t->K.d1[j]"}
POSITION_MASS |= {"K01": "t->K.d01[i][j]"}

TYPES = """
/* What does not change while a step is solved. */
typedef struct {
  real q0[NAME_N], p0[NAME_N], s0, h;
{%if inputs}
  real push[NAME_N];  /* G u, the force of the inputs */
{%end}
  NAME_potential_t V0;
} NAME_problem;

/* The terms of L_d at one q1 = q0 + move, with c = 1 + E{%if !full} = exp(g) and root = sqrt(c){%end}. Once the step is
   solved, `rest` is the last, tiny correction: q1 = q0 + move + rest. */
typedef struct {
  real move[NAME_N], rest[NAME_N], F[NAME_N], J[NAME_N][NAME_N];
{%if full}
  real E, c;
  NAME_jet L;  /* without V(q1) */
{%else}
  real E, c, root;
{%if mass}
  NAME_jet K;
{%else}
  real K, momentum[NAME_N];  /* and m move / h */
{%end}
{%end}
{%if affine}
  NAME_jet g;
{%end}
{%if jet_N}
  NAME_jet N;
{%end}
{%if friction}
  real f[NAME_N], slope[NAME_N];
{%end}
} NAME_terms;
"""

EVALUATION = """
{%if friction}

/* Friction and inputs f at v = move / h, with df/dv: they enter both momenta, by c (h/2) f and by (h/2) f. */
static inline void NAME_friction(const NAME_problem *P, NAME_terms *t) {
  int i;
  for (i = 0; i < NAME_N; i++) {
    const real v = t->move[i] / P->h;
    t->f[i] = -NAME_viscous[i] * v;
    t->slope[i] = -NAME_viscous[i] + SPREAD(0.0);
{%if dry}
    {
      const real x = v * NAME_per_smooth[i], y = v * NAME_per_stribeck[i], T = TANH(x);
      const real sharp = NAME_breakaway[i] * EXP(-y * y), force = NAME_coulomb[i] + sharp;
      t->f[i] -= force * T;
      t->slope[i] -= force * (R(1.0) - T * T) * NAME_per_smooth[i] - R(2.0) * y * NAME_per_stribeck[i] * sharp * T;
    }
{%end}
{%if inputs}
    t->f[i] += P->push[i];
{%end}
  }
}
{%end}

/* F = D1 L_d + c p0 (+ F-) and, at order 2, J = D1 D2 L_d + p0 (x) D2 D3 L_d, at q1 = q0 + t->move. */
static inline void NAME_evaluate(const NAME_problem *P, int order, NAME_terms *t) {
  const real h = P->h;
  int i, j;
{%if affine}
  const real S = P->s0 - h / R(2.0) * P->V0.value;
{%end}
{%if phase}
  NAME_phase f;
  real dx[NAME_PHASE], ddx[NAME_N][NAME_PHASE];
  int count = order == 2 ? NAME_N : 0;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_PHASE; j++) ddx[i][j] = SPREAD(0.0);
  NAME_phase_features(P->q0, t->move, h, order, &f);
{%end}
{%if correction}
  NAME_correction_network(f.x, &t->N.value, dx, count, f.along, ddx);
  NAME_chain(&f, h, order, dx, ddx, &t->N);
  t->N.value *= h * NAME_energy;
  for (i = 0; i < NAME_N; i++) {
    t->N.d0[i] *= h * NAME_energy;
    t->N.d1[i] *= h * NAME_energy;
    t->N.both[i] *= h * NAME_energy;
  }
{%end}
{%if affine}
{%if damping_network}
  NAME_damping_network(f.x, &t->g.value, dx, count, f.along, ddx);
  NAME_chain(&f, h, order, dx, ddx, &t->g);
{%else}
  t->g.value = SPREAD(0.0);
  for (i = 0; i < NAME_N; i++) t->g.d0[i] = t->g.d1[i] = t->g.both[i] = SPREAD(0.0);
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) t->g.d01[i][j] = SPREAD(0.0);
{%end}
  t->g.value = -h * (NAME_rate + t->g.value);
  for (i = 0; i < NAME_N; i++) {
    t->g.value += NAME_drag[i] * t->move[i];
    t->g.d0[i] = -NAME_drag[i] - h * t->g.d0[i];
    t->g.d1[i] = NAME_drag[i] - h * t->g.d1[i];
    t->g.both[i] *= -h;
  }
  t->E = EXPM1(t->g.value);
{%else}
  t->E = EXPM1(-NAME_rate * h);
{%end}
  t->c = R(1.0) + t->E;
  t->root = SQRT(t->c);
{%if mass}
  NAME_kinetic(&f, t->move, h, order, &t->K);
{%else}
  t->K = SPREAD(0.0);
  for (i = 0; i < NAME_N; i++) {
    t->momentum[i] = SPREAD(0.0);
{%if baseline}
    for (j = 0; j < NAME_N; j++) t->momentum[i] += NAME_mass[i * NAME_N + j] * t->move[j] / h;
    t->K += t->momentum[i] * t->move[i] / R(2.0);
{%end}
  }
{%end}
{%if friction}
  NAME_friction(P, t);
{%end}
  for (i = 0; i < NAME_N; i++) {
    t->F[i] = t->c * (P->p0[i] - h / R(2.0) * P->V0.slope[i]) + t->root * (@K0_I@);
{%if friction}
    t->F[i] += t->c * h / R(2.0) * t->f[i];
{%end}
{%if affine}
    t->F[i] += t->g.d0[i] * (t->c * S + t->root * @K@ / R(2.0));
{%end}
{%if correction}
    t->F[i] += t->N.d0[i];
{%end}
  }
  if (order < 2) return;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) {
      real J = SPREAD(0.0);
{%if baseline}
      J = t->root * (@K01@);
{%end}
{%if affine}
      {
        const real a = t->g.d0[i], b = t->g.d1[j], ab = t->g.d01[i][j] * -h;
        J += t->c * (S * (ab + a * b) + b * (P->p0[i] - h / R(2.0) * P->V0.slope[i]));
        J += t->root / R(2.0) * (a * @K1_J@ + b * (@K0_I@) + @K@ * (ab + a * b / R(2.0)));
      }
{%end}
{%if correction}
      J += h * NAME_energy * t->N.d01[i][j];
{%end}
{%if friction}
      if (i == j) J += t->c / R(2.0) * t->slope[i];
{%end}
      t->J[i][j] = J;
    }
}

/* p1 - p0 and s1 - s0 of a solved step: with F = 0, p1 = D2 L_d is c p0 + (D1 + D2) L_d, where the large terms of D1
   and D2 have cancelled on paper. Adding increments keeps digits, in float above all: c rounds, c - 1 does not. */
static inline void NAME_increments(const NAME_problem *P, const NAME_terms *t, const NAME_potential_t *V1,
    real dp[NAME_N], real *ds) {
  const real h = P->h;
  int i;
{%if affine}
  const real X = t->c * (P->s0 - h / R(2.0) * P->V0.value) + t->root * @K@ / R(2.0);
{%end}
  *ds = t->E * P->s0 + t->root * @K@ - h / R(2.0) * (t->c * P->V0.value + V1->value);
{%if correction}
  *ds += t->N.value;
{%end}
  for (i = 0; i < NAME_N; i++) {
    dp[i] = t->E * P->p0[i] - h / R(2.0) * (t->c * P->V0.slope[i] + V1->slope[i]);
{%if mass}
    dp[i] += t->root * t->K.both[i];
{%end}
{%if affine}
    dp[i] += t->g.both[i] * X;
{%end}
{%if correction}
    dp[i] += t->N.both[i];
{%end}
{%if friction}
    dp[i] += h / R(2.0) * (R(1.0) + t->c) * t->f[i];
{%if !linear}
    dp[i] += (R(1.0) + t->c) / R(2.0) * t->slope[i] * t->rest[i];  /* dry friction near rest is steep */
{%end}
{%end}
{%if !linear}
    *ds += (P->p0[i] + dp[i]) * t->rest[i];
{%end}
  }
}
"""

LEGENDRE_PLUS = """
/* p1 = D2 L_d and s1 = s0 + L_d at the solved q1, with V1 = V(q1). */
static inline void NAME_legendre_plus(const NAME_problem *P, const NAME_terms *t, const NAME_potential_t *V1,
    real p1[NAME_N], real *s1) {
  const real h = P->h;
  int i;
  for (i = 0; i < NAME_N; i++) {
    p1[i] = t->root * @K1_I@ - h / R(2.0) * V1->slope[i];
{%if affine}
    p1[i] += t->g.d1[i] * (t->c * (P->s0 - h / R(2.0) * P->V0.value) + t->root * @K@ / R(2.0));
{%end}
{%if correction}
    p1[i] += t->N.d1[i];
{%end}
{%if friction}
    p1[i] += h / R(2.0) * t->f[i];
{%end}
  }
  *s1 = t->c * P->s0 + t->root * @K@ - h / R(2.0) * (t->c * P->V0.value + V1->value);
{%if correction}
  *s1 += t->N.value;
{%end}
}
"""
