"""The contents of a report: sections of text, tables, code and pictures, before they become HTML or Markdown."""

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
    """Lines to copy."""

    text: str


@dataclass(frozen=True)
class Picture:
    """A figure with the sentence that says what it shows."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class Slider:
    """A motion to walk through: times, data and model of each coordinate, and where training ended."""

    values: dict[str, Any]
    caption: str


Block = str | Table | Code | Picture | Slider


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """A whole report; the verdict stands first."""

    title: str
    verdict: str  # one of the sentences of `herglotz.training.verdict`
    meaning: str  # of the verdict for the reader
    sections: tuple[Section, ...] = field(default_factory=tuple)
