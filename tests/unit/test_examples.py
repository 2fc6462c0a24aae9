"""Every public name has an example, and the examples run."""

import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from test_public_surface import GOLDEN

from tests.compilers import CC

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "examples.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)


def test_every_public_name_has_an_example():  # fails if a name becomes public and nobody is shown how it is used
    frozen = GOLDEN.read_text(encoding="utf-8")
    names = re.findall(r"^(hz\.\w+)\(", frozen, re.M) + re.findall(r"^herglotz\..*?(\w+)\(", frozen, re.M)
    names += [f"run.{x}" for x in re.findall(r"^Run\.(\w+)$", frozen, re.M)]
    code = "\n".join(BLOCKS)
    assert [name for name in names if not re.search(rf"\b{re.escape(name)}\b", code)] == []


@pytest.mark.parametrize("first", [3, pytest.param(len(BLOCKS), marks=pytest.mark.slow)])  # files take 10 s more
def test_the_examples_run(tmp_path, monkeypatch, capsys, first):  # fails if an example of the page no longer works
    if first > 3 and CC is None:
        pytest.skip("no C compiler in the PATH")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in BLOCKS[:first]:
        exec(compile(block, str(PAGE), "exec"), names)
    plt.close("all")
    assert names["run"].metrics["verdict"].startswith("fits")
    assert "positions without times" in capsys.readouterr().out
    assert {p.name for p in tmp_path.iterdir()} >= {"motion.csv", "report"}
