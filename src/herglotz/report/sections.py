"""The contents of a report, independent of HTML and Markdown: sections of text, tables, code and pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure


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
