"""docs/paper.md names functions and tests, docs/conventions.md functions; here they are looked up."""

import importlib
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
TESTS = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")}


def test_every_function_on_the_page_exists():
    # fails if a function is renamed and the page is not
    conventions = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    names = set(re.findall(r"`((?:mechanics|theory|scenes|stepping|plots)\.[\w.]+)`", PAGE + conventions))
    assert len(names) > 60
    for name in sorted(names):
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(f"herglotz.{module}"), attribute), name


def test_every_test_on_the_page_exists():
    # fails if a test is renamed, moved or dropped and the page still claims it
    named = set(re.findall(r"`(test_\w+\.py)::(\w+)`", PAGE))
    assert len(named) > 50
    missing = [f"{file}::{test}" for file, test in sorted(named) if f"def {test}(" not in TESTS.get(file, "")]
    assert not missing, missing
