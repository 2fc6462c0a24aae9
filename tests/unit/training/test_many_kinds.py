"""Coordinates of different kinds, dictionaries without a linear start, and dictionaries that rival one another."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.noise import precision
from herglotz.models.features import revolute
from herglotz.scenes import scene
from herglotz.training import fit
from herglotz.training.linear_start import LinearFit


@pytest.fixture(scope="module")
def cart():
    return simulate(scene("cart_pole"), trajectories=3, steps=150, h=0.05, noise=0.001, seed=1)


def in_units(data: Trajectories, of_lengths: float) -> Trajectories:
    """The same recording with lengths in a unit so many times smaller."""
    by = torch.tensor([1.0 if angle else of_lengths for angle in data.angles], dtype=data.q.dtype)
    return replace(data, q=data.q * by)


def test_the_unit_of_a_length_changes_nothing_beside_an_angle(cart):
    # fails if metres and radians are added up: with lengths in mm the angle had no say in the linear problem
    found, sizes = [], []
    for by in (1.0, 1000.0):
        data = in_units(cart, by)
        triples = data.thinned(2).triples()
        fitted = LinearFit.of(data.angles, tuple(revolute(data.angles)), triples, data.balance)
        x = fitted.solve(torch.ones(len(fitted.names), dtype=torch.bool))
        found.append((x[:3] / x[0]).tolist())  # masses: m/m², 1/m, 1
        sizes.append(precision(data) / float((data.q / data.balance).std()))
    assert found[1][1] == pytest.approx(found[0][1] * 1e3, rel=1e-6)
    assert found[1][2] == pytest.approx(found[0][2] * 1e6, rel=1e-6)
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-6)


def test_balance_keeps_coordinates_of_one_unit():
    # fails if a coordinate that hardly moves is taken for as well known as its neighbour of the same unit
    q = torch.stack([torch.linspace(0, 1, 9), torch.linspace(0, 0.01, 9) ** 2], 1).double()
    t = torch.arange(9).double()
    alike = Trajectories.of(t, q, units=("m", "m"))
    other = Trajectories.of(t, q, units=("m", "rad"), angles=(False, True))
    still = Trajectories.of(t, q * 0 + 1.0, units=("m", "rad"), angles=(False, True))
    assert alike.balance.tolist() == [1.0, 1.0]
    assert other.balance[0] == 1.0
    assert other.balance[1] == pytest.approx(float(q[:, 1].std() / q[:, 0].std()))
    assert still.balance.tolist() == [1.0, 1.0]


def test_a_flexible_joint_is_found():
    # fails if joints that turn have no torsion spring between them, which winds up by their difference: a wave of it,
    # cos(q1 - q2), needed nine terms beside it and stayed at 17 times the noise; or if the damper between them is
    # printed as forces of either speed
    h, steps, count = 0.01, 4, 700
    make = torch.Generator().manual_seed(0)
    u = (4 * torch.rand(count // 30 + 1, generator=make, dtype=torch.float64) - 2).repeat_interleave(30)[:count]
    t, y, q = torch.arange(count).double() * h, np.zeros(4), []

    def rate(y, u):
        motor, link, v, w = y
        spring = 100 * (motor - link) + 1.5 * (v - w)
        return np.array([v, w, 40 * u - 2 * v - 2 * spring, spring - 25 * np.sin(link) - 0.3 * w])

    for held in u.tolist():
        q.append(y[:2])
        for _ in range(steps):
            a = rate(y, held)
            b = rate(y + h / steps / 2 * a, held)
            c = rate(y + h / steps / 2 * b, held)
            y = y + h / steps * (a + 2 * b + 2 * c + rate(y + h / steps * c, held)) / 6
    q = torch.tensor(np.stack(q)) + 5e-4 * torch.randn(count, 2, generator=make, dtype=torch.float64)
    assert float((q[:, 0] - q[:, 1]).abs().max()) > 0.4
    run = fit(Trajectories.of(t, q, u=u, hold="zero", angles=(True, True)), progress=False)
    assert run.metrics["plan"]["features"] == ("(q1 - q2)^2",)
    by = {(term.left[-3:], term.what): term.value for term in run.equation().terms}
    assert by["q1″", "(q1′ − q2′)"] == pytest.approx(-3, rel=0.01)
    assert by["q1″", "q1′"] == pytest.approx(-2, rel=0.01)
    assert by["q2″", "sin q2"] == pytest.approx(-50, rel=0.01)
    assert run.metrics["verdict"].startswith("fits to the noise")


@pytest.mark.slow  # 40 s
def test_terms_that_follow_better_than_the_dictionary_of_features_are_taken():
    # fails if features that leave an error are final: with quadratic drag they missed 19 times the noise, unnoticed
    from benchmarks.zoo_systems.drawing import draw
    from benchmarks.zoo_systems.ours import trajectories

    of = draw(1, 12)
    run = fit(trajectories(of, of.train), progress=False)
    assert "|v1| v1" in run.metrics["plan"]["drag"]
    assert run.metrics["extrapolation_rms"] < 1e-4
