"""The promise of `tune`: on starts that had no part in the choice, the setting keeps the error it was chosen for."""

import json
from argparse import Namespace
from dataclasses import replace

import pytest
import torch

from herglotz.cli import main
from herglotz.data import simulate
from herglotz.export.c_header import read_metadata
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, fit, load_run, save_run
from herglotz.tune import TuneConfig, tune
from herglotz.tune.cost import Cost
from herglotz.tune.search import draw_starts, record
from tests.compilers import needs_compiler

QUICK = TuneConfig(
    multiples=(1, 2), widths=(16,), artefacts=("eager",), tolerances=(None,), starts=93, iterations=40, pairs=200
)
SCENES = {"damped_pendulum": ("linear", 0.1), "kepler": ("linear", 0.05), "parachute": ("affine", 0.1)}
LIMIT = 1e-3  # every scene's own model misses it at twice its step


def run_of(name):
    level, h = SCENES[name]
    data = simulate(scene(name), trajectories=6, steps=24, h=h, seed=0)
    iterations = 40 if name == "damped_pendulum" else 8  # one wide layer is rough at first, and rough is hard to follow
    settings = FitConfig(
        level=level, train_fraction=1.0, objective="residual", iterations=iterations, departures=(2e-3,)
    )
    return fit(data, settings, progress=False)


@pytest.fixture(scope="module")
def pendulum_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tune") / "run"
    save_run(run_of("damped_pendulum"), folder)
    return folder


@pytest.fixture(autouse=True)
def _a_step_costs_a_step(monkeypatch):
    """Every setting is run once: which one wins does not hang on a busy machine. `test_tune_parts.py` times steps."""

    def once(timed, _):
        for one in timed:
            one.run()
        return [Cost(1.0, 0.0) for _ in timed]

    monkeypatch.setattr("herglotz.tune.search.measure_costs", once)


@pytest.mark.parametrize(
    "name", ["damped_pendulum", *(pytest.param(name, marks=pytest.mark.slow) for name in ("kepler", "parachute"))]
)
def test_promise_holds_on_held_out_starts(name, pendulum_run):
    # fails if the bound promises too much, or the larger step is not bought by the re-trained correction
    longer = replace(QUICK, iterations=80, pairs=500) if name == "damped_pendulum" else QUICK
    run = load_run(pendulum_run) if name == "damped_pendulum" else run_of(name)
    found = tune(run, max_error=LIMIT, config=longer, progress=False)
    plain = found.candidates[1]
    assert (plain.setting.multiple, plain.setting.width) == (2, None)
    assert plain.median > LIMIT
    assert (found.chosen.setting.multiple, found.chosen.setting.width) == (2, 16), found.table()
    assert found.chosen.bound <= LIMIT
    assert found.held_out["starts"] == 93
    assert found.held_out["share_within"] >= 0.95, found.held_out
    # and once more from outside, with other starts still: the tuned run against the run, position by position
    tuned = found.tuned_run()
    motions = record(found.run, draw_starts(found.run, 60, 99), found.horizon).at(2 * found.run.h)
    with torch.no_grad():
        start = (x[:, 0] for x in motions)
        q = Stepper(tuned.model).rollout(*start, h=tuned.h, steps=motions.s.shape[1] - 1).q
    error = (q - motions.q).abs().flatten(1).amax(1)
    assert float((error <= LIMIT).double().mean()) >= 0.95


def test_command_writes_a_run_that_exports(pendulum_run, tmp_path, capsys):
    # fails if the tuned folder is no run, export does not take its step, or a budget is not kept
    out = tmp_path / "fast"
    options = ["--widths", "none", "--multiples", "1,2", "--starts", "59", "--no-c", "--json"]
    assert main(["tune", str(pendulum_run), "--budget-us", "1e9", "--out", str(out), *options]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((out / "tuned.json").read_text())
    assert found["chosen"]["us_per_time"] <= 1e9
    assert found["chosen"]["error_bound"] == min(c["error_bound"] for c in found["candidates"])
    assert found["model_error"]["train_rms"] > 0
    assert (out / "tuned.png").stat().st_size > 10_000
    assert main(["export", str(out), "--format", "c", "--out", str(tmp_path / "stepper.h")]) == 0
    written = read_metadata((tmp_path / "stepper.h").read_text(), "stepper.h")
    assert written["h"] == pytest.approx(found["chosen"]["h"])
    capsys.readouterr()
    assert main(["tune", str(pendulum_run), "--max-error", "1e-9", "--horizon", "4", "--out", str(out), *options]) == 0
    assert load_run(out).h == pytest.approx(0.1)


@needs_compiler
def test_command_writes_the_kicks_that_win(pendulum_run, tmp_path, capsys):
    # fails if kicks are not among the settings, export writes another step than the chosen one, or the folder is no run
    out = tmp_path / "fast"
    options = ["--widths", "none", "--multiples", "1,4", "--starts", "59", "--json"]
    command = ["tune", str(pendulum_run), "--out", str(out), *options]
    assert main([*command, "--max-error", "1e-3", "--kicks", "3", "--iterations", "30"]) == 0
    found = json.loads(capsys.readouterr().out)
    chosen = found["chosen"]
    assert (chosen["kicks"], chosen["multiple"]) == (3, 4)
    assert chosen["error_bound"] <= 1e-3
    assert found["held_out"]["share_within"] >= 0.95
    assert f"h = {chosen['h']!r}" in (out / "kicks.h").read_text()
    assert load_run(out).h == pytest.approx(0.1)
    # export takes the step that was chosen, not the model that it came from
    assert main(["export", str(out), "--format", "c", "--out", str(tmp_path / "step.h")]) == 0
    assert (tmp_path / "step.h").read_text() == (out / "kicks.h").read_text()
    # a choice without kicks leaves none behind
    assert main([*command, "--kicks", "none", "--max-error", "1"]) == 0
    assert not (out / "kicks.h").exists()


@needs_compiler
def test_export_takes_whatever_was_chosen(pendulum_run, tmp_path, capsys, monkeypatch):
    # fails if the header of a float32 choice is written in float64, or its tolerance or its step is another; or if
    # nobody is told that a file of another format has neither the tolerance nor the kicks
    config = replace(QUICK, widths=(), artefacts=("eager", "c"), tolerances=(None, 1e-7), starts=59, rounds=1)
    found = tune(load_run(pendulum_run), max_error=1.0, horizon=0.4, config=config, progress=False)
    assert len({c.setting for c in found.candidates}) == 8
    for k, candidate in enumerate(found.candidates):
        s, out, header = candidate.setting, tmp_path / f"{k}", tmp_path / f"{k}.h"
        save_run(replace(found, chosen=candidate).tuned_run(), out)
        assert main(["export", str(out), "--format", "c", "--out", str(header)]) == 0
        written = read_metadata(header.read_text(), header)
        assert written["h"] == pytest.approx(0.1 * s.multiple)
        assert written["dtype"] == s.dtype
        assert s.tol is None or written["newton_tolerance"] == s.tol
        again = load_run(out)
        assert (again.h, again.stepper.tol) == (pytest.approx(0.1 * s.multiple), s.tol)
        assert next(again.model.parameters()).dtype == getattr(torch, s.dtype)
    loose = next(k for k, c in enumerate(found.candidates) if c.setting.tol)
    capsys.readouterr()
    # what is said does not hang on the file, whose trace takes seconds
    monkeypatch.setattr("herglotz.export.export_run", lambda _, path, *__, **___: path.touch())
    monkeypatch.setattr("herglotz.export.load_exported", lambda _: Namespace(metadata={"dtype": "float32", "dof": 1}))
    (tmp_path / f"{loose}" / "kicks.h").touch()  # as `tune` leaves one; this file is not read
    written = ["--format", "onnx", "--out", str(tmp_path / "step.onnx")]
    assert main(["export", str(tmp_path / f"{loose}"), *written]) == 0
    said = capsys.readouterr().out
    assert "The tolerance 1e-07 of tune applies to PyTorch and C only" in said
    assert "exist in C only" in said


def test_a_smaller_correction_is_tried_at_the_own_step_and_a_larger_one_is_not(pendulum_run):
    # fails if sizes are compared by units alone: 48 in one layer are fewer numbers than 16 in two
    run = load_run(pendulum_run)
    assert (run.model.config.correction_width, run.model.config.correction_depth) == (48, 1)
    config = replace(QUICK, multiples=(1,), widths=(4, 16), starts=59, iterations=1, pairs=50)
    found = tune(run, max_error=10.0, horizon=0.4, config=config, progress=False)
    assert [c.setting.width for c in found.candidates] == [None, 4]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "either --max-error or --budget-us"),
        (["--max-error", "1e-3", "--widths", "8.5"], "--widths needs whole numbers"),
        (["--max-error", "1e-3", "--kicks", "2.5"], "--kicks needs whole numbers"),
        (["--max-error", "1e-3", "--multiples", "a"], "--multiples needs whole numbers"),
        (["--max-error", "1e-3", "--starts", "9"], "take 59 or more"),
    ],
)
def test_wrong_input_is_one_line(pendulum_run, capsys, arguments, words):
    # fails if a mistake ends in a traceback, or after minutes of work
    assert main(["tune", str(pendulum_run), *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_data_are_no_run(tmp_path, capsys):
    # fails if a file of data is refused as a place for the result, which nobody named
    file = tmp_path / "motion.csv"
    file.write_text("t[s],q\n")
    assert main(["tune", str(file), "--max-error", "1"]) == 2
    assert "motion.csv: is a file; give the folder" in capsys.readouterr().err


def test_another_run_is_not_overwritten(pendulum_run, capsys):
    # fails if --out takes the place of a fitted run
    assert main(["tune", str(pendulum_run), "--max-error", "1", "--out", str(pendulum_run)]) == 2
    assert "already holds a run" in capsys.readouterr().err


def test_inputs_are_refused(pendulum_run):
    # fails if a motor's model is tuned as if nothing drove it
    from herglotz.models import ContactLagrangian, ModelConfig

    driven = replace(load_run(pendulum_run), model=ContactLagrangian(ModelConfig(level="forced", inputs=1)))
    with pytest.raises(Exception, match="inputs"):
        tune(driven, max_error=1.0)
