/* ns of processor time of a step of a run, of a single step and of a step with its Jacobian: `benchmarks/control.py`. */

#include MODEL
#include <time.h>

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

/* The three over `count` steps from the start, with q[0] moved by 0.5; they make the same motion. */
void measure(long count, double h, double ns[3]) {
  enum { SIZE = 2 * model_N + 1 };
  double A[SIZE * SIZE], by_h[SIZE], left, began;
  model_state x[3];
  model_track track;
  int i;
  long k;
  for (i = 0; i < 3; i++) {
    x[i] = model_start;
    x[i].q[0] += 0.5;
  }
  model_track_start(&x[0], &track);
  began = now();
  for (k = 0; k < count; k++) model_advance(&x[0], &track, h, &left);
  ns[0] = (now() - began) / (double)count;
  began = now();
  for (k = 0; k < count; k++) model_step(&x[1], h, &left);
  ns[1] = (now() - began) / (double)count;
  began = now();
  for (k = 0; k < count; k++) model_step_jacobian(&x[2], h, &left, A, by_h);
  ns[2] = (now() - began) / (double)count;
}
