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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from herglotz.data.files import check_seal, private_folder, sealed_bytes, write_atomically
from herglotz.errors import InputError

# No -ffast-math, which flushes denormals of the whole process that loads the library, and drops the compensation of
# rounding. -ffp-contract keeps the fused multiply-adds that -std=c99 turns off.
NATIVE = "-march=native"
FLAGS = ("-std=c99", "-O3", NATIVE, "-fno-math-errno", "-ffp-contract=fast")
SOURCE = "loops.c"
# Variable that names a compiler → its language, the names that are looked for, and the package to install.
COMPILERS = {"CC": ("C", ("cc", "gcc", "clang"), "gcc"), "CXX": ("C++", ("g++", "clang++", "c++"), "g++")}


def compiler(variable: str = "CC") -> list[str]:
    """The compiler of C, or of another language of `COMPILERS`: the variable's value, or the first in the PATH.

    Raise InputError if no compiler is found.
    """
    language, names, wanted = COMPILERS[variable]
    given = shlex.split(os.environ.get(variable, ""))
    for words in [given] if given else [[name] for name in names]:
        found = shutil.which(words[0])
        if found:
            return [found, *words[1:]]
    missing = f"no {language} compiler ({', '.join(names)}) in the PATH"
    if given:
        missing = f"${variable} names '{given[0]}', which is not there"
    raise InputError(f"{missing}; install one, for example with: apt install {wanted}")


def build(header: str, loops: str) -> ctypes.CDLL:
    """The loaded library of C code `loops` that includes the header as "stepper.h"; errors as of `built`."""
    return built("\0".join([header, loops]), lambda: {"stepper.h": header, SOURCE: loops})


def built(key: str, sources: Callable[[], Mapping[str, str]], level: Sequence[str] = ()) -> ctypes.CDLL:
    """The loaded library of these files, of which `SOURCE` is compiled; from the cache if the cache has the library.

    `key` identifies the files in the cache, together with the compiler, its flags and the processor. `level` are
    flags of optimisation in place of -O3. Raise InputError if there is no compiler, or the compiler refuses the files.
    """
    # Compilers take the last of several -O flags.
    words, flags = compiler(), (*FLAGS, *level)
    digest = hashlib.sha256("\0".join([key, *words, *flags, sys.platform, _processor()]).encode()).hexdigest()[:32]
    library = private_folder("c") / f"{digest}.so"
    if not _is_whole(library):
        write_atomically(library, sealed_bytes(_compile(words, sources(), flags)))
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise InputError(f"{library}: cannot be loaded ({error}); check the compiler {words[0]}") from None


def portable_library(sources: Mapping[str, str]) -> bytes:
    """The library of these files, of which `SOURCE` is compiled, for every processor of this kind.

    Raise InputError if there is no compiler, or the compiler refuses the files.
    """
    return _compile(compiler(), sources, [flag for flag in FLAGS if flag != NATIVE])


def _is_whole(library: Path) -> bool:
    """Whether the file is complete: loading half a library would end the process."""
    try:
        check_seal(library.read_bytes(), library)
    except (OSError, InputError):
        return False
    return True


def _compile(words: list[str], sources: Mapping[str, str], flags: Sequence[str]) -> bytes:
    """The shared library, as bytes; without -march=native if the compiler does not know the flag."""
    message = ""
    with tempfile.TemporaryDirectory(prefix="herglotz-") as folder:
        source, library = Path(folder, SOURCE), Path(folder, "loops.so")
        for name, text in sources.items():
            Path(folder, name).write_text(text)
        for options in (flags, [f for f in flags if f != NATIVE]):
            command = [*words, *options, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
            except (OSError, subprocess.TimeoutExpired) as error:
                raise InputError(f"{words[0]}: cannot be run ({error}); set CC to a C compiler") from None
            if done.returncode == 0:
                return library.read_bytes()
            # The first line only names the files.
            lines = done.stderr.strip().splitlines() or ["no message"]
            message = next((x.strip() for x in lines if "error" in x.lower()), lines[0])
    raise InputError(f"{words[0]}: does not compile the header ({message[:200]}); export the model again")


def _processor() -> str:
    """The processor, on which -march=native depends: machines may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.platform() + platform.processor()
    return platform.machine() + "".join(sorted({x for x in lines if x.startswith(("model name", "flags", "Features"))}))
