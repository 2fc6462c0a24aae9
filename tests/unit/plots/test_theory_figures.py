"""The figures of S^k for anything that has an L_d, and the paper's two figures from the package."""

import pytest
import torch
from fake_run import fake_run

from herglotz.cli import main
from herglotz.errors import InputError
from herglotz.plots import IDENTITIES, save_theory_figures
from herglotz.plots.fan import point_fan, spread_fan
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
