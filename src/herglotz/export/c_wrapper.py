"""The compiled header: a C compiler, a cache of shared libraries, and loops over samples around the header."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from herglotz.data.files import write_atomically
from herglotz.errors import InputError
from herglotz.export.c_template import finish, render

# No -ffast-math: a shared library built with it flushes denormals of the whole process, and drops the compensation of
# rounding. Fused multiply-adds are what -std=c99 alone would turn off.
FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast")

LOOPS = """
#include "stepper.h"

static void load(const real *q, const real *p, const real *s, long b, NAME_state *x) {
  int i;
  for (i = 0; i < NAME_N; i++) {
    x->q[i] = q[b * NAME_N + i];
    x->p[i] = p[b * NAME_N + i];
  }
  x->s = s[b];
  x->sigma = R(1.0);
}

static void store(const NAME_state *x, long at, real *q_out, real *p_out, real *s_out, real *sigma_out) {
  int i;
  for (i = 0; i < NAME_N; i++) {
    q_out[at * NAME_N + i] = x->q[i];
    p_out[at * NAME_N + i] = x->p[i];
  }
  s_out[at] = x->s;
  sigma_out[at] = x->sigma;
}

#ifdef NAME_BATCHED
/* The samples b .. b + LANES of herglotz_rollouts. */
static void lanes(long b, long batch, long steps, const real *q, const real *p, const real *s, const real *h,
    long h_sample, long h_step, const real *u, long u_sample, real *q_out, real *p_out, real *s_out, real *sigma_out,
    unsigned char *status_out, real *residual_out) {
  NAME_wide_state x;
  NAME_wide_track track;
  NAME_state one;
  real now[NAME_LANES], left[NAME_LANES];
{%if inputs}
  const real *push[NAME_LANES];
{%end}
  int status[NAME_LANES], i, w, count = batch - b < NAME_LANES ? (int)(batch - b) : NAME_LANES;
  long k;
{%if !inputs}
  (void)u;
  (void)u_sample;
{%end}
  for (w = 0; w < NAME_LANES; w++) {
    load(q, p, s, w < count ? b + w : batch - 1, &one);
    for (i = 0; i < NAME_N; i++) {
      x.q[i][w] = one.q[i];
      x.p[i][w] = one.p[i];
    }
    x.s[w] = one.s;
    x.sigma[w] = one.sigma;
    status[w] = NAME_CONVERGED;
  }
  NAME_wide_track_start(&x, &track);
  for (k = 0; k <= steps; k++) {
    int before[NAME_LANES];
    for (w = 0; w < NAME_LANES; w++) {
      before[w] = status[w];
      if (k > 0) now[w] = h[(w < count ? b + w : batch - 1) * h_sample + (k - 1) * h_step];
{%if inputs}
      push[w] = u && k > 0 ? u + (w < count ? b + w : batch - 1) * u_sample + (k - 1) * NAME_M : 0;
{%end}
    }
    if (k > 0) NAME_wide_advance(&x, &track, now, {%if inputs}push, {%end}status, left);
    for (w = 0; w < count; w++) {
      if (before[w]) continue;
      if (k > 0) {
        status_out[(b + w) * steps + k - 1] = (unsigned char)status[w];
        residual_out[(b + w) * steps + k - 1] = left[w];
      }
      if (status[w]) continue;
      NAME_wide_get(&x, w, &one);
      store(&one, (b + w) * (steps + 1) + k, q_out, p_out, s_out, sigma_out);
    }
  }
}
#endif

/* Rollouts of `batch` samples; outputs are (batch, steps + 1, ...), statuses and residuals (batch, steps). The outputs
   arrive full of NaN and the statuses full of NAME_DIVERGED: nothing is written after a failure but its own status. */
void herglotz_rollouts(long batch, long steps, const real *q, const real *p, const real *s, const real *h,
    long h_sample, long h_step, const real *u, long u_sample, real *q_out, real *p_out, real *s_out, real *sigma_out,
    unsigned char *status_out, real *residual_out) {
  long b, k;
#ifdef NAME_BATCHED
  if (batch > 1) {
    for (b = 0; b < batch; b += NAME_LANES)
      lanes(b, batch, steps, q, p, s, h, h_sample, h_step, u, u_sample, q_out, p_out, s_out, sigma_out, status_out,
          residual_out);
    return;
  }
#endif
  for (b = 0; b < batch; b++) {
    NAME_state x;
    NAME_track track;
    int status = 0;
    load(q, p, s, b, &x);
    NAME_track_start(&x, &track);
    for (k = 0; k <= steps; k++) {
      const long at = b * (steps + 1) + k;
      if (k > 0) {
        const long step = b * steps + k - 1;
        real left = R(0.0);
        const real now = h[b * h_sample + (k - 1) * h_step];
{%if inputs}
        status = NAME_advance(&x, &track, now, u ? u + b * u_sample + (k - 1) * NAME_M : 0, &left);
{%else}
        status = NAME_advance(&x, &track, now, &left);
{%end}
        status_out[step] = (unsigned char)status;
        residual_out[step] = left;
        if (status) break;
      }
      store(&x, at, q_out, p_out, s_out, sigma_out);
    }
  }
}

void herglotz_inits(long batch, const real *q0, const real *q1, const real *s0, const real *h, long h_sample,
    const real *u, long u_sample, real *p_out, real *s_out, unsigned char *status_out) {
  long b;
  int i;
{%if !inputs}
  (void)u;
  (void)u_sample;
{%end}
  for (b = 0; b < batch; b++) {
    NAME_state x;
    int status = NAME_init(q0 + b * NAME_N, q1 + b * NAME_N, s0[b], h[b * h_sample],
        {%if inputs}u ? u + b * u_sample : 0, {%end}&x) & 15;
    status_out[b] = (unsigned char)status;
    if (status) continue;
    for (i = 0; i < NAME_N; i++) p_out[b * NAME_N + i] = x.p[i];
    s_out[b] = x.s;
  }
}

void herglotz_outside_box(long batch, const real *q, const real *p, const real *s, unsigned char *out) {
  long b;
  for (b = 0; b < batch; b++) {
    NAME_state x;
    load(q, p, s, b, &x);
    out[b] = NAME_outside_box(&x) != 0;
  }
}
"""


def compiler() -> list[str]:
    """The C compiler: $CC, or cc, gcc or clang from the PATH.

    Raises
    ------
    InputError
        If there is none.
    """
    given = shlex.split(os.environ.get("CC", ""))
    for words in [given] if given else [["cc"], ["gcc"], ["clang"]]:
        found = shutil.which(words[0])
        if found:
            return [found, *words[1:]]
    missing = f"$CC names '{given[0]}', which is not there" if given else "no C compiler (cc, gcc, clang) in the PATH"
    raise InputError(f"{missing}; install one, for example with: apt install gcc")


def build(header: str, name: str, dtype: str, *, inputs: bool = False) -> ctypes.CDLL:
    """Compile the header with its loops, or take the library from the cache, and load it.

    Raises
    ------
    InputError
        If there is no compiler, or it does not compile the header.
    """
    words = compiler()
    loops = finish(render(LOOPS, None, {"inputs": inputs}), name, dtype)
    key = "\0".join([header, loops, *words, *FLAGS, sys.platform, _processor()])
    digest = hashlib.sha256(key.encode()).hexdigest()[:32]
    folder = _cache()
    library = folder / f"{digest}.so"
    if not library.exists():
        write_atomically(library, _compile(words, header, loops))
    try:
        return ctypes.CDLL(str(library))
    except OSError:  # a damaged file
        write_atomically(library, _compile(words, header, loops))
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise InputError(f"{library}: cannot be loaded ({error}); check the compiler {words[0]}") from None


def _compile(words: list[str], header: str, loops: str) -> bytes:
    """The shared library, as bytes; without -march=native where the compiler does not know it."""
    message = ""
    with tempfile.TemporaryDirectory(prefix="herglotz-") as folder:
        source, library = Path(folder, "loops.c"), Path(folder, "loops.so")
        Path(folder, "stepper.h").write_text(header)
        source.write_text(loops)
        for flags in (FLAGS, [f for f in FLAGS if f != "-march=native"]):
            command = [*words, *flags, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
            except (OSError, subprocess.TimeoutExpired) as error:
                raise InputError(f"{words[0]}: cannot be run ({error}); set CC to a C compiler") from None
            if done.returncode == 0:
                return library.read_bytes()
            lines = done.stderr.strip().splitlines() or ["no message"]
            message = next((x.strip() for x in lines if "error" in x.lower()), lines[0])  # the first names the files
    raise InputError(f"{words[0]}: does not compile the header ({message[:200]}); export the model again")


def _cache() -> Path:
    """A folder that only this user can write to."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(base, "herglotz", "c")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="herglotz-c-"))


def _processor() -> str:
    """What -march=native depends on: a home folder may be shared by machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.platform() + platform.processor()
    return platform.machine() + "".join(sorted({x for x in lines if x.startswith(("model name", "flags", "Features"))}))
