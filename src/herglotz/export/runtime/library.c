/* Loops over samples around the header, for `herglotz.export.load`: not part of what is exported. */

#include "stepper.h"

static void load(const hz_real *q, const hz_real *p, const hz_real *s, long b, hz_state *x) {
  int i;
  for (i = 0; i < hz_N; i++) {
    x->q[i] = q[b * hz_N + i];
    x->p[i] = p[b * hz_N + i];
  }
  x->s = s[b];
  x->sigma = (hz_real)1.0;
}

static void store(const hz_state *x, long at, hz_real *q_out, hz_real *p_out, hz_real *s_out, hz_real *sigma_out) {
  int i;
  for (i = 0; i < hz_N; i++) {
    q_out[at * hz_N + i] = x->q[i];
    p_out[at * hz_N + i] = x->p[i];
  }
  s_out[at] = x->s;
  sigma_out[at] = x->sigma;
}

/* Rollouts of `batch` samples; outputs are (batch, steps + 1, ...), statuses and residuals (batch, steps). The statuses
   arrive full of hz_DIVERGED: nothing is written after a failure but its own status. */
void herglotz_rollouts(long batch, long steps, const hz_real *q, const hz_real *p, const hz_real *s, const hz_real *h,
    long h_sample, long h_step, const hz_real *u, long u_sample, hz_TAKES_THETA hz_real *q_out, hz_real *p_out, hz_real *s_out,
    hz_real *sigma_out, unsigned char *status_out, hz_real *residual_out) {
  const hz_job job = {steps, 1, h, h_sample, h_step, hz_WITH_U(u) hz_WITH_U(u_sample) hz_WITH_U(hz_M)
                      hz_WITH_THETA(theta) q_out, p_out, s_out, sigma_out, residual_out, status_out};
  hz_state x[hz_SIDE];
  int status[hz_SIDE], w;
  long b;
  (void)u;
  (void)u_sample;
  for (b = 0; b < batch;) {
    for (w = 0; w < hz_SIDE && b + w < batch; w++) {
      load(q, p, s, b + w, x + w);
      status[w] = hz_CONVERGED;
    }
    b += hz_run_some(x, b, batch, &job, status, 0);
  }
}

#if hz_DERIVATIVES
/* Steps of `batch` samples with their derivatives; h and u are one a sample. Outputs arrive full of NaN. */
void herglotz_jacobians(long batch, const hz_real *q, const hz_real *p, const hz_real *s, const hz_real *h,
    const hz_real *u, hz_TAKES_THETA hz_real *q_out, hz_real *p_out, hz_real *s_out, hz_real *sigma_out, unsigned char *status_out,
    hz_real *residual_out, hz_real *by_state, hz_real *by_input, hz_WITH_THETA(hz_real *by_theta) hz_real *by_h) {
  const long size = 2 * hz_N + 1;
  long b;
  (void)u;
  (void)by_input;
  for (b = 0; b < batch; b++) {
    hz_state x;
    int status;
    load(q, p, s, b, &x);
    status = hz_step_jacobian(&x, h[b], hz_WITH_U(u ? u + b * hz_M : 0) hz_WITH_THETA(theta) residual_out + b, by_state + b * size * size,
        hz_WITH_U(by_input + b * size * hz_M) hz_WITH_THETA(by_theta + b * size * hz_P) by_h + b * size);
    status_out[b] = (unsigned char)(status & 15);
    if (!(status & 15)) store(&x, b, q_out, p_out, s_out, sigma_out);
  }
}
#endif

/* States from two positions; h and u are one a sample. */
void herglotz_inits(long batch, const hz_real *q0, const hz_real *q1, const hz_real *s0, const hz_real *h,
    const hz_real *u, hz_TAKES_THETA hz_real *p_out, hz_real *s_out, unsigned char *status_out) {
  long b;
  int i;
  (void)u;
  for (b = 0; b < batch; b++) {
    hz_state x;
    const int status =
        15 & hz_init(q0 + b * hz_N, q1 + b * hz_N, s0[b], h[b], hz_WITH_U(u ? u + b * hz_M : 0) hz_WITH_THETA(theta) &x);
    status_out[b] = (unsigned char)status;
    if (status) continue;
    for (i = 0; i < hz_N; i++) p_out[b * hz_N + i] = x.p[i];
    s_out[b] = x.s;
  }
}

#ifdef hz_VELOCITIES
/* Momenta of positions and velocities; h is one a sample. */
void herglotz_momenta(long batch, const hz_real *q, const hz_real *v, const hz_real *s, const hz_real *h,
    hz_TAKES_THETA hz_real *p_out, unsigned char *status_out) {
  long b;
  int i;
  for (b = 0; b < batch; b++) {
    hz_state x;
    const int status = 15 & hz_init_qv(q + b * hz_N, v + b * hz_N, s[b], h[b], hz_WITH_THETA(theta) &x);
    status_out[b] = (unsigned char)status;
    for (i = 0; !status && i < hz_N; i++) p_out[b * hz_N + i] = x.p[i];
  }
}

/* Velocities of positions and momenta; h is one a sample. */
void herglotz_velocities(long batch, const hz_real *q, const hz_real *p, const hz_real *s, const hz_real *h,
    hz_TAKES_THETA hz_real *v_out, unsigned char *status_out) {
  long b;
  for (b = 0; b < batch; b++) {
    hz_state x;
    load(q, p, s, b, &x);
    status_out[b] = (unsigned char)(15 & hz_velocity(&x, h[b], hz_WITH_THETA(theta) v_out + b * hz_N));
  }
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
