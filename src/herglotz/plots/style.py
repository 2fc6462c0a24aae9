"""The style of every figure. matplotlib's global settings are unchanged, and no display is needed."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea
from matplotlib.ticker import LogFormatter, MaxNLocator
from PIL import Image

from herglotz.choices import FIGURES
from herglotz.data import Trajectories
from herglotz.data.files import PathLike, folder_at, write_atomically
from herglotz.errors import InputError
from herglotz.training.equation_words import raised

# Sharp on a screen of two pixels a point.
DPI = 150
# Colours of Okabe & Ito (2008), distinguishable with every common form of colour blindness and in grey.
INK, MODEL, UNSEEN, ACCENT, MUTED = "#222222", "#0072B2", "#D55E00", "#009E73", "#8A8A8A"
SERIES = (MODEL, UNSEEN, ACCENT, "#CC79A7", "#E69F00", "#56B4E9")
# Backgrounds: of samples outside training, and of the range of the data.
SHADE, SUPPORT = "#FBEDE3", "#EAF2F8"

STYLE: Any = {
    "font.size": 9.5,
    # DejaVu Sans ships with matplotlib: figures are the same on every machine.
    "font.family": "DejaVu Sans",
    "text.color": INK,
    "axes.edgecolor": "#555555",
    "axes.labelcolor": INK,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
}


@contextmanager
def styled() -> Iterator[None]:
    """Set matplotlib's defaults and `STYLE`; restore the caller's settings afterwards."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        yield


class Picture(Figure):
    """A figure that a notebook shows without pyplot: pyplot would keep every figure in a global list."""

    def _repr_png_(self) -> bytes:
        return image(self, "png")


def new_figure(width: float, height: float, title: str) -> Figure:
    """Return an empty figure of this width and height [inches] with a title; no window is opened."""
    figure = Picture(figsize=(width, height), dpi=DPI, layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11.5, fontweight="bold")
    return figure


def save_figure(figure: Figure, path: PathLike) -> None:
    """Write a figure as PNG, SVG or PDF, by the extension of the name; the file appears whole or not at all.

    Raise InputError if the name has another extension, or the file cannot be written.
    """
    form = Path(path).suffix.lower().removeprefix(".")
    if form not in FIGURES:
        raise InputError(f"{path}: a figure's name must end in .{', .'.join(FIGURES)}")
    write_atomically(path, image(figure, form))


def save_all(drawn: dict[str, Figure], folder: PathLike, form: str) -> list[Path]:
    """Write figures by their names into `folder`, which is made if missing; return the files."""
    files = [folder_at(folder) / f"{name}.{form}" for name in drawn]
    for file, figure in zip(files, drawn.values(), strict=True):
        save_figure(figure, file)
    return files


def image(figure: Figure, form: str) -> bytes:
    """Return the bytes of a figure's file, in the form png, svg or pdf."""
    buffer = io.BytesIO()
    with styled():
        if form != "png":
            figure.savefig(buffer, format=form, dpi=DPI)
            return buffer.getvalue()
        # `savefig` would draw the figure twice: the first time for its layout alone.
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba()))
    picture.save(buffer, "PNG", compress_level=1, dpi=(figure.dpi, figure.dpi))
    return buffer.getvalue()


def label(ax: Axes, x: float, y: float, text: str, color: str = INK, **options: Any) -> None:
    """Write `text` beside the data point (x, y), on a white box that hides the lines behind the text."""
    options = {"fontsize": 8.5, "xytext": (4, 4), "ha": "left", "va": "bottom"} | options
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.0}
    ax.annotate(text, (x, y), textcoords="offset points", color=color, bbox=box, **options)


def captions(ax: Axes, entries: list[tuple[str, str]], where: str = "upper left", row: int = 0) -> None:
    """Write (text, colour) entries side by side inside a panel, each in the colour of the curve that it names.

    `row` is the number of lines of captions above these entries.
    """
    areas = [TextArea(text, textprops={"color": color, "fontsize": 8.5}) for text, color in entries]
    line = HPacker(children=list(areas), pad=0, sep=10)
    place: Any = (0.0, 0.0, 1.0, 1.0 - 0.075 * row)
    box = AnchoredOffsetbox(
        where, child=line, pad=0.35, borderpad=0.2, bbox_to_anchor=place, bbox_transform=ax.transAxes
    )
    box.patch.set(facecolor="white", edgecolor="none", alpha=0.85)
    box.set_zorder(5)
    ax.add_artist(box)


def with_unit(name: str, unit: str) -> str:
    """Return the label of an axis: `theta (rad)`, or the name alone for a quantity without unit."""
    return name if unit in ("", "1") else f"{name} ({unit})"


class Powers(LogFormatter):
    """Numbers of a logarithmic axis as text, `20` and `2×10⁻⁵`: matplotlib's parser of formulas takes 0.1 s to load."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the text of a tick; empty for a tick that matplotlib draws without its number."""
        mantissa, _, exponent = f"{x:g}".partition("e")
        power = raised("10", int(exponent)) if exponent else ""
        text = power if mantissa == "1" and power else "×".join(filter(None, (mantissa, power)))
        return text if super().__call__(x, pos) else ""


def logarithmic(ax: Axes) -> None:
    """Make the vertical axis logarithmic."""
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(Powers())
    ax.yaxis.set_minor_formatter(Powers())


def position_axis(ax: Axes, data: Trajectories, i: int) -> None:
    """Label the horizontal axis with coordinate i; ticks are in degrees if the coordinate was recorded in degrees."""
    in_degrees = data.names[i] in data.degrees
    if in_degrees:
        low, high = ax.get_xlim()
        ticks = MaxNLocator(6, steps=[1, 1.5, 2, 3, 4.5, 5, 9, 10]).tick_values(math.degrees(low), math.degrees(high))
        at = [x for x in map(float, ticks) if math.degrees(low) <= x <= math.degrees(high)]
        ax.set_xticks([math.radians(x) for x in at], [f"{x:g}".replace("-", "−") for x in at])
    ax.set_xlabel(with_unit(data.names[i], "deg" if in_degrees else data.units[i]))
