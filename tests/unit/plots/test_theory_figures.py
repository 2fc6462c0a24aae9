"""The figures of S^k for anything that has an L_d, and the paper's two figures from the package."""

import functools
import math
from typing import Any

import numpy as np
import pytest
import torch
from fake_run import fake_run
from matplotlib.text import Text
from numpy.testing import assert_allclose as close

from herglotz.cli import main
from herglotz.errors import InputError
from herglotz.plots import IDENTITIES, save_theory_figures
from herglotz.plots.theory import (
    STEPS,
    plot_hamilton_jacobi_residual,
    plot_momentum_vs_generating_function,
    point_fan,
    spread_fan,
)
from herglotz.scenes import scene
from tests.lagrangians import verlet_pendulum as pendulum

# Differences of exactly 0 are drawn here.
FLOOR = torch.finfo(torch.float64).eps / 200
STATES = (
    torch.linspace(-1, 1, 8).double()[:, None],
    torch.linspace(0.5, 1, 8).double()[:, None],
    torch.zeros(8).double(),
)


@functools.cache
def residual_figure() -> Any:
    """The residual of the pendulum, drawn once; read-only."""
    return plot_hamilton_jacobi_residual(pendulum, h=0.1)


def test_a_function_with_a_step_is_drawn(tmp_path):
    # fails if a figure needs a run, or the step does not reach the figures
    written = save_theory_figures(pendulum, tmp_path / "new", h=0.1)
    assert [path.name for path in written] == [f"{name}.png" for name in IDENTITIES]
    assert all(path.stat().st_size > 10_000 for path in written)


def test_the_command_draws_the_papers_figures(tmp_path, capsys):
    # fails if the figures of the paper need the script in train/, or a scene, which has no others, needs --theory
    assert main(["plot", "parachute", "--out", str(tmp_path)]) == 0
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


def texts(figure: Any) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


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
    assert min(line.get_ydata().min() for line in drawn) >= FLOOR
    assert right.lines[STEPS].get_ydata()[0] == largest
    (named,) = right.texts
    assert (named.xy[1], named.get_text()) == (largest, f"largest: {largest:.1e}")
    # below and above all points; numbers this small need close(), as pytest.approx allows 1e-12
    close(right.get_ylim(), (FLOOR / 3, max(1e3 * largest, 1e6 * FLOOR)))
    assert list(right.get_xticks()) == list(range(1, STEPS + 1))
    assert f"{largest:.1e}" in left.figure.get_suptitle()
    assert f"{32 * STEPS} end points\n" in texts(left.figure)
    assert left.get_xlabel() == "$p_k$ from the stepper"  # a lambda has no units


def test_a_largest_difference_of_zero_is_drawn_at_the_floor():
    # fails if the line of the largest leaves the axes where p and dS agree to the last bit
    def free(q0, q1, s0, h):
        return (q1 - q0).square().sum(-1) / (2 * h) + 0 * s0

    states = (torch.zeros(4, 1).double(), torch.tensor([[1.0], [2.0], [4.0], [8.0]]).double(), torch.zeros(4).double())
    axes: Any = plot_momentum_vs_generating_function((free, states), h=0.5).axes
    (named,) = axes[1].texts
    assert named.get_text() == "largest: 0.0e+00"
    close(
        [named.xy[1], axes[1].lines[STEPS].get_ydata()[0], *axes[1].get_ylim()], [FLOOR, FLOOR, FLOOR / 3, 1e6 * FLOOR]
    )
    table = np.asarray(plot_hamilton_jacobi_residual((free, states), h=0.5).axes[0].images[0].get_array())
    assert table.min() == pytest.approx(math.log10(FLOOR))


def test_the_residual_is_rounding_on_the_flow():
    # fails if a column stands at another momentum or a row at another k, or the colours saturate
    table, _, bar = residual_figure().axes
    image = table.images[0]
    momenta = point_fan(pendulum, 31, 0.1).states.p[:, 0]
    left, right, bottom, top = image.get_extent()
    assert ((right - left) / 31, left + (right - left) / 62) == pytest.approx(
        (float(momenta[1] - momenta[0]), float(momenta[0]))
    )
    assert (bottom, top) == (0.5, STEPS + 0.5)
    assert list(table.get_yticks()) == list(range(1, STEPS + 1))
    residual = np.asarray(image.get_array())
    assert residual.shape == (STEPS, 31)
    assert residual.max() < -12
    assert (image.norm.vmin, image.norm.vmax) == (-18, -1)  # a two hundredth of rounding, and a tenth of the terms
    assert (min(bar.get_yticks()), max(bar.get_yticks())) == (-18, -1)
    assert table.get_title("left") == "on the flow"
    assert table.get_xlabel() == r"initial momentum $\hat p_0$"


def orbit(q, p, s, steps: int, h: float):
    """The steps of `pendulum` by hand: D1 + c p0 = 0 is v = c p0 − h sin q0, and p1 = v."""
    found = [(q, p, s)]
    for _ in range(steps):
        v = (1 - 0.2 * h) * p - h * np.sin(q)
        q, p, s = q + h * v, v, s + h * (v * v / 2 + np.cos(q) - 0.2 * s)
        found.append((q, p, s))
    return found


def test_off_the_flow_the_equation_is_between_two_solutions_of_the_fan():
    # fails if a term of the residual or of its size is another one, or the curve belongs to another k or distance
    h, axes = 0.1, residual_figure().axes
    start = point_fan(pendulum, 31, h).states
    q, p, s = start.q[:, 0].numpy(), start.p[:, 0].numpy(), start.s.numpy()
    here = orbit(q, p, s, 9, h)
    for line, k in zip(axes[1].lines, (1, 4, 8), strict=False):
        expected = []
        for far in np.logspace(-5, -0.5, 10):
            q0, _, s0 = here[k]
            q1, p1, s1 = orbit(q, p + far * (p[-1] - p[0]), s, k + 1, h)[-1]
            H_plus = p1 * (q0 + h * p1) - h * (p1**2 / 2 + np.cos(q0) - 0.2 * s0)
            terms = [s1 - s, -(s0 - s), -p1 * q1, H_plus]
            residual = np.abs(sum(terms)) / sum(np.abs(x) for x in terms)
            expected.append([np.median(np.abs(q1 - here[k + 1][0])), np.median(residual)])
        close(np.stack(line.get_data()), np.array(expected).T, rtol=1e-5)  # rounding of 1e-16 in a residual of 7e-11


def test_off_the_flow_the_residual_grows_with_the_square():
    # fails if the null experiment is on the flow, or its lines are not its own
    table, null = residual_figure().axes[:2]
    *curves, on_flow, square = null.lines
    assert len(curves) == 3
    close(on_flow.get_ydata()[0], 10 ** np.asarray(table.images[0].get_array()).max())
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
    close(null.get_ylim(), (on_flow.get_ydata()[0] / 30, 1e5 * r.max() / 6))  # room for the captions
    assert "grows like distance^2.0" in texts(null)


def test_the_slope_is_read_above_rounding():
    # fails if points of which rounding decides tilt the slope: at float32 without them 1.98, with them 1.85
    single = tuple(x.float() for x in STATES)
    axes: Any = plot_hamilton_jacobi_residual((pendulum, single), h=0.1).axes
    first, _, _, on_flow, _ = axes[1].lines
    d, r = first.get_data()
    fine = (r > 30 * on_flow.get_ydata()[0]) & (r < 1e-2)
    assert 2 < fine.sum() < len(d)
    slope = np.polyfit(np.log(d[fine]), np.log(r[fine]), 1)[0]
    assert f"grows like distance^{slope:.2f}\n" in texts(axes[1])


def wall(q0, q1, s0, h):
    """A potential that ends at q = 2."""
    v = (q1 - q0) / h[..., None]
    return h * ((v * v / 2 + torch.sqrt(2 - q0)).sum(-1) - 0.2 * s0)


def test_solutions_without_S_are_left_out_and_counted():
    # fails if one solution that leaves the domain hides the others, or is left out without a word
    source = (wall, (STATES[0], 1 + 4 * STATES[1].square(), STATES[2]))
    momentum, residual = (plot(source, h=0.4) for plot in IDENTITIES.values())
    drawn = len(np.asarray(momentum.axes[0].lines[1].get_xdata()))
    assert 0 < drawn < 8 * STEPS
    assert f"{drawn} end points, {8 * STEPS - drawn} left out (caustic, or failed step)" in texts(momentum)
    axes: Any = residual.axes
    table = np.ma.filled(np.ma.masked_invalid(axes[0].images[0].get_array()), np.nan)
    alive = np.isfinite(table).sum(1)
    assert 0 < alive[-1] < alive[0] == 31
    assert axes[0].get_title("left") == "on the flow, grey: left out (caustic, or failed step)"
    worst = 10 ** np.nanmax(table)
    assert residual.get_suptitle().endswith(f"largest relative residual {worst:.1e}")
    close(axes[1].lines[3].get_ydata()[0], worst)


@pytest.mark.parametrize("name", IDENTITIES)
def test_a_fan_without_any_S_says_so(name):
    # fails if a figure of a model all of whose steps fail ends in a traceback of matplotlib
    with pytest.raises(InputError, match="no solution has an S"):
        IDENTITIES[name]((wall, (3 + STATES[0], *STATES[1:])), h=0.1)


def test_axes_have_the_units_of_the_run():
    # fails if a momentum has no unit, or that of a position
    run = fake_run(steps=12)
    momentum, residual = (plot(run) for plot in IDENTITIES.values())
    assert momentum.axes[0].get_xlabel() == "$p_k$ from the stepper (rad/s, mass 1)"
    assert residual.axes[0].get_xlabel() == r"initial momentum $\hat p_0$ (rad/s, mass 1)"


def test_a_point_of_two_coordinates_is_one_point():
    # fails if its coordinates are counted as points, or a fan in a plane is drawn over a momentum without saying which
    momentum, residual = (plot(scene("kepler")) for plot in IDENTITIES.values())
    assert np.shape(momentum.axes[0].lines[1].get_xdata()) == (2 * 32 * STEPS,)
    assert f"○ {32 * STEPS} end points\n" in texts(momentum)
    assert residual.axes[0].get_xlabel() == r"initial momentum $\hat p_0$, first coordinate"
