"""The documentation site, the tutorials and the package's metadata: what can be checked without building them."""

import ast
import base64
import importlib
import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
sys.path.insert(0, str(ROOT))
from tools.pages import cells, main, notebook, page, parts_of  # noqa: E402
from tools.readme import elsewhere  # noqa: E402


def test_every_page_is_in_the_menu():  # fails if a page is added that no reader can reach, or one is gone
    menu = re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M)
    pages = [str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(menu) == sorted(pages)
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert {name for name in pages if f"({name})" not in index} == {"index.md"}


def test_the_style_of_the_site_is_there():  # fails if code in a table breaks inside words because mkdocs finds no style
    (name,) = re.findall(r"^extra_css: \[(.*)\]$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M)
    assert "word-break: normal" in (ROOT / "docs" / name).read_text(encoding="utf-8")


def test_every_name_of_the_reference_exists():  # fails if a function moves and the site's build would end
    text = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    names = re.findall(r"^::: ([\w.]+)$", text, re.M)
    assert len(names) > 20
    for name in names:
        module, _, own = name.rpartition(".")
        if module not in ("herglotz.regressor", "herglotz.environment"):  # which need extras
            assert getattr(importlib.import_module(module), own).__doc__, name


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_a_tutorial_is_its_script(path):
    # fails if a script is changed and its page is not executed again, or a picture is missing
    shown = (ROOT / "docs" / "tutorials" / f"{path.stem}.md").read_text(encoding="utf-8")
    code = [body for text, body in cells(path.read_text(encoding="utf-8")) if not text]
    assert re.findall(r"^```python\n(.*?)\n```$", shown, re.M | re.S) == code
    assert all(text in shown for is_text, text in cells(path.read_text(encoding="utf-8")) if is_text)
    for body in code:
        ast.parse(body)
    for picture in re.findall(r"\]\(([\w-]+\.(?:png|gif))\)", shown):
        assert (ROOT / "docs" / "tutorials" / picture).exists()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_a_tutorial_is_offered_as_a_notebook(path):
    # fails if a cell, an output or a picture of the page is lost on its way into the notebook
    folder = ROOT / "docs" / "tutorials"
    written = (folder / f"{path.stem}.md").read_text(encoding="utf-8")
    made = notebook(written, folder)
    code = [cell for cell in made["cells"] if cell["cell_type"] == "code"]
    assert [c["source"] for c in code] == [body for text, body in cells(path.read_text("utf-8")) if not text]
    outputs = [output for cell in code for output in cell["outputs"]]
    kinds = [kind for kind, _ in parts_of(written)]
    assert len(outputs) == kinds.count("text") + kinds.count("picture") > 0
    assert len({cell["id"] for cell in made["cells"]}) == len(made["cells"])
    for output in outputs:
        for kind, body in output.get("data", {}).items():
            assert base64.b64decode(body)[:4] in {"image/png": [b"\x89PNG"], "image/gif": [b"GIF8"]}[kind]


def test_notebooks_are_written_without_the_site(tmp_path, capsys):
    # fails if a clone without mkdocs has no notebooks, or a cell lacks what the format 4.5 asks for
    main(["--notebooks", str(tmp_path / "notebooks")])
    written = sorted((tmp_path / "notebooks").iterdir())
    assert [path.stem for path in written] == [path.stem for path in EXAMPLES]
    assert capsys.readouterr().out.splitlines() == [str(path) for path in written]
    for path in written:
        made = json.loads(path.read_text(encoding="utf-8"))
        assert (made["nbformat"], made["nbformat_minor"], made["metadata"]["kernelspec"]["name"]) == (4, 5, "python3")
        for cell in made["cells"]:
            extra = {"outputs", "execution_count"} if cell["cell_type"] == "code" else set()
            assert set(cell) == {"cell_type", "id", "metadata", "source"} | extra
            assert re.fullmatch(r"[\w-]{1,64}", cell["id"])
            for output in cell.get("outputs", ()):
                kind = output["output_type"]
                assert set(output) == {"output_type"} | {"stream": {"name", "text"}}.get(kind, {"data", "metadata"})


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_a_tutorial_runs(tmp_path, monkeypatch, path):  # fails if a script no longer does what its page shows
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tools.pages.PAGES", tmp_path)
    shown = page(path.stem)
    assert "does not fit" not in shown
    assert shown.count("](") == (ROOT / "docs" / "tutorials" / f"{path.stem}.md").read_text("utf-8").count("](")


def test_links_of_the_readme_on_a_package_index(monkeypatch):
    # fails if a link of the README leads nowhere on an index: relative there, or to a place that does not exist
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    plain = elsewhere(text, ROOT, lambda _: True)
    assert not re.findall(r"\]\((?!http)[^)]*\)", plain)
    assert "[docs/verification.md]" not in plain
    assert "docs/verification.md says" in plain
    monkeypatch.setenv("HERGLOTZ_URL", "https://example.org/herglotz/")
    full = elsewhere(text, ROOT, lambda _: True)
    assert "](https://example.org/herglotz/blob/main/docs/choosing.md#several-coordinates)" in full
    assert "](https://example.org/herglotz/raw/main/docs/images/trajectory.png)" in full
    assert not re.findall(r"\]\((?!http)[^)]*\)", full)


def test_the_metadata_are_those_of_a_published_package():  # fails if an extra that a message names does not exist
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["license"] == "MIT"
    sources = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    named = set(re.findall(r"herglotz\[(\w+)\]", sources))
    assert named <= set(project["optional-dependencies"])
    assert {"tables", "sklearn"} <= named
