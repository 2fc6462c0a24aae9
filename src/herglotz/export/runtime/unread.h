
/* Constants of the header that nothing below reads: compilers warn of such constants in a source file. */
static inline void hz_unread(void) {
  (void)hz_weights_sha256;
  (void)hz_level;
  (void)hz_dtype;
  (void)hz_versions;
  (void)hz_units;
  (void)hz_is_angle;
  (void)hz_tolerance;
  (void)hz_floor;
  (void)hz_top_speed;
  (void)hz_near;
  (void)hz_start;
#if hz_BOXED && !hz_CARRIES_S
  (void)hz_s_low;
  (void)hz_s_high;
#endif
}

