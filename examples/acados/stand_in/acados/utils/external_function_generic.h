/* What a file for acados' discrete dynamics reads of acados: enough to compile it where acados is not installed. */

#ifndef STAND_IN_EXTERNAL_FUNCTION_GENERIC_H
#define STAND_IN_EXTERNAL_FUNCTION_GENERIC_H

#include "blasfeo_d_aux.h"

struct blasfeo_dvec_args {
  struct blasfeo_dvec *x;
  int xi; /* where the vector begins */
};

struct blasfeo_dmat_args {
  struct blasfeo_dmat *A;
  int ai, aj; /* where the matrix begins */
};

#endif
