"""The structure of joints, found from positions without a word about it."""

import sys
from dataclasses import replace
from functools import cache

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.errors import InputError
from herglotz.models.features import parse, revolute
from herglotz.stepping import Stepper
from herglotz.systems import scene
from herglotz.training import FitConfig, fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.linear_start import LinearFit
from herglotz.training.pruning import prune
from herglotz.training.structure import KINETIC, nothing_told, structured

NOISY = 3e-4


@cache
def double_pendulum(noise=0.0, seed=0, trajectories=12, steps=40, gaps=0):
    settings = {"trajectories": trajectories, "steps": steps, "noise": noise, "seed": seed, "gaps": gaps}
    return simulate(scene("double_pendulum"), h=0.02, **settings)


def two_pendulums(noise):
    """Two pendulums that do not touch each other."""
    one, other = (simulate(scene("damped_pendulum"), trajectories=12, steps=40, h=0.1, noise=noise, seed=k)
                  for k in (0, 1))  # fmt: skip
    return Trajectories.of(one.t, torch.cat([one.q, other.q], 1), one.lengths, angles=(True, True))


def test_the_dictionary_of_chains():
    # fails if a wave is missing, counted twice with the opposite sign, or the baseline's own are repeated in V
    names = revolute((True, True))
    assert len(names) == 4 + 3 * 8
    assert len({str(parse(name, (True, True))) for name in names}) == len(names)
    assert "cos(1q1 + 1q2)" in names  # relative angles need it in V
    assert "cos(1q1 - 1q2) v1 v2" in names  # absolute ones in the mass
    assert len(revolute((True,) * 3)) == 26 - 6 + 26 * 6


@pytest.mark.parametrize("gaps", [0, 3])
def test_one_linear_problem_finds_the_double_pendulum(gaps):
    # fails if R, J or their normalisation is wrong: the mass then collapses or comes out scaled; or a gap counts as a
    # step like the others
    data = double_pendulum(gaps=gaps)
    names = revolute(data.angles)
    found = LinearFit.of(data.angles, names, data.triples(1.5 * data.typical_step))
    x = found.solve(torch.ones(len(found.names), dtype=torch.bool))
    start = found.start(x)
    assert start is not None
    assert float(start["kinetic.base.log_diagonal"].exp().square()) == pytest.approx(0.5, abs=0.05)  # m₂₂ of m₁₁
    moving = [name for name in names if "v" in name]
    assert float(start[KINETIC][moving.index("cos(1q1 - 1q2) v1 v2")]) == pytest.approx(0.5, abs=0.05)
    plain = found.solve(torch.tensor([name != KINETIC for name in found.names]))
    assert float(found.errors(x).norm()) < 1e-2 * float(found.errors(plain).norm())


def test_the_data_decide():
    # fails if the rich structure is taken for pendulums that do not touch, or missed where the mass turns
    told = FitConfig()
    for data, rich in ((double_pendulum(), True), (two_pendulums(0.01), False)):
        config, base = structured(data, estimate_baseline(data), told.resolved(data), NOISY)
        assert bool(config.features) is rich
        assert bool(base.start) is rich


def test_noise_is_told_from_order():
    # fails if noisy data are fitted step by step, or features of noise are kept
    data, told, make = double_pendulum(), FitConfig(), torch.Generator().manual_seed(0)
    data = replace(data, q=data.q + 1e-3 * torch.randn(data.q.shape, generator=make, dtype=data.q.dtype))
    config, _ = structured(data, estimate_baseline(data), told.resolved(data), NOISY)
    assert (config.objective, config.order) == ("trajectory", 2)
    assert "cos(1q1 - 1q2) v1 v2" in config.features
    assert len(config.features) < 14


@pytest.mark.parametrize(
    "told", [{"level": "linear"}, {"features": ("pendulums",)}, {"order": 4}, {"objective": "raw"}, {"mass_width": 4}]
)
def test_what_a_user_says_is_left_alone(told):
    # fails if a setting is overruled
    assert nothing_told(double_pendulum(), FitConfig())
    assert not nothing_told(double_pendulum(), FitConfig(**told))


def test_one_joint_masses_and_motors_are_left_alone():
    # fails if data without joints that share a mass, or with motors, are given the dictionary
    data = double_pendulum()
    assert not nothing_told(simulate(scene("damped_pendulum"), trajectories=2, steps=10, h=0.1), FitConfig())
    assert not nothing_told(replace(data, angles=(False, False)), FitConfig())
    assert not nothing_told(replace(data, u=torch.zeros_like(data.q)), FitConfig())


def test_pruning_leaves_out_what_is_noise():
    # fails if the others do not move when one goes, or a coefficient that counts is dropped
    make = torch.Generator().manual_seed(0)
    J = torch.randn(400, 5, generator=make, dtype=torch.float64)
    J[:, 4] = J[:, 0] + 1e-3 * J[:, 4]  # all but the first again: one of the two is enough
    truth = torch.tensor([1.0, 0.0, 2.0, 0.0, 0.0], dtype=torch.float64)
    y = J @ truth + torch.randn(400, generator=make, dtype=torch.float64)
    A = J.T @ J
    kept, x = prune(A, torch.linalg.solve(A, J.T @ y), torch.arange(5), 400)
    assert len(kept) == 2
    assert 2 in kept
    again = torch.linalg.lstsq(J[:, kept], y[:, None]).solution[:, 0]
    torch.testing.assert_close(x[kept], again, rtol=1e-6, atol=1e-9)


def test_triples_spread_out():
    # fails if the first ones are taken instead of an even choice
    t = double_pendulum().triples(None)
    some = t.spread_out(50)
    assert len(some) == 50
    assert int(some.index[0]) == 0
    assert int(some.index[-1]) == int(t.index[-1])
    assert len(t.spread_out(10**6)) == len(t)


@pytest.mark.slow
def test_an_interrupted_fit_keeps_its_structure(tmp_path, monkeypatch):
    # fails if the structure is looked for again, or a stage that was finished is run again from elsewhere
    data, told = double_pendulum(), FitConfig(iterations=20)
    whole = fit(data, told, out=tmp_path, progress=False)
    stored = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    name, first = next(iter(stored["stages"].items()))
    assert len(stored["stages"]) > 1
    torch.save({**stored, "stages": {name: first}}, tmp_path / "checkpoint.pt")
    monkeypatch.setattr(sys.modules["herglotz.training.structure"], "structured", None)
    resumed = fit(data, told, out=tmp_path, progress=False, resume=True)
    assert resumed.config == whole.config
    assert resumed.config.features
    one, other = (torch.nn.utils.parameters_to_vector(run.model.parameters()) for run in (whole, resumed))
    torch.testing.assert_close(other, one, rtol=1e-12, atol=1e-12)
    assert resumed.metrics["train_rms"] == pytest.approx(whole.metrics["train_rms"], rel=1e-3)
    with pytest.raises(InputError, match="belongs to other data or settings"):
        fit(data, replace(told, level="linear"), out=tmp_path, progress=False, resume=True)


@pytest.mark.slow
def test_default_fit_of_the_double_pendulum():
    # fails if the default falls back to a constant mass: its error is then 1e-1
    run = fit(double_pendulum(steps=49), FitConfig(train_fraction=1.0), progress=False)
    test = double_pendulum(seed=100, trajectories=5, steps=51)
    q = test.q.reshape(5, 52, 2)
    stepper = Stepper(run.model)
    with torch.no_grad():
        out = stepper.rollout(*stepper.init(q[:, 0], q[:, 1], None, 0.02), h=0.02, steps=50)
    assert float((out.q - q[:, 1:]).square().mean().sqrt()) < 1e-3
