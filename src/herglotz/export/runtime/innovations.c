/* The likelihood of a recording under the filter, for `herglotz.export.filtering`: not part of what is exported. */

#include "stepper.h"

/* -2 log p of the positions y, (rows, hz_N), of trajectories of these lengths: the sum over their innovations r of
   r^2/S + log S. Sample k is reached by parts[k] steps from the one before; h and u have an entry for each of them, one
   after the other. A trajectory starts at q, p = start, whose p has the derivatives `by_q`, (hz_N, hz_N), by each of two
   positions. `deviations` are those of position and momentum. Returns 0, or a status where there is no step. */
int herglotz_likelihood(long trajectories, const long *lengths, const long *parts, const hz_real *h, const hz_real *u,
    const hz_real *y, const hz_real *start, const hz_real *by_q, const hz_real *deviations, hz_real *sum) {
  hz_noise noise;
  long b, k, part;
  int i, j, status;
  (void)u;
  noise.adaptation = 0.0;
  *sum = 0.0;
  for (i = 0; i < hz_N; i++) {
    noise.position[i] = deviations[i];
    noise.momentum[i] = deviations[hz_N + i];
  }
  for (b = 0; b < trajectories; b++, start += 2 * hz_N, by_q += hz_N * hz_N) {
    hz_filter filter;
    hz_state x = hz_start;
    hz_real std[hz_F] = {0.0};
    for (i = 0; i < hz_N; i++) {
      x.q[i] = start[i];
      x.p[i] = start[hz_N + i];
      std[i] = noise.position[i];
      for (j = 0; j < hz_N; j++) std[hz_N + i] += 2.0 * by_q[i * hz_N + j] * by_q[i * hz_N + j] * std[j] * std[j];
      std[hz_N + i] = sqrt(std[hz_N + i]);
    }
    x.s = 0.0;
    if ((status = 15 & hz_filter_start(&filter, &x, std))) return status;
    for (k = 0; k < lengths[b]; k++, parts++, y += hz_N) {
      for (part = 0; part < *parts; part++, h++) {
        if ((status = 15 & hz_filter_predict(&filter, *h, hz_WITH_U(u) &noise))) return status;
        u += hz_M;
      }
      for (i = 0; k && i < hz_N; i++) {
        hz_innovation found;
        hz_filter_take(&filter, i, y[i], &noise, &found);
        *sum += found.miss * found.miss / found.variance + log(found.variance);
      }
    }
  }
  return 0;
}
