"""A law that is nonlinear in s, L = v²/2 − V − γ s − β s², found from positions by a fit with default settings."""

import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from printed_check import compared

from herglotz.data import Trajectories, simulate
from herglotz.training import FitConfig, fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.friction_search import with_dissipation
from herglotz.training.search import Search
from tests import runge_kutta

GAMMA, BETA, GAIN = 0.1, 0.2, 0.8
H, STEPS, FINE = 0.1, 150, 4


def recorded(count, noise, seed, driven=False, steps=STEPS, s0=0.0):
    """Positions of V = q²/2 + q⁴/4 from s in ±s0, by Runge and Kutta's rule; inputs are held between samples."""
    make = torch.Generator().manual_seed(seed)
    draw = lambda *shape: 2 * torch.rand(*shape, generator=make, dtype=torch.float64) - 1  # noqa: E731
    x = torch.cat([1.2 * draw(count, 1), draw(count, 1), s0 * draw(count, 1)], 1)
    t = H * torch.arange(steps + 1, dtype=torch.float64)
    rates, phases = 0.5 + 1.5 * draw(count, 3).abs(), 3 * draw(count, 3)
    u = (rates[..., None] * t + phases[..., None]).cos().sum(1) * 0.4 * driven

    def slope(x, u):
        q, v, s = x.unbind(-1)
        a = -q - q**3 - (GAMMA + 2 * BETA * s) * v + GAIN * u
        return torch.stack([v, a, v * v / 2 - q * q / 2 - q**4 / 4 - GAMMA * s - BETA * s * s + GAIN * u * q], -1)

    found = [x[:, 0]]
    for k in range(steps):
        for _ in range(FINE):
            x = runge_kutta.step(partial(slope, u=u[:, k]), x, H / FINE)
        found.append(x[:, 0])
    q = torch.stack(found, 1)
    q = (q + noise * torch.randn(q.shape, generator=make, dtype=torch.float64)).reshape(-1, 1)
    lengths = (steps + 1,) * count
    return Trajectories.of(t.repeat(count), q, lengths, u=u.reshape(-1, 1) if driven else None)


def beta_of(run):
    """β with its standard deviation, from the printed equation's terms."""
    (term,) = [term for term in run.equation().terms if term.what == "s²"]
    assert term.deviation is not None
    return -term.value, term.deviation


def test_the_law_is_found_in_noise():
    # fails if s² is no offer, its states of s do not start free, or a prediction does not find s of its start
    run = fit(recorded(3, 0.005, 0), progress=False)
    assert (run.model.config.level, run.model.config.dissipation) == ("full", ("s^2",))
    assert run.model.config.features == ("q1^2", "q1^4")
    beta, deviation = beta_of(run)
    assert abs(beta - BETA) < 4 * deviation < 0.5 * BETA
    missed, moved = compared(run, parts=2)  # by the printed text, which is the model
    assert moved < missed < 1.2 * 0.005
    test, noisy = recorded(3, 0.0, 100), recorded(3, 0.005, 100)
    ahead = run.predict(noisy, warmup=60)  # fewer samples say little of s at the start
    assert float((ahead.prediction - test.q)[ahead.free].square().mean().sqrt()) < 2 * 0.005


def test_inputs_do_work_in_s():
    # fails if the work of inputs is left out of s′, in the model or in the text
    run = fit(recorded(3, 0.002, 7, driven=True), progress=False)
    assert run.model.config.dissipation == ("s^2",)
    beta, deviation = beta_of(run)
    assert abs(beta - BETA) < 4 * deviation < 0.2 * BETA
    (gain,) = [term.value for term in run.equation().terms if term.left == "L" and term.what.startswith("u")]
    assert gain == pytest.approx(GAIN, rel=0.02)
    missed, moved = compared(run, parts=2)
    assert moved < missed < 1.2 * 0.002


def test_exact_positions_give_exact_numbers():
    # fails if steps stay too long for exact data: β is then off by the rule's error
    run = fit(recorded(3, 0.0, 3, steps=50), progress=False)
    beta, _ = beta_of(run)
    assert beta == pytest.approx(BETA, rel=1e-3)
    assert run.metrics["verdict"].startswith("fits to the noise")


def test_it_is_found_where_no_model_without_s_follows_the_data():
    # fails if every search starts without s²: from other values of s one motion is damped and another driven, and no
    # force of the state joins that makes s² worth a number
    data = recorded(8, 0.0, 0, steps=27, s0=1.5)
    config = FitConfig().resolved(data)
    search = Search(data, estimate_baseline(data), config)
    search.order = 2
    assert search.first is not None
    assert not search.first.whole
    found = search.run()
    assert found is not None
    assert found.at_the_noise
    assert found.taken >= {"q1^2", "q1^4", "s^2"}


def test_damping_of_a_plain_kind_is_left_as_it_is():
    # fails if s² stands for a force that the dictionary lacks, or is taken beside data that plain damping explains
    for name in ("damped_pendulum", "van_der_pol"):
        run = fit(simulate(name, trajectories=2, steps=80, noise=0.003, seed=1), progress=False)
        assert run.model.config.dissipation == ()
        assert math.isfinite(run.metrics["train_rms"])


def test_no_damping_by_s_is_asked_for_beside_friction_that_holds():
    # fails if a search begins that can only end in a model of both, which there is none of
    found: Any = SimpleNamespace(at_the_noise=False)
    config = SimpleNamespace(translations=(), sticking=True)
    assert with_dissipation(SimpleNamespace(config=config), found, found) is found


def test_the_best_model_by_the_score_is_asked_for_it():
    # fails if the model that free runs chose is asked, which may be so poor that s² makes no better model of it
    data = recorded(3, 0.003, 0, driven=True, steps=100)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    best = search.full
    assert best is not None
    assert best.whole
    poor = best.fitter.fit(best.fitter.simple, {}, best.length, None)
    assert poor is not None
    assert with_dissipation(search, poor, poor) is poor
    assert "s^2" in with_dissipation(search, poor, best).taken
