"""Every figure is drawn from a run, says what it should, and is written as a PNG; nothing global changes."""

import base64
import math
import struct
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import matplotlib as mpl
import numpy as np
import pytest
import torch
from fake_run import TERMS, fake_run
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text
from PIL import Image

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.plots import (
    FIGURES,
    IDENTITIES,
    plot_bands,
    plot_data,
    plot_learned,
    plot_momentum_vs_generating_function,
    plot_phase_portrait,
    plot_plan,
    plot_sizes,
    plot_training,
    plot_trajectory,
    save_animation,
    save_figure,
    save_figures,
)
from herglotz.plots.motion import plot_prediction, trajectory_title
from herglotz.plots.phase import _background
from herglotz.stepping import State
from herglotz.training import Bands, Run
from herglotz.training.trials import Compared, compared_models

KINDS = {
    "one": {},
    "many, affine": {"trajectories": 5, "steps": 20, "level": "affine"},
    "plane, everything trained, single precision": {"dof": 2, "steps": 30, "fraction": 1.0, "dtype": torch.float32},
}


@cache
def run_of(kind: str) -> Run:
    """A run of each kind, made once; read-only."""
    return fake_run(**KINDS[kind])


def title(figure: Figure) -> str:
    return figure.get_suptitle()


def png_size(path: Path) -> tuple[int, int]:
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", head[16:24])
    return width, height


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [*FIGURES, *IDENTITIES])
def test_every_figure_of_every_kind_of_run(tmp_path, name, kind):
    # fails if a figure warns, is empty, or cannot take several trajectories or coordinates, or no test part
    figure = {**FIGURES, **IDENTITIES}[name](run_of(kind))
    path = tmp_path / f"{name}.png"
    save_figure(figure, path)
    width, height = png_size(path)
    inches = figure.get_size_inches()
    assert (width, height) == (int(150 * inches[0]), int(150 * inches[1]))
    assert width >= 700
    assert np.asarray(imread(path)).std() > 0.02  # something is drawn
    assert title(figure)


def test_a_fit_without_iterations_has_its_other_figures(tmp_path):
    # fails if a fit of which no stage found a path, and which is saved, ends with an error of a figure
    run = replace(fake_run(steps=20), history=[])
    assert [x.stem for x in save_figures(run, tmp_path)] == [name for name in FIGURES if name != "training"]


def test_save_figures_writes_all_and_nothing_else(tmp_path):
    # fails if a name changes, a temporary file stays, or the folder is not made
    folder = tmp_path / "a" / "b"
    assert save_figures(fake_run(steps=20), folder) == [folder / f"{name}.png" for name in FIGURES]
    assert sorted(x.name for x in folder.iterdir()) == sorted(f"{name}.png" for name in FIGURES)
    assert set(FIGURES) >= {"trajectory", "phase_portrait", "learned", "training", "plan", "sizes"}
    assert set(IDENTITIES) == {"momentum_vs_dS", "hj_residual"}


def test_the_sizes_show_the_best_of_each_and_the_one_that_was_taken():
    run = fake_run(steps=12)
    figure = plot_sizes(run)
    _, best, taken = figure.axes[0].lines
    # fails if the line is not the least error of each size, or another model is in colour
    assert np.array_equal(best.get_xydata(), [[2, 0.1], [3, 0.01], [5, 0.011]])
    assert np.array_equal(taken.get_xydata(), [[3, 0.01]])
    assert "3 numbers" in title(figure)
    with pytest.raises(InputError, match="no search for terms"):
        plot_sizes(replace(run, metrics={}))


def test_a_model_without_a_held_out_error_is_not_drawn_among_sizes():
    # fails if a fit ends in an internal error because held-out blocks do not tell the error of the model it took
    row = Compared(20, 3, 0.1, frozenset({"a"}))
    fitter: Any = SimpleNamespace(compared=[row], offers=[SimpleNamespace(name="a")], loads=[])
    for error in (0.2, math.inf, math.nan):
        trial: Any = SimpleNamespace(
            fitter=fitter, length=20, taken=frozenset(), problem=SimpleNamespace(P=2), score=SimpleNamespace(rms=error)
        )
        assert [found["numbers"] for found in compared_models([fitter], trial)] == ([2, 3] if error == 0.2 else [])


def test_the_plan_has_a_box_for_every_reason():
    # fails if a decision is lost, a reason comes twice, or a decision without a reason is drawn
    figure = plot_plan(fake_run(steps=12))
    texts = [text.get_text() for text in figure.axes[0].texts if text.get_text()]
    assert texts == [
        "level: one damping rate\n(linear)\nterms of the model:\ncos(q1)", TERMS,
        "fitted to: whole\ntrajectories (trajectory)", "the data are noisy",
    ]  # fmt: skip
    with pytest.raises(InputError, match="holds no plan"):
        plot_plan(replace(fake_run(steps=12), metrics={}))


def test_a_mass_that_depends_on_position_is_drawn():
    # fails if the mass is not m(q), an entry that is constant is drawn, or a constant mass gets a row
    run = fake_run(dof=2, steps=20)
    assert len(plot_learned(run).axes) == 3 * 2
    one = (1.0, 1.0)
    config = ModelConfig((True, True), "linear", one, one, one, (0.0, 0.0), potential_width=0,
                         known=("0.3 cos(q1 - q2) v1 v2",))  # fmt: skip
    figure = plot_learned(replace(run, model=ContactLagrangian(config)))
    assert len(figure.axes) == 4 * 2
    drawn = figure.axes[6].lines  # the line at 0, and m12 = 0.3 cos(q1 − q2) with q2 at its median
    assert len(drawn) == 2
    q1, m12 = drawn[1].get_xdata(), np.asarray(drawn[1].get_ydata())
    q2 = float(run.states.q[: run.train_lengths[0], 1].median())
    np.testing.assert_allclose(m12, 0.3 * np.cos(np.asarray(q1) - q2), atol=1e-12)


def test_bands_of_one_unit_share_their_scale():  # fails if a panel of small residuals looks like one of large ones
    run = fake_run(trajectories=3, steps=20)
    q = run.data.q.clone()
    q[: run.data.lengths[0]] += 0.5
    run = replace(run, data=replace(run.data, q=q, recordings=("a_$_$", "trajectory 1", "c")))
    figure = plot_bands(run, Bands(run.states.q, torch.full_like(q, 0.01), torch.tensor([0.01])))
    assert len({ax.get_ylim() for ax in figure.axes}) == 1
    titles = ["trajectory 0 (a_$_$)", "trajectory 1", "trajectory 2 (c)"]
    assert [ax.get_title(loc="left") for ax in figure.axes] == titles
    figure.canvas.draw()  # fails if a name of a file is read as mathematics


@pytest.mark.parametrize("angles", [(True,), (False,), (True, True), (False, False), (False, True), (False,) * 3])
def test_animation(tmp_path, angles, monkeypatch):
    # fails if a kind of system cannot be drawn, the picture stands still, or a damaged file stays
    monkeypatch.setattr("herglotz.plots.animation.FRAMES", 5)
    run, n = fake_run(trajectories=2, steps=20), len(angles)
    names, units = tuple("abc"[:n]), tuple("rad" if angle else "m" for angle in angles)
    data = replace(run.data, q=run.data.q.repeat(1, n), names=names, units=units, angles=angles)
    states = State(run.states.q.repeat(1, n), run.states.p.repeat(1, n), run.states.s)
    shown = save_animation(replace(run, data=data, states=states), tmp_path / "a.gif", trajectory=1)._repr_html_()
    assert base64.b64encode((tmp_path / "a.gif").read_bytes()).decode() in shown  # of a notebook, which sees no files
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 5  # pyright: ignore[reportAttributeAccessIssue]
        frames = []
        for k in range(5):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")).copy())
    assert all((a != b).any() for a, b in pairwise(frames))
    assert [x.name for x in tmp_path.iterdir()] == ["a.gif"]
    with pytest.raises(InputError, match=r"must end in \.gif"):
        save_animation(run, tmp_path / "a.png")
    with pytest.raises(InputError, match="no trajectory 2"):
        save_animation(run, tmp_path / "b.gif", trajectory=2)


def test_formats(tmp_path):  # fails if a file holds another format than its name says, or a wrong name is written
    figure = plot_training(fake_run(steps=12))
    for end, begin in ((".svg", b"<?xml"), (".pdf", b"%PDF"), (".png", b"\x89PNG")):
        save_figure(figure, tmp_path / f"a{end}")
        assert (tmp_path / f"a{end}").read_bytes().startswith(begin)
    with pytest.raises(InputError, match=r"a.jpg: a figure's name must end in .png, .svg, .pdf"):
        save_figure(figure, tmp_path / "a.jpg")


def test_a_notebook_shows_a_figure():  # fails if a kernel prints <Figure ...> instead of the picture
    png = plot_training(fake_run(steps=12))._repr_png_()  # pyright: ignore[reportAttributeAccessIssue]
    assert png.startswith(b"\x89PNG")


def test_a_folder_that_cannot_be_made(tmp_path):  # fails if an OSError escapes instead of one clear line
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        save_figures(fake_run(steps=12), tmp_path / "file" / "figures")


def test_the_title_is_the_error_of_the_unseen_part():  # fails if training samples enter, or the fraction is wrong
    run = fake_run(steps=59)
    unseen = (run.prediction - run.data.q)[run.train_lengths[0] :].detach()
    rms = float(unseen.square().mean().sqrt())
    assert title(plot_trajectory(run)) == f"Extrapolation RMS {rms:.3g} rad over the unseen third"
    assert "nothing was held out" in title(plot_trajectory(fake_run(fraction=1.0, steps=20)))
    assert "unseen 20 %" in title(plot_trajectory(fake_run(fraction=0.8, steps=49)))
    for seen, words in ((3 / 4, "quarter"), (1 / 2, "half"), (1 / 3, "two thirds"), (1 / 4, "three quarters")):
        assert trajectory_title(fake_run(fraction=seen, steps=11)).endswith(f"over the unseen {words}")


def test_a_free_run_that_fails_is_drawn_and_named():  # fails if NaN in a prediction breaks or beautifies the figure
    run = fake_run(steps=40)
    q = run.states.q.clone()
    q[35:] = torch.nan
    run = replace(run, states=State(q, run.states.p, run.states.s))
    figure = plot_trajectory(run)
    assert title(figure) == "The free run breaks off at 7 s"
    for plot in FIGURES.values():
        plot(run).canvas.draw()


def test_one_trajectory_can_be_chosen():  # fails if the index is ignored or not checked
    run = fake_run(trajectories=3, steps=20)
    figure = plot_trajectory(run, 2)
    drawn = figure.axes[0].lines[0].get_ydata()
    np.testing.assert_array_equal(drawn, run.data[2].q[:, 0])
    with pytest.raises(InputError, match="there is no trajectory 3; choose one from 0 to 2"):
        plot_trajectory(run, 3)


def test_the_first_of_several_motions_says_what_is_what():  # fails if captions stand elsewhere, or in every panel
    figure = plot_trajectory(run_of("many, affine"))
    said = [any("data" in text.get_text() for text in ax.findobj(Text)) for ax in figure.axes[::2]]
    assert said == [True, False, False, False]


def test_lines_of_the_flow_last_as_long_as_the_longest_motion():
    # fails if they end after a sample, or if a panel shows the flow of another coordinate
    run = run_of("plane, everything trained, single precision")
    flow = _background(run)
    assert flow.shape == (1, 31, 2, 2)
    for i, ax in enumerate(plot_phase_portrait(run).axes):
        (line,) = cast("LineCollection", ax.collections[0]).get_segments()
        assert np.allclose(np.asarray(line), flow[0, :, :, i])


def test_residuals_are_data_minus_model():  # fails if the lower panel shows something else
    run = fake_run(steps=20)
    lower = plot_trajectory(run).axes[1]
    drawn = np.concatenate([np.asarray(line.get_ydata()) for line in lower.lines[1:]])
    np.testing.assert_allclose(drawn, (run.data.q - run.prediction)[:, 0].detach(), atol=1e-15)


def test_an_angle_shows_plus_and_minus_pi():  # fails if ±π is not marked for angles, or is for lengths
    ticks = [x.get_text() for x in plot_phase_portrait(fake_run(steps=60)).axes[0].get_xticklabels()]
    assert {"π", "−π"} <= set(ticks)
    ticks = [x.get_text() for x in plot_phase_portrait(fake_run(dof=2, steps=20)).axes[0].get_xticklabels()]
    assert not {"π", "−π"} & set(ticks)


def test_momentum_figure_takes_a_model_alone():  # fails if a model needs a run, or if dS is not the momentum
    figure = plot_momentum_vs_generating_function(fake_run(steps=12).model, h=0.1)
    assert float(title(figure).split()[-1]) < 1e-12


def test_momentum_figure_shows_a_wrong_momentum():  # fails if the figure compares a momentum with itself
    model = fake_run(steps=12).model

    class Wrong(type(model)):
        def partials(self, q0, q1, s0, h, order=1):
            P = super().partials(q0, q1, s0, h, order)
            return type(P)(**{**vars(P), "D2": 1.01 * P.D2})

    model.__class__ = Wrong
    assert float(title(plot_momentum_vs_generating_function(model, h=0.1)).split()[-1]) > 1e-3


def test_stages_are_separate_lines():  # fails if costs of different objectives are joined, or a stage is lost
    figure = plot_training(fake_run(steps=12))
    assert [len(np.asarray(ax.lines[0].get_xdata())) for ax in figure.axes] == [12, 10, 8]
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["1  residual", "2  horizon 30", "3  whole trajectory"]
    ends = [ax.texts[0].get_text() for ax in figure.axes]
    assert ends == ["settled"] * 3
    falling = [{"stage": "one", "iteration": k, "cost": 1e13 * (100 - k)} for k in range(9)]  # by 12 % of its fall
    figure = plot_training(replace(fake_run(steps=12), history=falling))
    assert figure.axes[0].texts[0].get_text() == "ends at 9.2e+14"
    assert title(figure) == "8 iterations in 1 stage"
    long = [{"stage": f"stage {k}", "iteration": k, "cost": 1.0 + (j == 0)} for k in range(20) for j in range(4)]
    figure = plot_training(replace(fake_run(steps=12), history=long))
    assert title(figure) == "60 iterations in 20 stages, the last 12 shown: the last one has settled"
    with pytest.raises(InputError, match="no history"):
        plot_training(replace(fake_run(steps=12), history=[]))


def test_what_is_learned_is_the_models_own():  # fails if a panel shows another function, or another coordinate's
    run = fake_run(steps=40)
    potential, force, friction = plot_learned(run).axes
    assert [ax.get_ylabel() for ax in (potential, friction)] == ["potential V (rad²/s²)", "friction (rad/s²)"]
    v, f = (np.asarray(x) for x in friction.lines[1].get_data())
    np.testing.assert_allclose(f, -0.201 * v, atol=1e-12)  # fails if damping by the contact form is not friction
    x, V = (np.asarray(v) for v in potential.lines[1].get_data())
    _, f = (np.asarray(v) for v in force.lines[1].get_data())
    np.testing.assert_allclose(f[1:-1], -(V[2:] - V[:-2]) / (x[2] - x[0]), atol=2e-3 * np.abs(f).max())
    seen = run.data.q[: run.train_lengths[0]]
    assert x[0] < float(seen.min()) < float(seen.max()) < x[-1]


def test_an_angle_that_goes_round_is_drawn_over_one_turn():
    # fails if 161 points are spread over a dozen turns: waves that come four times a turn were drawn as others
    run = fake_run(steps=40)
    round_and_round = replace(run, states=run.states._replace(q=8 * math.pi * run.states.q))
    potential, _, friction = plot_learned(round_and_round).axes
    assert potential.get_xlim() == pytest.approx((-math.pi, math.pi))
    assert friction.get_xlim()[1] > math.pi
    on_a_line = replace(round_and_round, data=replace(run.data, angles=(False,)))
    assert plot_learned(on_a_line).axes[0].get_xlim()[1] > 2 * math.pi


def test_what_was_recorded_in_degrees_is_drawn_in_degrees():
    # fails if a figure shows radians to a reader whose file has degrees, or a unit that its numbers are not in
    run = fake_run()
    run = replace(run, data=replace(run.data, columns=(("theta", "coordinate", "deg"),)))
    factor, bands = 180 / math.pi, Bands(run.prediction, 0.02 * torch.ones_like(run.prediction), torch.full((1,), 0.01))
    upper, lower = plot_trajectory(run).axes
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("theta (deg)", "residual (deg)")
    assert upper.lines[0].get_ydata() == pytest.approx(factor * run.data.q[:, 0].numpy())
    missed = float((run.prediction - run.data.q).abs().max())  # the model is turned as the data are
    drawn = max(np.abs(np.asarray(line.get_ydata())).max() for line in lower.lines)
    assert drawn == pytest.approx(factor * missed)
    assert trajectory_title(run).split()[3] == "deg"
    plain = plot_bands(fake_run(), bands).axes[0]
    turned = plot_bands(run, bands).axes[0]
    assert turned.get_ylabel() == "residual of theta (deg)"
    assert turned.lines[1].get_ydata() == pytest.approx(factor * np.asarray(plain.lines[1].get_ydata()))
    assert turned.get_ylim() == pytest.approx([factor * y for y in plain.get_ylim()])  # the band, too
    for ax in (plot_phase_portrait(run).axes[0], *plot_learned(run).axes[:2]):  # curves of radians, ticks in degrees
        assert ax.get_xlabel() == "theta (deg)"
        shown = [float(x.get_text().replace("−", "-")) for x in ax.get_xticklabels()]
        assert shown == pytest.approx([factor * x for x in ax.get_xticks()])
    assert plot_data(run.data).axes[0].get_ylabel() == "theta (deg)"


def test_data_alone_leaves_gaps_open():  # fails if a line is drawn across missing samples
    data = fake_run(steps=30).data
    keep = torch.ones(31, dtype=torch.bool)
    keep[10:13] = False
    gappy = type(data).of(data.t[keep], data.q[keep], angles=(True,), names=("theta",))
    line = np.asarray(plot_data(gappy).axes[0].lines[0].get_ydata())
    assert np.isnan(line).nonzero()[0].tolist() == [10]
    assert plot_data(fake_run(trajectories=6, steps=12).data).axes[-1].get_title(loc="left") == "trajectory 5"


def test_nothing_global_changes(tmp_path):  # fails if rcParams leak either way
    before = dict(mpl.rcParams)
    figure = plot_training(fake_run(steps=12))
    assert dict(mpl.rcParams) == before
    with mpl.rc_context({"savefig.dpi": 31, "savefig.bbox": "tight"}):
        save_figure(figure, tmp_path / "a.png")
    assert png_size(tmp_path / "a.png") == tuple(int(150 * x) for x in figure.get_size_inches())


def test_a_stage_with_nothing_to_do_has_no_panel():  # fails if one cost is drawn as a curve over −0.03 to 0.03
    run = fake_run(steps=12)
    costs = [{"stage": "states", "iteration": k, "cost": 9.0 - k} for k in range(3)]
    once = [{"stage": "whole", "iteration": 3, "cost": 7.0}]
    assert len(plot_training(replace(run, history=costs + once)).axes) == 1
    assert len(plot_training(replace(run, history=once)).axes) == 1


def test_a_short_warm_up_has_no_caption():  # fails if the RMS of a few samples is written under that of the free run
    run = fake_run(steps=60)

    def captions(warmup):
        texts = plot_prediction(run.predict(run.data, warmup=warmup)).axes[1].texts
        return [text.get_text() for text in texts if text.get_text().startswith("RMS")]

    assert (len(captions(6)), len(captions(40))) == (1, 2)
