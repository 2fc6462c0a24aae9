"""`select`: the simplest level of the ladder that is not beaten beyond its spread."""

import json
import math
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.plots import plot_selection, save_figure
from herglotz.scenes import scene
from herglotz.stepping import State
from herglotz.training import FitConfig, select
from herglotz.training.run import Run
from herglotz.training.selection import Candidate, Selection, _simplest, block_errors, levels_for

module = sys.modules[Candidate.__module__]


def candidate(level, *seeds, parameters=7):
    """Held-out errors a seed and block, and nothing else of a run."""
    run = SimpleNamespace(metrics={"parameters": parameters, "seconds": 1.0}, data=SimpleNamespace(units=("rad",)))
    return Candidate(level, cast(Any, (run,) * len(seeds)), torch.tensor(seeds, dtype=torch.float64), 10.0)


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        # fails if the lowest error wins although the simpler level is within its spread
        ([candidate("linear", [1.0, 1.2, 0.9]), candidate("affine", [1.0, 1.0, 0.95])], "linear"),
        # fails if the simplest level is kept although it is clearly beaten
        ([candidate("linear", [9.0, 9.5, 9.1]), candidate("affine", [1.0, 1.1, 0.9])], "affine"),
        # fails if the best level's range over seeds does not count
        ([candidate("linear", [2.0] * 3), candidate("affine", [1.0] * 3, [2.1] * 3, [1.1] * 3)], "linear"),
        # fails if a tiny advantage in every block counts as being beaten
        ([candidate("linear", [1.002, 1.202, 0.902]), candidate("forced", [1.0, 1.2, 0.9])], "linear"),
        # fails if 35 weights are preferred to 2 named terms of the same error, or the terms where they are beaten
        ([candidate("linear", [1.0] * 3, parameters=35), candidate("auto", [1.0] * 3, parameters=2)], "auto"),
        ([candidate("linear", [1.0] * 3, parameters=35), candidate("auto", [9.0] * 3, parameters=2)], "linear"),
        # fails if a level whose free run failed can be chosen, or spoils the comparison
        ([candidate("linear", [math.inf] * 3), candidate("affine", [1.0] * 3)], "affine"),
        ([candidate("linear", [1.0] * 3), candidate("affine", [math.inf] * 3)], "linear"),
    ],
)
def test_the_simplest_level_that_is_not_beaten(levels, expected):
    assert _simplest(levels).level == expected


def test_no_level_that_predicts_is_an_error():
    # fails if a ladder of failures still chooses one
    with pytest.raises(InputError, match="every free run failed"):
        _simplest([candidate("linear", [math.inf] * 3)])


def test_table_json_and_figure_say_the_same(tmp_path):
    # fails if a failed seed breaks the report, or JSON carries Infinity
    good, bad = candidate("linear", [1.0] * 3, [1.5] * 3), candidate("affine", [math.inf] * 3, [2.0] * 3)
    selection = Selection((good, bad), good)
    assert "linear" in selection.table()
    assert selection.table().count("→") == 1
    assert max(map(len, selection.table().splitlines())) <= 80  # fails if a line wraps in a terminal
    rows = json.loads(selection.to_json())
    assert rows["chosen"] == "linear"
    assert rows["levels"][1]["held_out_rms_of_seeds"] == [None, 2.0]
    save_figure(plot_selection(selection), tmp_path / "selection.png")
    assert (tmp_path / "selection.png").stat().st_size > 10_000


def test_blocks_are_the_held_out_time():
    # fails if training samples are scored, or a prediction that failed is not infinitely wrong
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=29, h=0.2, seed=0)
    wrong = data.q.clone()
    wrong[:20] += 100.0  # trained on
    wrong[20:30] += 0.5
    wrong[50:] = torch.nan
    run = cast(Run, SimpleNamespace(data=data, prediction=wrong, train_lengths=(20, 20)))
    errors = block_errors(run)
    assert len(errors) == 6
    torch.testing.assert_close(errors[:3], torch.full((3,), 0.5, dtype=torch.float64))
    assert errors[3:].isinf().all()


@pytest.mark.parametrize("name", ["damped_pendulum", "double_pendulum", "chain"])
def test_what_fit_does_by_itself_is_compared(name):
    # fails if select keeps a level that misses what fit finds without a flag, named terms or the structure of joints
    data = simulate(scene(name), trajectories=1, steps=10, h=0.1)
    assert levels_for(data, FitConfig()) == ("conservative", "linear", "affine", "forced", "auto")
    assert "auto" not in levels_for(data, FitConfig(features=("q1^4",)))


def test_forces_that_are_told_or_recorded_leave_the_forced_level():
    # fails if a level that cannot take them is tried, or dry friction, which fit adds for inputs, is not compared
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=10, h=0.1)
    driven = replace(data, u=torch.zeros_like(data.q))
    assert levels_for(driven, FitConfig()) == ("forced", "auto")
    assert levels_for(driven, FitConfig(input_map=(1.0,))) == ("forced", "auto")
    assert levels_for(driven, FitConfig(coulomb=True)) == levels_for(data, FitConfig(coulomb=True)) == ("forced",)
    assert levels_for(data, FitConfig(coupled=True)) == ("forced",)
    assert "linear" in levels_for(driven, FitConfig(use_inputs=False))


@pytest.mark.parametrize(("change", "message"), [
    ({"levels": ("linear", "cubic")}, "cubic"),
    ({"seeds": 0}, "seeds must be >= 1"),
    ({"config": FitConfig(train_fraction=1.0)}, "holds nothing out"),
    ({"train_fraction": 1.0}, "holds nothing out"),
    ({"iteration": 3}, "unknown setting 'iteration' of a fit; did you mean iterations"),
    ({"model": torch.nn.Linear(1, 1)}, "select compares levels of our own models"),
    ({"level": "affine"}, "say which levels to compare"),
])  # fmt: skip
def test_settings_are_checked(change, message):
    # fails if a wrong setting is found only after hours of fitting
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=30, h=0.2, seed=0)
    with pytest.raises(InputError, match=message):
        select(data, **change)


@pytest.mark.parametrize(("change", "fits"), [({}, 1), ({"potential_width": 2}, 3), ({"batch": 8}, 3)])
def test_seeds_are_tried_where_something_is_drawn(change, fits, monkeypatch):
    # fails if a fit that draws nothing is made again, or the seeds of networks or of batches are not tried
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=20, h=0.2, seed=0)
    drawn = ModelConfig(level="linear", potential_width=change.get("potential_width", 0))
    settings = FitConfig(**({"optimiser": "adam", "objective": "residual", **change} if "batch" in change else {}))
    seen = []

    def fitted(data, config, **_):
        seen.append(config.seed)
        run: Any = Run(ContactLagrangian(drawn), config, {"seconds": 1.0, "parameters": 1}, data, (14, 14),
                       State(data.q, data.q, data.q[:, 0]), 0.2, {}, [])  # fmt: skip
        return run

    monkeypatch.setattr(module, "fit", fitted)
    monkeypatch.setattr(module, "block_errors", lambda _: torch.ones(5))
    monkeypatch.setattr(module, "step_cost", lambda _: 1.0)
    found = select(data, ("linear",), 3, settings, progress=False)
    assert len(found.chosen.runs) == fits
    assert seen == [0, 1, 2][:fits]


def test_a_level_that_is_beaten_is_fitted_once(monkeypatch, capsys):
    # fails if seeds are spent on a level that the first tells to be beaten, if others are not tried at all seeds, or if
    # the progress counts fits that are not made
    data, seen = simulate(scene("damped_pendulum"), trajectories=2, steps=20, h=0.2, seed=0), []
    worse = {"conservative": 9.0, "linear": 1.0, "affine": 1.02}

    def fitted(data, config, **_):
        seen.append((config.level, config.seed))
        run: Any = Run(ContactLagrangian(ModelConfig(level=config.level, potential_width=2)), config,
                       {"seconds": 1.0, "parameters": 1, "level": config.level}, data, (14, 14),
                       State(data.q, data.q, data.q[:, 0]), 0.2, {}, [])  # fmt: skip
        return run

    monkeypatch.setattr(module, "fit", fitted)
    monkeypatch.setattr(module, "block_errors", lambda run: torch.full((5,), worse[run.metrics["level"]]))
    monkeypatch.setattr(module, "step_cost", lambda _: 1.0)
    found = select(data, tuple(worse), 3, progress=True)
    assert seen == [
        *((level, 0) for level in worse),
        *((level, seed) for level in ("linear", "affine") for seed in (1, 2)),
    ]
    assert [len(c.runs) for c in found.candidates] == [1, 3, 3]
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("fit ")]
    assert [line.split(":")[0] for line in told][-1] == "fit 7 of 7"


def test_one_level_end_to_end(tmp_path):
    # fails if fits, scores and the chosen run do not belong together, or resume fits again
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=30, h=0.2, noise=0.005, seed=0)
    settings = replace(FitConfig(), departures=(1e-3,))
    found = select(data, ("linear",), 1, settings, out=tmp_path, progress=False)
    assert found.chosen.level == found.run.metrics["level"] == "linear"
    assert abs(found.chosen.error - found.run.metrics["extrapolation_rms"]) < 1e-2 * found.chosen.error
    again = select(data, ("linear",), 1, settings, out=tmp_path, progress=False, resume=True)
    assert again.chosen.error == pytest.approx(found.chosen.error, rel=1e-6)
