"""--config RUN: what a fit was told is kept apart from what it decided, so that the same data give the same fit."""

import json
import re
from argparse import Namespace
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from herglotz.cli import main
from herglotz.cli.flags import data_of
from herglotz.data import load, save, simulate
from herglotz.export import between
from herglotz.models.numbers import lines
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, load_run, save_run, select

SLOW = partial(pytest.param, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A fit of Duffing's oscillator, whose terms are found: `motion.csv` and `run`."""
    folder = tmp_path_factory.mktemp("config")
    data = simulate(scene("duffing"), trajectories=1, steps=80, h=0.1, noise=0.001, gaps=0, seed=3)
    save(folder / "motion.csv", data)
    assert fitted(folder, "run", "--seed", "1") == 0
    return folder


def fitted(folder, out, *flags):
    return main(["fit", str(folder / "motion.csv"), "--out", str(folder / out), "--no-plots", "--quiet", *flags])


def assert_same(one, other):
    ours, theirs = one.model.state_dict(), other.model.state_dict()
    assert [*ours] == [*theirs]
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert all(torch.equal(x, y) for x, y in zip(one.states, other.states, strict=True))
    plain, again = (json.loads(json.dumps({**run.metrics, "seconds": 0})) for run in (one, other))
    assert plain == again


def test_the_same_fit_from_a_runs_settings(folder):
    # fails if config.json holds what the plan decided: a second fit would take that for what the user wants
    run = load_run(folder / "run")
    assert run.config == FitConfig(seed=1)
    assert run.decided.features
    assert fitted(folder, "again", "--config", str(folder / "run")) == 0
    assert_same(run, load_run(folder / "again"))
    assert_same(run, fit(load(folder / "motion.csv", show=False), run.config, progress=False))


def test_another_recording_by_the_plan_of_a_run(folder):
    # fails if the terms are searched again: half of the time has no use for those of the run
    save(folder / "short.csv", simulate(scene("duffing"), trajectories=1, steps=40, h=0.1, noise=0.001, gaps=0, seed=5))
    flags = ("--out", str(folder / "short"), "--plan", str(folder / "run"), "--no-plots", "--quiet")
    assert main(["fit", str(folder / "short.csv"), *flags]) == 3  # too little to tell
    run, other = load_run(folder / "run"), load_run(folder / "short")
    assert other.decided.features == run.decided.features != ()
    assert other.config.features != run.decided.features  # it was not told
    assert "load" in lines(between(run, "load", other).model)


READ = ("--time", "clock", "--coordinates", "x", "--inputs", "drive", "--every", "2", "--hold", "first")


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A driven recording whose columns have to be told: `driven.csv`, and the run `told` of it."""
    folder = tmp_path_factory.mktemp("driven")
    data = simulate(scene("driven_duffing"), trajectories=1, steps=60, h=0.1, noise=0.001, gaps=0, seed=3)
    assert data.u is not None
    columns = zip(data.t.tolist(), data.q[:, 0].tolist(), data.u[:, 0].tolist(), strict=True)
    rows = "".join(f"{t!r},{x!r},{u!r},{k}\n" for k, (t, x, u) in enumerate(columns))
    (folder / "driven.csv").write_text("clock,x,drive,ticks\n" + rows)
    # How the data are read is the question here: a fit without networks is the quickest.
    short = ["--level", "forced", "--iterations", "5", "--objective", "residual", "--order", "4"]
    assert main(["fit", str(folder / "driven.csv"), "--out", str(folder / "told"), "--no-plots", *READ, *short]) in (
        0,
        3,
    )
    return folder


def test_the_data_are_read_the_same_way(driven, capsys):
    # fails if columns, hold or thinning are forgotten: the refit would take drive and ticks for coordinates
    file, told = str(driven / "driven.csv"), str(driven / "told")
    assert main(["fit", file, "--out", str(driven / "again"), "--no-plots", "--config", told]) in (0, 3)
    said = capsys.readouterr().err
    assert f"note: read as {told} says: time clock, coordinates x, inputs drive, hold first, every 2" in " ".join(
        said.split()
    )
    one, other = load_run(driven / "told"), load_run(driven / "again")
    assert_same(one, other)
    assert one.data.digest() == other.data.digest()
    assert one.reading == other.reading == {
        "time": "clock", "coordinates": ["x"], "inputs": ["drive"], "every": 2, "hold": "first",
    }  # fmt: skip


def test_samples_that_miss_a_position_are_fitted(tmp_path, capsys):
    # fails if a fit without --every leaves out samples of the faster of two coordinates, or --every does in silence
    rows = [f"{k},{k**2},{k**3 if k % 4 == 0 else ''}" for k in range(41)]
    (tmp_path / "a.csv").write_text("\n".join(["t,x[m],y[m]", *rows]))
    plain = Namespace(config=None, data=tmp_path / "a.csv")
    data, reading = data_of(plain, {})
    assert (data.samples, reading) == (41, {})
    assert "--every" not in capsys.readouterr().err
    assert data_of(Namespace(**vars(plain), every=2), {})[0].samples == 6
    said = "note: --every counts complete samples: 30 that miss a position are left out"
    assert said in " ".join(capsys.readouterr().err.split())


def test_flags_stand_over_what_was_read(driven):  # fails if a flag beside --config is not heard
    file, told = str(driven / "driven.csv"), str(driven / "told")
    more = ["--every", "3", "--inputs", "none", "--drop", "drive,ticks", "--level", "linear"]
    assert main(["fit", file, "--out", str(driven / "other"), "--no-plots", "--config", told, *more]) in (0, 3)
    run = load_run(driven / "other")
    assert run.data.u is None
    assert run.data.samples == 21
    assert run.reading["every"] == 3


def test_python_remembers_how_data_were_read(driven, tmp_path):
    # fails if a run of `hz.fit(path, time=...)` cannot be repeated by --config, or arrays end up in config.json
    file = driven / "driven.csv"
    few = FitConfig(iterations=5, objective="residual", order=4)
    run = fit(file, few, time="clock", coordinates="x", inputs=("drive",))
    assert run.reading == {"time": "clock", "coordinates": "x", "inputs": ["drive"]}
    save_run(run, tmp_path / "run")
    assert load_run(tmp_path / "run").reading == run.reading
    x = load(file, time="clock", coordinates="x", inputs=(), show=False)
    assert fit(x.q[:, 0].numpy(), few, time=x.t.numpy()).reading == {}


@pytest.mark.parametrize(("told", "named"), [(True, ["x"]), (False, []), SLOW("x", "x"), SLOW(("x",), ["x"])])
def test_angles_and_sensors_are_remembered(driven, tmp_path, told, named):
    # fails if --config reads an angle as a length because Python said angles=True, or an array of zeros is forgotten
    sensors = {"sensor_zeros": np.array([0.25]), "sensor_scales": 2}
    columns = {"time": "clock", "coordinates": np.array(["x"]), "inputs": "drive"}
    run = fit(driven / "driven.csv", angles=told, iterations=5, objective="residual", order=4, **columns, **sensors)
    assert run.reading == {"angles": named, "time": "clock", "coordinates": ["x"], "inputs": "drive",
                           "sensor_zeros": [0.25], "sensor_scales": [2.0]}  # fmt: skip
    save_run(run, tmp_path / "run")
    words = ["fit", str(driven / "driven.csv"), "--out", str(tmp_path / "again"), "--no-plots"]
    assert main([*words, "--config", str(tmp_path / "run")]) in (0, 3)
    again = load_run(tmp_path / "again")
    for name in ("t", "q", "u"):  # but for the rounding shake, which disturbs tables and no files
        torch.testing.assert_close(getattr(again.data, name), getattr(run.data, name), rtol=1e-12, atol=0)
    assert again.data.angles == run.data.angles == (bool(named),)


def test_a_selected_run_remembers_too(driven):  # fails if hz.select forgets how its data were read
    told = {"time": "clock", "coordinates": "x", "inputs": (), "drop": "ticks", "angles": True}
    few = FitConfig(iterations=5, objective="residual", order=4)
    found = select(driven / "driven.csv", ["conservative"], 1, few, progress=False, **told)
    assert found.run.reading == {**told, "inputs": [], "angles": ["x"]}


def test_a_driven_run_without_inputs_says_so(driven, capsys):
    # fails if a free run of a driven model has inputs 0 without a word, or says so although they are given
    words = ["rollout", str(driven / "told"), "--steps", "3", "--force", "--out", str(driven / "free.csv")]
    assert main(words) == 0
    assert "all of its inputs are 0" in " ".join(capsys.readouterr().err.split())
    assert main([*words, "--u", "0.5"]) == 0
    assert "inputs are 0" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("reading", "message"),
    [
        ({"every": "2"}, r"reading: every must be int, got '2' \(str\)"),
        ({"path": "/etc"}, "reading has no path"),
        ([], "must hold named entries, got"),
    ],
)
def test_a_damaged_reading_is_refused(driven, tmp_path, capsys, reading, message):
    # fails if what config.json says of reading the data goes unchecked into `load`
    (tmp_path / "config.json").write_text(json.dumps({**FitConfig().to_dict(), "reading": reading}))
    words = ["fit", str(driven / "driven.csv"), "--out", str(tmp_path / "run"), "--config", str(tmp_path)]
    assert main(words) == 2
    assert re.search(message, capsys.readouterr().err)


def test_decisions_stand_over_what_was_told(folder):
    # fails if `decided` loses a decision of the plan; its level and order are those of the model
    run = load_run(folder / "run")
    assert (run.decided.level, run.decided.order) == (run.model.config.level, run.model.config.order)
    assert (run.decided.objective, run.decided.seed) == (run.metrics["objective"], 1)


def test_a_run_that_stored_its_decisions_still_loads(folder):
    # fails if runs of before, whose config.json holds what was decided, are refused or decided otherwise
    run = load_run(folder / "run")
    save_run(replace(run, config=run.decided), folder / "old")
    old = load_run(folder / "old")
    assert old.config == old.decided == run.decided
    assert old.summary() == run.summary()
