"""Panels, their labels and the title keep apart, inside the figure; numbers of logarithmic axes; arrows of the flow."""

from itertools import combinations
from typing import Any, cast

import numpy as np
import pytest
from fake_run import fake_run
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from herglotz.plots import plot_plan, plot_trajectory, save_figure
from herglotz.plots.phase import _draw_flow
from herglotz.plots.style import logarithmic, new_figure, styled

LABELLED = {"xlabel": "time (s)", "ylabel": "theta (rad)"}
PIXEL = 1.0  # text is placed on whole pixels


def drawn(figure: Figure) -> Figure:
    with styled():
        FigureCanvasAgg(figure).draw()
    return figure


def grid(rows: int = 2, columns: int = 2, top: float = 1.0, height: float = 5.0, **ratios: Any) -> Figure:
    """A grid of labelled panels; numbers up to `top`, those of the lower left panel a thousand times as large."""
    with styled():
        figure = new_figure(7.0, height, "A title")
        axes = figure.subplots(rows, columns, squeeze=False, **ratios)
        for ax in axes.flat:
            ax.plot([0.0, 16.0], [0.0, 1000 * top if ax is axes[-1, 0] else top])
            ax.set(xlim=(0, 16), title="trajectory 0", **LABELLED)
    return drawn(figure)


def offset(figure: Figure) -> str:
    return figure.axes[0].yaxis.get_offset_text().get_text()


@pytest.mark.parametrize(
    ("kind", "figure"),
    [
        ("plain", lambda: grid()),
        ("wide numbers", lambda: grid(top=123456.0)),
        ("a factor above the ordinate", lambda: grid(top=1e-9)),
        ("one panel", lambda: grid(1, 1)),
        ("a tall one, whose title is not lower", lambda: grid(1, 1, height=16.0)),
        ("a run", lambda: drawn(plot_trajectory(fake_run(trajectories=5, steps=20)))),
    ],
)
def test_nothing_overlaps_and_nothing_is_cut_off(kind, figure):
    # fails if a label, a title, numbers, or their factor (1e−9) get no room, or that of another row or column
    figure = figure()
    assert ("1e" in offset(figure)) == (kind == "a factor above the ordinate")
    boxes = [ax.get_tightbbox() for ax in figure.axes]
    for box in boxes:
        assert (box.min > -PIXEL).all()
        assert (box.max < figure.bbox.max + PIXEL).all()
    for one, other in combinations(boxes, 2):
        assert (np.maximum(one.min, other.min) > np.minimum(one.max, other.max) - PIXEL).any()
    (title,) = (text for text in figure.texts if text.get_text() == figure.get_suptitle())
    extent = title.get_window_extent()
    assert max(box.max[1] for box in boxes) < extent.min[1] + PIXEL
    assert extent.max[1] < figure.bbox.max[1]


def test_room_is_not_wasted():  # fails if pads add up: panels and their labels fill the figure but for 12 points
    figure = grid()
    low, high = (np.array([getattr(ax.get_tightbbox(), end) for ax in figure.axes]) for end in ("min", "max"))
    point = figure.dpi / 72
    assert (low.min(0) < 12 * point).all()
    assert (high.max(0) > figure.bbox.max - np.array([12, 32]) * point).all()


def test_panels_are_in_line_and_have_their_ratios():  # fails if a panel has the size that its own labels leave
    figure = grid(height_ratios=[2.4, 1.0], width_ratios=[1.0, 2.0])
    places = [ax.get_position() for ax in figure.axes]
    assert places[0].x0 == places[2].x0
    assert places[0].y1 == places[1].y1
    assert places[1].width == pytest.approx(2 * places[0].width)
    assert places[0].height == pytest.approx(2.4 * places[2].height)


def test_a_panel_may_take_several_cells():  # fails if its end, or its label, is that of its first cell
    with styled():
        figure = new_figure(7.0, 4.0, "A title")
        cells = figure.add_gridspec(2, 2)
        upper, lower, right = (figure.add_subplot(cells[where]) for where in ((0, 0), (1, 0), (slice(None), 1)))
        right.set_xlabel("time (s)")
    drawn(figure)
    assert cast("Bbox", right.get_tightbbox()).min[1] > -PIXEL
    assert right.get_position().y1 == pytest.approx(upper.get_position().y1)
    assert right.get_position().y0 == pytest.approx(lower.get_position().y0)


def test_drawn_again_nothing_moves():  # fails if labels are measured at other heights than those they are drawn at
    figure = grid(3, 2)
    before = [ax.get_position().bounds for ax in figure.axes]
    drawn(figure)
    assert before == [pytest.approx(ax.get_position().bounds, abs=1e-3) for ax in figure.axes]


def test_a_panel_without_axes_needs_no_room():  # fails if hidden numbers are measured
    (place,) = (ax.get_position() for ax in drawn(plot_plan(fake_run(steps=12))).axes)
    assert place.width > 0.97


def test_a_cut_to_the_ink_keeps_the_panels():  # fails if panels are taken out of what bbox_inches="tight" looks at
    assert all(ax.get_in_layout() for ax in grid().axes)


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
