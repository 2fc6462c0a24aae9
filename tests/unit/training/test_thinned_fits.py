"""What is fitted to every m-th sample is looked at, foretold and told apart as it was fitted."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.training import FitConfig, dictionary_search, foresight, sensor_zeros
from herglotz.training.baseline import estimate_baseline
from herglotz.training.dictionary_search import DictionarySearch
from herglotz.training.sensor_zeros import ZerosOf
from herglotz.training.stages import Stages
from herglotz.training.task import Task

EVERY = 3


def swing(samples=60, recordings=1):
    t = 0.1 * torch.arange(samples, dtype=torch.float64)
    return Trajectories.of(t.repeat(recordings), t.cos().repeat(recordings)[:, None], (samples,) * recordings)


def task_of(data, **settings):
    config = FitConfig(level="linear", objective="trajectory", **settings)
    return Task(data, estimate_baseline(data), config, Stages(False, None, "", resume=False))


def test_a_thinned_search_reads_its_start_off_all_samples(monkeypatch):
    # fails if the linear problem is made of the samples that stay, or shooting starts from states at all of them
    data, asked = swing(), {}
    search = DictionarySearch(data, estimate_baseline(data), FitConfig(), every=EVERY)

    def starts(of, *_):
        asked["linear"] = of.samples
        return []

    def grown(*given):
        asked["shooting"] = given[-1].samples

    monkeypatch.setattr(dictionary_search, "starts_of", starts)
    monkeypatch.setattr(search, "_grown", grown)
    assert search._begun() is None
    assert asked == {"linear": 60, "shooting": 20}
    assert search.data.samples == 20


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


def test_zeros_are_looked_for_with_the_samples_that_were_fitted(monkeypatch):
    # fails if a fit to every m-th sample is repeated with all of them, or starts from samples between
    asked = []

    class Seen:
        lengths = (20,)

        def __init__(self, task, *_):
            asked.append((task.data.samples, task.base.model_step))

        def fit(self, *_, begin):
            asked.append(begin.samples)

    data = swing()
    monkeypatch.setattr(sensor_zeros, "SegmentStages", Seen)
    assert ZerosOf(looked(data, EVERY)).fit(data) is None
    assert asked == [(20, EVERY * task_of(data).base.model_step), 20]


@pytest.mark.parametrize(
    ("wanted", "alone", "looks"), [(None, 0.9, False), (None, 0.1, True), (True, 0.9, True), (True, 0.1, True)]
)
def test_a_second_search_waits_for_a_difference(monkeypatch, wanted, alone, looks):
    # fails if recordings that are followed together cost a second search that nobody asked for, if those that are not
    # have none, or if the misfit of the reference is taken over samples of other recordings
    data = swing(recordings=2)
    thin = data.thinned(EVERY)  # its samples are not those of the data
    missed = torch.where(thin.trajectory == 0, 1.0, 50.0)[:, None]
    fits = iter([
        SimpleNamespace(path=None, noise=30.0, problem=SimpleNamespace(
            data=thin, grid=SimpleNamespace(sample=torch.arange(thin.samples)), misfit=lambda _path: missed)),
        SimpleNamespace(noise=alone),
    ])  # fmt: skip

    def look(*_):
        raise Asked

    stub = SimpleNamespace(reference=0, fit=lambda _data: next(fits))
    monkeypatch.setattr(sensor_zeros, "ZerosOf", lambda _seen: stub)
    monkeypatch.setattr(sensor_zeros, "look", look)
    config, seen = FitConfig(find_zeros=wanted), looked(data)
    if looks:
        with pytest.raises(Asked):
            sensor_zeros.sensor_zeros(data, config, seen)
    else:
        assert sensor_zeros.sensor_zeros(data, config, seen) is None
