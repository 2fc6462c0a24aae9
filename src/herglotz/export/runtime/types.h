#ifdef __cplusplus
#define hz_RESTRICT
#else
#define hz_RESTRICT restrict
#endif

/* Whether the guess extrapolates the last moves. Where dry friction can hold a coordinate, the equation at rest is a
   better guess; an explicit step needs no guess. */
#define hz_CONTINUES (!hz_EXPLICIT && !hz_STICKING)

#if hz_SINGLE
#define hz_sin sinf
#define hz_cos cosf
#define hz_exp_of expf
#define hz_expm1_of expm1f
#define hz_sqrt sqrtf
#define hz_atanh_of atanhf
#define hz_pow powf
#define hz_fabs fabsf
#define hz_floor_of floorf
#else
#define hz_sin sin
#define hz_cos cos
#define hz_exp_of exp
#define hz_expm1_of expm1
#define hz_sqrt sqrt
#define hz_atanh_of atanh
#define hz_pow pow
#define hz_fabs fabs
#define hz_floor_of floor
#endif

/* The status of a step: `status & 15` is 0 where the step succeeded; the bits above are flags. */
enum {
  hz_CONVERGED = 0,
  hz_MAX_ITERATIONS = 1,
  hz_SINGULAR = 2,     /* det J = 0 or c = 0: the step is not defined */
  hz_DIVERGED = 3,     /* an input, or a number of the state before the step or after it, is not finite */
  hz_BAD_INPUT = 5,    /* h is no finite number > 0, or hz_init is given a number that is not finite */
  hz_OUTSIDE_BOX = 16, /* a separate bit: a state outside the box of the fitted data; the step is done */
  hz_OUTSIDE_H = 32    /* a separate bit: h outside [hz_h_low, hz_h_high]; the step is done */
};

/* A state. q in hz_units; p in the units of D2 L_d, s in those of L_d; sigma is the product of the factors c of the
   steps so far (start it at 1). */
typedef struct {
  hz_real q[hz_N], p[hz_N], s, sigma;
} hz_state;
