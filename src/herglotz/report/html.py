"""A document of text, tables, code and pictures, as Markdown and as one HTML file with styles, pictures and script."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Any

from matplotlib.figure import Figure

from herglotz.plots.style import image


@dataclass(frozen=True)
class Table:
    """Rows under a header."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Code:
    """Lines of code for the reader to copy."""

    text: str


@dataclass(frozen=True)
class Picture:
    """A figure with a sentence that explains the figure."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class Slider:
    """An interactive motion: times, data and model of a coordinate, and the last training sample."""

    values: dict[str, Any]
    caption: str


Block = str | Table | Code | Picture | Slider


@dataclass(frozen=True)
class Section:
    """A heading and its blocks."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """A whole report, which begins with a sentence of `herglotz.training.verdict` and its meaning for the reader."""

    title: str
    verdict: str
    meaning: str
    sections: tuple[Section, ...] = field(default_factory=tuple)


COLOURS = {"fits to the noise": "#1b7f4d", "fits, worse": "#b26a00", "does not fit": "#b3261e"}
# A table cell with up to this many characters, a number with its sign, stays on one line on a narrow screen.
MAX_UNBROKEN = 12


def as_html(document: Document) -> str:
    """Return the page as HTML."""
    style = files("herglotz.report").joinpath("report.css").read_text(encoding="utf-8")
    script = files("herglotz.report").joinpath("slider.js").read_text(encoding="utf-8")
    colour = next((c for text, c in COLOURS.items() if document.verdict.startswith(text)), "#444444")
    head = f'<strong style="color:{colour}">{escape(_head(document.verdict))}</strong>'
    contents = "".join(f'<a href="#{_anchor(s.title)}">{escape(s.title)}</a>' for s in document.sections)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(document.title)}</title><style>{style}</style></head><body><main>
<h1>{escape(document.title)}</h1>
<p class="verdict" style="border-color:{colour}">{head}
{escape(document.meaning)}<br><small>{escape(document.verdict)}</small></p>
<nav>{contents}</nav>
{"".join(map(_section, document.sections))}
</main><script>{script}</script></body></html>
"""


def _head(verdict: str) -> str:
    text = verdict.split(":")[0]
    return text[:1].upper() + text[1:] + "."


def _anchor(title: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in title.lower())


def _section(section: Section) -> str:
    body = "".join(map(_block, section.blocks))
    return f'<section id="{_anchor(section.title)}"><h2>{escape(section.title)}</h2>{body}</section>\n'


def _block(block: Block) -> str:
    if isinstance(block, str):
        return f"<p>{escape(block)}</p>"
    if isinstance(block, Code):
        return f"<pre><code>{escape(block.text)}</code></pre>"
    if isinstance(block, Table):
        head = "".join(f"<th>{escape(cell)}</th>" for cell in block.head)
        rows = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in block.rows)
        return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    if isinstance(block, Picture):
        caption = escape(block.caption)
        return f'<figure><img alt="{caption}" src="{_data(block)}"><figcaption>{caption}</figcaption></figure>'
    return _slider(block)


def _cell(text: str) -> str:
    """A table cell; its text stays on one line if it is short."""
    return f"""<td{' class="short"' if len(text) <= MAX_UNBROKEN else ""}>{escape(text)}</td>"""


def _data(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(image(picture.figure, "png")).decode()


def _slider(slider: Slider) -> str:
    values = json.dumps(slider.values, allow_nan=False).replace("<", "\\u003c")
    return (
        '<figure class="slider"><canvas width="900" height="320"></canvas><input type="range" min="0" value="0" '
        f'aria-label="time"><output></output><script type="application/json">{values}</script>'
        f"<figcaption>{escape(slider.caption)}</figcaption></figure>"
    )


def as_markdown(document: Document) -> str:
    """Return text, tables and code as Markdown; the pictures are in the HTML file."""
    parts = [f"# {document.title}", f"**{document.verdict.split(':')[0]}.** {document.meaning}", document.verdict]
    for section in document.sections:
        parts += [f"## {section.title}", *filter(None, map(_text_of, section.blocks))]
    return "\n\n".join(parts) + "\n"


def _text_of(block: Block) -> str:
    if isinstance(block, Code):
        return f"```\n{block.text}\n```"
    if isinstance(block, Table):
        rows = [block.head, ("---",) * len(block.head), *block.rows]
        return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)
    if isinstance(block, (Picture, Slider)):
        return f"*(picture in the HTML file: {block.caption})*"
    return block
