/* FMI 2.0 for co-simulation: types and functions of the standard, sections 2.1 and 4.2. */

typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef const char *fmi2String;
typedef char fmi2Byte;
typedef int fmi2Status, fmi2Type, fmi2StatusKind;

typedef struct {
  void (*logger)(void *environment, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...);
  void *(*allocate)(size_t count, size_t size);
  void (*release)(void *memory);
  void (*finished)(void *environment, fmi2Status status);
  void *environment;
} fmi2CallbackFunctions;

typedef struct {
  fmu_instance of;
  fmi2CallbackFunctions calls;
  double start;
  char name[1]; /* and on to its end */
} fmu_component;

static void fmu_log(const fmu_instance *it, int status, const char *message) {
  const fmu_component *own = (const fmu_component *)(const void *)it;
  if (own->calls.logger)
    own->calls.logger(own->calls.environment, own->name, status, fmu_category(status), message);
}

fmu_API fmi2String fmi2GetTypesPlatform(void) { return "default"; }
fmu_API fmi2String fmi2GetVersion(void) { return "2.0"; }

fmu_API fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
    const fmi2CallbackFunctions *calls, fmi2Boolean visible, fmi2Boolean logging) {
  const size_t length = name ? strlen(name) : 0;
  fmu_component *made;
  if (type != 1 || !length || !guid || strcmp(guid, fmu_TOKEN) || !calls || !calls->allocate || !calls->release) {
    if (calls && calls->logger)
      calls->logger(calls->environment, name ? name : "", fmu_ERROR, "logStatusError",
                    "Not instantiated: this FMU is for co-simulation, and needs a name, its own GUID and callbacks.");
    return 0;
  }
  made = (fmu_component *)calls->allocate(1, sizeof *made + length);
  if (!made) return 0;
  made->calls = *calls;
  made->of.report = fmu_log;
  made->start = 0.0;
  memcpy(made->name, name, length + 1);
  fmu_restart(&made->of);
  return made;
}

fmu_API void fmi2FreeInstance(fmi2Component c) {
  if (c) ((fmu_component *)c)->calls.release(c);
}

fmu_API fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean with_tolerance, fmi2Real tolerance, fmi2Real start,
    fmi2Boolean with_stop, fmi2Real stop) {
  if (!fmu_allowed((fmu_instance *)c, fmu_INSTANTIATED, fmu_INSTANTIATED)) return fmu_ERROR;
  ((fmu_component *)c)->start = start;
  return fmu_OK;
}

fmu_API fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
  return c ? fmu_initialize((fmu_instance *)c, ((fmu_component *)c)->start) : fmu_ERROR;
}
fmu_API fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Real values[]) {
  return fmu_get((fmu_instance *)c, vr, count, values);
}
fmu_API fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Real values[]) {
  return fmu_set((fmu_instance *)c, vr, count, values);
}

#define fmu_NO_VARIABLES(name, type) \
  fmu_API fmi2Status fmi2Get##name(fmi2Component c, const fmi2ValueReference vr[], size_t count, type values[]) { \
    return fmu_none(c, count); \
  } \
  fmu_API fmi2Status fmi2Set##name(fmi2Component c, const fmi2ValueReference vr[], size_t count, \
      const type values[]) { \
    return fmu_none(c, count); \
  }
fmu_NO_VARIABLES(Integer, fmi2Integer)
fmu_NO_VARIABLES(Boolean, fmi2Boolean)
fmu_NO_VARIABLES(String, fmi2String)

fmu_API fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t rows,
    const fmi2ValueReference knowns[], size_t columns, const fmi2Real seed[], fmi2Real result[]) {
  return fmu_differentiate((fmu_instance *)c, unknowns, rows, knowns, columns, seed, result, 0);
}

fmu_API fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_way_back) {
  return fmu_communicate((fmu_instance *)c, time, step);
}

/* Inputs are held over a step, outputs have no derivatives by time, and steps are over when fmi2DoStep returns. */
fmu_API fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    const fmi2Integer order[], const fmi2Real values[]) {
  return fmu_none(c, count);
}
fmu_API fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    const fmi2Integer order[], fmi2Real values[]) {
  return fmu_none(c, count);
}
fmu_API fmi2Status fmi2CancelStep(fmi2Component c) {
  return fmu_ERROR;
}
fmu_API fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
  if (!c || kind != 2) return fmu_DISCARD; /* the last successful time */
  *value = ((fmu_instance *)c)->now.time;
  return fmu_OK;
}
fmu_API fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
  if (!c || kind != 3) return fmu_DISCARD; /* whether the model wants to end the simulation */
  *value = 0;
  return fmu_OK;
}
#define fmu_NO_STATUS(name, type) \
  fmu_API fmi2Status fmi2Get##name(fmi2Component c, const fmi2StatusKind kind, type *value) { \
    return fmu_DISCARD; \
  }
fmu_NO_STATUS(Status, fmi2Status)
fmu_NO_STATUS(IntegerStatus, fmi2Integer)
fmu_NO_STATUS(StringStatus, fmi2String)
