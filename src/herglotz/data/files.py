"""Reading and writing whole files: every failure is an `InputError`, and no file is ever half written."""

from __future__ import annotations

import codecs
import errno
import os
import stat
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from herglotz.errors import InputError, no_such_file

PathLike = str | os.PathLike[str]
# The disk or the user's quota is full.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
# Bytes of units and of Western European words in the files of spreadsheets and motor drives that do not write UTF-8.
WINDOWS = "°µ²³·äöüÄÖÜßáàâçéèêëíìîïñóòôúùûÉÈÀÑ".encode("cp1252")
# Pattern of the temporary names of a file (`tempfile.mkstemp`).
TEMPORARY = ".{}.????????.tmp"


def read_bytes(path: PathLike, most: int = -1) -> bytes:
    """Return the contents of a file, or its first `most` bytes.

    Raise InputError if the path is no file, is a directory, a pipe or a device (which may never end), or if the file is
    empty or not readable.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise InputError(f"{path}: is a pipe or a device, not a file; save its output to a file first")
        with open(path, "rb") as file:
            content = file.read(most)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(no_such_file(path)) from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, not a file; name one file in it") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); check its name and permissions") from error
    if not content:
        raise InputError(f"{path}: the file is empty; check how it was written")
    return content


def read_lines(path: PathLike) -> list[str]:
    r"""Return the lines of a text file, without their ends (\n, \r\n or \r).

    The encoding is UTF-8, UTF-16 with a byte-order mark, or cp1252 with letters of units and Western European words.
    Raise InputError as `read_bytes`, and for any other encoding.
    """
    content = read_bytes(path)
    # Spreadsheets call UTF-16 "Unicode text".
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        if wide or not all(byte < 128 or byte in WINDOWS for byte in set(content)):
            row = content.count(b"\n", 0, error.start) + 1
            raise InputError(
                f"{Path(path)}, row {row}: not UTF-8 text (byte 0x{content[error.start]:02x}); save the file as UTF-8"
            ) from None
        text = content.decode("cp1252")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def write_atomically(path: PathLike, content: bytes) -> None:
    """Write a file under a temporary name in the same folder, then rename it: a crash leaves the old file whole.

    The temporary name is random and the file must not exist (`tempfile.mkstemp`: O_EXCL, O_NOFOLLOW), so that no link
    planted in the folder is written through. The folder is synced after the rename. Raise InputError if the folder does
    not exist or is not writable, the path is a folder, or the disk is full.
    """
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
        try:
            with open(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            # mkstemp makes a private file; `open` would have made a file with these permissions.
            os.chmod(temporary, 0o666 & ~_umask())
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
        _sync(path.parent)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        full = isinstance(error, OSError) and error.errno in NO_ROOM
        remedy = "make room on its disk, or write to another" if full else "check that its folder exists, writable"
        raise InputError(f"{path}: cannot be written ({reason}); {remedy}") from error


def folder_at(path: PathLike) -> Path:
    """Return this folder, made with its parents if missing; raise InputError if the folder cannot be made."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error
    return folder


def remove_leftovers(folder: PathLike, names: Iterable[str]) -> None:
    """Remove the temporary files that a killed writer of these files left; no other writer may be at work."""
    for name in names:
        for path in Path(folder).glob(TEMPORARY.format(name)):
            with suppress(OSError):
                path.unlink()


def _umask() -> int:
    """The process's mask of permissions: the system returns the mask only when a new mask is set."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _sync(folder: Path) -> None:
    """Write the rename itself to the disk, where the system can sync a folder."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        # Some network file systems refuse to sync a folder; the file is written all the same.
        with suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)
