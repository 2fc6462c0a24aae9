"""The C compiler that the tests find, the mark of what needs one, and programs that are compiled once."""

import functools
import hashlib
import os
import platform
import shutil
import subprocess
from pathlib import Path

import pytest

CC = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler in the PATH")
KEPT = Path(__file__).parents[1] / "build" / "tests" / "programs"


@functools.cache
def identity(compiler):
    """Version of a compiler, and the processor, on which -march=native depends."""
    options = ["--version"], ["-march=native", "-dM", "-E", "-x", "c", os.devnull]
    said = [subprocess.run([compiler, *x], capture_output=True, text=True, check=False).stdout for x in options]
    return "\0".join([*said, platform.machine()])


def compile_once(command, cwd=None):
    """Run a compiler; a file that it made without a word is kept for both workers and the next run.

    The file is named after -o. It is found by the hash of the command, of the compiler and of the preprocessed source,
    so that another header is compiled again. What the preprocessor or the compiler says is said every time.
    """
    words = [str(x) for x in command]
    run = functools.partial(subprocess.run, capture_output=True, text=True, check=False, cwd=cwd)
    at = words.index("-o")
    output, rest = Path(cwd or "", words[at + 1]), words[:at] + words[at + 2 :]
    source = run([*rest, "-E", "-P"])
    if source.returncode or source.stderr or not source.stdout:
        return run(words)
    places = {str(output.parent), *(str(Path(x).parent) for x in rest if Path(x).is_absolute())}
    named = "\0".join(rest)
    for place in sorted(places, key=len, reverse=True):
        named = named.replace(place, "")
    key = "\0".join([identity(words[0]), named, source.stdout])
    kept = KEPT / hashlib.sha256(key.encode()).hexdigest()
    if not kept.exists():
        done = run(words)
        if done.returncode or done.stderr:
            return done
        KEPT.mkdir(parents=True, exist_ok=True)
        own = kept.with_suffix(f".{os.getpid()}")
        shutil.copy(output, own) if output.is_file() else own.touch()
        own.replace(kept)
    elif output != Path(os.devnull):
        shutil.copy(kept, output)
    return subprocess.CompletedProcess(words, 0, "", "")
