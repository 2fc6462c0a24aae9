/* Time and evaluations of single steps, from random states of the box or along motions: `worst_case.py`.

   A step is repeated from the same state, and the shortest time counts: what interrupts a program only adds to it. The
   longest ones are kept with their states, and repeated often when the others are done. */

#define _POSIX_C_SOURCE 199309L
#include <stdint.h>
#include <time.h>

static int evaluations; /* of the step equation; the header that is measured counts them */
#include "model.h"

enum { BINS = 1 << 20, TRIES = 3, KEPT = 10000, REPEATS = 300, MOTION = 400 }; /* bins of a nanosecond */
static long times[BINS], counts[model_max_iterations + 2];

typedef struct {
  long took;
  model_state x;
  model_real u[model_M + 1];
} try;
static try kept[KEPT]; /* the longest, in no order */
static int least;      /* the shortest of these */

static void keep(const try *one) {
  int i;
  if (one->took <= kept[least].took) return;
  kept[least] = *one;
  for (i = 0; i < KEPT; i++)
    if (kept[i].took < kept[least].took) least = i;
}

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

static long clock_takes;

/* The shortest of `tries` steps in ns; `one` receives it, `end` the state after the step. The status. */
static int timed(try *one, int tries, model_state *end) {
  int status = 0;
  one->took = BINS - 1;
  while (tries--) {
    long begin, took;
    *end = one->x;
    evaluations = 0;
    begin = clocked();
    status = model_step(end, model_h, model_WITH_U(one->u) 0);
    took = clocked() - begin - clock_takes;
    if (took < one->took) one->took = took < 0 ? 0 : took;
  }
  return status & 15;
}

/* `found` receives the median, the 99.99 % quantile and the longest time in ns, the same of evaluations, and how many
   steps failed. */
void measure(long steps, int along, uint64_t seed, long found[7]) {
  long k;
  int i;
  try one = {0, {{0}, {0}, 0, 0}, {0}};
  model_state end;
  found[6] = 0;
  clock_takes = 1000000;
  for (k = 0; k < BINS; k++) times[k] = 0;
  for (i = 0; i < model_max_iterations + 2; i++) counts[i] = 0;
  for (k = 0; k < 1000; k++) {
    const long begin = clocked(), took = clocked() - begin;
    if (took < clock_takes) clock_takes = took;
  }
  for (k = 0; k < steps; k++) {
    for (i = 0; i < model_M; i++) one.u[i] = (model_real)uniform(&seed, -1.0, 1.0);
    if (!along || k % MOTION == 0) {
      for (i = 0; i < model_N; i++) {
        one.x.q[i] = (model_real)uniform(&seed, model_q_low[i], model_q_high[i]);
        one.x.p[i] = (model_real)uniform(&seed, model_p_low[i], model_p_high[i]);
      }
      one.x.s = (model_real)uniform(&seed, model_s_low, model_s_high);
      one.x.sigma = (model_real)1.0;
    }
    found[6] += timed(&one, TRIES, &end) != 0;
    times[one.took]++;
    counts[evaluations]++;
    keep(&one);
    one.x = end;
  }
  for (i = 0; i < KEPT && i < steps; i++) {
    times[kept[i].took]--;
    timed(&kept[i], REPEATS, &end);
    times[kept[i].took]++;
  }
  found[0] = quantile(times, BINS, 0.5, steps);
  found[1] = quantile(times, BINS, 0.9999, steps);
  found[2] = quantile(times, BINS, 1.0, steps);
  found[3] = quantile(counts, model_max_iterations + 2, 0.5, steps);
  found[4] = quantile(counts, model_max_iterations + 2, 0.9999, steps);
  found[5] = quantile(counts, model_max_iterations + 2, 1.0, steps);
}
