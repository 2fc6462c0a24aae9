"""Which files may run code when they are opened: those that this user's herglotz wrote here, and those told by name.

Opening a C header compiles and loads what stands in it; a `.pt2` file holds machine code (aoti), or graphs whose reader
in torch evaluates text and unpickles. An ONNX file and the folder of a run are read without running anything. Every
file that herglotz writes is remembered by its sha256 in a folder that only this user can write to.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

from herglotz.data.files import PathLike
from herglotz.errors import InputError

_here: set[str] = set()  # what this process wrote, where no folder can remember it


def remember(content: bytes) -> None:
    """Note that this user's herglotz wrote this file."""
    digest = hashlib.sha256(content).hexdigest()
    _here.add(digest)
    with suppress(OSError):
        (private_folder("written") / digest).touch(mode=0o600)


def check_trusted(content: bytes, path: PathLike, trust_code: bool) -> None:
    """Refuse a file that runs code when it is opened, unless it was written here or `trust_code` is true."""
    digest = hashlib.sha256(content).hexdigest()
    if trust_code or digest in _here or (private_folder("written") / digest).exists():
        return
    raise InputError(
        f"{path}: opening it runs code that it holds, and this user's herglotz did not write it on this machine; if "
        "you trust who did, use --trust-code (Python: trust_code=True), else ask for an .onnx file or the run's folder"
    )


def private_folder(name: str) -> Path:
    """A folder of ~/.cache/herglotz (or $XDG_CACHE_HOME) that no other user can write to.

    Where there can be none (no home, another owner, writable for others), it is one of this process alone.
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
    """Whether this user owns the folder, which is no link, and no other can write to it."""
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
