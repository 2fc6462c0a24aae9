"""Coordinates of different kinds, dictionaries without a linear start, and dictionaries that rival one another."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.roughness import precision
from herglotz.data.smoothing import local_polynomials
from herglotz.models.features import revolute
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.dictionary_search import DictionarySearch
from herglotz.training.linear_start import LinearFit
from herglotz.training.linear_terms import LinearTerms
from herglotz.training.named_terms import without_terms


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


def test_terms_are_found_without_a_linear_start(monkeypatch):
    # fails if a dictionary whose linear problem gives no mass is given up instead of grown from the baseline
    monkeypatch.setattr(LinearTerms, "start", lambda *_: None)
    data = simulate(scene("duffing"), trajectories=1, steps=150, h=0.1, noise=0.003, seed=0)
    config = FitConfig().resolved(data)
    found = DictionarySearch(data, estimate_baseline(data, outliers=False, drag=False), config).run()
    assert found is not None
    assert "q1^4" in found.terms.names
    assert found.rms < 1.2 * 0.003


def test_other_terms_are_fitted_over_the_same_segments():
    # fails if a gap, which several model steps cross, makes segments of another number for the next terms
    q = simulate(scene("damped_pendulum"), trajectories=1, steps=100, h=0.1, noise=0.003, seed=0).q
    stay = torch.ones(101, dtype=torch.bool)
    stay[5:15] = False
    data = Trajectories.of((torch.arange(101).double() * 0.1)[stay], q[stay], angles=(True,))
    search = DictionarySearch(data, estimate_baseline(data, outliers=False, drag=False), FitConfig().resolved(data))
    terms, values = without_terms(search.all, search.base)
    stages = search._stages(terms, values, 1, None)
    fitted = stages.fit(20, 0.003, None, None)
    assert fitted is not None
    assert fitted.problem.grid.segments == 4
    found = search._found(terms, stages, fitted)
    assert search._problem(found, search.all, 1)[1].grid.segments == 4


def test_fewer_residuals_than_a_dictionary_needs_give_no_start():
    # fails if noise chooses the smallest singular value: 206 coefficients from 188 windows of three coordinates
    t = torch.arange(60).double() * 0.1
    q = torch.stack([0.5 * torch.sin(w * t) for w in (1.0, 1.3, 1.7)], 1)
    data = Trajectories.of(t, q, units=("rad",) * 3, angles=(True,) * 3)
    config = FitConfig().resolved(data)
    search = DictionarySearch(data, estimate_baseline(data, outliers=False, drag=False), config)
    local = local_polynomials(data)
    assert local is not None
    assert LinearTerms(data, search.base, search.all, local).start(search.all) is None


@pytest.mark.slow  # 40 s
def test_terms_that_follow_better_than_the_dictionary_of_features_are_taken():
    # fails if features that leave an error are final: with quadratic drag they missed 19 times the noise, unnoticed
    from benchmarks.zoo_systems.drawing import draw
    from benchmarks.zoo_systems.ours import trajectories

    of = draw(1, 12)
    run = fit(trajectories(of, of.train), progress=False)
    assert "|v1| v1" in run.metrics["plan"]["drag"]
    assert run.metrics["extrapolation_rms"] < 1e-4


@pytest.mark.parametrize(("damping", "level"), [((0.2, 0.2), "linear"), ((0.05, 0.5), "forced")])
def test_one_rate_where_frictions_say_no_more(damping, level):
    # fails if masses that are damped alike keep frictions of their own, or others get one rate
    K = torch.tensor([[2.0, -1.0], [-1.0, 2.0]], dtype=torch.float64)
    zero, eye = torch.zeros_like(K), torch.eye(2, dtype=torch.float64)
    A = torch.cat([torch.cat([zero, eye], 1), torch.cat([-K, -torch.diag(K.new_tensor(damping))], 1)])
    t = 0.1 * torch.arange(200, dtype=torch.float64)
    q = (torch.linalg.matrix_exp(A * t[:, None, None]) @ K.new_tensor([1.0, -0.3, 0.0, 0.5]))[:, :2]
    q = q + 1e-3 * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    data = Trajectories.of(t, q)
    found = DictionarySearch(data, estimate_baseline(data), FitConfig()).run()
    assert found is not None
    assert found.config.level == level
    assert found.rms < 1.2e-3
