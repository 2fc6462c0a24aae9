/* A header of `herglotz export` on a microcontroller: 1000 steps, every 100th state, and what a step costs. */

#include "board.h"
#include "stepper.h"

#if stepper_INPUTS
#define NO_INPUTS 0, /* or the address of stepper_M numbers */
#else
#define NO_INPUTS
#endif

enum { STEPS = 1000, EVERY = 100 };

static stepper_state x; /* all that has to be kept between steps */

static void put_whole(unsigned value, int digits) {
  char text[12] = {0};
  int i = 11;
  for (; value || digits > 0; value /= 10, digits--) text[--i] = (char)('0' + value % 10);
  put(text + i);
}

/* Six decimals. */
static void put_number(float value) {
  const float size = value < 0.0f ? -value : value;
  const unsigned whole = (unsigned)size, rest = (unsigned)((size - (float)whole) * 1e6f);
  put(value < 0.0f ? " -" : " ");
  put_whole(whole, 1);
  put(".");
  put_whole(rest, 6);
}

static void put_state(int step) {
  int i;
  put_whole((unsigned)step, 1);
  for (i = 0; i < stepper_N; i++) put_number((float)x.q[i]);
  for (i = 0; i < stepper_N; i++) put_number((float)x.p[i]);
  put_number((float)x.s);
  put("\n");
}

static void put_count(const char *name, unsigned value) {
  put(name);
  put_whole(value, 1);
  put("\n");
}

int main(void) {
  unsigned sum = 0, most = 0;
  int i, step, status = 0;
  x = stepper_start;
#if stepper_BOXED /* a motion of some size: three quarters up the box of the fitted data */
  for (i = 0; i < stepper_N; i++) x.q[i] = 0.25f * stepper_q_low[i] + 0.75f * stepper_q_high[i];
#endif
  put_state(0);
  for (step = 1; step <= STEPS && !(status & 15); step++) {
    const unsigned begin = ticks();
    unsigned took;
    status = stepper_step(&x, stepper_h, NO_INPUTS 0);
    took = (begin - ticks()) & 0xffffffu;
    sum += took;
    if (took > most) most = took;
    if (step % EVERY == 0) put_state(step);
  }
  put_count("mean ", COST(sum / STEPS));
  put_count("most ", COST(most));
  put_count("stack ", stack_used());
  put_count("status ", (unsigned)status & 15u);
  return status & 15;
}
