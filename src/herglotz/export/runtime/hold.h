
/* The number of equal steps in a time H under a held input: the fewest that are no longer than `longest`. */
static inline double hz_steps_of(double H, double longest) {
  const double slack = 1e-6; /* recorded times carry rounding */
  const double steps = ceil(H / longest * (1.0 - slack));
  return steps > 1.0 ? steps : 1.0;
}

#if hz_DERIVATIVES
/* `steps` equal steps h under u, with their derivatives: rows are (q, p, s) after the last step, columns (q, p, s)
   before the first one (by_state), the input (by_input, where the model takes some) and the whole time (by_time). A step
   maps a derivative d of the state before it to A d, plus its own derivative by what acts in every step. The state
   changes on success only. Returns a status without flags. */
static inline int hz_hold_jacobian(hz_state *state, hz_real h, hz_TAKES_U double steps, hz_real *by_state,
    hz_WITH_U(hz_real *by_input) hz_real *by_time) {
  enum { SIZE = 2 * hz_N + 1, WIDTH = SIZE + hz_M + 1 };
  hz_state x = *state, before;
  hz_track track;
  hz_real left, A[SIZE * SIZE], B[SIZE * (hz_M + 1)], by_h[SIZE], map[SIZE * WIDTH], old[SIZE * WIDTH];
  double k;
  int i, j, l, status = hz_before(&x, h);
  if (!status && hz_BAD_U(u)) status = hz_DIVERGED;
  if (!status) hz_track_start(&x, &track);
  for (i = 0; i < SIZE; i++)
    for (j = 0; j < WIDTH; j++) map[i * WIDTH + j] = i == j ? hz_R(1.0) : hz_R(0.0);
  (void)B;
  for (k = 0.0; !status && k < steps; k += 1.0) {
    before = x;
    status = hz_advance(&x, &track, h, hz_WITH_U(u) &left);
    if (!status) status = hz_step_slopes(&before, &x, h, hz_WITH_U(u) A, hz_WITH_U(B) by_h);
    if (status) break;
    for (i = 0; i < SIZE * WIDTH; i++) old[i] = map[i];
    for (i = 0; i < SIZE; i++) {
      for (j = 0; j < SIZE; j++) map[i * WIDTH + j] = hz_R(0.0);
#if hz_INPUTS
      for (j = 0; j < hz_M; j++) map[i * WIDTH + SIZE + j] = B[i * hz_M + j];
#endif
      map[i * WIDTH + WIDTH - 1] = by_h[i];
      for (l = 0; l < SIZE; l++)
        for (j = 0; j < WIDTH; j++) map[i * WIDTH + j] += A[i * SIZE + l] * old[l * WIDTH + j];
    }
  }
  if (status) return status;
  *state = x;
  for (i = 0; i < SIZE; i++) {
    for (j = 0; by_state && j < SIZE; j++) by_state[i * SIZE + j] = map[i * WIDTH + j];
#if hz_INPUTS
    for (j = 0; by_input && j < hz_M; j++) by_input[i * hz_M + j] = map[i * WIDTH + SIZE + j];
#endif
    if (by_time) by_time[i] = map[i * WIDTH + WIDTH - 1] / (hz_real)steps;
  }
  return 0;
}
#endif
