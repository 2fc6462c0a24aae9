"""Folders that no other user can write to: a cache of compiled libraries and of checked files."""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path


def private_folder(name: str) -> Path:
    """A folder of ~/.cache/herglotz (or $XDG_CACHE_HOME) that no other user can write to.

    A temporary folder of this process replaces a folder that cannot be made or is not private.
    """
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(base, "herglotz", name)
    with suppress(OSError):
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        if _is_private(folder) and os.access(folder, os.W_OK):
            return folder
    return _temporary(name)


def _is_private(folder: Path) -> bool:
    """Whether the path is a folder, not a link, that this user owns and no other user can write to."""
    if not hasattr(os, "getuid"):
        return True
    found = folder.lstat()
    others = stat.S_IWGRP | stat.S_IWOTH
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & others


@cache
def _temporary(name: str) -> Path:
    folder = tempfile.mkdtemp(prefix=f"herglotz-{name}-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
