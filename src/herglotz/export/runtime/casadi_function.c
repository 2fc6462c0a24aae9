
NAME_VISIBLE int NAME_FN(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem) {
  hz_state state;
  hz_real u[hz_M + 1], h;
  double steps;
  int i;
  (void)iw;
  (void)w;
  (void)mem;
  NAME_read(arg, &state, u, &h);
  steps = FN_STEPS(h);
  if (hz_hold(&state, h / (hz_real)steps, hz_WITH_U(u) steps)) return 1;
  for (i = 0; res[0] && i < hz_N; i++) {
    res[0][i] = state.q[i];
    res[0][hz_N + i] = state.p[i];
  }
  if (res[0]) res[0][2 * hz_N] = state.s;
  return 0;
}

NAME_VISIBLE casadi_int NAME_FN_n_in(void) { return NAME_IN; }
NAME_VISIBLE casadi_int NAME_FN_n_out(void) { return 1; }

NAME_VISIBLE const char *NAME_FN_name_in(casadi_int i) {
  return i == 0 ? "x" : i == NAME_IN - 1 ? "h" : i == 1 ? "u" : 0;
}
NAME_VISIBLE const char *NAME_FN_name_out(casadi_int i) { return i == 0 ? "x1" : 0; }
NAME_VISIBLE casadi_real NAME_FN_default_in(casadi_int i) { return i == NAME_IN - 1 ? hz_h : 0.0; }

NAME_VISIBLE const casadi_int *NAME_FN_sparsity_in(casadi_int i) {
#if hz_INPUTS
  if (i == 1) return NAME_input;
#endif
  return i == 0 ? NAME_vector : i == NAME_IN - 1 ? NAME_scalar : 0;
}
NAME_VISIBLE const casadi_int *NAME_FN_sparsity_out(casadi_int i) { return i == 0 ? NAME_vector : 0; }

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
  hz_state state;
  hz_real u[hz_M + 1], h, by_x[NAME_SIZE * NAME_SIZE], by_u[NAME_SIZE * (hz_M + 1)], by_h[NAME_SIZE];
  double steps;
  int i, j;
  (void)iw;
  (void)w;
  (void)mem;
  (void)by_u;
  NAME_read(arg, &state, u, &h);
  steps = FN_STEPS(h);
  if (hz_hold_jacobian(&state, h / (hz_real)steps, hz_WITH_U(u) steps, by_x, hz_WITH_U(by_u) by_h)) return 1;
  for (i = 0; i < NAME_SIZE; i++) {
    for (j = 0; res[0] && j < NAME_SIZE; j++) res[0][j * NAME_SIZE + i] = by_x[i * NAME_SIZE + j];
#if hz_INPUTS
    for (j = 0; res[1] && j < hz_M; j++) res[1][j * NAME_SIZE + i] = by_u[i * hz_M + j];
#endif
    if (res[NAME_IN - 1]) res[NAME_IN - 1][i] = by_h[i];
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
  return i == NAME_IN ? NAME_unread : NAME_FN_sparsity_in(i);
}
NAME_VISIBLE const casadi_int *jac_NAME_FN_sparsity_out(casadi_int i) {
#if hz_INPUTS
  if (i == 1) return NAME_by_u;
#endif
  return i == 0 ? NAME_by_x : i == NAME_IN - 1 ? NAME_vector : 0;
}

NAME_VISIBLE int jac_NAME_FN_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w) {
  NAME_FN_work(sz_arg, sz_res, sz_iw, sz_w);
  if (sz_arg) *sz_arg = NAME_IN + 1;
  if (sz_res) *sz_res = NAME_IN;
  return 0;
}
#endif
