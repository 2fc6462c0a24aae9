"""The recipes of docs/extending.md, executed: one file and one line each, as a reader would write them."""

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from fake_run import fake_run

import herglotz as hz
from herglotz import formats, plots
from herglotz.data import readers
from herglotz.errors import InputError
from herglotz.export import export_run, load_exported
from herglotz.models import TERMS

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "extending.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)


def written(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The file of the page that defines `name`, as a module of herglotz."""
    (code,) = (block for block in BLOCKS if f"def {name}(" in block)
    file = re.search(rf"`src/(herglotz/[\w/]+)\.py`:\n+```python\n{re.escape(code)}", PAGE)
    assert file is not None
    module = ModuleType(file[1].replace("/", "."))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(code, f"{file[1]}.py", "exec"), module.__dict__)
    return module


def line(pattern: str) -> str:
    """The line that the page tells the reader to add."""
    found = re.search(pattern, PAGE)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("block", [x for x in BLOCKS if x.lstrip().startswith(("import", "from herglotz"))])
def test_the_scripts_print_what_they_say(block, capsys, monkeypatch):
    # fails if a term, a feature or a set of one's own is made otherwise than the page shows, or prints something else
    monkeypatch.setitem(TERMS, "coupling_spring", object)  # what the page registers is taken away after the test
    exec(block, {"__name__": "page"})
    shown = capsys.readouterr().out
    for words in re.findall(r"print\(.*\)  # (.*)", block):
        assert all(part in shown for part in words.rpartition(": ")[2].split(", ")), (words, shown)


def test_a_reader(tmp_path, monkeypatch):  # fails if one file and one line are not enough to read `.trk`
    module = written("read_whitespace", monkeypatch)
    one = eval(line(r"`(Format\(.*?read_whitespace\))`"), {"Format": readers.Format, **vars(module)})
    monkeypatch.setattr(readers, "FORMATS", (*readers.FORMATS, one))
    path = tmp_path / "motion.trk"
    path.write_text("\n".join(f"{0.1 * k} {0.2 * k}" for k in range(6)))
    found = hz.load(path, angles=True, show=False)
    assert (found.samples, found.q[5].item(), found.angles) == (6, 1.0, (True,))
    path.write_text("0 1\n0.1 2 3")
    with pytest.raises(InputError, match=r"motion.trk, row 2: 3 numbers where 2 belong"):
        hz.load(path)


def test_a_figure(tmp_path, monkeypatch):  # fails if one file and one line are not enough for `misses.png`
    module = written("plot_misses", monkeypatch)
    figures = eval("{" + line(r"`(\"misses\": plot_misses,)`") + "}", vars(module))
    monkeypatch.setattr(plots, "FIGURES", figures)
    run = fake_run(steps=20)
    assert [x.name for x in plots.save_figures(run, tmp_path)] == ["misses.png"]
    (ax,) = figures["misses"](run).axes
    assert ax.get_ylabel() == "theta (rad)"


def test_a_format(tmp_path, monkeypatch):  # fails if one file and one line are not enough to write and read `.json`
    written("load_json", monkeypatch)
    one = eval("{" + line(r"(?m)^ {4}(\"json\": Format\(.*\)),$") + "}", {"Format": formats.Format})
    monkeypatch.setattr(formats, "FORMATS", formats.FORMATS | one)
    for place in ("export.run_file", "export.load"):
        monkeypatch.setattr(f"herglotz.{place}.FORMATS", formats.FORMATS)
    run = fake_run(steps=20)
    file = load_exported(export_run(run, tmp_path / "motion.json"))
    start = (torch.tensor([[0.3]]).double(), torch.tensor([[0.1]]).double(), torch.zeros(1).double())
    steps = {"h": 0.2, "steps": 5}
    assert torch.equal(file.rollout(*start, **steps).q, run.stepper.rollout(*start, **steps).q)
