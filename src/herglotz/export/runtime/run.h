/* The loop over steps of FN_WIDTH samples at once. */

/* Step samples b .. b + count of a batch, count <= FN_WIDTH, to the end of the job; `states` has these samples only. A
   sample whose status is not 0 on entry is not stepped. `flags` receive hz_OUTSIDE_BOX where a sample has been outside
   the box; with null neither the box nor the inputs are checked. */
static inline void FN_run(hz_state *states, long b, int count, const hz_job *job, int status[FN_WIDTH], int *flags) {
  const long entries = 1 + job->steps / job->every;
  const int kept = job->q || job->p || job->s || job->sigma;
  FN_state x;
  FN_track track;
  hz_real h[FN_WIDTH], left[FN_WIDTH];
#if hz_INPUTS
  const hz_real *u[FN_WIDTH];
#endif
  long k, entry = 0, wait = 1;
  int before[FN_WIDTH], i, w;
  for (w = 0; w < FN_WIDTH; w++) { /* the last one is repeated */
    FN_set(&x, w, states + (w < count ? w : count - 1));
    if (w >= count) status[w] = status[count - 1];
  }
  FN_track_start(&x, hz_WITH_THETA(job->theta) &track);
  for (k = 0; k <= job->steps; k++) {
    for (w = 0; w < FN_WIDTH; w++) {
      const long sample = b + (w < count ? w : count - 1);
      before[w] = status[w];
      if (k > 0) h[w] = job->h[sample * job->h_sample + (k - 1) * job->h_step];
#if hz_INPUTS
      u[w] = job->u && k > 0 ? job->u + sample * job->u_sample + (k - 1) * job->u_step : 0;
      if (!status[w] && hz_BAD_U(u[w])) status[w] = hz_DIVERGED;
#endif
    }
    if (k > 0) FN_take(&x, &track, h, hz_WITH_U(u) status, left);
    wait--;
    if (flags) {
      int outside[FN_WIDTH] = {0};
      FN_mark_outside(&x, outside);
      for (w = 0; w < count; w++)
        if (!status[w]) flags[w] |= outside[w];
    }
    for (w = 0; w < count; w++) {
      const long at = (b + w) * entries + entry, step = (b + w) * job->steps + k - 1;
      const hz_state *now = (const hz_state *)&x; /* one sample is not copied */
      hz_state one;
      if (k > 0 && !before[w] && job->status) {
        job->status[step] = (unsigned char)status[w];
        job->residual[step] = left[w];
      }
      if (wait || !kept) continue;
      if (FN_WIDTH > 1 || status[w]) {
        now = &one;
        FN_get(&x, w, &one);
      }
      if (status[w]) hz_lose(&one);
      for (i = 0; job->q && i < hz_N; i++) job->q[at * hz_N + i] = now->q[i];
      for (i = 0; job->p && i < hz_N; i++) job->p[at * hz_N + i] = now->p[i];
      if (job->s) job->s[at] = now->s;
      if (job->sigma) job->sigma[at] = now->sigma;
    }
    if (!wait) {
      wait = job->every;
      entry++;
    }
  }
  for (w = 0; w < count; w++) FN_get(&x, w, states + w);
}
