"""Structure that is told: a chain with one spring for all, and two links with hinges, from few positions."""

from typing import Any

import pytest
import torch

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, fit, laplace


def free_run(model, of, h, steps):
    """RMS of |error| over a free run from 5 unseen starts, relative to the motion."""
    q = simulate(of, trajectories=5, steps=steps + 1, h=h, seed=1000).q.reshape(5, steps + 2, of.dof)
    stepper = Stepper(model)
    with torch.no_grad():
        out = stepper.rollout(*stepper.init(q[:, 0], q[:, 1], None, h), h=h, steps=steps)
    return float((out.q - q[:, 1:]).square().mean().sqrt() / q.square().mean().sqrt())


def test_a_chain_is_learned_from_three_numbers():
    # fails if the springs do not share their parameters, or order 4 is lost in training
    of = scene("chain", masses=4, beta=0.5)
    data = simulate(of, trajectories=3, steps=15, h=0.1, seed=0)
    settings = FitConfig(
        level="linear", objective="residual", train_fraction=1.0, features=("chain",), alike=True, order=4
    )
    run = fit(data, settings, progress=False)
    model: Any = run.model
    k, cubic, beta = (model.potential.features.sum.coefficient * torch.tensor([2.0, 3.0, 4.0])).tolist()
    assert run.metrics["parameters"] == 4
    assert k == pytest.approx(1.0, abs=1e-4)
    assert cubic == pytest.approx(0.0, abs=1e-4)
    assert beta == pytest.approx(0.5, abs=1e-2)
    assert run.metrics["rate"] == pytest.approx(0.1, abs=1e-4)
    assert free_run(model, of, 0.1, 40) < 1e-4


def test_what_is_known_is_not_learned_again():
    # fails if a known part of V does not reach the fit or has the other sign: V = −cos q is then found otherwise
    data = simulate(scene("damped_pendulum"), trajectories=3, steps=20, h=0.1, seed=0)
    settings = FitConfig(
        level="linear", objective="residual", train_fraction=1.0, known=("-0.7 cos(q1)",), order=4, iterations=30
    )
    run = fit(data, settings, progress=False)
    model: Any = run.model
    assert model.potential.features.sum.coefficient.tolist() == pytest.approx([-0.3, 0.0], abs=1e-5)
    assert run.metrics["rate"] == pytest.approx(0.2, abs=1e-5)


def test_samples_far_apart_are_crossed_in_model_steps():
    # fails if a recorded step is one model step in the fit, the free run or the bands: 1e-3 then
    data = simulate(scene("damped_pendulum"), trajectories=3, steps=18, h=0.8, seed=0)
    data = data.select([1, 2])  # the other one turns by more than π between samples
    found = {}
    for m in (1, 4):
        run = fit(data, FitConfig(objective="trajectory", level="linear", order=4, substeps=m), progress=False)
        model: Any = run.model
        weight = float(model.potential.features.sum.coefficient.detach()[0])
        found[m] = abs(weight + 1), run.metrics["extrapolation_rms"]
        assert run.h == pytest.approx(0.8 / m)
        assert run.h_range[0] <= run.h <= run.h_range[1]
        assert (run.metrics["one_step_rms"] is None) is (m > 1)
        torch.testing.assert_close(laplace(run).bands().q, run.prediction, rtol=0, atol=1e-8)
    assert max(found[4]) < 5e-5
    assert min(found[1]) > 10 * max(found[4])
