"""The step equation, its Jacobian and FL⁺ as a C template."""

from __future__ import annotations

EVALUATION = """
/* What does not change while a step is solved. */
typedef struct {
  real q0[NAME_N], p0[NAME_N], s0, h;
  NAME_potential_t V0;
} NAME_problem;

/* The terms of L_d at one q1 = q0 + move: c = exp(g) = 1 + E, root = sqrt(c), K and its momentum m move / h, N. */
typedef struct {
  real move[NAME_N], F[NAME_N], J[NAME_N][NAME_N];
  real E, c, root, K, momentum[NAME_N];
{%if affine}
  NAME_jet g;
{%end}
{%if correction}
  NAME_jet N;
{%end}
} NAME_terms;

/* F = D1 L_d + c p0 and, at order 2, J = D1 D2 L_d + p0 (x) D2 D3 L_d, at q1 = q0 + t->move. */
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
  NAME_phase_features(P->q0, t->move, h, order, &f);
{%end}
{%if correction}
  NAME_correction_network(f.x, &t->N.value, dx, count, f.along, ddx);
  NAME_chain(&f, h, order, dx, ddx, &t->N);
  t->N.value *= h * NAME_energy;
  for (i = 0; i < NAME_N; i++) {
    t->N.d0[i] *= h * NAME_energy;
    t->N.d1[i] *= h * NAME_energy;
  }
{%end}
{%if affine}
{%if damping_network}
  NAME_damping_network(f.x, &t->g.value, dx, count, f.along, ddx);
  NAME_chain(&f, h, order, dx, ddx, &t->g);
{%else}
  t->g.value = R(0.0);
  for (i = 0; i < NAME_N; i++) t->g.d0[i] = t->g.d1[i] = R(0.0);
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) t->g.d01[i][j] = R(0.0);
{%end}
  t->g.value = -h * (NAME_rate + t->g.value);
  for (i = 0; i < NAME_N; i++) {
    t->g.value += NAME_drag[i] * t->move[i];
    t->g.d0[i] = -NAME_drag[i] - h * t->g.d0[i];
    t->g.d1[i] = NAME_drag[i] - h * t->g.d1[i];
  }
  t->E = EXPM1(t->g.value);
{%else}
  t->E = EXPM1(-NAME_rate * h);
{%end}
  t->c = R(1.0) + t->E;
  t->root = SQRT(t->c);
  t->K = R(0.0);
  for (i = 0; i < NAME_N; i++) {
    t->momentum[i] = R(0.0);
{%if baseline}
    for (j = 0; j < NAME_N; j++) t->momentum[i] += NAME_mass[i * NAME_N + j] * t->move[j] / h;
    t->K += t->momentum[i] * t->move[i] / R(2.0);
{%end}
    t->F[i] = t->c * (P->p0[i] - h / R(2.0) * P->V0.slope[i]) - t->root * t->momentum[i];
  }
  for (i = 0; i < NAME_N; i++) {
{%if affine}
    t->F[i] += t->g.d0[i] * (t->c * S + t->root * t->K / R(2.0));
{%end}
{%if correction}
    t->F[i] += t->N.d0[i];
{%end}
  }
  if (order < 2) return;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) {
      real J = R(0.0);
{%if baseline}
      J = -t->root * NAME_mass[i * NAME_N + j] / h;
{%end}
{%if affine}
      {
        const real a = t->g.d0[i], b = t->g.d1[j], ab = t->g.d01[i][j] * -h;
        J += t->c * (S * (ab + a * b) + b * (P->p0[i] - h / R(2.0) * P->V0.slope[i]));
        J += t->root / R(2.0) * (a * t->momentum[j] - b * t->momentum[i] + t->K * (ab + a * b / R(2.0)));
      }
{%end}
{%if correction}
      J += h * NAME_energy * t->N.d01[i][j];
{%end}
      t->J[i][j] = J;
    }
}

/* p1 = D2 L_d and s1 = s0 + L_d at the solved q1, with V1 = V(q1). */
static inline void NAME_legendre_plus(const NAME_problem *P, const NAME_terms *t, const NAME_potential_t *V1,
    real p1[NAME_N], real *s1) {
  const real h = P->h;
  int i;
  for (i = 0; i < NAME_N; i++) {
    p1[i] = t->root * t->momentum[i] - h / R(2.0) * V1->slope[i];
{%if affine}
    p1[i] += t->g.d1[i] * (t->c * (P->s0 - h / R(2.0) * P->V0.value) + t->root * t->K / R(2.0));
{%end}
{%if correction}
    p1[i] += t->N.d1[i];
{%end}
  }
  *s1 = t->c * P->s0 + t->root * t->K - h / R(2.0) * (t->c * P->V0.value + V1->value);
{%if correction}
  *s1 += t->N.value;
{%end}
}
"""
