"""One writer a folder: a lock that names its owner, and that the system removes when the owner's process ends."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from herglotz.data.files import PathLike
from herglotz.errors import InputError

try:
    import fcntl
except ImportError:
    # Not a POSIX system: folders are not locked.
    fcntl = None

NAME = "fit.lock"
# Folders that this process has locked; it may lock a folder inside its own lock.
_locked: set[str] = set()


@contextmanager
def locked(folder: PathLike) -> Iterator[None]:
    """Hold a folder, which is made if missing, for this process alone.

    The system itself holds the lock (`flock`) and releases the lock when the process ends, so that neither a dead
    process nor a reused process number locks a folder. The file holds the owner's number for the error message. In a
    group of `torchrun` the first process locks for all. Raise InputError if another process holds the folder, or the
    folder cannot be written to.
    """
    key = str(Path(folder).resolve())
    if fcntl is None or key in _locked or os.environ.get("RANK", "0") != "0":
        yield
        return
    handle = _taken(Path(folder))
    _locked.add(key)
    try:
        yield
    finally:
        _locked.discard(key)
        with suppress(OSError):
            (Path(folder) / NAME).unlink()
        os.close(handle)


def _taken(folder: Path) -> int:
    """The locked file, open, with this process's number in it."""
    assert fcntl is not None
    path = folder / NAME
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        except OSError as error:
            raise InputError(f"{folder}: cannot be locked ({error.strerror}); choose another folder") from None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.stat(path).st_ino == os.fstat(handle).st_ino:
                os.ftruncate(handle, 0)
                os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
                return handle
        except FileNotFoundError:
            # The owner removed the file between our opening and our locking.
            pass
        except OSError:
            owner = os.pread(handle, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(handle)
            raise InputError(
                f"{folder}: process {owner} is writing a fit there; wait for it, stop it, or choose another folder"
            ) from None
        os.close(handle)
