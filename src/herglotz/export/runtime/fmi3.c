/* FMI 3.0 for co-simulation: types and functions of the standard, sections 2.2 and 4.2. */

#include <stdbool.h>
#include <stdint.h>

typedef void *fmi3Instance;
typedef uint32_t fmi3ValueReference;
typedef double fmi3Float64;
typedef bool fmi3Boolean;
typedef uint8_t fmi3Byte;
typedef const char *fmi3String;
typedef int fmi3Status, fmi3DependencyKind, fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(void *environment, fmi3Status status, fmi3String category, fmi3String message);
typedef void (*fmi3IntermediateUpdateCallback)(void *environment, fmi3Float64 time, fmi3Boolean set, fmi3Boolean get,
    fmi3Boolean finished, fmi3Boolean can_return, fmi3Boolean *return_wanted, fmi3Float64 *return_time);

typedef struct {
  fmu_instance of;
  fmi3LogMessageCallback log;
  void *environment;
} fmu_component;

static void fmu_log(const fmu_instance *it, int status, const char *message) {
  const fmu_component *own = (const fmu_component *)(const void *)it;
  if (own->log) own->log(own->environment, status, fmu_category(status), message);
}

fmu_API fmi3String fmi3GetVersion(void) { return "3.0"; }

fmu_API fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early_return,
    const fmi3ValueReference intermediate[], size_t count, void *environment, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback update) {
  fmu_component *made = 0;
  if (name && *name && token && !strcmp(token, fmu_TOKEN) && !events && !count)
    made = (fmu_component *)calloc(1, sizeof *made);
  if (!made) {
    if (log)
      log(environment, fmu_ERROR, "logStatusError",
          "Not instantiated: this FMU needs a name and its own token, and has no events and no intermediate updates.");
    return 0;
  }
  made->of.report = fmu_log;
  made->log = log;
  made->environment = environment;
  fmu_restart(&made->of);
  return made;
}
fmu_API fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, void *environment, fmi3LogMessageCallback log) {
  if (log) log(environment, fmu_ERROR, "logStatusError", "This FMU is for co-simulation.");
  return 0;
}
fmu_API fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, void *environment, fmi3LogMessageCallback log, void (*clock)(void *),
    void (*lock)(void), void (*unlock)(void)) {
  return fmi3InstantiateModelExchange(name, token, resources, visible, logging, environment, log);
}
fmu_API void fmi3FreeInstance(fmi3Instance it) { free(it); }

fmu_API fmi3Status fmi3EnterInitializationMode(fmi3Instance it, fmi3Boolean with_tolerance, fmi3Float64 tolerance,
    fmi3Float64 start, fmi3Boolean with_stop, fmi3Float64 stop) {
  return fmu_initialize((fmu_instance *)it, start);
}
fmu_API fmi3Status fmi3GetFloat64(fmi3Instance it, const fmi3ValueReference vr[], size_t count, fmi3Float64 values[],
    size_t size) {
  return size == count ? fmu_get((fmu_instance *)it, vr, count, values) : fmu_ERROR;
}
fmu_API fmi3Status fmi3SetFloat64(fmi3Instance it, const fmi3ValueReference vr[], size_t count,
    const fmi3Float64 values[], size_t size) {
  return size == count ? fmu_set((fmu_instance *)it, vr, count, values) : fmu_ERROR;
}

/* Calls on `count` variables of which this FMU has none: other types, clocks and derivatives by time. */
#define fmu_NOTHING(name, ...) \
  fmu_API fmi3Status fmi3##name(fmi3Instance it, const fmi3ValueReference vr[], size_t count, __VA_ARGS__) { \
    return fmu_none(it, count); \
  }
#define fmu_NO_VARIABLES(name, type) \
  fmu_NOTHING(Get##name, type values[], size_t size) \
  fmu_NOTHING(Set##name, const type values[], size_t size)
fmu_NO_VARIABLES(Float32, float)
fmu_NO_VARIABLES(Int8, int8_t)
fmu_NO_VARIABLES(UInt8, uint8_t)
fmu_NO_VARIABLES(Int16, int16_t)
fmu_NO_VARIABLES(UInt16, uint16_t)
fmu_NO_VARIABLES(Int32, int32_t)
fmu_NO_VARIABLES(UInt32, uint32_t)
fmu_NO_VARIABLES(Int64, int64_t)
fmu_NO_VARIABLES(UInt64, uint64_t)
fmu_NO_VARIABLES(Boolean, fmi3Boolean)
fmu_NO_VARIABLES(String, fmi3String)
fmu_NOTHING(GetBinary, size_t *sizes, const uint8_t **values, size_t size)
fmu_NOTHING(SetBinary, const size_t *sizes, const uint8_t *const *values, size_t size)
fmu_NOTHING(GetIntervalFraction, uint64_t *counters, uint64_t *resolutions, fmi3IntervalQualifier *qualifiers)
fmu_NOTHING(GetOutputDerivatives, const int32_t *orders, fmi3Float64 *values, size_t size)
fmu_NOTHING(GetIntervalDecimal, fmi3Float64 *intervals, fmi3IntervalQualifier *qualifiers)
fmu_NOTHING(GetShiftFraction, uint64_t *counters, uint64_t *resolutions)
fmu_NOTHING(SetIntervalFraction, const uint64_t *counters, const uint64_t *resolutions)
fmu_NOTHING(SetShiftFraction, const uint64_t *counters, const uint64_t *resolutions)
fmu_NOTHING(GetClock, bool *values)
fmu_NOTHING(SetClock, const bool *values)
fmu_NOTHING(GetShiftDecimal, fmi3Float64 *shifts)
fmu_NOTHING(SetIntervalDecimal, const fmi3Float64 *intervals)
fmu_NOTHING(SetShiftDecimal, const fmi3Float64 *shifts)

/* Modes and calls that a co-simulation without events and continuous states does not have. */
#define fmu_NO_MODE(name, ...) \
  fmu_API fmi3Status fmi3##name(__VA_ARGS__) { return fmu_none(it, 1); }
fmu_NO_MODE(EnterEventMode, fmi3Instance it)
fmu_NO_MODE(EnterStepMode, fmi3Instance it)
fmu_NO_MODE(EnterConfigurationMode, fmi3Instance it)
fmu_NO_MODE(ExitConfigurationMode, fmi3Instance it)
fmu_NO_MODE(EvaluateDiscreteStates, fmi3Instance it)
fmu_NO_MODE(EnterContinuousTimeMode, fmi3Instance it)
fmu_NO_MODE(UpdateDiscreteStates, fmi3Instance it, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
    fmi3Boolean *states, fmi3Boolean *next, fmi3Float64 *time)
fmu_NO_MODE(CompletedIntegratorStep, fmi3Instance it, fmi3Boolean no_way_back, fmi3Boolean *events,
    fmi3Boolean *terminate)
fmu_NO_MODE(SetTime, fmi3Instance it, fmi3Float64 time)
fmu_NO_MODE(ActivateModelPartition, fmi3Instance it, fmi3ValueReference clock, fmi3Float64 time)

#define fmu_NO_STATES(name, type) \
  fmu_API fmi3Status fmi3##name(fmi3Instance it, type values, size_t count) { return fmu_none(it, count); }
fmu_NO_STATES(SetContinuousStates, const fmi3Float64 *)
fmu_NO_STATES(GetContinuousStates, fmi3Float64 *)
fmu_NO_STATES(GetContinuousStateDerivatives, fmi3Float64 *)
fmu_NO_STATES(GetNominalsOfContinuousStates, fmi3Float64 *)
fmu_NO_STATES(GetEventIndicators, fmi3Float64 *)

static fmi3Status fmu_zero(fmi3Instance it, size_t *count) {
  if (!it || !count) return fmu_ERROR;
  *count = 0;
  return fmu_OK;
}
fmu_API fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance it, size_t *count) { return fmu_zero(it, count); }
fmu_API fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance it, size_t *count) { return fmu_zero(it, count); }
fmu_API fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance it, fmi3ValueReference vr, size_t *count) {
  return fmu_zero(it, count);
}
fmu_API fmi3Status fmi3GetVariableDependencies(fmi3Instance it, fmi3ValueReference vr, size_t places[],
    fmi3ValueReference independents[], size_t their_places[], fmi3DependencyKind kinds[], size_t count) {
  return fmu_none(it, count);
}
fmu_API fmi3Status fmi3GetDirectionalDerivative(fmi3Instance it, const fmi3ValueReference unknowns[], size_t rows,
    const fmi3ValueReference knowns[], size_t columns, const fmi3Float64 seed[], size_t seeds, fmi3Float64 result[],
    size_t results) {
  if (seeds != columns || results != rows) return fmu_ERROR;
  return fmu_differentiate((fmu_instance *)it, unknowns, rows, knowns, columns, seed, result, 0);
}
fmu_API fmi3Status fmi3GetAdjointDerivative(fmi3Instance it, const fmi3ValueReference unknowns[], size_t rows,
    const fmi3ValueReference knowns[], size_t columns, const fmi3Float64 seed[], size_t seeds, fmi3Float64 result[],
    size_t results) {
  if (seeds != rows || results != columns) return fmu_ERROR;
  return fmu_differentiate((fmu_instance *)it, unknowns, rows, knowns, columns, seed, result, 1);
}

fmu_API fmi3Status fmi3DoStep(fmi3Instance it, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_way_back,
    fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
  const fmi3Status status = fmu_communicate((fmu_instance *)it, time, step);
  if (event) *event = false;
  if (terminate) *terminate = false;
  if (early) *early = false;
  if (last && it) *last = ((fmu_instance *)it)->now.time;
  return status;
}
