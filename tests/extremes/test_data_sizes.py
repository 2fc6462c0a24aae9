"""From one triple to a million samples, and the files that nobody wants."""

import os
import time

import pytest
import torch

import herglotz
from herglotz import FitConfig, Trajectories
from herglotz.data.noise import part_of
from herglotz.errors import InputError
from herglotz.training.baseline import estimate_baseline
from herglotz.verify import verify

RATE, STIFFNESS = 0.2, 1.01  # of q = e^{−t/10} cos t


def motion(t):
    t = torch.as_tensor(t, dtype=torch.float64)
    return t, torch.exp(-0.1 * t) * torch.cos(t)


def seeded(count, seed=0):
    return torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_one_triple_is_data_but_cannot_be_split():
    # fails if one equation crashes the baseline, or is fitted with nothing left to judge by
    data = Trajectories.of(*motion([0.0, 0.1, 0.2]))
    assert len(data.triples()) == 1
    base = estimate_baseline(data)
    assert torch.isfinite(torch.tensor([base.rate, *base.stiffness, *base.tilt, *base.speed])).all()
    with pytest.raises(
        InputError, match=r"cuts the 3 samples of trajectory 0 into 2 and 1, each part needs 3; record more"
    ):
        herglotz.fit(data)


def test_one_triple_can_be_fitted_whole():
    # fails if a fit with fewer equations than parameters is not finite, or hangs
    data = Trajectories.of(*motion([0.0, 0.1, 0.2]))
    run = herglotz.fit(data, FitConfig(train_fraction=1.0, iterations=5))
    q, p, s = run.states_at_end()
    assert bool(torch.isfinite(torch.cat([q.flatten(), p.flatten(), s.flatten()])).all())


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_a_constant_trajectory_is_refused(value):
    # fails if a motion that determines nothing is fitted: every L_d with M ≠ 0 that rests there would do
    data = Trajectories.of(torch.arange(50) * 0.1, torch.full((50,), value))
    with pytest.raises(InputError, match="coordinate 'q' never moves; record a motion"):
        herglotz.fit(data)
    two = Trajectories.of(data.t, torch.stack([data.t.sin(), data.q[:, 0]], 1), names=("x", "temperature"))
    with pytest.raises(InputError, match=r"'temperature' never moves; leave it out: --drop temperature \(drop= in"):
        herglotz.fit(two)


def test_steps_that_vary_by_ten_thousand():
    # fails if short steps, whose second difference is rounding over h², drown the long ones
    data = Trajectories.of(*motion(torch.cumsum(10 ** (-4 * seeded(300)), 0)))
    h = data.steps().h
    assert float(h.max() / h.min()) > 5e3
    base = estimate_baseline(data)
    assert base.rate == pytest.approx(RATE, rel=0.01)
    assert base.stiffness[0] == pytest.approx(STIFFNESS, rel=0.01)


@pytest.mark.slow
def test_steps_that_vary_by_ten_thousand_are_fitted():
    # fails if the fit, its segments or its free run are lost where the baseline is not
    run = herglotz.fit(Trajectories.of(*motion(torch.cumsum(10 ** (-4 * seeded(300)), 0))), FitConfig(iterations=5))
    assert run.metrics["extrapolation_rms"] < 2e-3
    assert run.metrics["train_rms"] < 3e-3


def test_noise_that_drowns_the_shortest_steps_is_reported():
    # fails if a fit whose start is noise over h² passes for a good one: noise 1e-3, steps down to 1e-4
    t, q = motion(torch.cumsum(10 ** (-4 * seeded(300)), 0))
    noise = 1e-3 * torch.randn(300, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    run = herglotz.fit(Trajectories.of(t, q + noise), FitConfig(iterations=5))
    with torch.no_grad():
        # named terms, started from smoothed positions, follow these data: then the motion without noise is met, too
        assert not verify(run).passed or float((run.prediction[:, 0] - q).square().mean().sqrt()) < 5e-3


def test_half_of_the_samples_missing():
    # fails if gaps are stepped over as if they were typical steps, or leave nothing to fit
    kept = seeded(400) < 0.5
    run = herglotz.fit(Trajectories.of(*motion((torch.arange(400) * 0.1)[kept])), FitConfig(iterations=5))
    assert run.metrics["extrapolation_status"] == "ok"
    assert run.metrics["extrapolation_rms"] < 2e-3


def test_outliers_that_stay_are_reported():
    # fails if samples that are off by fifty amplitudes give NaN, or a run that passes for a good one
    t, q = motion(torch.arange(80) * 0.1)
    q[::37] += 50
    run = herglotz.fit(Trajectories.of(t, q), FitConfig(iterations=5, robust="off"))
    if run.metrics["one_step_rms"] is not None:  # a recorded step is one of the model's
        assert run.metrics["one_step_rms"] > 0.3 * run.metrics["one_step_rms_constant_velocity"]
    with torch.no_grad():
        # named terms, started from smoothed positions, follow these data: then the motion without noise is met, too
        assert not verify(run).passed or float((run.prediction[:, 0] - q).square().mean().sqrt()) < 5e-3


def test_a_million_samples():
    # fails if loading, windows or the baseline are slower than linear, or loop over samples in Python
    begin = time.process_time()
    data = Trajectories.of(*motion(torch.arange(1_000_000) * 1e-3))
    assert len(data.triples()) == 999_998
    base = estimate_baseline(data)
    assert time.process_time() - begin < 20
    assert base.rate == pytest.approx(RATE, rel=1e-6)
    assert base.stiffness[0] == pytest.approx(STIFFNESS, rel=1e-6)


@pytest.mark.slow
def test_a_million_samples_are_fitted():
    # fails if the time or the memory of a fit grows faster than the number of samples (measured: 52 s and 1.7 GB)
    t, q = motion(torch.arange(1_000_000) * 1e-3)
    q += 1e-3 * torch.randn(len(q), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    begin = time.process_time()
    run = herglotz.fit(Trajectories.of(t, q))
    assert time.process_time() - begin < 120
    assert run.metrics["verdict"].startswith("fits to the noise")
    assert run.metrics["rate"] == pytest.approx(RATE, rel=1e-2)


def test_what_no_memory_is_there_for_is_refused(monkeypatch):
    # fails if `fit` starts what ends in a killed process, or its advice does not help
    data = Trajectories.of(*motion(torch.arange(1000) * 0.05))
    with monkeypatch.context() as patch:
        patch.setattr(os, "sysconf", lambda _: 1000)  # pages, and bytes of each
        with pytest.raises(InputError, match=r"667 samples takes about 0.00267 GB .* has 0.001; .*--every 3,"):
            herglotz.fit(data)
    run = herglotz.fit(data.thinned(3), FitConfig(iterations=5))
    assert run.metrics["train_rms"] < 1e-3 * run.metrics["spread"]


def test_of_many_short_recordings_some_are_searched():
    # fails if every second sample is left out until recordings have fewer samples than a polynomial needs: an internal
    # error was raised, and 4000 recordings of 100 samples are 400 000 samples
    t = torch.arange(67, dtype=torch.float64).repeat(4000)
    noise = 1e-3 * torch.randn(len(t), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    part = part_of(Trajectories.of(t, (0.05 * t).sin() + noise, (67,) * 4000), 2000)[0]
    assert min(part.lengths) >= 9
    assert 1000 < part.samples < 4000
