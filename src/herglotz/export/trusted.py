"""Which files may run code when they are opened: those that this user's herglotz wrote here, and those told by name.

Opening a C header compiles and loads what stands in it; a `.pt2` file holds machine code (aoti), or graphs whose reader
in torch evaluates text and unpickles. An ONNX file and the folder of a run are read without running anything. Every
file that herglotz writes is remembered by its sha256 in a folder that only this user can write to.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress

from herglotz.codegen.cache import private_folder
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
