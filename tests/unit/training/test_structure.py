"""The structure of joints, found from positions without a word about it."""

import math
import sys
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.errors import InputError
from herglotz.models.features import lengths, parse, revolute
from herglotz.scenes import scene
from herglotz.scenes.reference import reference_flow
from herglotz.training import FitConfig, fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.linear_start import LinearFit
from herglotz.training.named_terms import MOVING
from herglotz.training.pruning import prune
from herglotz.training.structure import (
    dictionaries,
    explains_steps,
    start_of_features,
    structure_is_free,
    structured,
)
from herglotz.training.task import build_model


@cache
def double_pendulum(noise=0.0, seed=0, trajectories=12, steps=40, gaps=0):
    settings = {"trajectories": trajectories, "steps": steps, "noise": noise, "seed": seed, "gaps": gaps}
    return simulate(scene("double_pendulum"), h=0.02, **settings)


def two_pendulums(noise):
    """Two pendulums that do not touch each other."""
    one, other = (simulate(scene("damped_pendulum"), trajectories=8, steps=30, h=0.1, noise=noise, seed=k)
                  for k in (0, 1))  # fmt: skip
    return Trajectories.of(one.t, torch.cat([one.q, other.q], 1), one.lengths, angles=(True, True))


def test_the_dictionary_of_chains():
    # fails if a wave is missing, counted twice with the opposite sign, or the baseline's own are repeated in V
    names = revolute((True, True))
    assert len(names) == 4 + 3 * 8
    assert len({str(parse(name, (True, True))) for name in names}) == len(names)
    assert "cos(q1 + q2)" in names  # relative angles need it in V
    assert "cos(q1 - q2) v1 v2" in names  # absolute ones in the mass
    assert len(revolute((True,) * 3)) == 26 - 6 + 26 * 6


@pytest.mark.parametrize("gaps", [0, 3])
def test_one_linear_problem_finds_the_double_pendulum(gaps):
    # fails if R, J or their normalisation is wrong: the mass then collapses or comes out scaled; or a gap counts as a
    # step like the others
    data = double_pendulum(gaps=gaps)
    names = revolute(data.angles)
    found = LinearFit.of(data.angles, names, data.triples(1.5 * data.typical_step), data.balance)
    x = found.solve(torch.ones(len(found.names), dtype=torch.bool))
    start = found.start(x)
    assert start is not None
    assert float(start["kinetic.base.log_diagonal"].exp().square()) == pytest.approx(0.5, abs=0.05)  # m₂₂ of m₁₁
    moving = [name for name in names if "v" in name]
    assert float(start[MOVING][moving.index("cos(q1 - q2) v1 v2")]) == pytest.approx(0.5, abs=0.05)
    plain = found.solve(torch.tensor([name != MOVING for name in found.names]))
    assert float(found.errors(x).norm()) < 1e-2 * float(found.errors(plain).norm())


def test_features_that_are_named_start_where_the_data_say():
    # fails if the search starts from a constant mass, values land at other parameters, or other models are touched
    data = double_pendulum()
    base = estimate_baseline(data)
    for told in (FitConfig(features=("pendulums",), level="forced", coupled=True, order=4),
                 FitConfig(features=("pendulums",), level="linear")):  # fmt: skip
        found = start_of_features(data, base, told)
        model = build_model(found, told, "potential")
        kinetic: Any = model.kinetic
        assert float(kinetic.sum.coefficient.detach()) == pytest.approx(0.5, abs=0.05)
        assert float(kinetic.base.mass().detach()[1, 1]) == pytest.approx(0.5, abs=0.05)
        assert found.rate == base.rate
    for other in ({"known": ("cos(2q1)",)}, {"level": "affine"}, {"features": ("cos(q1)",)}, {"mass_width": 4},
                  {"objective": "raw"}):  # fmt: skip
        told = FitConfig(**{"features": ("pendulums",), "level": "linear", **other})
        assert start_of_features(data, base, told) is base


@pytest.mark.parametrize(
    ("order4", "order2", "kept"), [(0.4, 1.0, True), (0.6, 1.0, False), (5e-8, 5e-8, True), (2e-7, 2e-7, False)]
)
def test_order_4_is_kept_where_it_is_better_or_exact(order4, order2, kept):
    # fails if one of the two is not enough: exact data of a rule of order 2 have no error that order 4 could halve
    assert explains_steps(order4, order2, 1.0) is kept


def test_the_data_decide():
    # fails if the rich structure is taken for pendulums that do not touch, or missed where the mass turns
    told = FitConfig()
    for data, rich in ((double_pendulum(), True), (two_pendulums(0.01), False)):
        config, base, *_ = structured(data, estimate_baseline(data), told.resolved(data))
        assert bool(config.features) is rich
        assert bool(base.start) is rich


def test_noise_is_told_from_order():
    # fails if noisy data are fitted step by step, or features of noise are kept
    data, told, make = double_pendulum(), FitConfig(), torch.Generator().manual_seed(0)
    data = replace(data, q=data.q + 1e-3 * torch.randn(data.q.shape, generator=make, dtype=data.q.dtype))
    config, *_ = structured(data, estimate_baseline(data), told.resolved(data))
    assert (config.objective, config.order) == ("trajectory", 2)
    assert "cos(q1 - q2) v1 v2" in config.features
    assert len(config.features) < 14


@pytest.mark.parametrize(
    "told", [{"level": "linear"}, {"features": ("pendulums",)}, {"order": 4}, {"objective": "raw"}, {"mass_width": 4}]
)
def test_what_a_user_says_is_left_alone(told):
    # fails if a setting is overruled
    assert structure_is_free(double_pendulum(), FitConfig())
    assert not structure_is_free(double_pendulum(), FitConfig(**told))


def test_one_joint_masses_and_motors_are_left_alone():
    # fails if data without joints that share a mass, or with motors, are given the dictionary
    data = double_pendulum()
    assert not structure_is_free(simulate(scene("damped_pendulum"), trajectories=2, steps=10, h=0.1), FitConfig())
    assert not structure_is_free(replace(data, u=torch.zeros_like(data.q)), FitConfig())


def bodies(count, *, springs=1.0, masses=None, noise=0.0):
    """Bodies on a line, each on a spring of its own and on one to the next, with drag: exact motion by exp(hA)."""
    make, h, steps, trajectories = torch.Generator().manual_seed(1), 0.2, 30, 6
    eye = torch.eye(count, dtype=torch.float64)
    K = torch.diag(1.0 + 0.3 * torch.arange(count, dtype=torch.float64))
    for i in range(count - 1):
        stretch = eye[i] - eye[i + 1]
        K += springs * torch.outer(stretch, stretch)
    inverse = torch.diag(1 / torch.tensor(masses or [1.0] * count, dtype=torch.float64))
    A = torch.cat([torch.cat([0 * eye, eye], 1), torch.cat([-inverse @ K, -0.1 * eye], 1)])
    step = torch.linalg.matrix_exp(h * A)
    x = [torch.randn(trajectories, 2 * count, generator=make, dtype=torch.float64)]
    for _ in range(steps):
        x.append(x[-1] @ step.mT)
    q = torch.stack(x, 1)[..., :count].flatten(0, 1)
    t = (h * torch.arange(steps + 1, dtype=torch.float64)).repeat(trajectories)
    q = q + noise * torch.randn(q.shape, generator=make, dtype=q.dtype)
    return Trajectories.of(t, q, (steps + 1,) * trajectories)


@pytest.mark.parametrize("noise", [0.0, 3e-3])
def test_bodies_find_their_masses_and_springs(noise):
    # fails if masses between bodies take the springs' place, a mass is lost, or noise keeps every feature
    data = bodies(2, masses=[1.0, 2.0], noise=noise)
    config, base, *_ = structured(data, estimate_baseline(data), FitConfig().resolved(data))
    model = build_model(base, config, "potential")
    assert config.diagonal
    assert "(q1 - q2)^2" in config.features
    kinetic: Any = getattr(model.kinetic, "base", model.kinetic)
    mass = kinetic.mass().detach()
    assert float(mass[1, 1]) == pytest.approx(2.0, rel=1e-4 if not noise else 0.05)
    assert float(mass[0, 1]) == 0.0
    assert config.objective == ("residual" if not noise else "trajectory")
    if noise:
        assert len(config.features) < 8


def test_few_samples_of_many_bodies_show_their_springs():
    # fails if coordinates that have too few samples for the whole dictionary (81 coefficients) go without springs (39),
    # if pairs that the samples tell have no dictionary of their own, or if joints are offered a part of theirs; twenty
    # masses took 208 s by networks, which did not fit
    data = bodies(6)
    found = {}
    for count in (2, 3):  # of recordings of 31 samples
        short = data.select(range(count))
        found[count] = structured(short, estimate_baseline(short), FitConfig().resolved(short))
    noisy = bodies(6, noise=3e-3)
    for part, sizes in ((noisy, [57, 5 * 3 + 6 * 2, 15]), (noisy.select(range(2)), [57, 15])):
        assert [len(names) for names in dictionaries(part)] == sizes
    assert len(dictionaries(double_pendulum())) == 1
    assert [f"of {n} features" in found[k].reason for k, n in ((2, 15), (3, 57))] == [True, True]
    config, base, *_ = found[2]
    springs = dict(zip(config.features, base.start["potential.features.sum.coefficient"], strict=True))
    between = [springs[f"(q{i} - q{i + 1})^2"] for i in range(1, 6)]
    assert between == pytest.approx([0.5] * 5, rel=2e-3)  # 4e-4 to 8e-4 by the rule's step


def test_bodies_that_share_nothing_are_left_alone():
    # fails if the scale of each, which nothing fixes, ends a fit, or features of rounding are kept
    data = bodies(2, springs=0.0).select(range(3))
    told = FitConfig(iterations=10, objective="residual")
    config, base, *_ = structured(data, estimate_baseline(data), told.resolved(data))
    assert bool(config.features) is bool(base.start)
    assert fit(data, told, progress=False).metrics["extrapolation_rms"] < 1e-2


def test_distances_need_one_unit_and_a_way_from_zero():
    # fails if 1/r is a candidate where r = 0 is among the data, or lengths and other units make a distance
    data = simulate(scene("kepler"), trajectories=2, steps=20, h=0.05)
    assert "r^-1" in dictionaries(data)[0]
    assert not any(name.startswith("r") for name in dictionaries(replace(data, q=data.q - data.q[3]))[0])
    assert not any(name.startswith("r") for name in dictionaries(replace(data, units=("m", "1")))[0])
    for n in (2, 3, 4):
        names = lengths((False,) * n)
        assert len({str(parse(name, (False,) * n)) for name in names}) == len(names)
    assert len(lengths((False,) * 2)) == 3 + 4 + 2 + 5 + 1
    assert len(lengths((False,) * 10)) == 3 * 45 + 20


def test_a_magnetic_field_is_found():
    # fails if a force across the velocity is no candidate, or its coefficient or that of 1/r is misread
    def slopes(q, p, s):
        turned = torch.stack([p[..., 1], -p[..., 0]], -1)
        return p, 0.8 * turned - 0.05 * p - q * (q * q).sum(-1, keepdim=True) ** -1.5, torch.zeros_like(s)

    charged = replace(scene("kepler"), flow=lambda q, p, s, h: reference_flow(slopes, q, p, s, h))
    data = simulate(charged, trajectories=6, steps=30, h=0.02, seed=0)
    config, base, *_ = structured(data, estimate_baseline(data), FitConfig().resolved(data))
    assert config.features == ("r^-1", "q1 v2 - q2 v1")
    assert base.start[MOVING][0] == pytest.approx(0.4, rel=1e-4)  # of K: half the field
    assert base.start["potential.features.sum.coefficient"][-1] == pytest.approx(-1.0, rel=1e-4)
    assert base.start["friction.viscous"] == pytest.approx((0.05, 0.05), rel=1e-2)


def test_a_dictionary_that_misses_is_not_taken_for_noise():
    # fails if forces that no feature makes count as noise of the data: the networks are then left out of exact data
    centres = torch.tensor([[0.0, 0.0], [0.9, 0.7], [-0.6, 0.8]], dtype=torch.float64)

    def slopes(q, p, s):
        d = q[..., None, :] - centres
        pull = 4.0 * d * torch.exp(-6.0 * d.square().sum(-1, keepdim=True))
        return p, -pull.sum(-2) - 0.5 * q - 0.05 * p, torch.zeros_like(s)

    wells = replace(scene("kepler"), flow=lambda q, p, s, h: reference_flow(slopes, q, p, s, h))
    data, told = simulate(wells, trajectories=4, steps=30, h=0.1, seed=0), FitConfig()
    config, base, *_ = structured(data, estimate_baseline(data), told.resolved(data))
    assert not config.features
    assert not base.start


def test_pruning_leaves_out_what_is_noise():
    # fails if the others do not move when one goes, or a coefficient that counts is dropped
    make = torch.Generator().manual_seed(0)
    J = torch.randn(400, 5, generator=make, dtype=torch.float64)
    J[:, 4] = J[:, 0] + 1e-3 * J[:, 4]  # all but the first again: one of the two is enough
    truth = torch.tensor([1.0, 0.0, 2.0, 0.0, 0.0], dtype=torch.float64)
    y = J @ truth + torch.randn(400, generator=make, dtype=torch.float64)
    A = J.T @ J
    kept, x = prune(A, torch.linalg.solve(A, J.T @ y), torch.arange(5), math.log(400))
    assert len(kept) == 2
    assert 2 in kept
    again = torch.linalg.lstsq(J[:, kept], y[:, None]).solution[:, 0]
    torch.testing.assert_close(x[kept], again, rtol=1e-6, atol=1e-9)


def test_the_simplest_of_terms_that_do_the_same_stays():
    # fails if noise chooses between a tilt and a third harmonic that make nearly the same force
    plain, simplest = set(), set()
    for seed in range(10):
        make = torch.Generator().manual_seed(seed)
        J = torch.randn(400, 3, generator=make, dtype=torch.float64)
        J[:, 1] = J[:, 0] + 1e-3 * J[:, 1]  # 1 is the simple one; 0 is what the data were made with
        y = J[:, 0] + torch.randn(400, generator=make, dtype=torch.float64)
        A = J.T @ J
        of = A, torch.linalg.solve(A, J.T @ y), torch.tensor([0, 1]), math.log(400)
        plain.add(tuple(prune(*of)[0].tolist()))
        simplest.add(tuple(prune(*of, simplest=torch.tensor([1]))[0].tolist()))
    assert plain == {(0,), (1,)}
    assert simplest == {(1,)}


def test_triples_spread_out():
    # fails if the first ones are taken instead of an even choice
    t = double_pendulum().triples(None)
    some = t.spread_out(50)
    assert len(some) == 50
    assert int(some.index[0]) == 0
    assert int(some.index[-1]) == int(t.index[-1])
    assert len(t.spread_out(10**6)) == len(t)


def test_an_interrupted_fit_keeps_its_terms(tmp_path, monkeypatch):
    # fails if terms that a checkpoint remembers are searched again, or lose a number
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=40, h=0.2, noise=1e-3, seed=0)
    whole = fit(data, out=tmp_path, progress=False)
    monkeypatch.setattr(sys.modules["herglotz.training.look"], "search", None)
    resumed = fit(data, out=tmp_path, progress=False, resume=True)
    one, other = (torch.nn.utils.parameters_to_vector(run.model.parameters()) for run in (whole, resumed))
    assert torch.equal(one, other)
    assert resumed.metrics["plan"] == whole.metrics["plan"]
    with pytest.raises(InputError, match="belongs to other data or settings"):
        fit(data, FitConfig(level="linear"), out=tmp_path, progress=False, resume=True)
