"""Functions of (q0, q1, s0) with their derivatives as C templates: products, chain rule, and the kinetic term."""

from __future__ import annotations

JETS = """
/* y += a x, value and derivatives; as everywhere, second derivatives at order 2 only. */
static inline void NAME_jet_add(NAME_jet *y, real a, const NAME_jet *x, int order) {
  int i, j;
  y->value += a * x->value;
{%if full}
  y->ds += a * x->ds;
{%end}
  for (i = 0; i < NAME_N; i++) {
    y->d0[i] += a * x->d0[i];
    y->d1[i] += a * x->d1[i];
    y->both[i] += a * x->both[i];
  }
  if (order < 2) return;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++) y->d01[i][j] += a * x->d01[i][j];
}

/* y += x z. */
static inline void NAME_jet_product(NAME_jet *y, const NAME_jet *x, const NAME_jet *z, int order) {
  const real a = x->value, b = z->value;
  int i, j;
  y->value += a * b;
{%if full}
  y->ds += x->ds * b + a * z->ds;
{%end}
  for (i = 0; i < NAME_N; i++) {
    y->d0[i] += x->d0[i] * b + a * z->d0[i];
    y->d1[i] += x->d1[i] * b + a * z->d1[i];
    y->both[i] += x->both[i] * b + a * z->both[i];
  }
  if (order < 2) return;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_N; j++)
      y->d01[i][j] += x->d01[i][j] * b + a * z->d01[i][j] + x->d0[i] * z->d1[j] + z->d0[i] * x->d1[j];
}

/* x becomes f(x), given the value, slope and second derivative of f there. */
static inline void NAME_jet_map(NAME_jet *x, real value, real slope, real second, int order) {
  int i, j;
  x->value = value;
{%if full}
  x->ds *= slope;
{%end}
  if (order == 2)
    for (i = 0; i < NAME_N; i++)
      for (j = 0; j < NAME_N; j++) x->d01[i][j] = slope * x->d01[i][j] + second * x->d0[i] * x->d1[j];
  for (i = 0; i < NAME_N; i++) {
    x->d0[i] *= slope;
    x->d1[i] *= slope;
    x->both[i] *= slope;
  }
}

static inline void NAME_jet_clear(NAME_jet *x) {
  int i, j;
  x->value = SPREAD(0.0);
{%if full}
  x->ds = SPREAD(0.0);
{%end}
  for (i = 0; i < NAME_N; i++) {
    x->d0[i] = x->d1[i] = x->both[i] = SPREAD(0.0);
    for (j = 0; j < NAME_N; j++) x->d01[i][j] = SPREAD(0.0);
  }
}
"""

KINETIC = """
{%if mass}
/* K = h |T^T C^T v|^2 / 2, where T(q) is lower triangular: T_ii = exp(2 tanh(r_ii / 2)), T_ij = r_ij below, and r is
   one network of the features of the position, less its value at q = 0. */
static inline void NAME_kinetic(NAME_phase *f, const real move[NAME_N], real h, int order, NAME_jet *K) {
  real dx[NAME_PHASE], ddx[NAME_N][NAME_PHASE];
  int i, j, k;
  for (i = 0; i < NAME_N; i++)
    for (j = 0; j < NAME_PHASE; j++) ddx[i][j] = SPREAD(0.0);
  NAME_jet_clear(K);
  for (j = 0; j < NAME_N; j++) {
    NAME_jet y;
    NAME_jet_clear(&y);
    for (i = j; i < NAME_N; i++) {
      const int place = i == j ? i : NAME_N + i * (i - 1) / 2 + j;
      NAME_jet T, w;
      NAME_jet_clear(&T);
      NAME_mass_network(place, f->x, &T.value, dx, order == 2 ? NAME_N : 0, f->along, ddx);
      T.value -= NAME_mass_origin[place];
      NAME_chain(f, h, order, dx, ddx, &T);
      if (i == j) {
        const real t = TANH(T.value / R(2.0)), e = EXP(R(2.0) * t), slope = R(1.0) - t * t;
        NAME_jet_map(&T, e, e * slope, e * slope * (slope - t), order);
      }
      NAME_jet_clear(&w);
      for (k = 0; k < NAME_N; k++) {
        w.d1[k] = NAME_mass_factor[k * NAME_N + i] / h;
        w.d0[k] = -w.d1[k];
        w.value += w.d1[k] * move[k];
      }
      NAME_jet_product(&y, &T, &w, order);
    }
    NAME_jet_product(K, &y, &y, order);
  }
  NAME_jet_map(K, K->value * h / R(2.0), h / R(2.0), SPREAD(0.0), order);
}
{%else}
/* K = move^T m move / 2h. */
static inline void NAME_kinetic(NAME_phase *f, const real move[NAME_N], real h, int order, NAME_jet *K) {
{%if baseline}
  int i, j;
  (void)f;
  (void)order;
  NAME_jet_clear(K);
  for (i = 0; i < NAME_N; i++) {
    for (j = 0; j < NAME_N; j++) {
      K->d01[i][j] = -NAME_mass[i * NAME_N + j] / h;
      K->d1[i] -= K->d01[i][j] * move[j];
    }
    K->d0[i] = -K->d1[i];
    K->value += K->d1[i] * move[i] / R(2.0);
  }
{%else}
  (void)f;
  (void)move;
  (void)h;
  (void)order;
  NAME_jet_clear(K);
{%end}
}
{%end}
"""
