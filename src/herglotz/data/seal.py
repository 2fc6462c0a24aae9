"""The seal of a file: the file ends with the sha256 of all bytes before, in a place that the format leaves free.

A seal finds damage and careless changes, not malice: whoever changes a file on purpose can seal the file again.
`SECURITY.md` says what that means for files from strangers.
"""

from __future__ import annotations

import hashlib
import re

from herglotz.data.files import PathLike
from herglotz.errors import InputError

# Hexadecimal digits of a sha256.
SIZE = 64
# A zip archive ends with the length of its comment.
EMPTY_ZIP_COMMENT = b"\0\0"
ONNX_KEY = b"sha256"
# An entry of `metadata_props`, field 14 of ModelProto: the message so far and one more entry are again a message.
ONNX_ENTRY = b"\x72" + bytes([4 + len(ONNX_KEY) + SIZE, 0x0A, len(ONNX_KEY)]) + ONNX_KEY + b"\x12" + bytes([SIZE])
TEXT = (b"/* sha256 of all above: ", b" */\n")


def sealed_zip(content: bytes) -> bytes:
    """A zip archive (`.pt2`, `.pt`, `.npz`) whose comment is the hash.

    Raise ValueError if the archive has a comment already: another program wrote the archive.
    """
    if content[-22:-18] != b"PK\5\6" or content[-2:] != EMPTY_ZIP_COMMENT:
        raise ValueError("not a zip archive without a comment")
    return sealed_bytes(content[:-2] + SIZE.to_bytes(2, "little"))


def sealed_onnx(content: bytes) -> bytes:
    """An ONNX model whose last metadata entry is the hash."""
    return sealed_bytes(content + ONNX_ENTRY)


def sealed_text(content: str) -> str:
    """A C header whose last line is the hash, independent of line ends."""
    return sealed_bytes(content.encode() + TEXT[0], TEXT[1]).decode()


def sealed_bytes(content: bytes, tail: bytes = b"") -> bytes:
    """A file whose format ignores trailing bytes, such as a shared library: the content, its hash, and the tail."""
    return content + hashlib.sha256(content).hexdigest().encode() + tail


def check_seal(content: bytes, path: PathLike, remedy: str = "export the model again", text: bool = False) -> None:
    """Raise InputError if the hash is missing (the file is cut, or older than seals) or is not the file's."""
    if text:
        content = content.replace(b"\r\n", b"\n").removesuffix(TEXT[1])
    body, seal = content[:-SIZE], content[-SIZE:]
    if not re.fullmatch(rb"[0-9a-f]{64}", seal):
        raise InputError(
            f"{path}: does not end with its sha256: it was cut off, or this version did not write it; {remedy}"
        )
    if hashlib.sha256(body).hexdigest().encode() != seal:
        raise InputError(f"{path}: its sha256 is not the one it was written with: it was damaged or changed; {remedy}")
