"""Run the scripts of examples/ cell by cell and write each as a page: `python tools/pages.py [NAME ...]`.

A cell begins with `# %%`; one with `# %% [markdown]` holds text behind `# `. What a cell prints stands below its code,
and so does the value of its last line; a figure becomes a PNG beside the page, in docs/tutorials/.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES, PAGES = ROOT / "examples", ROOT / "docs" / "tutorials"

COLOURS = 128  # of a picture; the most that a colour then changes is 8 of 255, measured


def cells(script: str) -> list[tuple[bool, str]]:
    """Whether a cell is text, and its text or code."""
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
        elif value is not None:
            parts.append(f"```text\n{value}\n```")
    parts.append(f"*This page is `examples/{name}.py`, executed by `python tools/pages.py {name}`.*")
    return "\n\n".join(parts) + "\n"


def main(chosen: list[str]) -> None:
    """Write the pages of these scripts, or of all; each runs in an empty folder."""
    PAGES.mkdir(parents=True, exist_ok=True)
    for name in chosen or sorted(path.stem for path in EXAMPLES.glob("*.py")):
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            written = page(name)
        (PAGES / f"{name}.md").write_text(written, encoding="utf-8")
        print(PAGES / f"{name}.md")


if __name__ == "__main__":
    main(sys.argv[1:])
