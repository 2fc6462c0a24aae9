/* Checks of states, steps and inputs; the description of a run. */

/* The status of a state before a step h: hz_BAD_INPUT unless h is finite and > 0, hz_DIVERGED where the state is not
   finite. */
static inline int hz_before(const hz_state *state, hz_real h) {
  if (!(hz_finite(h) && h > hz_R(0.0))) return hz_BAD_INPUT;
  return hz_all_finite(state->q) && hz_all_finite(state->p) && hz_finite(state->s) && hz_finite(state->sigma)
      ? hz_CONVERGED : hz_DIVERGED;
}

/* Mark a state as lost: all its numbers become NaN. */
static inline void hz_lose(hz_state *state) {
  int i;
  for (i = 0; i < hz_N; i++) state->q[i] = state->p[i] = hz_nan();
  state->s = state->sigma = hz_nan();
}

#if hz_INPUTS
#define hz_TAKES_U const hz_real *u,
#define hz_WITH_U(argument) argument,

/* Number i of what a step takes of inputs u: these, then 1 where the inputs have a zero; nothing but 0 where u is null. */
static inline hz_real hz_taken(const hz_real *u, int i) { return !u ? hz_R(0.0) : i < hz_M ? u[i] : hz_R(1.0); }

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

/* The number of samples of a batch that are stepped at once. */
#if hz_WIDE && defined(hz_LANE_BYTES)
#define hz_BATCHED /* registers of samples */
enum { hz_SIDE = hz_LANES };
#else
enum { hz_SIDE = 1 };
#endif

/* One step of a single state, without the checks of hz_step. */
static inline int hz_alone(hz_state *state, hz_real h, hz_TAKES_U hz_TAKES_THETA hz_real *residual);

/* A run of steps: h of sample b and step k is h[b * h_sample + k * h_step], and u likewise. q, p, s and sigma are stored
   after each `every` steps, status and residual after each step; any of these may be null. */
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
#endif
  hz_real *q, *p, *s, *sigma, *residual;
  unsigned char *status;
} hz_job;
