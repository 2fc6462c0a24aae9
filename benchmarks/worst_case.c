/* Time and evaluations of single steps, from random states of the box or along motions: `worst_case.py`.

   A step is repeated from the same state, and the shortest time counts: what interrupts a program only adds to it. A step
   that looks long is repeated until REPEATS tries agree that it is. */

#define _POSIX_C_SOURCE 199309L
#include <stdint.h>
#include <time.h>

static int evaluations; /* of the step equation; the header that is measured counts them */
#include "model.h"

enum { BINS = 1 << 20, TRIES = 3, REPEATS = 30, MOTION = 400 }; /* bins of a nanosecond */
static long times[BINS], counts[model_max_iterations + 2];

static double uniform(uint64_t *seed, double low, double high) { /* splitmix64 */
  uint64_t z = (*seed += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return low + (high - low) * (double)((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

static long clocked(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * 1000000000L + t.tv_nsec;
}

static long quantile(const long *bins, int many, double part, long total) {
  long seen = 0;
  int i = 0;
  while (i < many - 1 && (double)(seen += bins[i]) < part * (double)total) i++;
  return i;
}

/* `found` receives the median, the 99.99 % quantile and the longest time in ns, the same of evaluations, failed steps,
   and steps that were long in fewer than REPEATS tries. */
void measure(long steps, int along, uint64_t seed, long found[8]) {
  long k, clock = 1000000, limit = BINS;
  int i, r, failed = 0, interrupted = 0;
  model_state x = model_start, y;
  for (k = 0; k < BINS; k++) times[k] = 0;
  for (i = 0; i < model_max_iterations + 2; i++) counts[i] = 0;
  for (k = 0; k < 1000; k++) { /* what two readings of the clock take */
    const long begin = clocked(), took = clocked() - begin;
    if (took < clock) clock = took;
  }
  for (k = 0; k < steps; k++) {
    long shortest = BINS, took;
    int status = 0, again = TRIES;
#if model_INPUTS
    model_real u[model_M];
    for (i = 0; i < model_M; i++) u[i] = (model_real)uniform(&seed, -1.0, 1.0);
#endif
    if (!along || k % MOTION == 0) {
      for (i = 0; i < model_N; i++) {
        x.q[i] = (model_real)uniform(&seed, model_q_low[i], model_q_high[i]);
        x.p[i] = (model_real)uniform(&seed, model_p_low[i], model_p_high[i]);
      }
      x.s = (model_real)uniform(&seed, model_s_low, model_s_high);
      x.sigma = (model_real)1.0;
    }
    for (r = 0; r < again; r++) {
      long begin;
      y = x;
      evaluations = 0;
      begin = clocked();
      status = model_step(&y, model_h, model_WITH_U(u) 0);
      took = clocked() - begin - clock;
      if (took < shortest) shortest = took < 0 ? 0 : took;
      if (r == TRIES - 1 && shortest > limit) again = REPEATS;
    }
    interrupted += again > TRIES && shortest <= limit;
    failed += (status & 15) != 0;
    times[shortest < BINS ? shortest : BINS - 1]++;
    counts[evaluations]++;
    x = y;
    if (k == 1000) limit = 2 * quantile(times, BINS, 0.5, k + 1);
  }
  found[0] = quantile(times, BINS, 0.5, steps);
  found[1] = quantile(times, BINS, 0.9999, steps);
  found[2] = quantile(times, BINS, 1.0, steps);
  found[3] = quantile(counts, model_max_iterations + 2, 0.5, steps);
  found[4] = quantile(counts, model_max_iterations + 2, 0.9999, steps);
  found[5] = quantile(counts, model_max_iterations + 2, 1.0, steps);
  found[6] = failed;
  found[7] = interrupted;
}
