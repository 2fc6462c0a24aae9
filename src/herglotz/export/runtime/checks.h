/* What is checked of states, steps and inputs, and the forces of inputs. */

/* hz_OUTSIDE_BOX where a state lies outside the box the model was fitted in, or 0. Angles count modulo a turn, and s only
   where the motion depends on it: it grows without bound. */
static inline int hz_outside_box(const hz_state *state) {
#if hz_BOXED
  int i;
  for (i = 0; i < hz_N; i++) {
    hz_real q = state->q[i];
    if (hz_is_angle[i]) {
      const hz_real turn = hz_R(6.28318530717958647693), middle = (hz_q_low[i] + hz_q_high[i]) / hz_R(2.0);
      q -= turn * hz_floor_of((q - middle) * hz_R(0.15915494309189533577) + hz_R(0.5));
    }
    if (!(q >= hz_q_low[i] && q <= hz_q_high[i])) return hz_OUTSIDE_BOX;
    if (!(state->p[i] >= hz_p_low[i] && state->p[i] <= hz_p_high[i])) return hz_OUTSIDE_BOX;
  }
  return !hz_CARRIES_S || (state->s >= hz_s_low && state->s <= hz_s_high) ? 0 : hz_OUTSIDE_BOX;
#else
  (void)state;
  return 0;
#endif
}

/* The status of a state before a step h: hz_BAD_INPUT where h is no step, hz_DIVERGED where the state is not finite. */
static inline int hz_before(const hz_state *state, hz_real h) {
  if (!(hz_finite(h) && h > hz_R(0.0))) return hz_BAD_INPUT;
  return hz_all_finite(state->q) && hz_all_finite(state->p) && hz_finite(state->s) && hz_finite(state->sigma)
      ? hz_CONVERGED : hz_DIVERGED;
}

/* A state that there is none of. */
static inline void hz_lose(hz_state *state) {
  int i;
  for (i = 0; i < hz_N; i++) state->q[i] = state->p[i] = hz_nan();
  state->s = state->sigma = hz_nan();
}

#if hz_INPUTS
#define hz_TAKES_U const hz_real *u,
#define hz_WITH_U(argument) argument,

/* What inputs are to the step: forces G (u - u0), or themselves where L_d takes them; 0 where u is null. */
static inline void hz_push(const hz_real *u, hz_TAKES_THETA hz_real push[hz_INPUTS]) {
  int i, j;
#if hz_P
  hz_real hz_input_map[hz_INPUTS * hz_M], hz_input_offset[hz_INPUTS];
  hz_inputs_at(theta->value, hz_input_map, hz_input_offset);
#endif /* hz_P */
  for (i = 0; i < hz_INPUTS; i++) {
    push[i] = u ? hz_input_offset[i] : hz_R(0.0);
    for (j = 0; u && j < hz_M; j++) push[i] += hz_input_map[i * hz_M + j] * u[j];
  }
}

static inline int hz_inputs_finite(const hz_real *u) {
  int j, good = 1;
  for (j = 0; j < hz_M; j++) good &= hz_finite(u[j]);
  return good;
}
#define hz_BAD_U(u) ((u) && !hz_inputs_finite(u))
#else
#define hz_TAKES_U
#define hz_WITH_U(argument)
#define hz_BAD_U(u) 0
#endif

static inline int hz_outside_h(hz_real h) { return h >= hz_h_low && h <= hz_h_high ? 0 : hz_OUTSIDE_H; }

/* How many samples of a batch go side by side. */
#if hz_WIDE && defined(hz_LANE_BYTES)
#define hz_BATCHED /* registers of samples */
enum { hz_SIDE = hz_LANES };
#else
enum { hz_SIDE = 1 };
#endif

/* One step of a state by itself, with its checks done. */
static inline int hz_alone(hz_state *state, hz_real h, hz_TAKES_U hz_TAKES_THETA hz_real *residual);

/* A run of steps: h of sample b and step k is h[b * h_sample + k * h_step], and u likewise. What is stored after every
   so many steps, and status and residual after each; any may be null. */
typedef struct {
  long steps, every;
  const hz_real *h;
  long h_sample, h_step;
#if hz_INPUTS
  const hz_real *u; /* null: none act */
  long u_sample, u_step;
#endif
#if hz_P
  const hz_parameters *theta;
#endif /* hz_P */
  hz_real *q, *p, *s, *sigma, *residual;
  unsigned char *status;
} hz_job;
