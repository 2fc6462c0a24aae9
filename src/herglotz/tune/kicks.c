/* The loop over motions and steps around a header of kicks (`herglotz.tune.kick_composition`).

   states (batch, steps + 1): the start of each motion, then the state after every step; status (batch, steps). A motion
   ends before a step that is not finite. */
#include "stepper.h"

void herglotz_kicks_rollouts(long batch, long steps, herglotz_kicks_state *states, unsigned char *status) {
  long b, k;
  for (b = 0; b < batch; b++) {
    herglotz_kicks_state *now = states + b * (steps + 1), x = *now;
    for (k = 0; k < steps; k++) {
      herglotz_kicks_step(&x);
      if (!isfinite((x.q + x.p) + x.s)) break;
      *++now = x;
      status[b * steps + k] = 0;
    }
  }
}
