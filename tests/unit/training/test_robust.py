"""Outliers: left out where they are single spikes, outweighed by a heavy-tailed loss where they are not."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, fit, laplace
from herglotz.training.baseline import outliers_pull
from herglotz.training.problems.robust import FEW, FREEDOM, far_out, heavy_tailed, loss, root_weights, scale_of

NETWORKS = FitConfig(departures=(2e-3,), objective="trajectory", train_fraction=1.0)
SETTINGS = replace(NETWORKS, level="linear", potential_width=0)  # outliers are told before any network is fitted


def recorded(seed=0, share=0.0, run=1):
    """Noisy positions; a share of the samples, `run` in a row, is off by 0.5 to 1.5 rad."""
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=45, h=0.2, noise=0.01, seed=seed)
    make = torch.Generator().manual_seed(seed + 100)
    bad = torch.rand(data.samples // run + 1, generator=make) < share
    bad = bad.repeat_interleave(run)[: data.samples]
    off = (0.5 + torch.rand(data.samples, generator=make, dtype=data.q.dtype)) * torch.where(
        torch.rand(data.samples, generator=make) < 0.5, -1.0, 1.0
    )
    return replace(data, q=data.q + (off * bad)[:, None]), int(bad.sum())


def rollout_error(run, seed=0):
    """RMS of 60-step rollouts from exact unseen starts."""
    test = simulate(scene("damped_pendulum"), trajectories=10, steps=60, h=0.2, seed=seed + 500, keep_state=True)
    assert test.p is not None
    q, p = (x.reshape(10, 61, 1) for x in (test.q, test.p))
    with torch.no_grad():
        out = Stepper(run.model).rollout(q[:, 0], p[:, 0], h=0.2, steps=60)
    return float((out.q - q).square().mean().sqrt())


@pytest.fixture(scope="module")
def clean():
    return fit(recorded()[0], SETTINGS, progress=False)


def test_two_per_cent_of_gross_outliers(clean):
    # fails if outliers reach the baseline, the start states or the loss
    data, count = recorded(share=0.02)
    run = fit(data, SETTINGS, progress=False)
    assert run.metrics["outliers"] == count
    assert rollout_error(run) < 2 * rollout_error(clean)
    plain = fit(data, replace(SETTINGS, robust="off"), progress=False)
    assert rollout_error(plain) > 2 * rollout_error(clean)


def test_outliers_side_by_side_and_at_the_ends_are_left_out(clean):
    # fails if the robust fit's outliers stay in, or their rows are told wrongly: Student's t would fit the rest worse
    data, count = recorded(share=0.06, run=3)
    q = data.q.clone()
    q[[0, 91, 183]] += 0.7  # the first sample, the last of the second trajectory, and the last of all
    data = replace(data, q=q)
    run = fit(data, SETTINGS, progress=False)
    wrong = (data.q != recorded()[0].q).any(1).nonzero()[:, 0].tolist()
    assert len(wrong) > count >= 6
    assert run.metrics["outlier_samples"] == wrong
    assert run.metrics["outliers"] == len(wrong)
    assert not run.metrics["robust"]
    assert run.metrics["train_rms"] < 0.012
    assert rollout_error(run) < 2 * rollout_error(clean)
    inside = laplace(run).bands().inside(recorded()[0].q).double().mean()
    assert 0.8 < float(inside) < 0.97


@pytest.mark.slow
@pytest.mark.parametrize("settings", [SETTINGS, NETWORKS], ids=["named terms", "networks"])
def test_many_outliers_are_outweighed(clean, settings):
    # fails if so many samples are left out that nobody could say why, or heavy tails are not seen
    data, count = recorded(share=0.2, run=6)
    assert count > FEW * data.samples
    run = fit(data, settings, progress=False)
    assert run.metrics["robust"]
    assert run.metrics["sigma"] < 0.02
    assert rollout_error(run) < 3 * rollout_error(clean)


def test_outliers_in_runs_are_noticed_before_the_first_fit():
    # fails if a start pulled by outliers that are no lone spikes is kept, or clean, smooth data are mistrusted
    for seed in range(2):
        assert outliers_pull(recorded(seed, share=0.15, run=6)[0])
        assert not outliers_pull(recorded(seed)[0])
    for name, steps, h in (("parachute", 60, 0.2), ("kepler", 60, 0.05), ("double_pendulum", 60, 0.05),
                           ("quadratic_drag", 200, 0.2), ("damped_pendulum", 200, 0.2)):  # fmt: skip
        assert not outliers_pull(simulate(scene(name), trajectories=3, steps=steps, h=h).unwrapped())
    t = 2.0 * torch.arange(500, dtype=torch.float64)  # three samples a period, and at rest for most of the time
    assert not outliers_pull(Trajectories.of(t, torch.exp(-0.1 * t) * torch.cos(t)))


def test_clean_data_are_fitted_as_without(clean):
    # fails if the default costs clean data anything: not a sample is left out, not a weight differs from 1
    plain = fit(recorded()[0], replace(SETTINGS, robust="off"), progress=False)
    assert (clean.metrics["outliers"], clean.metrics["robust"]) == (0, False)
    for a, b in zip(clean.model.parameters(), plain.model.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)


def test_weights_are_the_gradient_of_the_loss():
    # fails if w r is not ρ′(r): Gauss–Newton would go to another point than the cost's minimum
    r = torch.linspace(-30, 30, 61, dtype=torch.float64, requires_grad=True)
    for freedom in (None, FREEDOM):
        (slope,) = torch.autograd.grad(loss(r, freedom), r)
        torch.testing.assert_close(root_weights(r, freedom).square() * r, slope)
    assert float(loss(torch.tensor([1e6]), FREEDOM)) < 100


def test_heavy_tails():
    # fails if normal residuals, or those of another scale, count as heavy-tailed, or 2 % of outliers do not
    r = 0.01 * torch.randn(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert scale_of(r) == pytest.approx(0.01, rel=0.1)
    assert not heavy_tailed(r)
    tails = torch.cat([r, torch.full((40,), 0.5)])
    assert heavy_tailed(tails)
    assert far_out(tails.reshape(-1, 2)).nonzero()[:, 0].tolist() == list(range(1000, 1020))
