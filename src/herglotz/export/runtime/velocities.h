/* Velocities of several states at once. */

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
