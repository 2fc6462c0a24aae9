"""Whole files: reading and writing, the seal at the end of a file, the lock of a folder, and files that may run code.

Every failure is an `InputError`, and no file is ever half written.

A sealed file ends with the sha256 of all bytes before, in a place that the format leaves free. A seal finds damage and
careless changes, not malice: whoever changes a file on purpose can seal the file again. `SECURITY.md` says what that
means for files from strangers. The lock of a folder names its owner, and the system removes the lock when the process
of the owner ends.

Opening a C header compiles and loads its code. A `.pt2` file holds machine code (AOTInductor), or graphs whose reader
in torch evaluates text and unpickles. An ONNX file and the folder of a run are read without running anything. Every
file that herglotz writes is remembered by its sha256 in a folder that only this user can write to.
"""

from __future__ import annotations

import atexit
import codecs
import errno
import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from herglotz.errors import InputError, no_such_file

try:
    import fcntl
except ImportError:
    # Not a POSIX system: folders are not locked.
    fcntl = None

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


# Hexadecimal digits of a sha256.
DIGITS = 64
# A zip archive ends with the length of its comment.
EMPTY_ZIP_COMMENT = b"\0\0"
ONNX_KEY = b"sha256"
# An entry of `metadata_props`, field 14 of ModelProto: the message so far and one more entry are again a message.
ONNX_ENTRY = b"\x72" + bytes([4 + len(ONNX_KEY) + DIGITS, 0x0A, len(ONNX_KEY)]) + ONNX_KEY + b"\x12" + bytes([DIGITS])
TEXT_SEAL = (b"/* sha256 of all above: ", b" */\n")


def sealed_zip(content: bytes) -> bytes:
    """A zip archive (`.pt2`, `.pt`, `.npz`) whose comment is the hash.

    Raise ValueError if the archive has a comment already: another program wrote the archive.
    """
    if content[-22:-18] != b"PK\5\6" or content[-2:] != EMPTY_ZIP_COMMENT:
        raise ValueError("not a zip archive without a comment")
    return sealed_bytes(content[:-2] + DIGITS.to_bytes(2, "little"))


def sealed_onnx(content: bytes) -> bytes:
    """An ONNX model whose last metadata entry is the hash."""
    return sealed_bytes(content + ONNX_ENTRY)


def sealed_text(content: str) -> str:
    """A C header whose last line is the hash, independent of line ends."""
    return sealed_bytes(content.encode() + TEXT_SEAL[0], TEXT_SEAL[1]).decode()


def sealed_bytes(content: bytes, tail: bytes = b"") -> bytes:
    """A file whose format ignores trailing bytes, such as a shared library: the content, its hash, and the tail."""
    return content + hashlib.sha256(content).hexdigest().encode() + tail


def check_seal(content: bytes, path: PathLike, remedy: str = "export the model again", text: bool = False) -> None:
    """Raise InputError if the hash is missing (the file is cut, or older than seals) or is not the file's."""
    if text:
        content = content.replace(b"\r\n", b"\n").removesuffix(TEXT_SEAL[1])
    body, seal = content[:-DIGITS], content[-DIGITS:]
    if not re.fullmatch(rb"[0-9a-f]{64}", seal):
        raise InputError(
            f"{path}: does not end with its sha256: it was cut off, or this version did not write it; {remedy}"
        )
    if hashlib.sha256(body).hexdigest().encode() != seal:
        raise InputError(f"{path}: its sha256 is not the one it was written with: it was damaged or changed; {remedy}")


# The file that a folder of a run has beside model.pt.
MANIFEST = "manifest.json"


def refuse_weights(path: PathLike) -> None:
    """Raise InputError if a file is of the kind that `torch.save` writes: no recording, run or exported model is."""
    path = Path(path)
    if path.suffix.lower() in (".pt", ".pth"):
        remedy = "in Python, net.load_state_dict takes weights, and fit(data, model=net) gives a run to plot and verify"
        if (path.parent / MANIFEST).is_file():
            remedy = f"the model of a run goes by the folder of the run, {path.parent}"
        raise InputError(f"{path}: is a file of torch.save, and no recording, run or exported model; {remedy}")


LOCK = "fit.lock"
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
            (Path(folder) / LOCK).unlink()
        os.close(handle)


def _taken(folder: Path) -> int:
    """The locked file, open, with this process's number in it."""
    assert fcntl is not None
    path = folder / LOCK
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


# The sha256 of files that this process wrote, for machines on which no folder can remember them.
_written: set[str] = set()


def write_trusted(path: PathLike, content: bytes) -> Path:
    """Write a file, and remember that this user's herglotz wrote it; return the path."""
    write_atomically(path, content)
    digest = hashlib.sha256(content).hexdigest()
    _written.add(digest)
    with suppress(OSError):
        (private_folder("written") / digest).touch(mode=0o600)
    return Path(path)


def check_trusted(content: bytes, path: PathLike, trust_code: bool) -> None:
    """Refuse a file that runs code when it is opened, unless this user wrote it here or `trust_code` is true."""
    digest = hashlib.sha256(content).hexdigest()
    if trust_code or digest in _written or (private_folder("written") / digest).exists():
        return
    raise InputError(
        f"{path}: opening it runs code that it holds, and this user's herglotz did not write it on this machine; if "
        "you trust who did, use --trust-code (Python: trust_code=True), else ask for an .onnx file or the run's folder"
    )
