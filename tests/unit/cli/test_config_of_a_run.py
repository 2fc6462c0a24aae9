"""--config RUN: what a fit was told is kept apart from what it decided, so that the same data give the same fit."""

import json
from dataclasses import replace

import pytest
import torch

from herglotz.cli import main
from herglotz.data import load, save, simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, load_run, save_run


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
