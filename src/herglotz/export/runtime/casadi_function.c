
NAME_VISIBLE int NAME_FN(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem) {
  const hz_real h = NAME_entry(arg[NAME_IN - 1], 0), step = h / (hz_real)FN_STEPS(h);
  hz_state states[hz_SIDE];
  hz_real u[hz_SIDE * hz_M + 1];
  const hz_job job = {NAME_whole(FN_STEPS(h)), 1, &step, 0, 0, hz_WITH_U(u) hz_WITH_U(hz_M) hz_WITH_U(0) 0, 0, 0, 0, 0, 0};
  int b, k, i, some;
  (void)iw;
  (void)w;
  (void)mem;
  for (b = 0; b < FN_COUNT; b += some) {
    some = FN_COUNT - b < hz_SIDE ? FN_COUNT - b : hz_SIDE;
    for (k = 0; k < some; k++) NAME_read(arg, b + k, states + k, u + k * hz_M);
    if (hz_run_batch(some, states, &job, 0) & 15) return 1;
    for (k = 0; res[0] && k < some; k++) {
      casadi_real *x1 = res[0] + (b + k) * NAME_SIZE;
      for (i = 0; i < hz_N; i++) {
        x1[i] = states[k].q[i];
        x1[hz_N + i] = states[k].p[i];
      }
      x1[2 * hz_N] = states[k].s;
    }
  }
  return 0;
}

NAME_VISIBLE casadi_int NAME_FN_n_in(void) { return NAME_IN; }
NAME_VISIBLE casadi_int NAME_FN_n_out(void) { return 1; }

NAME_VISIBLE const char *NAME_FN_name_in(casadi_int i) {
  return i == 0 ? "x" : i == NAME_IN - 1 ? "h" : i == 1 ? "u" : 0;
}
NAME_VISIBLE const char *NAME_FN_name_out(casadi_int i) { return i == 0 ? "x1" : 0; }
NAME_VISIBLE casadi_real NAME_FN_default_in(casadi_int i) { return i == NAME_IN - 1 ? hz_h : 0.0; }

NAME_VISIBLE const casadi_int *NAME_FN_sparsity_out(casadi_int i) {
  static const casadi_int states[3] = {NAME_SIZE, FN_COUNT, 1};
  return i == 0 ? states : 0;
}
NAME_VISIBLE const casadi_int *NAME_FN_sparsity_in(casadi_int i) {
#if hz_INPUTS
  static const casadi_int inputs[3] = {hz_M, FN_COUNT, 1};
  if (i == 1) return inputs;
#endif
  return i == NAME_IN - 1 ? NAME_scalar : NAME_FN_sparsity_out(i);
}

NAME_VISIBLE int NAME_FN_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w) {
  if (sz_arg) *sz_arg = NAME_IN;
  if (sz_res) *sz_res = 1;
  if (sz_iw) *sz_iw = 0;
  if (sz_w) *sz_w = 0;
  return 0;
}

#if hz_DERIVATIVES
/* (x, u, h, x1) -> (d x1 / dx, d x1 / du, d x1 / dh) */
NAME_VISIBLE int jac_NAME_FN(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem) {
  const hz_real h = NAME_entry(arg[NAME_IN - 1], 0);
  const double steps = FN_STEPS(h);
  hz_state state;
  hz_real u[hz_M + 1], by_x[NAME_SIZE * NAME_SIZE], by_u[NAME_SIZE * (hz_M + 1)], by_h[NAME_SIZE];
  int k, i, j;
  (void)iw;
  (void)w;
  (void)mem;
  (void)by_u;
  for (k = 0; k < FN_COUNT; k++) {
    NAME_read(arg, k, &state, u);
    if (hz_hold_jacobian(&state, h / (hz_real)steps, hz_WITH_U(u) steps, by_x, hz_WITH_U(by_u) by_h)) return 1;
    for (i = 0; i < NAME_SIZE; i++) {
      for (j = 0; res[0] && j < NAME_SIZE; j++) res[0][(k * NAME_SIZE + j) * NAME_SIZE + i] = by_x[i * NAME_SIZE + j];
#if hz_INPUTS
      for (j = 0; res[1] && j < hz_M; j++) res[1][(k * hz_M + j) * NAME_SIZE + i] = by_u[i * hz_M + j];
#endif
      if (res[NAME_IN - 1]) res[NAME_IN - 1][k * NAME_SIZE + i] = by_h[i];
    }
  }
  return 0;
}

NAME_VISIBLE casadi_int jac_NAME_FN_n_in(void) { return NAME_IN + 1; }
NAME_VISIBLE casadi_int jac_NAME_FN_n_out(void) { return NAME_IN; }

NAME_VISIBLE const char *jac_NAME_FN_name_in(casadi_int i) { return i == NAME_IN ? "out_x1" : NAME_FN_name_in(i); }
NAME_VISIBLE const char *jac_NAME_FN_name_out(casadi_int i) {
  return i == 0 ? "jac_x1_x" : i == NAME_IN - 1 ? "jac_x1_h" : i == 1 ? "jac_x1_u" : 0;
}
NAME_VISIBLE casadi_real jac_NAME_FN_default_in(casadi_int i) { return NAME_FN_default_in(i); }

NAME_VISIBLE const casadi_int *jac_NAME_FN_sparsity_in(casadi_int i) {
  static const casadi_int unread[3 + FN_COUNT] = {NAME_SIZE, FN_COUNT}; /* no entries: x1, which the Jacobian does not read */
  return i == NAME_IN ? unread : NAME_FN_sparsity_in(i);
}
NAME_VISIBLE const casadi_int *jac_NAME_FN_sparsity_out(casadi_int i) {
  static const casadi_int by_h[3] = {NAME_SIZE * FN_COUNT, 1, 1};
  static casadi_int by_x[3 + NAME_SIZE * FN_COUNT * (1 + NAME_SIZE)];
#if hz_INPUTS
  static casadi_int by_u[3 + hz_M * FN_COUNT * (1 + NAME_SIZE)];
  if (i == 1) return NAME_diagonal(FN_COUNT, hz_M, by_u);
#endif
  return i == 0 ? NAME_diagonal(FN_COUNT, NAME_SIZE, by_x) : i == NAME_IN - 1 ? by_h : 0;
}

NAME_VISIBLE int jac_NAME_FN_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w) {
  NAME_FN_work(sz_arg, sz_res, sz_iw, sz_w);
  if (sz_arg) *sz_arg = NAME_IN + 1;
  if (sz_res) *sz_res = NAME_IN;
  return 0;
}
#endif
