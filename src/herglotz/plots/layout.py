"""Where the panels of a figure lie: room for the labels of every row and column, measured once."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import LayoutEngine
from matplotlib.transforms import Bbox

PAD = 5.0  # points around a panel with its labels, and above and below the title of the figure
LINE = 1.2  # height of a line of text, of its font size
Panel = tuple[Axes, SubplotSpec]


class Panels(LayoutEngine):
    """Gives each row and column of one grid of panels the room that its labels take.

    matplotlib's constrained layout measures every artist of a panel twice and solves for the positions, which took 0.9
    of the 2.4 s of a fit's figures. In one grid the positions follow from the sizes of the labels. Rows come first: the
    ticks of an ordinate depend on its height, and the height of a label under the abscissa on nothing. Texts inside a
    panel get no room, and a bar of colours has no place: figures with one keep the constrained layout.
    """

    _adjust_compatible = True
    _colorbar_gridspec = False

    def execute(self, fig: Figure) -> None:
        """Place every panel of the grid of `fig`."""
        panels = [(ax, spec) for ax in fig.axes if (spec := ax.get_subplotspec()) is not None]
        if not panels:
            return
        grid, point = panels[0][1].get_gridspec(), fig.dpi / 72
        pad, renderer = PAD * point, fig._get_renderer()  # type: ignore[attr-defined]
        above, below = np.full((2, grid.nrows), pad)
        left, right = np.full((2, grid.ncols), pad)
        for ax, spec in panels:
            under, beyond = _room(ax, ax.xaxis, renderer)
            above[spec.rowspan.start] = max(above[spec.rowspan.start], _heading(ax) * point + pad)
            below[spec.rowspan.stop - 1] = max(below[spec.rowspan.stop - 1], under + pad)
            right[spec.colspan.stop - 1] = max(right[spec.colspan.stop - 1], beyond + pad)
        for title in (text for text in fig.texts if text.get_text() == fig.get_suptitle()):
            title.set_y(1.0 - pad / fig.bbox.height)
            above[0] += LINE * float(title.get_fontsize()) * point + pad
        rows = _spans(fig.bbox.height, grid.get_height_ratios(), above, below)
        _place(panels, rows, _spans(fig.bbox.width, grid.get_width_ratios(), left, right))
        for ax, spec in panels:
            left[spec.colspan.start] = max(left[spec.colspan.start], _room(ax, ax.yaxis, renderer)[0] + pad)
        _place(panels, rows, _spans(fig.bbox.width, grid.get_width_ratios(), left, right))


def _room(ax: Axes, axis: Axis, renderer: Any) -> tuple[float, float]:
    """Pixels that an axis takes outside its panel: across the axis, and beyond its upper end."""
    if not (ax.axison and ax.get_visible()):
        return 0.0, 0.0
    k, point = 0 if axis is ax.yaxis else 1, renderer.dpi / 72
    low, high = ax.bbox.min[1 - k], ax.bbox.max[1 - k]
    # Each call finds all ticks anew, and between ticks a linear axis has no numbers.
    numbers = [*axis.get_majorticklabels(), *(axis.get_minorticklabels() if axis.get_scale() == "log" else ())]
    texts = [text for text in numbers if text.get_text()]
    # Ticks beyond the limits have texts, too, which are not drawn.
    boxes = [box for text in texts if low - 1 < _middle(box := text.get_window_extent(renderer), 1 - k) < high + 1]
    across = axis.get_tick_padding() * point + max((box.size[k] for box in boxes), default=0.0)
    if axis.label.get_text():
        across += axis.labelpad * point + axis.label.get_window_extent(renderer).size[k]
    return float(across), max((float(box.max[1 - k] - high) for box in boxes), default=0.0)


def _middle(box: Bbox, k: int) -> float:
    return float(box.min[k] + box.max[k]) / 2


def _heading(ax: Axes) -> float:
    """Points above a panel: its title, and the factor of all numbers of the ordinate (1e−9)."""
    if not (ax.axison and ax.get_visible()):
        return 0.0
    formatter = ax.yaxis.get_major_formatter()
    formatter.format_ticks([float(y) for y in ax.yaxis.get_majorticklocs()])
    size = max(float(text.get_fontsize()) for text in (ax.title, ax.yaxis.get_offset_text()))
    lines = any(ax.get_title(loc=where) for where in ("left", "center", "right")) + bool(formatter.get_offset())
    return lines * (LINE * size + PAD)


def _spans(length: float, ratios: Any, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Begin and end of every row or column, as shares of a length, (2, …): the rest is shared out by the ratios."""
    shares = np.asarray(ratios, dtype=float)
    sizes = max(length - before.sum() - after.sum(), 1.0) * shares / shares.sum()
    ends = np.cumsum(before + sizes + after) - after
    return np.stack([ends - sizes, ends]) / length


def _place(panels: list[Panel], rows: np.ndarray, columns: np.ndarray) -> None:
    for ax, spec in panels:
        x, end = float(columns[0, spec.colspan.start]), float(columns[1, spec.colspan.stop - 1])
        top, bottom = float(rows[0, spec.rowspan.start]), float(rows[1, spec.rowspan.stop - 1])
        ax.set_position((x, 1.0 - bottom, end - x, bottom - top))
        ax.set_in_layout(True)  # `set_position` takes a panel out of what a notebook cuts a figure to
