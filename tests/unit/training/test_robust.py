"""Outliers: left out where they are single spikes, outweighed by a heavy-tailed loss where they are not."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.stepping import Stepper
from herglotz.systems import scene
from herglotz.training import FitConfig, fit
from herglotz.training.robust import FREEDOM, heavy_tailed, loss, root_weights, scale_of

SETTINGS = FitConfig(departures=(2e-3,), objective="trajectory", train_fraction=1.0)


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


def test_runs_of_outliers_are_outweighed(clean):
    # fails if heavy tails are not seen, or the loss is not what is minimised: three errors in a row are no single spike
    data, count = recorded(share=0.06, run=3)
    assert count >= 6
    run = fit(data, SETTINGS, progress=False)
    assert run.metrics["robust"]
    assert run.metrics["sigma"] < 0.02
    assert rollout_error(run) < 2 * rollout_error(clean)


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
    assert heavy_tailed(torch.cat([r, torch.full((40,), 0.5)]))


def test_the_choice_is_checked():
    # fails if a misspelt choice silently means least squares
    with pytest.raises(InputError, match="unknown robust 'huber'; choose one of auto, on, off"):
        FitConfig(robust="huber")
