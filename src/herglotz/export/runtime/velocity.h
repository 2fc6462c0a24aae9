/* Momenta of velocities, p = L_v(q, v, s), and the inverse. Where dry friction can hold a coordinate, p also has half of
   the friction's impulse, +-(h/2) r(q, v), and Newton's unknown of the inverse is a z whose part beyond a bound is v, as
   in a step. */

#define hz_VELOCITIES

/* The results of hz_momentum; grip is 0 without set-valued friction. */
typedef struct {
  hz_real p[hz_N], by_v[hz_N * hz_N], grip[hz_N], grip_by_v[hz_N];
} hz_legendre;

static inline void hz_legendre_at(const hz_real q[hz_N], const hz_real v[hz_N], hz_real s, hz_real h,
    hz_TAKES_THETA hz_legendre *at) {
#if hz_STICKING
  hz_momentum(q, v, s, h, hz_WITH_THETA((theta ? theta : &hz_defaults)->value) at->p, at->by_v, at->grip, at->grip_by_v);
#else
  int i;
  hz_momentum(q, v, s, h, hz_WITH_THETA((theta ? theta : &hz_defaults)->value) at->p, at->by_v);
  for (i = 0; i < hz_N; i++) at->grip[i] = at->grip_by_v[i] = hz_R(0.0);
#endif
}

static inline hz_real hz_beyond(hz_real z, hz_real bound) {
  return z > bound ? z - bound : z < -bound ? z + bound : hz_R(0.0);
}

static inline hz_real hz_largest(const hz_real x[hz_N]) {
  hz_real size = hz_R(0.0);
  int i;
  for (i = 0; i < hz_N; i++) size = hz_fabs(x[i]) > size ? hz_fabs(x[i]) : size;
  return size;
}

/* The state at q with the velocity v, in hz_units over the unit of time, and the action s; sigma starts at 1. h is the
   step that the motion goes on with: it matters where dry friction can hold a coordinate, and is checked as that of a
   step. `out` is written on success only. Returns a status. */
static inline int hz_init_qv(const hz_real q[hz_N], const hz_real v[hz_N], hz_real s, hz_real h,
    hz_TAKES_THETA hz_state *out) {
  hz_legendre at;
  hz_state next;
  int i;
  for (i = 0; i < hz_N; i++) {
    next.q[i] = q[i];
    next.p[i] = v[i];
  }
  next.s = s;
  next.sigma = hz_R(1.0);
  if (hz_before(&next, h) || hz_BAD_THETA(theta)) return hz_BAD_INPUT;
  hz_legendre_at(q, v, s, h, hz_WITH_THETA(theta) &at);
  for (i = 0; i < hz_N; i++)
    next.p[i] = at.p[i] + (v[i] > hz_R(0.0) ? at.grip[i] : v[i] < hz_R(0.0) ? -at.grip[i] : hz_R(0.0));
  if (!hz_all_finite(next.p)) return hz_DIVERGED;
  *out = next;
  return hz_outside_box(out) | hz_outside_h(h);
}

/* The velocity of a state that steps of h have made: the inverse of hz_init_qv, by Newton from rest; a move that does
   not lessen what is left of p is halved. `v` is written on success only. Returns a status: hz_SINGULAR or
   hz_MAX_ITERATIONS where no velocity with this p is found. */
static inline int hz_velocity(const hz_state *state, hz_real h, hz_TAKES_THETA hz_real v[hz_N]) {
  hz_legendre at;
  hz_real z[hz_N], base[hz_N], move[hz_N], own[hz_N], bound[hz_N], G[hz_N], now[hz_N];
  hz_real A[hz_N * hz_N], inverse[hz_N * hz_N];
  hz_real scale = hz_R(0.0), merit, before = hz_R(0.0), last = hz_R(0.0), part = hz_R(1.0);
  int i, j, sweep, iteration, better;
  const int status = hz_before(state, h);
  if (status) return status;
  if (hz_BAD_THETA(theta)) return hz_BAD_INPUT;
  for (i = 0; i < hz_N; i++) z[i] = move[i] = base[i] = now[i] = hz_R(0.0);
  hz_legendre_at(state->q, z, state->s, h, hz_WITH_THETA(theta) &at);
  for (i = 0; i < hz_N; i++) {
    own[i] = hz_fabs(at.by_v[i * hz_N + i]);
    bound[i] = hz_STICKING ? at.grip[i] / own[i] : hz_R(0.0);
  }
  for (sweep = 0; hz_STICKING && sweep < 8; sweep++) /* of Gauss and Seidel: which coordinates stand still */
    for (i = 0; i < hz_N; i++) {
      z[i] = state->p[i] - at.p[i];
      for (j = 0; j < hz_N; j++)
        if (j != i) z[i] -= at.by_v[i * hz_N + j] * hz_beyond(z[j], bound[j]);
      z[i] /= own[i];
    }
  for (iteration = 0; iteration <= hz_max_iterations; iteration++) {
    for (i = 0; i < hz_N; i++) now[i] = hz_beyond(z[i], bound[i]);
    hz_legendre_at(state->q, now, state->s, h, hz_WITH_THETA(theta) &at);
    for (i = 0; i < hz_N; i++) {
      const int slides = !hz_STICKING || now[i] != hz_R(0.0);
      const hz_real sign = now[i] > hz_R(0.0) ? hz_R(1.0) : hz_R(-1.0);
      G[i] = state->p[i] - at.p[i] - (slides ? sign * at.grip[i] : own[i] * z[i]);
      for (j = 0; j < hz_N; j++)
        A[j * hz_N + i] = slides ? at.by_v[j * hz_N + i] : hz_R(0.0);
      A[i * hz_N + i] += slides ? sign * at.grip_by_v[i] : own[i];
    }
    merit = hz_largest(G);
    better = !iteration || merit <= (hz_R(1.0) - hz_R(1e-4) * part) * before;
    if (!hz_all_finite(G)) {
      if (!iteration) return hz_DIVERGED;
    } else if (better || merit <= hz_floor * hz_largest(state->p)) { /* the last digits need not lessen */
      hz_inverse(hz_N, A, inverse);
      for (i = 0; i < hz_N; i++) {
        move[i] = hz_R(0.0);
        for (j = 0; j < hz_N; j++) move[i] += inverse[i * hz_N + j] * G[j];
      }
      if (!hz_all_finite(move)) return hz_SINGULAR;
      last = hz_largest(move);
      if (!iteration) scale = last > hz_largest(z) ? last : hz_largest(z);
      for (i = 0; i < hz_N; i++) {
        base[i] = z[i];
        z[i] += move[i];
      }
      if (last <= hz_floor * scale) break;
      before = merit;
      part = hz_R(1.0);
      continue;
    }
    part /= hz_R(2.0);
    for (i = 0; i < hz_N; i++) z[i] = base[i] + part * move[i];
  }
  if (iteration > hz_max_iterations) return hz_MAX_ITERATIONS;
  for (i = 0; i < hz_N; i++) v[i] = hz_beyond(z[i], bound[i]);
  return hz_outside_box(state) | hz_outside_h(h);
}

#if defined(hz_BATCHED) && !hz_STICKING
/* Velocities of FN_WIDTH states by Newton's method from rest; `found` is 1 for each that converged as in hz_velocity. */
static inline void FN_velocity(const FN_state *x, hz_real h, hz_TAKES_THETA REAL v[hz_N], int found[FN_WIDTH]) {
  FN_factors A;
  REAL p[hz_N], by_v[hz_N * hz_N], move[hz_N], sum;
  hz_real scale[FN_WIDTH], size[FN_WIDTH];
  int i, w, iteration, left = FN_WIDTH;
#if hz_P
  REAL values[hz_P];
  for (i = 0; i < hz_P; i++) values[i] = SPREAD(theta->value[i]);
#endif
  for (i = 0; i < hz_N; i++) v[i] = SPREAD(hz_R(0.0));
  for (iteration = 0; left && iteration < 8; iteration++) {
    FN_momentum(x->q, v, x->s, SPREAD(h), hz_WITH_THETA(values) p, by_v);
    for (i = 0; i < hz_N; i++) p[i] -= x->p[i];
    for (i = 0; i < hz_N * hz_N; i++) A.lu[i / hz_N][i % hz_N] = by_v[i];
    FN_factorise(&A);
    FN_direction(&A, p, move);
    FN_length(move, size);
    for (sum = SPREAD(hz_R(0.0)), i = 0; i < hz_N; i++) sum += v[i] += move[i]; /* NaN is in no length, but in a sum */
    for (left = FN_WIDTH, w = 0; w < FN_WIDTH; w++) {
      if (!iteration) scale[w] = size[w];
      found[w] = size[w] <= hz_floor * scale[w] && hz_finite(FN_LANE(sum, w));
      left -= found[w];
    }
  }
}
#endif

/* hz_velocity of the first of `count` states, as many at once as registers hold; returns their number. `statuses` have
   no flags. */
static inline int hz_velocity_some(const hz_state *states, long count, hz_real h, hz_TAKES_THETA hz_real v[hz_SIDE][hz_N],
    int statuses[hz_SIDE]) {
  const int some = count < hz_SIDE ? (int)count : hz_SIDE;
  int w, found[hz_SIDE] = {0};
#if defined(hz_BATCHED) && !hz_STICKING
  if (some > 1 && !hz_BAD_THETA(theta) && hz_finite(h) && h > hz_R(0.0)) {
    hz_wide_state x;
    hz_lanes wide[hz_N];
    int i;
    for (w = 0; w < hz_SIDE; w++) hz_wide_set(&x, w, states + (w < some ? w : some - 1)); /* the last one is repeated */
    hz_wide_velocity(&x, h, hz_WITH_THETA(theta ? theta : &hz_defaults) wide, found);
    for (w = 0; w < some; w++)
      for (i = 0; i < hz_N; i++) v[w][i] = hz_wide_LANE(wide[i], w);
  }
#endif
  for (w = 0; w < some; w++)
    statuses[w] = found[w] ? hz_CONVERGED : 15 & hz_velocity(states + w, h, hz_WITH_THETA(theta) v[w]);
  return some;
}
