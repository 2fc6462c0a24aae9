/* What a file for acados' discrete dynamics calls of BLASFEO, with matrices column by column. */

#ifndef STAND_IN_BLASFEO_D_AUX_H
#define STAND_IN_BLASFEO_D_AUX_H

struct blasfeo_dvec {
  double *pa;
  int m;
};

struct blasfeo_dmat {
  double *pA;
  int m, n;
};

static inline void blasfeo_pack_dvec(int m, double *x, int every, struct blasfeo_dvec *y, int yi) {
  int i;
  for (i = 0; i < m; i++) y->pa[yi + i] = x[i * every];
}

static inline void blasfeo_unpack_dvec(int m, struct blasfeo_dvec *x, int xi, double *y, int every) {
  int i;
  for (i = 0; i < m; i++) y[i * every] = x->pa[xi + i];
}

static inline void blasfeo_pack_dmat(int m, int n, double *A, int lda, struct blasfeo_dmat *B, int bi, int bj) {
  int i, j;
  for (j = 0; j < n; j++)
    for (i = 0; i < m; i++) B->pA[bi + i + B->m * (bj + j)] = A[i + lda * j];
}

#endif
