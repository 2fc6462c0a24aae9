"""The verdict of a fit: against the precision of the data, in words that name a remedy."""

import math
from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.roughness import AT_THE_NOISE, precision
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, verdict
from herglotz.training.evaluate import _gain
from herglotz.training.foresight import Foresight
from herglotz.training.verdict import Errors, in_words

GOOD = {"follows_data": True, "objective": "trajectory"}


KNOWN = Foresight(start=0.0, parameters=0.01, hidden=0.02, name="q1^3", horizon=7.0, reached=True)


@pytest.mark.parametrize(
    ("windows", "unseen", "free", "ahead", "expected"),
    [
        (0.011, 0.012, 0.013, KNOWN, "fits to the noise"),
        (0.011, None, None, None, "fits to the noise"),
        (0.011, 0.012, 0.02, KNOWN, "fits, worse than the noise by a factor of 2:"),
        (0.011, 0.012, 1.2, replace(KNOWN, start=0.5), "fits, worse than the noise by a factor of 1.2e+02:"),  # chaos
        (0.011, 0.012, 1.2, KNOWN, "does not fit beyond the recording"),
        (0.011, 0.012, 1.2, None, "does not fit beyond the recording"),
        (0.011, 0.012, 0.013, replace(KNOWN, parameters=0.2), "does not fit: too little was recorded"),
        (0.011, 0.012, 0.013, replace(KNOWN, hidden=0.2), "does not fit: too little was recorded"),
        (0.011, 0.012, 0.013, replace(KNOWN, reached=False), "does not fit: too little was recorded"),
        (0.2, 0.012, 0.013, KNOWN, "does not fit"),
        (0.011, 0.2, 0.013, KNOWN, "does not fit"),
        (0.011, 0.012, math.inf, KNOWN, "does not fit"),
        (math.nan, 0.012, 0.013, KNOWN, "does not fit"),
        (math.inf, 0.012, 0.013, KNOWN, "does not fit"),
    ],
)
def test_words(windows, unseen, free, ahead, expected):
    # fails if an error is left out of the comparison, a lost or broken free run passes without the excuse of its start,
    # what the data leave open passes, or a NaN compares as small
    text = in_words(Errors(windows, unseen, free, noise=0.01, spread=1.0), ahead, GOOD)
    assert text.startswith(expected)
    assert ("Try " in text) == (expected.startswith("does not fit"))


def test_a_verdict_on_degrees_is_in_degrees():  # fails if a reader whose file has degrees is told of radians alone
    errors = Errors(0.01, 0.02, 0.03, noise=0.01, spread=1.0, unit="rad", degrees=True)
    assert "miss the training data by 0.57 deg, unseen data by 1.1 deg, all unseen time in one run by 1.7" in str(
        errors
    )
    assert "miss the training data by 0.01 rad" in str(replace(errors, degrees=False))


def test_a_model_without_states_does_not_fit():
    # fails if a fit that says it follows no data is praised for its one-step errors
    text = in_words(Errors(0.01, 0.01, 0.01, noise=0.01, spread=1.0), KNOWN, {**GOOD, "follows_data": False})
    assert text.startswith("does not fit")


@pytest.mark.parametrize("noise", [1e-3, 1e-2, 0.1])
@pytest.mark.parametrize("h", [0.1, 0.5])
def test_precision_is_the_noise(noise, h):
    # fails if coarse motion (thirteen samples a period at h = 0.5) counts as noise; over 5 seeds the ratio was within
    # 0.90 … 1.08
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=100, h=h, noise=noise, seed=1)
    assert precision(data) == pytest.approx(noise, rel=0.2)


def test_a_fit_at_the_noise_says_so():
    # fails if windows start from the recorded samples, the unseen part from unfitted states, or units differ
    data = simulate(scene("damped_pendulum"), trajectories=3, steps=60, h=0.2, noise=0.01, seed=3)
    run = fit(data, FitConfig(departures=(2e-3,)), progress=False)
    assert run.metrics["verdict"].startswith("fits to the noise"), run.metrics["verdict"]
    assert run.metrics["window_rms"] < AT_THE_NOISE * 0.01
    assert run.metrics["unseen_window_rms"] < AT_THE_NOISE * 0.01


def test_states_that_are_found_badly_do_not_reject_a_model(monkeypatch):
    # fails if windows whose states were not found speak against a free run at the noise (a cart with a pole: 0.18 m
    # beside 0.005 m), or the verdict names their error
    found_badly = lambda task, fitted, data: torch.ones_like(data.q)  # noqa: E731, ARG005
    monkeypatch.setattr(verdict, "unseen_window_errors", found_badly)
    data = simulate(scene("damped_pendulum"), trajectories=3, steps=60, h=0.2, noise=0.01, seed=3)
    run = fit(data, FitConfig(departures=(2e-3,)), progress=False)
    assert run.metrics["verdict"].startswith("fits to the noise"), run.metrics["verdict"]
    assert run.metrics["unseen_window_rms"] == pytest.approx(run.metrics["extrapolation_rms"])


def test_a_model_that_lacks_a_force_is_told():
    # fails if training errors alone judge: a pendulum pushed by nobody's word of it is no damped pendulum
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=80, h=0.2, noise=0.002, seed=3)
    pushed = replace(data, q=data.q + 0.5 * torch.sin(2.3 * data.t)[:, None])
    run = fit(pushed, FitConfig(departures=(2e-4,), objective="trajectory", iterations=10), progress=False)
    assert not run.metrics["verdict"].startswith("fits to the noise"), run.metrics["verdict"]


def test_noise_alone_is_no_motion():
    # fails if white noise, which every model meets to its size, is said to be fitted (exit code 0, "believe it")
    noise = torch.randn(60, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    run = fit(Trajectories.of(torch.arange(60).double() * 0.1, noise), FitConfig(departures=(2e-3,)), progress=False)
    assert run.metrics["verdict"].startswith("does not fit: no motion"), run.metrics["verdict"]


def test_motion_under_much_noise_is_seen():  # fails if noise of half the motion's size hides a fit that follows it
    buried = Errors(0.7, 0.7, 0.7, noise=0.7, spread=1.0)
    assert in_words(buried, KNOWN, {**GOOD, "gain_over_mean": 5.0}).startswith("fits to the noise")
    assert in_words(buried, KNOWN, {**GOOD, "gain_over_mean": 1.0}).startswith("does not fit: no motion")
    assert in_words(buried, KNOWN, {**GOOD, "gain_over_mean": None}).startswith("does not fit: no motion")


def test_a_free_run_that_breaks_off_has_no_gain():
    # fails if it is nan, which metrics.json cannot hold: the run is lost at the end of its fit
    broken = torch.tensor([[0.1], [math.nan]])
    for lost in (broken, torch.tensor([[0.1], [1e30]])):  # the square of 1e30 is no float32
        assert _gain(lost, torch.ones(2, 1)) is None
    assert (_gain(broken[:1].expand(2, 1), torch.ones(2, 1)) or 0.0) > 0


def test_short_data_have_no_precision():
    # fails if fewer than nine samples raise, or are taken for exact
    t = torch.arange(6, dtype=torch.float64) * 0.1
    assert math.isinf(precision(Trajectories.of(t, t.cos()[:, None], (6,), angles=(False,))))
