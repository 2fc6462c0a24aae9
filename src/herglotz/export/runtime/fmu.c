/* An instance of an FMU around the header, for the functions of FMI below. Value references: 0 is time, then come the
   inputs u, then q, p and s; a further output or a parameter gets the next ones. */

#include "@HEADER@"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter" /* functions of the standard have arguments that no FMU has to read */
#endif
@HOLD@
#define fmu_TOKEN "@TOKEN@"

enum { fmu_STATE = 2 * hz_N + 1, fmu_FIRST_STATE = 1 + hz_M, fmu_VARIABLES = 1 + hz_M + fmu_STATE };
enum { fmu_OK, fmu_WARNING, fmu_DISCARD, fmu_ERROR }; /* as fmi2Status and fmi3Status */
typedef enum { fmu_INSTANTIATED, fmu_INITIALIZING, fmu_RUNNING, fmu_TERMINATED } fmu_phase;

/* The values that are saved and restored. The last communication step had `steps` steps h from `before` under `acted`. */
typedef struct {
  fmu_phase phase;
  hz_state x, before;
  hz_track track;
  hz_real u[hz_M + 1], acted[hz_M + 1], h;
  double time, steps;
  int outside;
} fmu_values;

typedef struct fmu_instance fmu_instance;
typedef void (*fmu_reporter)(const fmu_instance *it, int status, const char *message);

struct fmu_instance {
  fmu_values now;
  fmu_reporter report;
};

static const char *fmu_category(int status) { return status == fmu_WARNING ? "logStatusWarning" : "logStatusError"; }

static int fmu_said(const fmu_instance *it, int status, const char *message) {
  it->report(it, status, message);
  return status;
}

/* Whether the instance is there and in a phase that the call is allowed in. */
static int fmu_allowed(const fmu_instance *it, fmu_phase first, fmu_phase last) {
  if (!it) return 0;
  if (it->now.phase >= first && it->now.phase <= last) return 1;
  fmu_said(it, fmu_ERROR, "This call is not allowed now; the order is: instantiate, initialize, step, terminate.");
  return 0;
}

static void fmu_restart(fmu_instance *it) {
  static const hz_real u[hz_M + 1] = {@INPUTS@};
  memset(&it->now, 0, sizeof it->now);
  it->now.x = hz_start;
  memcpy(it->now.u, u, sizeof u);
}

/* The place of a variable other than time; null for an unknown reference. */
static hz_real *fmu_place(fmu_values *now, unsigned int reference) {
  int i;
  if (reference == 0 || reference >= fmu_VARIABLES) return 0;
  i = (int)reference - fmu_FIRST_STATE;
  if (i < 0) return now->u + (hz_M + i);
  return i < hz_N ? now->x.q + i : i < 2 * hz_N ? now->x.p + (i - hz_N) : &now->x.s;
}

static int fmu_get(fmu_instance *it, const unsigned int *references, size_t count, double *values) {
  size_t i;
  if (!fmu_allowed(it, fmu_INSTANTIATED, fmu_TERMINATED)) return fmu_ERROR;
  for (i = 0; i < count; i++) {
    const hz_real *place = fmu_place(&it->now, references[i]);
    if (!place && references[i]) return fmu_said(it, fmu_ERROR, "There is no variable of this value reference.");
    values[i] = place ? (double)*place : it->now.time;
  }
  return fmu_OK;
}

/* All values or none. Inputs may be set at any time, q, p and s until the first step. */
static int fmu_set(fmu_instance *it, const unsigned int *references, size_t count, const double *values) {
  size_t i;
  if (!fmu_allowed(it, fmu_INSTANTIATED, fmu_RUNNING)) return fmu_ERROR;
  for (i = 0; i < count; i++) {
    if (!fmu_place(&it->now, references[i]))
      return fmu_said(it, fmu_ERROR, "There is no variable of this value reference that can be set.");
    if (references[i] >= fmu_FIRST_STATE && it->now.phase == fmu_RUNNING)
      return fmu_said(it, fmu_ERROR, "q, p and s can be set until initialization ends; reset the instance first.");
    if (!hz_finite((hz_real)values[i])) return fmu_said(it, fmu_ERROR, "A value is not finite.");
  }
  for (i = 0; i < count; i++) *fmu_place(&it->now, references[i]) = (hz_real)values[i];
  return fmu_OK;
}

static int fmu_initialize(fmu_instance *it, double time) {
  if (!fmu_allowed(it, fmu_INSTANTIATED, fmu_INSTANTIATED)) return fmu_ERROR;
  if (!(time - time == 0.0)) return fmu_said(it, fmu_ERROR, "The start time is not finite.");
  it->now.time = time;
  it->now.phase = fmu_INITIALIZING;
  return fmu_OK;
}

static int fmu_initialized(fmu_instance *it) {
  if (!fmu_allowed(it, fmu_INITIALIZING, fmu_INITIALIZING)) return fmu_ERROR;
  it->now.phase = fmu_RUNNING;
  hz_track_start(&it->now.x, &it->now.track);
  return fmu_OK;
}

static int fmu_terminate(fmu_instance *it) {
  if (!fmu_allowed(it, fmu_RUNNING, fmu_RUNNING)) return fmu_ERROR;
  it->now.phase = fmu_TERMINATED;
  return fmu_OK;
}

/* A communication step H is one step, or the fewest equal steps that are not longer than those of the fit. */
static int fmu_communicate(fmu_instance *it, double time, double H) {
  const double slack = 1e-6; /* as of hz_steps_of */
  fmu_values *now, then;
  double steps, k;
  hz_real h;
  char text[160];
  if (!fmu_allowed(it, fmu_RUNNING, fmu_RUNNING)) return fmu_ERROR;
  if (!(time - time == 0.0 && H - H == 0.0 && H > 0.0))
    return fmu_said(it, fmu_ERROR, "The communication step is not a finite number above 0.");
  steps = hz_steps_of(H, (double)hz_h_high);
  h = (hz_real)(H / steps);
  if (fabs((double)h - (double)hz_h) <= slack * (double)hz_h) h = hz_h;
  if ((double)h < (double)hz_h_low * (1.0 - slack)) {
    snprintf(text, sizeof text, "A communication step of %.9g cannot be made of steps between %.9g and %.9g, which the "
             "model was fitted for.", H, (double)hz_h_low, (double)hz_h_high);
    return fmu_said(it, fmu_ERROR, text);
  }
  now = &it->now;
  then = *now;
  now->steps = steps;
  now->h = h;
  now->before = now->x;
  memcpy(now->acted, now->u, sizeof now->u);
  for (k = 0.0; k < steps; k += 1.0) {
    hz_real left;
    int status = hz_before(&now->x, h);
    if (!status) status = hz_advance(&now->x, &now->track, h, hz_WITH_U(now->acted) &left);
    if (status) {
      snprintf(text, sizeof text, "The step at time %.9g failed with status %d of the header; nothing has moved.", time,
               status);
      *now = then;
      return fmu_said(it, fmu_ERROR, text);
    }
  }
  now->time = time + H;
  now->outside = hz_outside_box(&now->x);
  if (now->outside && !then.outside)
    return fmu_said(it, fmu_WARNING, "The motion has left the data that the model was fitted to.");
  return now->outside ? fmu_WARNING : fmu_OK;
}

/* Derivatives of q, p, s after the last communication step by q, p, s before it and by the inputs during it:
   result = J seed, or Jᵀ seed where `adjoint` is true. */
static int fmu_differentiate(fmu_instance *it, const unsigned int *unknowns, size_t rows, const unsigned int *knowns,
    size_t columns, const double *seed, double *result, int adjoint) {
#if hz_DERIVATIVES
  hz_state x;
  hz_real by_x[fmu_STATE * fmu_STATE], by_u[fmu_STATE * (hz_M + 1)];
  size_t i, j;
  if (!fmu_allowed(it, fmu_RUNNING, fmu_RUNNING)) return fmu_ERROR;
  if (it->now.steps < 1.0) return fmu_said(it, fmu_ERROR, "There is no derivative before the first step.");
  for (i = 0; i < rows; i++)
    if (unknowns[i] < fmu_FIRST_STATE || unknowns[i] >= fmu_VARIABLES)
      return fmu_said(it, fmu_ERROR, "An unknown is no output.");
  for (j = 0; j < columns; j++)
    if (!fmu_place(&it->now, knowns[j])) return fmu_said(it, fmu_ERROR, "A known is no input or output.");
  x = it->now.before;
  if (hz_hold_jacobian(&x, it->now.h, hz_WITH_U(it->now.acted) it->now.steps, by_x, hz_WITH_U(by_u) 0))
    return fmu_said(it, fmu_ERROR, "The last step has no derivative.");
  for (i = 0; i < (adjoint ? columns : rows); i++) result[i] = 0.0;
  for (i = 0; i < rows; i++)
    for (j = 0; j < columns; j++) {
      const unsigned int row = unknowns[i] - fmu_FIRST_STATE, known = knowns[j];
      const double slope = (double)(known >= fmu_FIRST_STATE ? by_x[row * fmu_STATE + known - fmu_FIRST_STATE]
                                                             : by_u[row * hz_M + known - 1]);
      if (adjoint) result[j] += slope * seed[i];
      else result[i] += slope * seed[j];
    }
  return fmu_OK;
#else
  return fmu_said(it, fmu_ERROR, "The model has too many coordinates for derivatives.");
#endif
}

/* Saved states are values in memory of their own; as bytes they follow the token. */
enum { fmu_BYTES = sizeof fmu_TOKEN + sizeof(fmu_values) };

static int fmu_save(fmu_instance *it, void **state) {
  if (!fmu_allowed(it, fmu_INSTANTIATED, fmu_TERMINATED) || !state) return fmu_ERROR;
  if (!*state && !(*state = malloc(sizeof(fmu_values)))) return fmu_said(it, fmu_ERROR, "There is no memory left.");
  memcpy(*state, &it->now, sizeof it->now);
  return fmu_OK;
}

static int fmu_restore(fmu_instance *it, const void *state) {
  if (!fmu_allowed(it, fmu_INSTANTIATED, fmu_TERMINATED)) return fmu_ERROR;
  if (!state) return fmu_said(it, fmu_ERROR, "There is no state to restore.");
  memcpy(&it->now, state, sizeof it->now);
  return fmu_OK;
}

static int fmu_drop(fmu_instance *it, void **state) {
  if (!it || !state) return fmu_ERROR;
  free(*state);
  *state = 0;
  return fmu_OK;
}

static int fmu_to_bytes(fmu_instance *it, const void *state, void *bytes, size_t size) {
  if (!fmu_allowed(it, fmu_INSTANTIATED, fmu_TERMINATED)) return fmu_ERROR;
  if (!state || size != fmu_BYTES) return fmu_said(it, fmu_ERROR, "No state, or bytes of another size.");
  memcpy(bytes, fmu_TOKEN, sizeof fmu_TOKEN);
  memcpy((char *)bytes + sizeof fmu_TOKEN, state, sizeof(fmu_values));
  return fmu_OK;
}

static int fmu_from_bytes(fmu_instance *it, const void *bytes, size_t size, void **state) {
  fmu_values found;
  if (!fmu_allowed(it, fmu_INSTANTIATED, fmu_TERMINATED) || !state) return fmu_ERROR;
  if (size != fmu_BYTES || memcmp(bytes, fmu_TOKEN, sizeof fmu_TOKEN))
    return fmu_said(it, fmu_ERROR, "These bytes are no state of this model.");
  memcpy(&found, (const char *)bytes + sizeof fmu_TOKEN, sizeof found);
  if (hz_before(&found.x, hz_h)) return fmu_said(it, fmu_ERROR, "These bytes hold a state that is not finite.");
  if (!*state && !(*state = malloc(sizeof found))) return fmu_said(it, fmu_ERROR, "There is no memory left.");
  memcpy(*state, &found, sizeof found);
  return fmu_OK;
}

/* A call on `count` things that this FMU lacks: variables of other types, clocks, events, continuous states,
   derivatives by time. */
static int fmu_none(void *it, size_t count) {
  if (!it) return fmu_ERROR;
  return count ? fmu_said((fmu_instance *)it, fmu_ERROR, "This FMU has real variables alone, without derivatives by "
                          "time, clocks or events.") : fmu_OK;
}

#if defined(_WIN32)
#define fmu_API __declspec(dllexport)
#else
#define fmu_API
#endif
