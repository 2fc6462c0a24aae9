/* Calls every function of the header arm.h with numbers of any kind, beside a second header, in two threads: exits with
   the line of the first claim that fails. Arrays are of the exact size and aligned to their numbers only, so that a
   sanitizer or valgrind sees a step beyond the end or a load that wants more. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "arm.h"
#include "leg.h"

#define CLAIM(what) \
  do { \
    if (!(what)) { \
      fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #what); \
      exit(1); \
    } \
  } while (0)

#if arm_SINGLE
#define HUGE_ONE 1e38f
#define SMALL_ONE 1e-42f
#else
#define HUGE_ONE 1e300
#define SMALL_ONE 1e-310
#endif
enum { FILL = 0x5a, SIZE = 2 * arm_N + 1, KINDS = 9 };

typedef struct {
  unsigned long long bits;
  long calls, good;
} dice;

static unsigned below(dice *d, unsigned n) { /* xorshift */
  d->bits ^= d->bits << 13;
  d->bits ^= d->bits >> 7;
  d->bits ^= d->bits << 17;
  return (unsigned)(d->bits >> 33) % n;
}

/* An ordinary number, mostly; else one that is not finite, huge, denormal or zero. */
static arm_real any(dice *d, unsigned rarity) {
  const arm_real zero = 0, odd[KINDS] = {arm_nan(), HUGE_ONE * HUGE_ONE, -HUGE_ONE * HUGE_ONE, HUGE_ONE, -HUGE_ONE,
                                         SMALL_ONE, -SMALL_ONE, zero, -zero};
  return below(d, rarity) ? (arm_real)((int)below(d, 4001) - 2000) / 1000 : odd[below(d, KINDS)];
}

/* An array of `count` numbers, filled with a pattern that is recognised, at an address that no register divides. */
static arm_real *fresh(size_t count) {
  arm_real *x = (arm_real *)malloc((count + 1) * sizeof(arm_real));
  CLAIM(x);
  memset(x, FILL, (count + 1) * sizeof(arm_real));
  return x + 1;
}

static void done(arm_real *x) {
  if (x) free(x - 1);
}

static int untouched(const arm_real *x, size_t count) {
  const unsigned char *byte = (const unsigned char *)x;
  size_t i;
  for (i = 0; i < count * sizeof(arm_real); i++)
    if (byte[i] != FILL) return 0;
  return 1;
}

static int finite_all(const arm_real *x, size_t count) {
  size_t i;
  for (i = 0; i < count; i++)
    if (!arm_finite(x[i])) return 0;
  return 1;
}

static int lost_all(const arm_real *x, size_t count) {
  size_t i;
  for (i = 0; i < count; i++)
    if (arm_finite(x[i])) return 0;
  return 1;
}

static int finite_state(const arm_state *x) {
  return finite_all(x->q, arm_N) && finite_all(x->p, arm_N) && arm_finite(x->s) && arm_finite(x->sigma);
}

static arm_state state_of(dice *d, unsigned rarity) {
  arm_state x;
  int i;
  for (i = 0; i < arm_N; i++) {
    x.q[i] = any(d, rarity);
    x.p[i] = any(d, rarity);
  }
  x.s = any(d, rarity);
  x.sigma = below(d, rarity) ? 1 : any(d, 2);
  return x;
}

static arm_real step_of(dice *d) { return below(d, 4) ? (arm_real)(1 + (int)below(d, 200)) / 1000 : any(d, 2); }

#if arm_INPUTS
static arm_real *inputs_of(dice *d, long steps, unsigned rarity) {
  arm_real *u;
  long i;
  if (!below(d, 3) || steps < 0) return 0;
  u = fresh((size_t)(steps * arm_M));
  for (i = 0; i < steps * arm_M; i++) u[i] = any(d, rarity);
  return u;
}
#endif

/* A start: written where the status is 0, and finite then. */
static void start(dice *d) {
  const arm_state from = state_of(d, 9), to = state_of(d, 9);
  arm_state *out = (arm_state *)(void *)fresh(sizeof(arm_state) / sizeof(arm_real));
#if arm_INPUTS
  arm_real *u = inputs_of(d, 1, 9);
#endif
  const int status = 15 & arm_init(from.q, to.q, from.s, step_of(d), arm_WITH_U(u) out);
  CLAIM(status ? untouched(out->q, SIZE + 1) : finite_state(out));
  d->calls++;
  d->good += !status;
  done(out->q);
#if arm_INPUTS
  done(u);
#endif
}

/* A step with and without its derivatives: the same state, finite; without success nothing is written. */
static void step(dice *d) {
  const arm_state before = state_of(d, 20);
  arm_state x = before;
  arm_real left, h = step_of(d);
  int status;
#if arm_INPUTS
  arm_real *u = inputs_of(d, 1, 9);
#endif
  status = 15 & arm_step(&x, h, arm_WITH_U(u) &left);
  CLAIM(status ? !memcmp(&x, &before, sizeof x) : finite_state(&x) && arm_finite(left));
#if arm_DERIVATIVES
  {
    arm_state y = before;
    arm_real *by_state = below(d, 4) ? fresh(SIZE * SIZE) : 0, *by_h = below(d, 4) ? fresh(SIZE) : 0;
#if arm_INPUTS
    arm_real *by_input = below(d, 4) ? fresh(SIZE * arm_M) : 0;
#endif
    const int same = 15 & arm_step_jacobian(&y, h, arm_WITH_U(u) 0, by_state, arm_WITH_U(by_input) by_h);
    CLAIM(same || (!status && !memcmp(&x, &y, sizeof x)));
    CLAIM(!same || !memcmp(&y, &before, sizeof y));
    CLAIM(!by_state || (same ? untouched(by_state, SIZE * SIZE) : finite_all(by_state, SIZE * SIZE)));
    CLAIM(!by_h || (same ? untouched(by_h, SIZE) : finite_all(by_h, SIZE)));
#if arm_INPUTS
    CLAIM(!by_input || (same ? untouched(by_input, SIZE * arm_M) : finite_all(by_input, SIZE * arm_M)));
    done(by_input);
#endif
    done(by_state);
    done(by_h);
  }
#endif
  d->calls++;
  d->good += !status;
#if arm_INPUTS
  done(u);
#endif
}

/* A batch of rollouts, of any length, none too: up to a failure finite, NaN from there, and the last good state left. */
static void rollouts(dice *d) {
  const long count = (long)below(d, 2 * arm_SIDE + 2), steps = (long)below(d, 8) - 1, every = (long)below(d, 4);
  const int possible = steps >= 0 && every > 0;
  const size_t entries = possible ? (size_t)(1 + steps / every) : 0, all = (size_t)count * entries;
  arm_state *x = (arm_state *)(void *)fresh((size_t)count * (SIZE + 1)), *before;
  arm_real *q = below(d, 4) ? fresh(all * arm_N) : 0, *p = below(d, 4) ? fresh(all * arm_N) : 0;
  arm_real *s = below(d, 4) ? fresh(all) : 0, h = below(d, 9) ? (arm_real)0.1 : step_of(d);
  int *statuses = (int *)malloc((size_t)(count + !count) * sizeof(int));
  size_t k;
  long b;
#if arm_INPUTS
  arm_real *u = inputs_of(d, steps < 0 ? steps : count * steps, 99);
#endif
  before = (arm_state *)(void *)fresh((size_t)count * (SIZE + 1));
  for (b = 0; b < count; b++) x[b] = before[b] = state_of(d, 60);
  arm_rollout_batch(count, x, h, arm_WITH_U(u) steps, every, q, p, s, statuses);
  for (b = 0; b < count; b++) {
    const int status = statuses[b] & 15;
    int over = 0;
    d->calls++;
    d->good += !status;
    CLAIM(possible || status == arm_BAD_INPUT);
    CLAIM(!status ? finite_state(x + b) : finite_state(x + b) || !memcmp(x + b, before + b, sizeof *x));
    for (k = 0; k < entries; k++) {
      const size_t at = (size_t)b * entries + k;
      const int here = !s || arm_finite(s[at]);
      over |= s && !here;
      CLAIM(status || here);
      CLAIM(!s || !q || (over ? lost_all(q + at * arm_N, arm_N) : finite_all(q + at * arm_N, arm_N)));
      CLAIM(!s || !p || (over ? lost_all(p + at * arm_N, arm_N) : finite_all(p + at * arm_N, arm_N)));
      CLAIM(!over || !here);
    }
  }
  done(q);
  done(p);
  done(s);
  done(x->q);
  done(before->q);
  free(statuses);
#if arm_INPUTS
  done(u);
#endif
}

static long trials;

static void *fuzz(void *given) {
  dice *d = (dice *)given;
  long k;
  for (k = 0; k < trials; k++) {
    start(d);
    step(d);
    rollouts(d);
  }
  return 0;
}

int main(int count, char **words) {
  dice d[2] = {{0x9e3779b97f4a7c15ull, 0, 0}, {0xbf58476d1ce4e5b9ull, 0, 0}};
  leg_state other = {{0.3f, 0.2f}, {0.1f, 0.0f}, 0.0f, 1.0f};
  pthread_t thread[2];
  int i;
  trials = count > 1 ? atol(words[1]) : 100;
  for (i = 0; i < 2; i++) CLAIM(!pthread_create(&thread[i], 0, fuzz, &d[i]));
  CLAIM(!(15 & leg_rollout(&other, 0.1f, 10, 10, 0, 0, 0)));
  for (i = 0; i < 2; i++) CLAIM(!pthread_join(thread[i], 0));
  printf("%ld %ld\n", d[0].calls + d[1].calls, d[0].good + d[1].good);
  return 0;
}
