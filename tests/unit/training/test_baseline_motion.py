"""Motions of the baseline where there are no data."""

import math

import pytest
import torch

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.training import FitConfig, ResidualProblem, fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.baseline_motion import fit_baseline_motion


@pytest.fixture(scope="module")
def data():
    return simulate(scene("damped_pendulum"), trajectories=4, steps=12, h=1.0, seed=0).unwrapped()


def test_the_parameters_are_those_of_the_motion(data):
    # fails if the step's size biases them, or the velocity at the middle is not eliminated
    motion = fit_baseline_motion(data, estimate_baseline(data), worst=1e-6)
    assert motion is not None
    expected = torch.tensor([[1.0], [0.0], [0.2]], dtype=torch.float64)
    torch.testing.assert_close(motion.parameters, expected, rtol=0, atol=1e-6)


def test_triples_are_motions_inside_the_range(data):
    # fails if the triples do not solve the equation, leave the energies of the data, or miss a part of their range
    base = estimate_baseline(data)
    motion = fit_baseline_motion(data, base, worst=1e-6)
    assert motion is not None
    t = motion.triples(data, base)
    q0, q1, q2 = (x[::16] for x in (t.q0, t.q1, t.q2))
    flow, zero = scene("damped_pendulum").flow, torch.zeros(len(q0), dtype=torch.float64)
    p = q1 - q0  # the momentum at q0 that leads to q1, by Newton with a difference quotient
    for _ in range(8):
        there, _, _ = flow(q0, p, zero, zero + 1.0)
        slope = (flow(q0, p + 1e-6, zero, zero + 1.0)[0] - there) / 1e-6
        p = p - (there - q1) / slope
    end, _, _ = flow(*flow(q0, p, zero, zero + 1.0)[:2], zero, zero + 1.0)
    torch.testing.assert_close(there, q1, rtol=0, atol=1e-9)
    torch.testing.assert_close(end, q2, rtol=0, atol=1e-7)
    q1 = t.q1
    low, high = float(data.q.min()), float(data.q.max())
    assert float(q1.min()) < low
    assert float(q1.max()) > high
    assert float(q1.max() - q1.min()) <= 2 * math.pi


def test_noise_and_other_motions_say_nothing():
    # fails if a baseline that does not explain the data is believed
    noisy = simulate(scene("damped_pendulum"), trajectories=4, steps=12, h=1.0, seed=0, noise=0.01).unwrapped()
    kepler = simulate(scene("kepler"), trajectories=4, steps=12, h=0.1, seed=0).unwrapped()
    for one in (noisy, kepler):
        assert fit_baseline_motion(one, estimate_baseline(one), worst=3e-4) is None


def test_expected_triples_weigh_by_their_own_error(data):
    # fails if their residuals are taken for recorded ones, or scaled by the data's σ
    base = estimate_baseline(data)
    motion = fit_baseline_motion(data, base, worst=1e-6)
    assert motion is not None
    more, model = motion.triples(data, base), ContactLagrangian(ModelConfig())
    plain = ResidualProblem(model, data, sigma=0.1)
    both = ResidualProblem(model, data, sigma=0.1, expected=(more, 0.5))
    x = plain.start()
    torch.testing.assert_close(both.residuals(x), plain.residuals(x))
    r = both.all_residuals(x)[both.recorded :]
    torch.testing.assert_close(both.cost(x), plain.cost(x) + (r / 0.5).square().sum() / 2)
    cost, _, gradient = both.normal_equations(x)
    torch.testing.assert_close(cost, both.cost(x))
    torch.testing.assert_close(gradient, both.cost_and_gradient(x)[1])


def test_unseen_energies_are_followed(data):
    # fails if the fit of exact data leaves its correction free where no triple has been
    run = fit(data, FitConfig(train_fraction=1.0, iterations=60, objective="residual"), progress=False)
    assert run.model.config.correction_depth == 1
    assert run.metrics["follows_data"]
    test = simulate(scene("damped_pendulum"), trajectories=5, steps=31, h=1.0, seed=1000).q.reshape(5, 32, 1)
    with torch.no_grad():
        out = run.stepper.rollout(*run.stepper.init(test[:, 0], test[:, 1], None, 1.0), h=1.0, steps=30)
    assert bool(out.ok.all())
    assert float((out.q - test[:, 1:]).square().mean().sqrt()) < 1e-2


def test_restarts_race_and_the_one_ahead_goes_on(data):
    # fails if all start from the same weights, another than the least cost goes on, or the race costs more iterations
    run = fit(data, FitConfig(iterations=18, restarts=3, objective="residual"), progress=False)
    rows = [row for row in run.history if "one-step" in row["stage"]]
    ends = {row["stage"]: row["cost"] for row in rows}
    race = [cost for stage, cost in ends.items() if "start" in stage]
    assert len(set(race)) == 3
    first = next(row["cost"] for row in rows if row["stage"] == "one-step error")
    assert first == pytest.approx(min(race), rel=1e-9)
    assert run.metrics["iterations"] <= 18 - 3 * 2
    with pytest.raises(InputError, match="restarts must be >= 1, got 0"):
        FitConfig(restarts=0)
