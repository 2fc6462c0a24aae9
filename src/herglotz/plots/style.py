"""The style of every figure; matplotlib's global settings stay as they are, and no display is needed."""

from __future__ import annotations

import io
import math
import struct
import zlib
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

from herglotz.data import Trajectories
from herglotz.data.files import PathLike, folder_at, write_atomically
from herglotz.errors import InputError
from herglotz.plots.layout import Panels
from herglotz.training.equation_words import raised

DPI = 150  # sharp on a screen at twice the size
# Okabe & Ito (2008): distinguishable with every common form of colour blindness, and in grey.
INK, MODEL, UNSEEN, ACCENT, MUTED = "#222222", "#0072B2", "#D55E00", "#009E73", "#8A8A8A"
SERIES = (MODEL, UNSEEN, ACCENT, "#CC79A7", "#E69F00", "#56B4E9")
SHADE = "#FBEDE3"  # behind samples outside training
SUPPORT = "#EAF2F8"  # where the data are
FORMATS = ("png", "svg", "pdf")

STYLE: Any = {
    "font.size": 9.5,
    "font.family": "DejaVu Sans",  # ships with matplotlib: the same figure everywhere
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
    """Draw with matplotlib's defaults and this style; the caller's settings are restored afterwards."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        yield


class Picture(Figure):
    """A figure that a notebook shows without pyplot, which would register the figure there."""

    def _repr_png_(self) -> bytes:
        return image(self, "png")


def new_figure(width: float, height: float, title: str) -> Figure:
    """Return an empty figure (inches) with a title; without pyplot there is no window and no global list of figures."""
    figure = Picture(figsize=(width, height), dpi=DPI, layout=Panels())
    figure.suptitle(title, x=0.01, ha="left", fontsize=11.5, fontweight="bold")
    return figure


def save_figure(figure: Figure, path: PathLike) -> None:
    """Write a figure as PNG, SVG or PDF, by the end of the name; the file appears whole or not at all.

    Raise InputError if the name has another end, or the file cannot be written.
    """
    form = Path(path).suffix.lower().removeprefix(".")
    if form not in FORMATS:
        raise InputError(f"{path}: a figure's name must end in .{', .'.join(FORMATS)}")
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
        canvas = FigureCanvasAgg(figure)  # `savefig` would draw twice: once for the layout, without ink
        canvas.draw()
    return _png(np.asarray(canvas.buffer_rgba()), figure.dpi)


def _png(pixels: np.ndarray, dpi: float) -> bytes:
    """The file (PNG, W3C 2003) of pixels (height, width, 4), bytes.

    Rows are not filtered: Pillow tries five filters a row, which took 0.2 of the 1.3 s of a fit's figures, and made
    the files of lines on white larger.
    """
    height, width = pixels.shape[:2]
    rows = np.zeros((height, 1 + 4 * width), dtype=np.uint8)  # a row begins with the filter type: 0, none
    rows[:, 1:] = pixels.reshape(height, -1)
    per_metre = round(dpi / 0.0254)
    parts = {
        b"IHDR": struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0),  # 8 bits of red, green, blue and opacity
        b"pHYs": struct.pack(">IIB", per_metre, per_metre, 1),
        b"IDAT": zlib.compress(rows.tobytes(), 1),
        b"IEND": b"",
    }
    packed = [struct.pack(">I", len(x)) + k + x + struct.pack(">I", zlib.crc32(k + x)) for k, x in parts.items()]
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def label(ax: Axes, x: float, y: float, text: str, color: str = INK, **options: Any) -> None:
    """Write `text` beside the data point (x, y), on a white halo so that lines behind do not disturb it."""
    options = {"fontsize": 8.5, "xytext": (4, 4), "ha": "left", "va": "bottom"} | options
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.0}
    ax.annotate(text, (x, y), textcoords="offset points", color=color, bbox=box, **options)


def captions(ax: Axes, entries: list[tuple[str, str]], where: str = "upper left", row: int = 0) -> None:
    """Write (text, colour) entries in a line inside the panel, each in the colour of the thing named.

    `row` counts lines from the panel's top, for a second line under the first.
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
    """Return an axis label: `theta (rad)`, or the name alone for a number without unit."""
    return name if unit in ("", "1") else f"{name} ({unit})"


class Powers(LogFormatter):
    """Numbers of a logarithmic axis as text, `20` and `2×10⁻⁵`, without matplotlib's parser of formulas."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the text of a tick, empty where matplotlib leaves the number out."""
        mantissa, _, exponent = f"{x:g}".partition("e")
        power = raised("10", int(exponent)) if exponent else ""
        text = power if mantissa == "1" and power else "×".join(filter(None, (mantissa, power)))
        return text if super().__call__(x, pos) else ""


def logarithmic(ax: Axes) -> None:
    """Make the ordinate logarithmic."""
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(Powers())
    ax.yaxis.set_minor_formatter(Powers())


def position_axis(ax: Axes, data: Trajectories, i: int) -> None:
    """Name the lower axis after coordinate i, in rad or a length; ticks are in deg if the table was."""
    in_degrees = data.names[i] in data.degrees
    if in_degrees:
        low, high = ax.get_xlim()
        ticks = MaxNLocator(6, steps=[1, 1.5, 2, 3, 4.5, 5, 9, 10]).tick_values(math.degrees(low), math.degrees(high))
        at = [x for x in map(float, ticks) if math.degrees(low) <= x <= math.degrees(high)]
        ax.set_xticks([math.radians(x) for x in at], [f"{x:g}".replace("-", "−") for x in at])
    ax.set_xlabel(with_unit(data.names[i], "deg" if in_degrees else data.units[i]))
