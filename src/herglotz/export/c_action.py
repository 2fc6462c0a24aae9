"""The step equation of the full level as a C template: the flow of s through the units of a network."""

from __future__ import annotations

ACTION = """
/* One unit, half a step of ds/dt = (r S / k) tanh(k s / S + b), solved exactly: G, what s has gained so far, becomes
   G + (y - x) S / k with x = k (s + G) / S + b and y = asinh(exp(a) sinh x), a = r h / 2. */
static inline void NAME_action_unit(const NAME_jet *s, const NAME_jet *b, int unit, real h, int order, NAME_jet *G) {
  const real k = NAME_action_slope[unit] + SPREAD(0.0), one = SPREAD(1.0);
  const real grown = NAME_growth(NAME_action_rate[unit] * h / R(2.0)), e = one + grown, E = grown * (one + e);
  NAME_jet x = *b;
  real t, D, slope, gained;
  NAME_jet_add(&x, k, s, order);
  NAME_jet_add(&x, k, G, order);
  t = TANH(x.value);
  D = SQRT(one + E * t * t);
  slope = (one - t) * (one + t);
  gained = ATANH(t * E / (one + e * D));
  NAME_jet_map(&x, gained, E * slope / (D * (e + D)), -e * E * t * slope / (D * D * D), order);
  NAME_jet_add(G, one / k, &x, order);
}

/* F and J of NAME_terms at q1 = q0 + t->move. Derivatives d0 are taken along q0 and, p0 times, along s0: that is what
   F = D1 L_d + (1 + D3 L_d) p0 and its derivative J along q1 consist of. */
static inline void NAME_evaluate(const NAME_problem *P, int order, NAME_terms *t) {
  const real h = P->h, one = SPREAD(1.0);
  NAME_jet s, half, K, b[NAME_UNITS], x, *G = &t->L;
  NAME_phase f;
  real dx[NAME_PHASE], ddx[NAME_N][NAME_PHASE], g = -h * NAME_rate / R(2.0);
  int i, j, k;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_PHASE; j++) ddx[i][j] = SPREAD(0.0);
  NAME_phase_features(P->q0, t->move, h, order, &f);
  for (k = 0; k < NAME_UNITS; k++) {
    NAME_jet_clear(&b[k]);
    b[k].value = NAME_action_bias[k] + SPREAD(0.0);
    for (j = 0; j < NAME_PHASE; j++) {
      dx[j] = NAME_action_weight[k * NAME_PHASE + j] + SPREAD(0.0);
      b[k].value += dx[j] * f.x[j];
    }
    NAME_chain(&f, h, order, dx, ddx, &b[k]);
  }
  NAME_jet_clear(&s);
  s.value = P->s0;
  s.ds = one;
  NAME_jet_clear(G);
  G->value = -h / R(2.0) * P->V0.value;
  NAME_jet_clear(&half);  /* sqrt(c) - 1 of the part that positions and velocities give */
  for (i = 0; i < NAME_N; i++) {
    s.d0[i] = s.both[i] = P->p0[i];
    G->d0[i] = G->both[i] = -h / R(2.0) * P->V0.slope[i];
    g += NAME_drag[i] * t->move[i] / R(2.0);
    half.d1[i] = NAME_drag[i] / R(2.0) + SPREAD(0.0);
    half.d0[i] = -half.d1[i];
  }
  half.value = EXPM1(g);
  NAME_jet_map(&half, half.value, one + half.value, one + half.value, order);
  for (k = 0; k < NAME_UNITS; k++) NAME_action_unit(&s, &b[k], k, h, order, G);
  x = s;
  NAME_jet_add(&x, one, G, order);
  NAME_jet_product(G, &half, &x, order);
  NAME_kinetic(&f, t->move, h, order, &K);
  NAME_jet_add(G, one, &K, order);
  x = s;
  NAME_jet_add(&x, one, G, order);
  NAME_jet_product(G, &half, &x, order);
  for (k = NAME_UNITS - 1; k >= 0; k--) NAME_action_unit(&s, &b[k], k, h, order, G);
{%if correction}
  NAME_jet_clear(&x);
  NAME_correction_network(f.x, &x.value, dx, order == 2 ? NAME_N : 0, f.along, ddx);
  NAME_chain(&f, h, order, dx, ddx, &x);
  NAME_jet_add(G, h * NAME_energy, &x, order);
{%end}
  t->E = G->ds;
  t->c = one + t->E;
  for (i = 0; i < NAME_N; i++) {
    t->F[i] = P->p0[i] + G->d0[i];
    for (j = 0; j < NAME_N; j++) t->J[i][j] = G->d01[i][j];
  }
}

/* p1 - p0 and s1 - s0 of a solved step: with F = 0, p1 - p0 is (D1 + D2 + p0 D3) L_d, carried as `both`. */
static inline void NAME_increments(const NAME_problem *P, const NAME_terms *t, const NAME_potential_t *V1,
    real dp[NAME_N], real *ds) {
  int i;
  *ds = t->L.value - P->h / R(2.0) * V1->value;
  for (i = 0; i < NAME_N; i++) {
    dp[i] = t->L.both[i] - P->h / R(2.0) * V1->slope[i];
    *ds += (P->p0[i] + dp[i]) * t->rest[i];
  }
}
"""

ACTION_LEGENDRE_PLUS = """
/* p1 = D2 L_d and s1 = s0 + L_d at the solved q1, with V1 = V(q1). */
static inline void NAME_legendre_plus(const NAME_problem *P, const NAME_terms *t, const NAME_potential_t *V1,
    real p1[NAME_N], real *s1) {
  int i;
  for (i = 0; i < NAME_N; i++) p1[i] = t->L.d1[i] - P->h / R(2.0) * V1->slope[i];
  *s1 = P->s0 + t->L.value - P->h / R(2.0) * V1->value;
}
"""
