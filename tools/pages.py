"""Run the scripts of examples/ cell by cell and write each as a page: `python tools/pages.py [NAME ...]`.

A cell begins with `# %%`; one with `# %% [markdown]` holds text behind `# `. What a cell prints stands below its code,
and so does the value of its last line; a figure becomes a PNG beside the page, in docs/tutorials/, and an animation a
GIF. `make docs` offers each page as a notebook (`notebook`), with what was shown; `--notebooks FOLDER`
writes these files alone, and runs nothing.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES, PAGES = ROOT / "examples", ROOT / "docs" / "tutorials"
# Colours of a picture: with 128 no colour changes by more than 8 of 255, measured.
COLOURS = 128


def cells(script: str) -> list[tuple[bool, str]]:
    """(True, text) or (False, code) of every cell of a script."""
    found = []
    for part in re.split(r"^# %%", script, flags=re.M)[1:]:
        kind, _, body = part.partition("\n")
        text = kind.strip() == "[markdown]"
        found.append((text, re.sub(r"^# ?", "", body, flags=re.M).strip() if text else body.strip("\n")))
    return found


def run(code: str, names: dict[str, Any]) -> tuple[str, Any]:
    """What a cell prints, and the value of its last line."""
    tree, printed, value = ast.parse(code), io.StringIO(), None
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
        exec(compile(tree, "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    return printed.getvalue(), value


def page(name: str) -> str:
    """The executed page of a script; its figures are written."""
    from matplotlib.figure import Figure
    from PIL import Image

    from herglotz.plots import save_figure
    from herglotz.plots.animation import Animation

    script = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    parts, names, drawn = [], {"__name__": "__main__"}, 0
    for text, body in cells(script):
        if text:
            parts.append(body)
            continue
        printed, value = run(body, names)
        parts.append(f"```python\n{body}\n```")
        if printed.strip():
            parts.append(f"```text\n{printed.rstrip()}\n```")
        if isinstance(value, Figure):
            drawn += 1
            save_figure(value, "figure.png")
            few = Image.open("figure.png").convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
            few.save(PAGES / f"{name}-{drawn}.png", optimize=True)
            parts.append(f"![{value.get_suptitle()}]({name}-{drawn}.png)")
        elif isinstance(value, Animation):
            (PAGES / f"{name}-{value.path.name}").write_bytes(value.path.read_bytes())
            parts.append(f"![{value.path.stem}]({name}-{value.path.name})")
        elif value is not None:
            parts.append(f"```text\n{value}\n```")
    parts.append(f"*This page is `examples/{name}.py`, executed by `python tools/pages.py {name}`.*")
    return "\n\n".join(parts) + "\n"


def notebook(written: str, folder: Path) -> dict[str, Any]:
    """An executed page as a Jupyter notebook (nbformat 4.5): its text, its code, and what each cell showed."""
    found: list[dict[str, Any]] = []
    for kind, body in parts_of(written):
        if kind in ("markdown", "python"):
            code = {} if kind == "markdown" else {"execution_count": None, "outputs": []}
            name = "markdown" if kind == "markdown" else "code"
            found.append({"cell_type": name, "id": f"cell-{len(found)}", "metadata": {}, "source": body, **code})
            continue
        if kind == "text":
            output = {"output_type": "stream", "name": "stdout", "text": body + "\n"}
        else:
            picture = base64.b64encode((folder / body).read_bytes()).decode()
            data = {f"image/{Path(body).suffix[1:]}": picture}
            output = {"output_type": "display_data", "metadata": {}, "data": data}
        found[-1]["outputs"].append(output)
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": kernel, "cells": found}


def parts_of(written: str) -> list[tuple[str, str]]:
    """An executed page in pieces: markdown, python, text (what was printed) and picture (its file)."""
    found = []
    pattern = r"^```(\w+)\n(.*?)\n```$|^!\[[^\n]*\]\(([\w.-]+)\)$"
    at = 0
    for match in [*re.finditer(pattern, written, re.M | re.S), None]:
        between = written[at : match.start() if match else None].strip()
        found += [("markdown", between)] if between else []
        if match:
            found.append((match[1], match[2]) if match[1] else ("picture", match[3]))
            at = match.end()
    return found


def write_notebooks(folder: Path) -> None:
    """Write every executed page as a notebook into a folder; made if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(PAGES.glob("*.md")):
        cells = notebook(path.read_text(encoding="utf-8"), PAGES)
        (folder / f"{path.stem}.ipynb").write_text(json.dumps(cells, indent=1), encoding="utf-8")
        print(folder / f"{path.stem}.ipynb")


def main(chosen: list[str]) -> None:
    """Write the pages of these scripts, or of all; each runs in an empty folder."""
    if chosen[:1] == ["--notebooks"] and len(chosen) == 2:
        write_notebooks(Path(chosen[1]))
        return
    PAGES.mkdir(parents=True, exist_ok=True)
    for name in chosen or sorted(path.stem for path in EXAMPLES.glob("*.py")):
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            written = page(name)
        (PAGES / f"{name}.md").write_text(written, encoding="utf-8")
        print(PAGES / f"{name}.md")


if __name__ == "__main__":
    main(sys.argv[1:])
