"""Public names and flags are frozen in a file: a change of either is a change that users see, made on purpose.

`python tests/unit/test_public_surface.py` writes the file again; the difference then belongs into CHANGELOG.md.
"""

import argparse
import inspect
import re
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import herglotz as hz
from herglotz.cli.parser import build_parser
from herglotz.training.learned_functions import LearnedFunction
from herglotz.training.motion import Motion
from herglotz.training.selection import Selection
from herglotz.training.uncertainty import Bands

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "public_surface.txt"


def has_no_signature(value: object) -> bool:
    """Whether this is an exception or an enumeration: the signatures of these are Python's, and change with it."""
    return isinstance(value, type) and issubclass(value, (Exception, Enum))


def _named(path: str) -> Any:
    home, _, name = path.rpartition(".")
    return getattr(import_module(home), name)


PAGE = (GOLDEN.parents[2] / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
# The regressor and the environment can be imported where their extras are; their own tests look at them.
EXTRAS = re.compile(r"herglotz\.(regressor|environment)\.")
REFERENCE = {path: _named(path) for path in re.findall(r"^::: (\S+)$", PAGE, re.M) if not EXTRAS.match(path)}
PUBLIC = {f"hz.{name}": getattr(hz, name) for name in hz.__all__}
PUBLIC |= {path: value for path, value in REFERENCE.items() if value not in PUBLIC.values()}
OWNERS = (hz.Run, hz.Stepper, hz.Trajectories, hz.State, hz.FitConfig, hz.ModelConfig)
OWNERS += (Motion, Selection, Bands, LearnedFunction)


UNIT = re.compile(r"\bunits?\b|\brad\b|dimensionless|relative to")
# These read, write, draw, hold settings or repeat what another name computes; every other name follows an equation.
WITHOUT_EQUATION = {
    *("Run.export", "Run.last_fitted", "Run.plot", "Run.predict", "Run.report", "Run.rollout", "Run.save"),
    *("Run.states_at_end", "Run.summary", "Run.verify", "hz.Run", "hz.FitConfig", "hz.ModelConfig", "hz.Trajectories"),
    *("hz.compile", "hz.export_pt2", "hz.fit", "hz.load", "hz.load_pt2", "hz.load_run", "hz.save", "hz.save_run"),
    *("hz.scene_names", "hz.simulate", "herglotz.data.anything.as_trajectories", "herglotz.plots.save_figures"),
    *("herglotz.plots.animation.save_animation", "herglotz.report.write.write_report"),
    *("herglotz.training.motion.Motion", "herglotz.training.selection.Selection"),
    *("herglotz.training.selection.select", "herglotz.training.uncertainty.Bands"),
}


def methods(owner: type) -> dict[str, Any]:
    """Public functions of a class, class methods too; `Run` stands in the file with its properties besides."""
    own = {name: getattr(value, "__func__", value) for name, value in vars(owner).items() if not name.startswith("_")}
    return {f"{owner.__name__}.{name}": value for name, value in own.items() if inspect.isfunction(value)}


def _signature(name: str, value: Any) -> str:
    parameters = () if has_no_signature(value) else inspect.signature(value).parameters
    return f"{name}({', '.join(x for x in parameters if x not in ('self', 'cls'))})"


def _flags(command: argparse.ArgumentParser) -> str:
    """Arguments by place, then flags, each with what it can be."""
    found = []
    for action in command._actions:
        names = [flag for flag in action.option_strings if flag.startswith("--")] or [
            str(action.metavar or action.dest)
        ]
        choices = f"={{{','.join(map(str, action.choices))}}}" if action.choices else ""
        found += [name + choices for name in names if name != "--help"]
    return " ".join(sorted(found))


def surface() -> list[str]:
    """One line a public name with its parameters, and one a subcommand with its flags."""
    lines = [_signature(name, value) for name, value in sorted(PUBLIC.items())]
    lines += [f"Run.{name}" for name in sorted(vars(hz.Run)) if not name.startswith("_")]
    lines += [_signature(*one) for owner in OWNERS for one in sorted(methods(owner).items())]
    commands = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return lines + [f"herglotz {name} {_flags(command)}" for name, command in sorted(commands.choices.items())]


def test_every_public_name_is_in_the_reference():
    # fails if a name becomes public and its docstring is on no page, or not under the name that users write
    assert [name for name in hz.__all__ if f"herglotz.{name}" not in REFERENCE] == []


def test_public_names_and_flags_are_the_frozen_ones():
    # fails if a name, parameter or flag is renamed, lost or added without the golden file
    assert surface() == GOLDEN.read_text(encoding="utf-8").splitlines(), "see the first lines of this test's file"


def _callables() -> list[tuple[str, Any]]:
    """Public functions, classes and methods that take something, by name."""
    own = PUBLIC | methods(hz.Run) | methods(hz.Stepper)
    return [(name, value) for name, value in own.items() if not has_no_signature(value)]


@pytest.mark.parametrize("value", [pytest.param(value, id=name) for name, value in _callables()])
def test_a_public_docstring_is_whole(value):
    # fails if a parameter has no words, a tensor no shape, a function not its result or errors
    text = inspect.getdoc(value) or ""
    parameters = inspect.signature(value).parameters
    section = re.split(r"\n\n\w+\n---", text.partition("Parameters\n---")[2])[0]
    told = dict(re.findall(r"^([*\w]+(?:, [*\w]+)*)\n((?: {4}.*\n?)+)", section, re.M))
    words = {one: body for heads, body in told.items() for one in heads.split(", ")}
    own = {str(p).split(":")[0].split("=")[0].strip() for p in parameters.values()}
    own -= {"self", "**start"}  # of a rollout: its entries are told one by one
    if own == {"**settings"} or value is hz.Run.save:
        return  # the docstring names the function that takes them
    assert own <= words.keys()
    tensors = [name for name, p in parameters.items() if "Tensor" in str(p.annotation)]
    assert [name for name in tensors if "(" not in words[name]] == []
    measured = [name for name, p in parameters.items() if re.search("float|Tensor|ndarray", str(p.annotation))]
    without = [name for name in measured if name in words and not UNIT.search(words[name])]
    assert without == [], "say its unit, or that it is dimensionless"
    if inspect.isfunction(value) and own:
        returned = inspect.signature(value).return_annotation
        assert "Raises\n------" in text
        assert returned == "None" or re.search(r"Returns\n-------\n.+\n {4}\S", text)
        assert "Tensor" not in str(returned) or re.search(r"[Ss]hape|\(", text.partition("Returns\n")[2])
        assert not re.search("Tensor|Partials|Linearised|Step$|Prediction", str(returned)) or UNIT.search(
            text.partition("Returns\n")[2]
        )


@pytest.mark.parametrize(("name", "value"), [pytest.param(*one, id=one[0]) for one in _callables()])
def test_what_follows_an_equation_gives_it_and_its_source(name, value):
    # fails if a public name that computes has no formula, or no page that derives it; or a new name is not decided on
    text = inspect.getdoc(value) or ""
    formula, pages = re.search(r"\S [=∘↦≈∈] \S|𝒩\(", text), re.findall(r"docs/([\w/]+\.md)", text)
    if name in WITHOUT_EQUATION:
        return
    assert formula
    assert pages
    assert all((GOLDEN.parents[2] / "docs" / page).exists() for page in pages)


def test_names_without_equation_are_public_names():  # fails if one is renamed and its line stays
    assert {name for name, _ in _callables()} >= WITHOUT_EQUATION


if __name__ == "__main__":
    GOLDEN.write_text("\n".join(surface()) + "\n", encoding="utf-8")
