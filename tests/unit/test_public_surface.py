"""Public names and flags are frozen in a file: a change of either is a change that users see, made on purpose.

`python tests/unit/test_public_surface.py` writes the file again; the difference then belongs into CHANGELOG.md.
"""

import argparse
import inspect
import re
from enum import Enum
from pathlib import Path
from typing import Any

import pytest

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


def _callables() -> list[tuple[str, Any]]:
    """Public functions, classes and methods that take something, by name."""
    own = [(f"hz.{name}", getattr(hz, name)) for name in hz.__all__]
    own += [
        (f"{owner.__name__}.{name}", value)
        for owner in (hz.Run, hz.Stepper)
        for name, value in vars(owner).items()
        if inspect.isfunction(value) and not name.startswith("_")
    ]
    return [(name, value) for name, value in own if not has_no_signature(value)]


@pytest.mark.parametrize("value", [pytest.param(value, id=name) for name, value in _callables()])
def test_a_public_docstring_is_whole(value):
    # fails if a parameter has no words, or a function does not say what it returns and when it raises
    text = inspect.getdoc(value) or ""
    parameters = {str(p).split(":")[0].split("=")[0].strip() for p in inspect.signature(value).parameters.values()}
    section = re.split(r"\n\n\w+\n---", text.partition("Parameters\n---")[2])[0]
    heads = re.findall(r"^([*\w]+(?:, \w+)*)$", section, re.M)
    own = parameters - {"self", "**start"}  # of a rollout: its entries are told one by one
    if own == {"**settings"} or value is hz.Run.save:
        return  # the docstring names the function that takes them
    assert own <= {one for head in heads for one in head.split(", ")}
    if inspect.isfunction(value) and own:
        assert "Raises\n------" in text
        assert "Returns\n-------" in text or value.__annotations__["return"] == "None"


if __name__ == "__main__":
    GOLDEN.write_text("\n".join(surface()) + "\n", encoding="utf-8")
