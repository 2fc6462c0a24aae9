"""Functions that the subcommands share: argparse types, checks of output paths, tables, JSON."""

from __future__ import annotations

import argparse
import gc
import json
import math
import shlex
import sys
import tempfile
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from herglotz.errors import InputError, no_such_file

if TYPE_CHECKING:
    from herglotz.training import Run

# Exit code of a fit that does not follow its data. The run is written nevertheless.
NO_FIT = 3
# Width of a terminal when it opens.
COLUMNS = 80
# The step that `tune` chose, in the folder of its result, if `tune` chose kicks.
KICKS = "kicks.h"

# Names and options of a flag or an argument, as argparse takes them.
Flag = tuple[tuple[str, ...], dict[str, Any]]


def flag(*names_and_help: str, **options: Any) -> Flag:
    """A flag from its names, its help and further options of argparse."""
    *names, text = names_and_help
    return tuple(names), {"help": text, **options}


def exit_code(run: Run) -> int:
    """0, or 3 if the run does not fit its data."""
    return NO_FIT if run.metrics.get("verdict", "").startswith("does not fit") else 0


def warn_of_misfit(run: Run, means: str) -> None:
    """Warn on stderr if the run does not fit its data; `means` names the consequence."""
    if exit_code(run):
        say(f"herglotz: warning: the run does not fit its data: {means}; fit it better first", sys.stderr)


def import_torch() -> None:
    """Import torch, and exclude its objects from garbage collection.

    torch makes a million objects that live as long as the process. Collections during the import and at the end of
    Python took 0.7 of the 3.1 s of a command without work.
    """
    # The objects of a program that calls `main` are left to that program.
    if "torch" in sys.modules:
        return
    gc.disable()
    try:
        import torch as torch
    finally:
        gc.enable()
    gc.freeze()


def positive(text: str) -> float:
    """Parse a finite number > 0 (argparse type)."""
    value = finite(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be > 0, got {text}")
    return value


def finite(text: str) -> float:
    """Parse a finite number (argparse type)."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r}") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be finite, got {text}")
    return value


def count(text: str) -> int:
    """Parse a whole number >= 0 (argparse type)."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number >= 0, got {text!r}")
    return int(text)


def seed(text: str) -> int:
    """Parse a seed of PyTorch's generators, below 2^63 (argparse type)."""
    value = count(text)
    if value >= 2**63:
        raise argparse.ArgumentTypeError(f"must be below 2^63, got {text}")
    return value


def existing(text: str) -> Path:
    """Parse the path of an existing file or folder (argparse type)."""
    if not Path(text).exists():
        raise argparse.ArgumentTypeError(no_such_file(Path(text)))
    return Path(text)


def check_output_file(path: Path, suffixes: Sequence[str], force: bool = False) -> None:
    """Raise InputError unless a file of this name can be written; no file is left behind.

    The extension must be one of `suffixes`, the folder must exist and be writable, the path must be no folder, and a
    file of this name must not exist unless `force` is True.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"--out {path}: the name must end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder; name a file in it")
    if not path.parent.is_dir():
        raise InputError(f"--out {path}: the folder {path.parent} does not exist; make it first")
    if path.exists() and not force:
        raise InputError(f"--out {path}: exists already; choose another name, or overwrite it with --force")
    _probe(path, path.parent)


def check_output_folder(path: Path) -> None:
    """Raise InputError unless this folder exists, or can be made, and is writable; no file is left behind."""
    existing = path
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(f"--out {path}: {existing} is a file, not a folder; choose another folder")
    _probe(path, existing)


def _probe(path: Path, folder: Path) -> None:
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".herglotz-"):
            pass
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written ({error.strerror}); choose another place") from error


def print_json(values: dict[str, Any]) -> None:
    """Print one JSON object; NaN and infinities, which JSON lacks, become null."""
    print(json.dumps(_plain(values), indent=2, allow_nan=False, ensure_ascii=False))


def say(text: str, file: TextIO | None = None) -> None:
    """Print a sentence in lines of at most `COLUMNS` letters; names of files are not broken."""
    lines = textwrap.fill(text, COLUMNS, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    print(lines, file=file)


def print_next(*commands: Sequence[object]) -> None:
    """Print the next commands for a shell: a name with blanks is quoted."""
    for i, command in enumerate(commands):
        print(f"{'      ' if i else 'Next: '}herglotz {shlex.join(map(str, command))}")


def print_next_of(run: Run, out: Path, *commands: Sequence[object]) -> None:
    """Print the next commands for a run in this folder; of a run that does not fit its data, those that say why."""
    if exit_code(run):
        trust = shlex.join(["herglotz", "trust", str(out)])
        say(f"Next: what the verdict says, or {trust}, which says what the data leave open")
    else:
        print_next(*commands)


def complain(message: str) -> None:
    """Print a mistake on stderr: wrapped at a terminal, on one line for logs and other programs."""
    line = f"herglotz: {' '.join(message.split())}"
    if sys.stderr.isatty():
        say(line, sys.stderr)
    else:
        print(line, file=sys.stderr)


def print_table(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values in two aligned columns, wrapped."""
    from herglotz.training.summary import aligned

    print(*aligned(rows), sep="\n")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
