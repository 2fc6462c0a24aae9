"""The list of mutants is of today's sources: `make mutants` refuses to run with one entry that is out of date."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def _entries() -> list[tuple[str, str]]:
    spec = importlib.util.spec_from_file_location("mutant_list", ROOT / "tests" / "mutant_list.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return [entry[:2] for entry in (*module.MUTANTS, *module.ALIKE)]


@pytest.mark.parametrize("file", sorted({file for file, _ in _entries()}))
def test_every_mutant_has_its_line(file):
    # fails if a line was changed and its mutant was not: then no mutant of any room is tried
    text = (ROOT / "src" / "herglotz" / file).read_text(encoding="utf-8")
    assert [old for of, old in _entries() if of == file and old not in text] == []
