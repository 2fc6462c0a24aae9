"""What is fitted to every m-th sample is looked at, foretold and told apart as it was fitted."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.training import FitConfig, foresight
from herglotz.training.baseline import estimate_baseline
from herglotz.training.stages import Stages
from herglotz.training.task import Task

EVERY = 3


def swing(samples=60, recordings=1):
    t = 0.1 * torch.arange(samples, dtype=torch.float64)
    return Trajectories.of(t.repeat(recordings), t.cos().repeat(recordings)[:, None], (samples,) * recordings)


def task_of(data, **settings):
    config = FitConfig(level="linear", objective="trajectory", **settings)
    return Task(data, estimate_baseline(data), config, Stages(False, None, "", resume=False))


class Asked(Exception):
    """Ends what is tested where it has asked what is to be seen."""


def test_foresight_of_a_thinned_fit(monkeypatch):
    # fails if every sample is taken for one that was fitted (m times the information), the noise of a mean for that of
    # a sample, states for those of other samples, or if what is beyond the data is stepped through m times as coarsely
    data = swing(62)
    task, steps, asked = task_of(data), [], {}
    model = task.build("none")
    states = torch.cat([data.q, -data.q, torch.arange(62.0, dtype=torch.float64)[:, None]], -1)
    problems = foresight.ShootingProblem

    def problem(*given, sigma, **more):
        asked["sigma"] = sigma
        asked["used"] = more.get("used", asked.get("used"))
        return problems(*given, sigma=sigma, **more)

    def guessed(*given):
        asked["known"] = given[-1]
        raise Asked

    grids = foresight.segment_grid
    monkeypatch.setattr(foresight, "ShootingProblem", problem)
    monkeypatch.setattr(problems, "guess_from_states", guessed)
    monkeypatch.setattr(foresight, "segment_grid", lambda *given: steps.append(given) or grids(*given))
    fitted: Any = SimpleNamespace(
        model=model, states=states, sigma=0.3, notes={"every": EVERY, "segment_steps": 30},
        used=torch.arange(62) != 3 * 4,
    )  # fmt: skip
    seen: Any = SimpleNamespace(spikes=torch.zeros(62, dtype=torch.bool), data=data)
    with pytest.raises(Asked):
        foresight.foresee(task, fitted, seen, states)
    assert asked["sigma"] == pytest.approx(0.3 / EVERY**0.5)
    assert torch.equal(asked["known"][:, -1], torch.arange(0, 62, EVERY).double())
    assert (~asked["used"]).nonzero().flatten().tolist() == [4]
    of, length, step = steps[0]
    assert (of.samples, length, step) == (21, 10, EVERY * task.base.model_step)
    ahead: Any = SimpleNamespace(data=data, horizon=1.0, stepped_on=lambda _model, _states, step: steps.append(step))
    ahead.until_lost = lambda guess, *_: (ahead, guess)
    monkeypatch.setattr(problems, "guess_from_states", lambda *_: None)
    monkeypatch.setattr(problems, "normal_equations", lambda *_: (torch.zeros(()), None, None))
    monkeypatch.setattr(foresight._Ahead, "of", lambda *_: ahead)
    assert foresight.foresee(task, fitted, seen, states) == foresight.Foresight(math.inf, math.inf, 0.0, "", 1.0, False)
    assert steps[2] == task.base.model_step


def looked(data, every=1) -> Any:
    found = SimpleNamespace(sigma=0.01, every=every, apart=True)
    return SimpleNamespace(kept=data, outliers=False, found=found, task=lambda _stages: task_of(data))
