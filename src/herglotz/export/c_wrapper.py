"""The compiled header: a C compiler, a cache of shared libraries, and loops over samples around the header."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from herglotz.data.files import write_atomically
from herglotz.errors import InputError
from herglotz.export.c_header import runtime

# No -ffast-math: a shared library built with it flushes denormals of the whole process, and drops the compensation of
# rounding. Fused multiply-adds are what -std=c99 alone would turn off.
FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast")


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


def build(header: str, name: str) -> ctypes.CDLL:
    """Compile the header with its loops, or take the library from the cache, and load it.

    Raises
    ------
    InputError
        If there is no compiler, or it does not compile the header.
    """
    words = compiler()
    loops = re.sub(r"\bhz_", f"{name}_", runtime("library.c"))
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
