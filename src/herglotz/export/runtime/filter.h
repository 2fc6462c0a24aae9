
/* An extended Kalman filter on the model's step: positions in; (q, p, s), velocities and their covariance out, and the
   numbers of hz_parameters as slow states. Nothing is allocated, and nothing is kept but hz_filter. */

/* The size of the covariance, of q, p, s where the motion depends on s, and theta. */
#define hz_F (2 * hz_N + hz_CARRIES_S + hz_P)

typedef struct {
  hz_state x;
#if hz_P
  hz_parameters theta;
#endif
  hz_real P[hz_F][hz_F]; /* the covariance is scale * P */
  hz_real scale, weight; /* the learned factor of all variances and its weight in updates; 1 at the start */
} hz_filter;

/* Standard deviations: of a measured position; of the momentum that unknown forces add in a unit of time, growing with
   its root; and, in the same way, of how far each number of theta wanders. The error of a model differs between motions, so
   a common scale of all variances is learned; it does not change an estimate. The scale is the mean of the squared
   innovations over their variance in all updates. Each update lessens the weight of earlier updates by the share
   `adaptation`; the given deviations count as one update (West and Harrison, Bayesian forecasting and
   dynamic models, 1997, section 10.8). Adaptation 0: deviations are as given; 0.02: as the last 50 updates have them. */
typedef struct {
  hz_real position[hz_N], momentum[hz_N];
#if hz_P
  hz_real theta[hz_P];
#endif
  hz_real adaptation;
} hz_noise;

/* Start at a state with standard deviations `std` of q, p, s where the motion depends on it, and theta, hz_F numbers.
   theta null: hz_defaults. hz_BAD_INPUT where something is not finite, a deviation is negative, or theta is out of
   bounds; `filter` is written on success only. */
static inline int hz_filter_start(hz_filter *filter, const hz_state *x, hz_TAKES_THETA const hz_real std[hz_F]) {
  int i, j;
  if (hz_before(x, hz_R(1.0)) || hz_BAD_THETA(theta)) return hz_BAD_INPUT;
  for (i = 0; i < hz_F; i++)
    if (!(hz_finite(std[i]) && std[i] >= hz_R(0.0))) return hz_BAD_INPUT;
  filter->x = *x;
#if hz_P
  filter->theta = theta ? *theta : hz_defaults;
#endif
  for (i = 0; i < hz_F; i++)
    for (j = 0; j < hz_F; j++) filter->P[i][j] = i == j ? std[i] * std[i] : hz_R(0.0);
  filter->scale = filter->weight = hz_R(1.0);
  return hz_CONVERGED;
}

static inline int hz_noise_usable(const hz_noise *noise) {
  int i, good = noise->adaptation >= hz_R(0.0) && noise->adaptation < hz_R(1.0);
  for (i = 0; i < hz_N; i++) {
    good &= hz_finite(noise->position[i]) && noise->position[i] > hz_R(0.0);
    good &= hz_finite(noise->momentum[i]) && noise->momentum[i] >= hz_R(0.0);
  }
#if hz_P
  for (i = 0; i < hz_P; i++) good &= hz_finite(noise->theta[i]) && noise->theta[i] >= hz_R(0.0);
#endif
  return good;
}

/* Half of the noise of unknown forces in a step h. It is added before the step and after it, which correlates q and p. */
static inline void hz_filter_spread(hz_real P[hz_F][hz_F], hz_real h, const hz_noise *noise) {
  int i;
  for (i = 0; i < hz_N; i++) P[hz_N + i][hz_N + i] += noise->momentum[i] * noise->momentum[i] * h / hz_R(2.0);
#if hz_P
  for (i = 0; i < hz_P; i++)
    P[hz_F - hz_P + i][hz_F - hz_P + i] += noise->theta[i] * noise->theta[i] * h / hz_R(2.0);
#endif
}

/* hz_filter_predict, which also returns A. */
static inline int hz_filter_move(hz_filter *filter, hz_real h, hz_TAKES_U const hz_noise *noise, hz_real A[hz_F][hz_F]) {
  enum { SIZE = 2 * hz_N + 1, KEPT = 2 * hz_N + hz_CARRIES_S };
  hz_real by_state[SIZE * SIZE], P[hz_F][hz_F], half[hz_F][hz_F];
  hz_real by_theta[SIZE * hz_P + 1];
  hz_state x = filter->x;
  int i, j, k, status;
  if (!hz_noise_usable(noise)) return hz_BAD_INPUT;
  status = hz_step_jacobian(&x, h, hz_WITH_U(u) hz_WITH_THETA(&filter->theta) 0, by_state,
      hz_WITH_U(0) hz_WITH_THETA(by_theta) 0);
  if (status & 15) return status;
  for (i = 0; i < hz_F; i++)
    for (j = 0; j < hz_F; j++) {
      A[i][j] = i == j ? hz_R(1.0) : hz_R(0.0);
      if (i < KEPT && j < KEPT) A[i][j] = by_state[i * SIZE + j];
      if (i < KEPT && j >= KEPT) A[i][j] = by_theta[i * hz_P + j - KEPT];
      P[i][j] = filter->P[i][j];
    }
  hz_filter_spread(P, h, noise);
  for (i = 0; i < hz_F; i++)
    for (j = 0; j < hz_F; j++)
      for (half[i][j] = hz_R(0.0), k = 0; k < hz_F; k++) half[i][j] += A[i][k] * P[k][j];
  for (i = 0; i < hz_F; i++)
    for (j = 0; j <= i; j++) {
      for (P[i][j] = hz_R(0.0), k = 0; k < hz_F; k++) P[i][j] += half[i][k] * A[j][k];
      P[j][i] = P[i][j];
    }
  hz_filter_spread(P, h, noise);
  for (i = 0; i < hz_F; i++)
    for (j = 0; j < hz_F; j++)
      if (!hz_finite(P[i][j])) return hz_DIVERGED;
  filter->x = x;
  for (i = 0; i < hz_F; i++)
    for (j = 0; j < hz_F; j++) filter->P[i][j] = P[i][j];
  return status;
}

/* One step of h > 0: P becomes A P A' with A the derivative of the step, plus the noise of unknown forces. Returns the
   status of hz_step_jacobian, or hz_BAD_INPUT for unusable noise; the filter changes on success only. */
static inline int hz_filter_predict(hz_filter *filter, hz_real h, hz_TAKES_U const hz_noise *noise) {
  hz_real A[hz_F][hz_F];
  return hz_filter_move(filter, h, hz_WITH_U(u) noise, A);
}

/* Add gain * miss to the estimates. */
static inline void hz_filter_shift(hz_filter *filter, const hz_real gain[hz_F], hz_real miss) {
  int j;
  for (j = 0; j < hz_N; j++) {
    filter->x.q[j] += gain[j] * miss;
    filter->x.p[j] += gain[hz_N + j] * miss;
  }
  if (hz_CARRIES_S) filter->x.s += gain[2 * hz_N] * miss;
#if hz_P
  for (j = 0; j < hz_P; j++) filter->theta.value[j] += gain[hz_F - hz_P + j] * miss;
#endif
}

/* Numbers of theta stay within their bounds. */
static inline void hz_filter_bound(hz_filter *filter) {
#if hz_P
  int j;
  for (j = 0; j < hz_P; j++) {
    hz_real *value = filter->theta.value + j;
    if (*value < hz_lowest.value[j]) *value = hz_lowest.value[j];
    if (*value > hz_highest.value[j]) *value = hz_highest.value[j];
  }
#else
  (void)filter;
#endif
}

/* The innovation of one measured position, its variance, the part of that which is noise, and the gain. */
typedef struct {
  hz_real miss, variance, own, gain[hz_F];
} hz_innovation;

/* Update the filter by measured position i. */
static inline void hz_filter_take(hz_filter *filter, int i, hz_real y, const hz_noise *noise, hz_innovation *found) {
  int j, k;
  found->own = noise->position[i] * noise->position[i];
  found->variance = filter->P[i][i] + found->own;
  found->miss = y - filter->x.q[i];
  if (hz_is_angle[i]) {
    const hz_real turn = hz_R(6.28318530717958647693);
    found->miss -= turn * hz_floor_of(found->miss / turn + hz_R(0.5));
  }
  for (j = 0; j < hz_F; j++) found->gain[j] = filter->P[j][i] / found->variance;
  hz_filter_shift(filter, found->gain, found->miss);
  for (j = 0; j < hz_F; j++)
    for (k = 0; k <= j; k++) {
      /* P - gain variance gain', without cancellation in the row and column of what is measured */
      if (j != i && k != i) filter->P[j][k] -= found->gain[j] * found->gain[k] * found->variance;
      filter->P[k][j] = filter->P[j][k];
    }
  for (j = 0; j < hz_F; j++) filter->P[i][j] = filter->P[j][i] = found->gain[j] * found->own;
}

/* The squared innovations over their variance, of which `total` is the sum for a scale of 1; then the scale is learned. */
static inline hz_real hz_filter_scale(hz_filter *filter, hz_real total, const hz_noise *noise) {
  const hz_real surprise = total / filter->scale;
  if (noise->adaptation > hz_R(0.0)) {
    filter->weight = (hz_R(1.0) - noise->adaptation) * filter->weight + hz_R(1.0);
    filter->scale += (surprise / (hz_real)hz_N - hz_R(1.0)) / filter->weight * filter->scale;
  }
  return surprise;
}

/* An earlier sample, and the covariance C of its numbers (rows) with those of now. */
typedef struct {
  hz_filter then;
  hz_real C[hz_F][hz_F];
} hz_past;

/* hz_filter_update of the filter and of `count` earlier samples. */
static inline int hz_filter_correct(hz_filter *filter, hz_past *past, int count, const hz_real y[hz_N],
    const hz_noise *noise, hz_real *surprise) {
  hz_innovation found;
  hz_real gain[hz_F], total = hz_R(0.0);
  int i, j, k, b;
  if (!hz_all_finite(y) || !hz_noise_usable(noise)) return hz_BAD_INPUT;
  for (i = 0; i < hz_N; i++) {
    hz_filter_take(filter, i, y[i], noise, &found);
    total += found.miss * found.miss / found.variance;
    for (b = 0; b < count; b++) {
      for (j = 0; j < hz_F; j++) gain[j] = past[b].C[j][i] / found.variance;
      hz_filter_shift(&past[b].then, gain, found.miss);
      for (j = 0; j < hz_F; j++)
        for (k = 0; k < hz_F; k++) {
          hz_real *C = past[b].C[j] + k;
          past[b].then.P[j][k] -= gain[j] * gain[k] * found.variance;
          *C = k == i ? gain[j] * found.own : *C - gain[j] * found.gain[k] * found.variance;
        }
    }
  }
  hz_filter_bound(filter);
  total = hz_filter_scale(filter, total, noise);
  for (b = 0; b < count; b++) {
    hz_filter_bound(&past[b].then);
    past[b].then.scale = filter->scale;
  }
  if (surprise) *surprise = total;
  return hz_CONVERGED;
}

/* Update the filter by measured positions y one by one, as their noise is independent; angles count modulo a turn.
   `surprise` (may be null) receives the squared innovation over its variance, summed: hz_N on average. Numbers of theta
   stay within their bounds. hz_BAD_INPUT where y or the noise is not finite; the filter changes on success only. */
static inline int hz_filter_update(hz_filter *filter, const hz_real y[hz_N], const hz_noise *noise, hz_real *surprise) {
  return hz_filter_correct(filter, 0, 0, y, noise, surprise);
}

/* The velocity v of the filter's state and its covariance, hz_N numbers and (hz_N, hz_N): v = 4 d(h/2)/h - d(h)/h from
   the moves d of steps of h and h/2, which is exact to order 2 in h. Returns the status of the steps. */
static inline int hz_filter_velocity(const hz_filter *filter, hz_real h, hz_TAKES_U hz_real v[hz_N],
    hz_real *covariance) {
  enum { SIZE = 2 * hz_N + 1, KEPT = 2 * hz_N + hz_CARRIES_S };
  hz_real by_state[SIZE * SIZE], G[hz_N][hz_F], half[hz_N][hz_F], speed[hz_N];
  hz_real by_theta[SIZE * hz_P + 1];
  int i, j, k, pass;
  for (i = 0; i < hz_N; i++)
    for (speed[i] = hz_R(0.0), j = 0; j < hz_F; j++) G[i][j] = hz_R(0.0);
  for (pass = 0; pass < 2; pass++) {
    const hz_real by = (pass ? hz_R(4.0) : hz_R(-1.0)) / h;
    hz_state x = filter->x;
    const int status = hz_step_jacobian(&x, pass ? h / hz_R(2.0) : h, hz_WITH_U(u) hz_WITH_THETA(&filter->theta) 0,
        by_state, hz_WITH_U(0) hz_WITH_THETA(by_theta) 0);
    if (status & 15) return status;
    for (i = 0; i < hz_N; i++) {
      speed[i] += by * (x.q[i] - filter->x.q[i]);
      for (j = 0; j < KEPT; j++) G[i][j] += by * (by_state[i * SIZE + j] - (i == j ? hz_R(1.0) : hz_R(0.0)));
      for (j = 0; j < hz_P; j++) G[i][KEPT + j] += by * by_theta[i * hz_P + j];
    }
  }
  for (i = 0; i < hz_N; i++)
    for (v[i] = speed[i], j = 0; j < hz_F; j++)
      for (half[i][j] = hz_R(0.0), k = 0; k < hz_F; k++) half[i][j] += G[i][k] * filter->P[k][j];
  for (i = 0; covariance && i < hz_N; i++)
    for (j = 0; j < hz_N; j++)
      for (covariance[i * hz_N + j] = hz_R(0.0), k = 0; k < hz_F; k++)
        covariance[i * hz_N + j] += filter->scale * half[i][k] * G[j][k];
  return hz_CONVERGED;
}

/* A fixed-lag smoother: hz_filter, with estimates of the last samples that use the positions measured since. The samples
   lie in an array of the caller, so that nothing is allocated:

     hz_past past[20];
     hz_smoother smoother;
     hz_smoother_start(&smoother, &filter, past, 20);
     ...
     hz_smoother_predict(&smoother, h, &noise);
     hz_smoother_update(&smoother, y, &noise, 0);
     hz_filter_velocity(hz_smoothed(&smoother, 20), h, v, 0);

   A position moves an earlier sample by its covariance with the present one, which a step carries along as C A'.
   Source: B. D. O. Anderson & J. B. Moore, Optimal filtering (1979), section 7.3. */

typedef struct {
  hz_filter now;
  hz_past *past; /* a ring: `count` of `lag` are filled, the newest is past[newest] */
  int lag, count, newest, moved; /* moved: steps have been made since the last sample, which lies in the ring */
} hz_smoother;

/* Start at a filter that has been started, with an array of lag > 0 samples, which must live as long as the smoother.
   hz_BAD_INPUT where there is no array, or the filter is not finite; `smoother` is written on success only. */
static inline int hz_smoother_start(hz_smoother *smoother, const hz_filter *filter, hz_past *past, int lag) {
  int i, j;
  if (!past || lag < 1 || hz_before(&filter->x, hz_R(1.0))) return hz_BAD_INPUT;
  for (i = 0; i < hz_F; i++)
    for (j = 0; j < hz_F; j++)
      if (!hz_finite(filter->P[i][j])) return hz_BAD_INPUT;
  smoother->now = *filter;
  smoother->past = past;
  smoother->lag = lag;
  smoother->newest = lag - 1;
  smoother->count = smoother->moved = 0;
  return hz_CONVERGED;
}

/* The estimate of the sample `back` samples ago, 0 to lag; null where that sample is not kept. */
static inline const hz_filter *hz_smoothed(const hz_smoother *smoother, int back) {
  if (back < 0 || back > smoother->count) return 0;
  return back ? &smoother->past[(smoother->newest + smoother->lag + 1 - back) % smoother->lag].then : &smoother->now;
}

/* hz_filter_predict; several steps may lie between two samples. */
static inline int hz_smoother_predict(hz_smoother *smoother, hz_real h, hz_TAKES_U const hz_noise *noise) {
  hz_filter next = smoother->now;
  hz_real A[hz_F][hz_F], row[hz_F];
  int i, j, k, b;
  const int status = hz_filter_move(&next, h, hz_WITH_U(u) noise, A);
  if (status & 15) return status;
  if (!smoother->moved) {
    hz_past *last;
    smoother->newest = (smoother->newest + 1) % smoother->lag;
    if (smoother->count < smoother->lag) smoother->count++;
    last = smoother->past + smoother->newest;
    last->then = smoother->now;
    for (i = 0; i < hz_F; i++)
      for (j = 0; j < hz_F; j++) last->C[i][j] = smoother->now.P[i][j];
    smoother->moved = 1;
  }
  for (b = 0; b < smoother->count; b++)
    for (i = 0; i < hz_F; i++) {
      hz_real *own = smoother->past[b].C[i];
      for (j = 0; j < hz_F; j++)
        for (row[j] = hz_R(0.0), k = 0; k < hz_F; k++) row[j] += own[k] * A[j][k];
      for (j = 0; j < hz_F; j++) own[j] = row[j];
    }
  smoother->now = next;
  return status;
}

/* hz_filter_update of all kept samples. */
static inline int hz_smoother_update(hz_smoother *smoother, const hz_real y[hz_N], const hz_noise *noise,
    hz_real *surprise) {
  const int status = hz_filter_correct(&smoother->now, smoother->past, smoother->count, y, noise, surprise);
  if (!status) smoother->moved = 0;
  return status;
}
