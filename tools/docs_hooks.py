"""What `make docs` adds to the pages: the help of the commands, links that leave docs/, tutorials as notebooks."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from tools.pages import notebook  # noqa: E402
from tools.readme import elsewhere  # noqa: E402

TUTORIALS = "tutorials"


def on_files(files: Any, config: Any) -> Any:
    """Called by mkdocs once: every executed tutorial becomes a notebook beside its page."""
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    for path in sorted((ROOT / "docs" / TUTORIALS).glob("*.md")):
        cells = notebook(path.read_text(encoding="utf-8"), path.parent)
        files.append(File.generated(config, f"{TUTORIALS}/{path.stem}.ipynb", content=json.dumps(cells, indent=1)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by mkdocs for every page."""
    if page.file.src_uri.startswith(f"{TUTORIALS}/"):
        markdown += f"\n[Download as a notebook]({Path(page.file.src_uri).stem}.ipynb)\n"
    if "{{ help }}" in markdown:
        return markdown.replace("{{ help }}", helps())
    folder = (ROOT / "docs" / page.file.src_uri).parent
    outside = lambda target: not (folder / target).resolve().is_relative_to(ROOT / "docs")  # noqa: E731
    return elsewhere(markdown, folder, outside)


def helps() -> str:
    """The help of every command."""
    from herglotz.cli.parser import build_parser

    os.environ["COLUMNS"] = "80"
    parser = build_parser()
    action = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    parts = [f"```text\n{parser.format_help().rstrip()}\n```"]
    for name, command in action.choices.items():
        parts.append(f"## herglotz {name}\n\n```text\n{command.format_help().rstrip()}\n```")
    return "\n\n".join(parts)
