"""Which files may run code when they are opened: files that this user wrote on this machine, and files named as such.

Opening a C header compiles and loads its code. A `.pt2` file holds machine code (AOTInductor), or graphs whose reader
in torch evaluates text and unpickles. An ONNX file and the folder of a run are read without running anything. Every
file that herglotz writes is remembered by its sha256 in a folder that only this user can write to.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from herglotz.codegen.c_compiler import private_folder
from herglotz.data.files import PathLike, write_atomically
from herglotz.errors import InputError

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
