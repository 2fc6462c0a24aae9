
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

/* An earlier sample, and the covariance C of its numbers (rows) with those of now. */
typedef struct {
  hz_filter then;
  hz_real C[hz_F][hz_F];
} hz_past;

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
  hz_innovation found;
  hz_real gain[hz_F], total = hz_R(0.0);
  int i, j, k, b;
  if (!hz_all_finite(y) || !hz_noise_usable(noise)) return hz_BAD_INPUT;
  for (i = 0; i < hz_N; i++) {
    hz_filter_take(&smoother->now, i, y[i], noise, &found);
    total += found.miss * found.miss / found.variance;
    for (b = 0; b < smoother->count; b++) {
      hz_past *past = smoother->past + b;
      for (j = 0; j < hz_F; j++) gain[j] = past->C[j][i] / found.variance;
      hz_filter_shift(&past->then, gain, found.miss);
      for (j = 0; j < hz_F; j++)
        for (k = 0; k < hz_F; k++) {
          past->then.P[j][k] -= gain[j] * gain[k] * found.variance;
          past->C[j][k] = k == i ? gain[j] * found.own : past->C[j][k] - gain[j] * found.gain[k] * found.variance;
        }
    }
  }
  hz_filter_bound(&smoother->now);
  total = hz_filter_scale(&smoother->now, total, noise);
  for (b = 0; b < smoother->count; b++) {
    hz_filter_bound(&smoother->past[b].then);
    smoother->past[b].then.scale = smoother->now.scale;
  }
  smoother->moved = 0;
  if (surprise) *surprise = total;
  return hz_CONVERGED;
}
