"""Public names and flags are frozen in a file: a change of either is a change that users see, made on purpose.

`python tests/unit/test_public_surface.py` writes the file again; the difference then belongs into CHANGELOG.md.
"""

import argparse
import inspect
from enum import Enum
from pathlib import Path

import herglotz as hz
from herglotz.cli.parser import build_parser

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "public_surface.txt"


def has_no_signature(value: object) -> bool:
    """Whether this is an exception or an enumeration: the signatures of these are Python's, and change with it."""
    return isinstance(value, type) and issubclass(value, (Exception, Enum))


def surface() -> list[str]:
    """One line a public name with its parameters, and one a subcommand with its flags."""
    lines = []
    for name in sorted(hz.__all__):
        value = getattr(hz, name)
        parameters = () if has_no_signature(value) else inspect.signature(value).parameters
        lines.append(f"hz.{name}({', '.join(parameters)})")
    lines += [f"Run.{name}" for name in sorted(vars(hz.Run)) if not name.startswith("_")]
    commands = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    for name, command in sorted(commands.choices.items()):
        flags = sorted(flag for flag in command._option_string_actions if flag.startswith("--") and flag != "--help")
        lines.append(f"herglotz {name} {' '.join(flags)}")
    return lines


def test_public_names_and_flags_are_the_frozen_ones():
    # fails if a name, parameter or flag is renamed, lost or added without the golden file
    assert surface() == GOLDEN.read_text(encoding="utf-8").splitlines(), "see the first lines of this test's file"


if __name__ == "__main__":
    GOLDEN.write_text("\n".join(surface()) + "\n", encoding="utf-8")
