/* Loops over samples around the header, for `herglotz.export.load`: not part of what is exported. States are rows
   (q, p, s, sigma); h and u are one a sample. */

#include "stepper.h"

/* Rollouts of `batch` samples; outputs are (batch, steps + 1, ...), statuses and residuals (batch, steps). The statuses
   arrive full of hz_DIVERGED: nothing is written after a failure but its own status. */
void herglotz_rollouts(long batch, long steps, const hz_state *states, const hz_real *h, long h_sample, long h_step,
    const hz_real *u, long u_sample, hz_TAKES_THETA hz_real *q_out, hz_real *p_out, hz_real *s_out, hz_real *sigma_out,
    unsigned char *status_out, hz_real *residual_out) {
  const hz_job job = {steps, 1, h, h_sample, h_step, hz_WITH_U(u) hz_WITH_U(u_sample) hz_WITH_U(hz_M)
                      hz_WITH_THETA(theta) q_out, p_out, s_out, sigma_out, residual_out, status_out};
  hz_state x[hz_SIDE];
  int status[hz_SIDE], w;
  long b;
  (void)u;
  (void)u_sample;
  for (b = 0; b < batch;) {
    for (w = 0; w < hz_SIDE && b + w < batch; w++) {
      x[w] = states[b + w];
      status[w] = hz_CONVERGED;
    }
    b += hz_run_some(x, b, batch, &job, status, 0);
  }
}

#if hz_DERIVATIVES
/* Steps of states, written over, with their derivatives, which arrive full of NaN; a state without a step is lost. */
void herglotz_jacobians(long batch, const hz_real *h, const hz_real *u, hz_TAKES_THETA hz_state *states,
    unsigned char *statuses, hz_real *residuals, hz_real *by_state, hz_real *by_input,
    hz_WITH_THETA(hz_real *by_theta) hz_real *by_h) {
  const long size = 2 * hz_N + 1;
  long b;
  (void)u;
  (void)by_input;
  for (b = 0; b < batch; b++) {
    statuses[b] = 15 & hz_step_jacobian(states + b, h[b], hz_WITH_U(u ? u + b * hz_M : 0) hz_WITH_THETA(theta)
        residuals + b, by_state + b * size * size, hz_WITH_U(by_input + b * size * hz_M)
        hz_WITH_THETA(by_theta + b * size * hz_P) by_h + b * size);
    if (statuses[b]) hz_lose(states + b);
  }
}
#endif

/* States from two positions, which arrive in the places of q and p; lost where there is none. */
void herglotz_inits(long batch, const hz_real *h, const hz_real *u, hz_TAKES_THETA hz_state *states) {
  long b;
  (void)u;
  for (b = 0; b < batch; b++) {
    const hz_state x = states[b];
    if (15 & hz_init(x.q, x.p, x.s, h[b], hz_WITH_U(u ? u + b * hz_M : 0) hz_WITH_THETA(theta) states + b))
      hz_lose(states + b);
  }
}

#ifdef hz_VELOCITIES
/* States of positions and velocities, which arrive in the place of p; lost where there is none. */
void herglotz_momenta(long batch, const hz_real *h, hz_TAKES_THETA hz_state *states) {
  long b;
  for (b = 0; b < batch; b++) {
    const hz_state x = states[b];
    if (15 & hz_init_qv(x.q, x.p, x.s, h[b], hz_WITH_THETA(theta) states + b)) hz_lose(states + b);
  }
}

/* Velocities of states. */
void herglotz_velocities(long batch, const hz_real *h, hz_TAKES_THETA const hz_state *states, hz_real *v_out,
    unsigned char *statuses) {
  long b;
  for (b = 0; b < batch; b++)
    statuses[b] = 15 & hz_velocity(states + b, h[b], hz_WITH_THETA(theta) v_out + b * hz_N);
}

/* `steps` equal steps of states that stay where they lie, each under one input, and then what is observed of each:
   positions and velocities, (batch, 2 hz_N). An angle is taken within half a turn of the middle of low .. high, and
   positions beyond low .. high are put on its end. A state whose step failed is the last good one, and where a state has
   no velocity the observed one stays as it was. `statuses` are those of the steps, without hz_OUTSIDE_H. */
void herglotz_holds(long batch, long steps, hz_state *states, const hz_real *h, const hz_real *u,
    hz_TAKES_THETA const hz_real *low, const hz_real *high, hz_real *observed, int *statuses) {
  const hz_job job = {steps, 1, h, 0, 0, hz_WITH_U(u) hz_WITH_U(hz_M) hz_WITH_U(0)
                      hz_WITH_THETA(theta) 0, 0, 0, 0, 0, 0};
  hz_real v[hz_SIDE][hz_N];
  int status[hz_SIDE], i, w, some;
  long b;
  (void)u;
  for (b = 0; b < batch; b++) states[b].sigma = (hz_real)1.0; /* nobody asks for the product of the factors */
  hz_run_batch(batch, states, &job, statuses);
  for (b = 0; b < batch; b += some) {
    some = hz_velocity_some(states + b, batch - b, *h, hz_WITH_THETA(theta) v, status);
    for (w = 0; w < some; w++, observed += 2 * hz_N) {
      if (!(statuses[b + w] & 15)) statuses[b + w] |= status[w];
      statuses[b + w] &= 15 | hz_OUTSIDE_BOX;
      for (i = 0; i < hz_N; i++) {
        const hz_real turn = (hz_real)6.28318530717958647693, middle = (low[i] + high[i]) / (hz_real)2.0;
        hz_real q = states[b + w].q[i];
        if (hz_is_angle[i]) q -= turn * hz_floor_of((q - middle) * (hz_real)0.15915494309189533577 + (hz_real)0.5);
        observed[i] = q < low[i] ? low[i] : q > high[i] ? high[i] : q;
        if (!status[w]) observed[hz_N + i] = v[w][i];
      }
    }
  }
}
#endif
