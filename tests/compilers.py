"""The C compiler that the tests find, the mark of what needs one, and its runs."""

import shutil
import subprocess

import pytest

CC = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler in the PATH")


def run_compiler(command, cwd=None):
    """What a compiler said, and its exit code."""
    return subprocess.run([str(x) for x in command], capture_output=True, text=True, check=False, cwd=cwd)
