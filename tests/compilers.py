"""The C compiler that the tests find, and the mark of what needs one."""

import shutil

import pytest

CC = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler in the PATH")
