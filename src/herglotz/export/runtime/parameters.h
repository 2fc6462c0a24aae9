#if hz_P
/* Numbers of the model that are set at run time, `theta` of the functions below; null means hz_defaults. hz_advance
   steps with the numbers that its track was started with. by_theta of hz_step_jacobian, the derivatives by these
   numbers, is (2 hz_N + 1, hz_P). */
#define hz_TAKES_THETA const hz_parameters *theta,
#define hz_WITH_THETA(argument) argument,
#define hz_BAD_THETA(theta) ((theta) && !hz_in_bounds(theta))

/* Whether every number is finite and within its bounds. */
static inline int hz_in_bounds(const hz_parameters *theta) {
  int i, good = 1;
  for (i = 0; i < hz_P; i++)
    good &= hz_finite(theta->value[i]) && theta->value[i] >= hz_lowest.value[i] && theta->value[i] <= hz_highest.value[i];
  return good;
}

/* Set one number, as in hz_set_parameter(&theta, hz_damping_rate, 0.3). hz_BAD_INPUT, and nothing is changed, where there is no
   such number, or the value is not finite or outside its bounds. */
static inline int hz_set_parameter(hz_parameters *theta, int which, hz_real value) {
  if (which < 0 || which >= hz_P || !hz_finite(value)) return hz_BAD_INPUT;
  if (!(value >= hz_lowest.value[which] && value <= hz_highest.value[which])) return hz_BAD_INPUT;
  theta->value[which] = value;
  return hz_CONVERGED;
}
#else
#define hz_TAKES_THETA
#define hz_WITH_THETA(argument)
#define hz_BAD_THETA(theta) 0
#endif
