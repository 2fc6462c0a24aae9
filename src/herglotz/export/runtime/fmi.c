
/* Functions that FMI 2.0 and 3.0 have alike, but for the number in their names. */

fmu_API int fmi@V@SetDebugLogging(void *it, fmi@V@Boolean on, size_t count, const char *const categories[]) {
  return it ? fmu_OK : fmu_ERROR;
}

fmu_API int fmi@V@ExitInitializationMode(void *it) { return fmu_initialized((fmu_instance *)it); }
fmu_API int fmi@V@Terminate(void *it) { return fmu_terminate((fmu_instance *)it); }
fmu_API int fmi@V@Reset(void *it) {
  if (!it) return fmu_ERROR;
  fmu_restart((fmu_instance *)it);
  return fmu_OK;
}

fmu_API int fmi@V@Get@STATE@(void *it, void **state) { return fmu_save((fmu_instance *)it, state); }
fmu_API int fmi@V@Set@STATE@(void *it, void *state) { return fmu_restore((fmu_instance *)it, state); }
fmu_API int fmi@V@Free@STATE@(void *it, void **state) { return fmu_drop((fmu_instance *)it, state); }
fmu_API int fmi@V@Serialized@STATE@Size(void *it, void *state, size_t *size) {
  if (!it || !state || !size) return fmu_ERROR;
  *size = fmu_BYTES;
  return fmu_OK;
}
fmu_API int fmi@V@Serialize@STATE@(void *it, void *state, fmi@V@Byte bytes[], size_t size) {
  return fmu_to_bytes((fmu_instance *)it, state, bytes, size);
}
fmu_API int fmi@V@@DESERIALIZE@(void *it, const fmi@V@Byte bytes[], size_t size, void **state) {
  return fmu_from_bytes((fmu_instance *)it, bytes, size, state);
}
