"""The figures of S^k for anything that has an L_d, and the paper's two figures from the package."""

from typing import Any

import numpy as np
import pytest
import torch
from fake_run import fake_run
from matplotlib.text import Text

from herglotz.cli import main
from herglotz.errors import InputError
from herglotz.plots import IDENTITIES, save_theory_figures
from herglotz.plots.fan import point_fan, spread_fan
from herglotz.plots.hamilton_jacobi import (
    STEPS,
    plot_hamilton_jacobi_residual,
    plot_momentum_vs_generating_function,
)
from herglotz.scenes import scene


def pendulum(q0, q1, s0, h):
    v = (q1 - q0) / h[..., None]
    return h * ((v * v / 2 + torch.cos(q0)).sum(-1) - 0.2 * s0)


STATES = (
    torch.linspace(-1, 1, 8).double()[:, None],
    torch.linspace(0.5, 1, 8).double()[:, None],
    torch.zeros(8).double(),
)
SOURCES = {
    "lambda": (pendulum, {"h": 0.1}),
    "pair": ((pendulum, STATES), {"h": 0.1}),
    "scene": (scene("damped_pendulum"), {}),
    "run": (fake_run(steps=12), {}),
}


@pytest.mark.parametrize("kind", SOURCES)
def test_anything_with_an_L_d_is_drawn(tmp_path, kind):
    # fails if a figure needs a run, or draws states that are not of this source
    source, options = SOURCES[kind]
    written = save_theory_figures(source, tmp_path / "new", **options)
    assert [path.name for path in written] == [f"{name}.png" for name in IDENTITIES]
    assert all(path.stat().st_size > 10_000 for path in written)


def test_the_command_draws_the_papers_figures(tmp_path, capsys):
    # fails if the figures of the paper need the script in train/, or --theory takes no name of a scene
    assert main(["plot", "parachute", "--theory", "--out", str(tmp_path)]) == 0
    names = [*(f"{name}.png" for name in IDENTITIES), "parachute_map.png", "parachute_fall.png"]
    assert capsys.readouterr().out.split() == [str(tmp_path / name) for name in names]
    assert all((tmp_path / name).is_file() for name in names)


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [(pendulum, {}, "h must be given"), ("servo_axis", {}, "no contact map"), ("nothing", {}, "no such scene")],
)
def test_what_has_no_figure_says_why(tmp_path, source, options, message):
    # fails if a source without S^k ends in a traceback, or leaves a folder behind
    with pytest.raises(InputError, match=message):
        save_theory_figures(source, tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()


def test_both_fans_of_a_run_take_the_step_that_is_asked_for():
    # fails if one of them keeps the step of the run
    run = fake_run(steps=12)
    for fan in (spread_fan, point_fan):
        assert (fan(run, 5).h, fan(run, 5, 0.05).h) == (run.h, 0.05)


def test_the_momentum_is_drawn_against_the_actions_derivative():
    # fails if the line y = x misses the points, a number is another one's, or the title says less than what is drawn
    axes: Any = plot_momentum_vs_generating_function(pendulum, h=0.1).axes
    left, right = axes
    diagonal, points = left.lines
    p, dS = points.get_data()
    assert len(p) == 32 * STEPS
    assert list(diagonal.get_xdata()) == list(diagonal.get_ydata()) == [min(p.min(), dS.min()), max(p.max(), dS.max())]
    largest = np.abs(p - dS).max()
    assert largest < 1e-12  # rounding: 1e-14 measured
    assert p.max() - p.min() > 0.5
    drawn = right.lines[:STEPS]
    assert [set(line.get_xdata()) for line in drawn] == [{float(k)} for k in range(1, STEPS + 1)]
    assert max(line.get_ydata().max() for line in drawn) == largest
    assert right.lines[STEPS].get_ydata()[0] == largest
    assert right.get_ylim()[0] < min(line.get_ydata().min() for line in drawn)
    assert list(right.get_xticks()) == list(range(1, STEPS + 1))
    assert right.get_ylim()[1] >= 1e3 * largest
    assert f"{largest:.1e}" in left.figure.get_suptitle()


def test_the_residual_is_rounding_on_the_flow_and_a_square_off_it():
    # fails if a column stands at another momentum, the null experiment is on the flow, or its lines are not its own
    axes: Any = plot_hamilton_jacobi_residual(pendulum, h=0.1).axes
    table, null = axes[:2]
    image = table.images[0]
    momenta = point_fan(pendulum, 31, 0.1).start.p[:, 0]
    left, right, bottom, top = image.get_extent()
    assert ((right - left) / 31, left + (right - left) / 62) == pytest.approx(
        (float(momenta[1] - momenta[0]), float(momenta[0]))
    )
    assert (bottom, top) == (0.5, STEPS + 0.5)
    residual = np.asarray(image.get_array())
    assert residual.shape == (STEPS, 31)
    assert residual.max() < -12
    *curves, on_flow, square = null.lines
    assert len(curves) == 3
    assert on_flow.get_ydata()[0] == pytest.approx(10 ** residual.max())
    spans = []
    for curve in curves:
        d, r = curve.get_data()
        spans += [d.min(), d.max()]
        some = (r > 1e-11) & (r < 1e-3)
        assert np.polyfit(np.log(d[some]), np.log(r[some]), 1)[0] == pytest.approx(2.0, abs=0.1)
    d, r = square.get_data()
    assert list(d) == [min(spans), max(spans)]
    assert np.diff(np.log(r)) / np.diff(np.log(d)) == pytest.approx(2.0)
    at, first = curves[0].get_data()
    assert np.exp(np.interp(np.log(at[7]), np.log(d), np.log(r))) == pytest.approx(6 * first[7])
    assert at.max() / at.min() > 1e4  # from far above rounding to as wide as the fan
    assert image.norm.vmin == -18  # a two hundredth of rounding
    assert null.get_ylim()[0] < on_flow.get_ydata()[0]
    assert null.get_ylim()[1] > r.max()
    assert any(text.get_text().startswith("grows like distance^2.0") for text in null.findobj(Text))
