"""Links that leave a page's own place, for a package index and for the documentation site.

`HERGLOTZ_URL=https://… python -m build` makes the README's links absolute, to that address of the repository, and adds
it to the metadata. Without an address such links become plain text and pictures their captions: nothing is broken.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def elsewhere(text: str, folder: Path, leaves: Callable[[str], bool]) -> str:
    """The Markdown with every link whose target `leaves`, relative to `folder`, made absolute or plain."""
    home = os.environ.get("HERGLOTZ_URL", "").rstrip("/")

    def mended(match: re.Match[str]) -> str:
        mark, caption, target, anchor = match.groups("")
        if re.match(r"[a-z]+:|#", target) or not leaves(target):
            return match[0]
        path = (folder / target).resolve().relative_to(ROOT)
        if home:
            return f"{mark}[{caption}]({home}/{'raw' if mark else 'blob'}/main/{path}{anchor})"
        return f"*{caption}*" if mark else caption

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)", mended, text)


try:
    from hatchling.metadata.plugin.interface import MetadataHookInterface  # pyright: ignore[reportMissingImports]
# The documentation site imports `elsewhere` alone, and needs no hatchling.
except ImportError:
    MetadataHookInterface = object


class ReadmeHook(MetadataHookInterface):  # pyright: ignore[reportGeneralTypeIssues]
    """Called by hatchling: README and addresses of the package."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Fill in what pyproject.toml calls dynamic."""
        text = (ROOT / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": elsewhere(text, ROOT, lambda _: True)}
        home = os.environ.get("HERGLOTZ_URL", "").rstrip("/")
        if home:
            own = {"Source": home, "Issues": f"{home}/issues", "Changelog": f"{home}/blob/main/CHANGELOG.md"}
            metadata["urls"] = own
