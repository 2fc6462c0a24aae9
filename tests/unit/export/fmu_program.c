/* An FMU's sources as one program with their importer: a life of an instance. Prints the time at its end. */

#include SOURCE

#if FMI == 2
static void heard(void *environment, const char *name, int status, const char *category, const char *message, ...) {
  (void)environment, (void)name, (void)status, (void)category, (void)message;
}
#else
static void heard(void *environment, int status, const char *category, const char *message) {
  (void)environment, (void)status, (void)category, (void)message;
}
#endif

#define TRY(call) \
  if ((call) > fmu_WARNING) return __LINE__ & 127

int main(void) {
  const unsigned int all[] = {0, 1, 2, 3, 4, 5}, state_of[] = {3, 4, 5};
  double values[6] = {0.0, 0.2, 0.1, 0.3, -0.2, 0.1}, result[5], seed[5] = {1.0, 1.0, 1.0, 1.0, 1.0};
  void *saved = 0, *read = 0, *it;
  size_t size = 0;
  char *bytes;
  int k;
#if FMI == 2
  const fmi2CallbackFunctions calls = {heard, calloc, free, 0, 0};
  it = fmi2Instantiate("one", 1, fmu_TOKEN, "", &calls, 0, 0);
  if (!it) return 1;
  TRY(fmi2SetupExperiment(it, 0, 0.0, 0.0, 0, 0.0));
  TRY(fmi2SetReal(it, all + 1, 5, values + 1));
  TRY(fmi2EnterInitializationMode(it));
  TRY(fmi2ExitInitializationMode(it));
#define STEP(k) fmi2DoStep(it, k * 0.1, 0.1, 1)
#define GET fmi2GetReal(it, all, 6, values)
#define NAME(verb) fmi2##verb##FMUstate
#define READ fmi2DeSerializeFMUstate
#define SIZE fmi2SerializedFMUstateSize
#else
  it = fmi3InstantiateCoSimulation("one", fmu_TOKEN, "", 0, 0, 0, 0, 0, 0, 0, heard, 0);
  if (!it) return 1;
  TRY(fmi3SetFloat64(it, all + 1, 5, values + 1, 5));
  TRY(fmi3EnterInitializationMode(it, 0, 0.0, 0.0, 0, 0.0));
  TRY(fmi3ExitInitializationMode(it));
#define STEP(k) fmi3DoStep(it, k * 0.1, 0.1, 1, 0, 0, 0, 0)
#define GET fmi3GetFloat64(it, all, 6, values, 6)
#define NAME(verb) fmi3##verb##FMUState
#define READ fmi3DeserializeFMUState
#define SIZE fmi3SerializedFMUStateSize
#endif
  for (k = 0; k < 100; k++) TRY(STEP(k));
  TRY(NAME(Get)(it, &saved));
  TRY(SIZE(it, saved, &size));
  bytes = (char *)malloc(size);
  TRY(NAME(Serialize)(it, saved, (void *)bytes, size));
  TRY(STEP(100));
  TRY(READ(it, (void *)bytes, size, &read));
  TRY(NAME(Set)(it, read));
  TRY(fmu_differentiate((fmu_instance *)it, state_of, 3, all + 1, 5, seed, result, 0));
  if (!fmu_set((fmu_instance *)it, all, 6, values)) return 2; /* time cannot be set */
  TRY(GET);
  free(bytes);
  TRY(NAME(Free)(it, &saved));
  TRY(NAME(Free)(it, &read));
#if FMI == 2
  fmi2FreeInstance(it);
#else
  fmi3FreeInstance(it);
#endif
  printf("%.17g\n", values[0]);
  return 0;
}
