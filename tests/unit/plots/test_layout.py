"""Panels do not overlap; files have the pixels that were drawn; numbers of logarithmic axes; arrows of the flow."""

from itertools import combinations
from typing import Any, cast

import numpy as np
import pytest
from fake_run import fake_run
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from herglotz.plots import plot_plan, plot_trajectory, save_figure
from herglotz.plots.phase import _draw_flow
from herglotz.plots.style import logarithmic, new_figure, styled

# Text is placed on whole pixels.
PIXEL = 1.0


def drawn(figure: Figure) -> Figure:
    with styled():
        FigureCanvasAgg(figure).draw()
    return figure


def test_nothing_overlaps_and_nothing_is_cut_off():
    # fails if figures have no layout engine: labels, titles and panels then lie over each other
    figure: Any = drawn(plot_trajectory(fake_run(trajectories=5, steps=20)))
    with styled():
        boxes = [ax.get_tightbbox() for ax in figure.axes]
    for box in boxes:
        assert (box.min > -PIXEL).all()
        assert (box.max < figure.bbox.max + PIXEL).all()
    for one, other in combinations(boxes, 2):
        assert (np.maximum(one.min, other.min) > np.minimum(one.max, other.max) - PIXEL).any()


def test_a_picture_is_drawn_once(tmp_path, monkeypatch):  # fails if `savefig` draws it for its layout, and again
    count, draw = [], Figure.draw
    monkeypatch.setattr(Figure, "draw", lambda self, renderer: (count.append(1), draw(self, renderer)))
    save_figure(plot_plan(fake_run(steps=12)), tmp_path / "plan.png")
    assert len(count) == 1


def test_a_file_has_the_pixels_that_were_drawn(tmp_path):  # fails if rows shift, or colours, opacity or dpi are lost
    figure = plot_plan(fake_run(steps=12))
    save_figure(figure, tmp_path / "plan.png")
    with styled(), Image.open(tmp_path / "plan.png") as read:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        assert np.array_equal(np.asarray(read), np.asarray(canvas.buffer_rgba()))
        assert read.info["dpi"] == pytest.approx((150, 150), abs=0.0127)  # the file counts whole pixels a metre


def numbers(low: float, high: float) -> list[str]:
    with styled():
        figure = new_figure(4.0, 4.0, "A title")
        ax = figure.subplots()
        ax.plot([low, high])
        logarithmic(ax)
    drawn(figure)
    texts = [text.get_text() for text in ax.get_yticklabels(which="both")]
    assert "$" not in "".join(texts)  # no formula, whose parser takes a tenth of a second to load
    return [text for text in texts if text]


def test_numbers_of_a_logarithmic_axis():  # fails if a power of ten is written otherwise, or its factor is lost
    assert {"10⁻⁹", "10⁻⁷"} <= set(numbers(1e-10, 1e-5))
    assert {"2×10⁻⁸", "6×10⁻⁸"} <= set(numbers(2e-8, 7e-8))
    assert {"20", "60"} <= set(numbers(15, 90))
    assert {"0.1", "10", "1000"} <= set(numbers(0.1, 1e4))
    assert len(numbers(1e-10, 1e-5)) < 10  # fails if each of nine minor ticks has its number


def test_arrows_point_where_time_goes():
    turn = np.linspace(0.0, 3.0, 30)
    circle = np.stack([np.cos(turn), -np.sin(turn)], -1)
    failed = np.where(np.arange(30)[:, None] < 8, 2 * circle, np.nan)
    lost = np.where(np.arange(30)[:, None] < 1, 3 * circle, np.nan)
    rest = np.zeros_like(circle)
    with styled():
        ax = new_figure(4.0, 4.0, "A title").subplots()
        ax.set(xlim=(-2, 2), ylim=(-2, 2))
        _draw_flow(ax, np.stack([circle, failed, lost, rest]))
    lines, heads = cast("Any", ax.collections)
    # fails if a line is drawn beyond its failed step, or one of a single point is
    assert [len(line) for line in lines.get_segments()] == [30, 8, 30]
    for k, line, point in ((0, circle, 8), (1, failed, 7)):  # a quarter of the way, and the end of a short one
        # fails if a head is turned round, or stands elsewhere; a state of rest has none
        assert heads.get_offsets()[k] == pytest.approx(line[point])
        ahead = line[point] - line[point - 1]
        assert np.array([heads.U[k], heads.V[k]]) == pytest.approx(ahead / np.linalg.norm(ahead))
    assert len(heads.U) == 2
    drawn(cast("Figure", ax.figure))
