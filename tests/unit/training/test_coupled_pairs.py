"""Named terms of many coordinates: offers between those that a force couples, at the noise of whole trajectories."""

from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.drag import parse_drag
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, structure
from herglotz.training.baseline import estimate_baseline
from herglotz.training.coupled_pairs import coupled_pairs, groups, proportions, terms_between
from herglotz.training.search import Search
from herglotz.training.structure import many_are_free, search_of_many
from herglotz.training.trials import Variant


def with_dampers(noise=0.003, trajectories=10, steps=40, h=0.1, wall=None):
    """Four bodies between two walls, joined by springs and dampers: exact motion by exp(hA), with noise.

    `wall` (2,): the first wall moves as the sum of two sine waves of these angular rates, a recorded input, and moves
    the first body by a spring and a damper.
    """
    make, eye = torch.Generator().manual_seed(0), torch.eye(4, dtype=torch.float64)
    stretch = torch.cat([eye, 0 * eye[:1]]) - torch.cat([0 * eye[:1], eye])
    damped = stretch[1:-1] if wall is None else stretch[:-1]
    K, C = stretch.mT @ stretch, 0.2 * damped.mT @ damped
    A = torch.cat([torch.cat([0 * eye, eye], 1), torch.cat([-K, -C], 1)])
    starts = torch.rand(trajectories, 8, generator=make, dtype=torch.float64) - 0.5
    if wall is not None:
        # Each wave is an oscillator (u, u′) with u″ = −ω² u beside the bodies.
        A = torch.block_diag(A, *(torch.tensor([[0.0, 1.0], [-w * w, 0.0]], dtype=A.dtype) for w in wall))
        A[4, 8:] = torch.tensor([1.0, 0.2] * 2)
        starts = torch.cat([starts, torch.rand(trajectories, 4, generator=make, dtype=A.dtype) - 0.5], 1)
    step, x = torch.linalg.matrix_exp(h * A), [starts]
    for _ in range(steps):
        x.append(x[-1] @ step.mT)
    every = torch.stack(x, 1).flatten(0, 1)
    q = every[:, :4] + noise * torch.randn(every[:, :4].shape, generator=make, dtype=every.dtype)
    t = (h * torch.arange(steps + 1, dtype=torch.float64)).repeat(trajectories)
    u = None if wall is None else every[:, [8, 10]].sum(1, keepdim=True)
    return Trajectories.of(t, q, (steps + 1,) * trajectories, u=u)


@cache
def chain(masses, noise=0.003, seed=0, trajectories=10, steps=40):
    of = scene("chain", masses=masses)
    return simulate(of, trajectories=trajectories, steps=steps, h=0.1, noise=noise, seed=seed)


@pytest.mark.parametrize(("masses", "settings"), [(20, {}), (5, {"noise": 0.01, "trajectories": 3})])
def test_neighbours_of_a_chain_are_coupled_and_no_others(masses, settings):
    # fails if a spring is missed, as where both accelerations have to show a pair (of five masses 11 in 15 draws), or
    # if noise couples others: without the price of a choice 11 pairs of twenty masses
    neighbours, false = {(i, i + 1) for i in range(masses - 1)}, 0
    for seed in range(5):
        found = coupled_pairs(chain(masses, seed=seed, **settings))
        assert found is not None
        assert neighbours <= set(found)
        false += len(found) - len(neighbours)
    # 0 in 15 draws of each
    assert false <= 1


def apart(masses, count):
    """Recordings of chains that nothing couples to one another, as coordinates of one recording."""
    each, n = [chain(masses, seed=k) for k in range(count)], masses * count
    q = torch.cat([one.q for one in each], 1)
    return replace(each[0], q=q, names=tuple("abcdef"[:n]), units=("m",) * n, angles=(False,) * n)


def test_bodies_without_springs_between_them_have_no_pairs():
    # fails if positions of other bodies are taken for forces: each of these chains of one mass moves alone
    assert coupled_pairs(apart(1, 5)) == []


def test_groups_are_coordinates_that_terms_join():
    # fails if a group that a later term joins to another one stays apart, or if coordinates are lost
    names = ("q1^4", "(q1 - q3)^2", "(q4 - q5)^2", "(q3 - q5)^4")
    assert groups(names[:3], (False,) * 6) == [[0, 2], [1], [3, 4], [5]]
    assert groups(names, (False,) * 6) == [[0, 2, 3, 4], [1], [5]]


@pytest.mark.parametrize(("masses", "count"), [(1, 4), (2, 2)])
def test_terms_leave_bodies_that_nothing_couples(masses, count):
    # fails if the mass of coordinates that nothing couples to the first one is free: all terms stayed, as a larger mass
    # stands for all forces to first order, and no fit of the sets without them was near the data
    data = apart(masses, count)
    found = search_of_many(data, estimate_baseline(data), FitConfig().resolved(data), outliers=False)
    springs = {f"(q{i} - q{i + 1})^{k}" for i in range(1, 4) if i % masses for k in (2, 4)}
    # Noise may hide the weakest term of a single body.
    assert springs <= set(found.config.features) <= springs | {f"q{i}^4" for i in range(1, 5)}
    assert found.config.drag == ()


def test_few_samples_couple_nothing():
    # fails if a regression with as many coefficients as independent samples is believed
    assert coupled_pairs(chain(10, trajectories=2)) is None


def test_terms_between_pairs():
    # fails if a pair that nothing couples has a term, or one of a coupled pair or of a single coordinate is lost
    names = terms_between([(0, 1), (2, 3)], (False,) * 4)
    assert set(names) == {
        *(f"(q{i} - q{j})^{k}" for i, j in ((1, 2), (3, 4)) for k in (2, 3, 4)),
        *(f"q{i}^{k}" for i in range(1, 5) for k in (3, 4)),
    }


def test_more_coordinates_than_a_search_takes_are_free_where_they_have_noise():
    # fails if exact data, which one-step errors fit better, three coordinates or a user's terms come here, or if inputs
    # or angles, for which there is no other dictionary of so many coordinates, do not
    assert many_are_free(chain(4), FitConfig())
    assert not many_are_free(chain(3), FitConfig())
    assert not many_are_free(chain(4, noise=0.0), FitConfig())
    assert many_are_free(replace(chain(4, noise=0.0), angles=(True,) * 4, units=("rad",) * 4), FitConfig())
    assert many_are_free(replace(chain(4, noise=0.0), u=torch.zeros_like(chain(4).q)), FitConfig())
    named: list[dict[str, Any]] = [
        {"features": ("chain",)}, {"objective": "residual"}, {"level": "linear"}, {"input_map": (1.0, 0.0, 0.0, 0.0)}
    ]  # fmt: skip
    for told in named:
        assert not many_are_free(chain(4), FitConfig(**told))


def test_a_noisy_chain_is_found():
    # fails if terms of a pair are lost, or networks take their place: they missed unseen motion of twenty masses by a
    # quarter of its size
    run = fit(chain(4), FitConfig(train_fraction=1.0), progress=False)
    plan, springs = run.metrics["plan"], {f"(q{i} - q{i + 1})^{k}" for i in range(1, 4) for k in (2, 4)}
    assert (plan["network"], plan["objective"]) == ("none", "trajectory")
    assert springs | {"q1^4", "q4^4"} == set(plan["features"])
    assert run.metrics["verdict"].startswith("fits to the noise")


def test_terms_that_miss_by_more_than_the_noise_are_no_result():
    # fails if terms stand in for a force that they lack: a magnet on the third body, which networks may have
    data = chain(4)
    pushed = data.q + 0.05 * torch.sin(4 * data.t)[:, None] * torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=data.q.dtype)
    data = replace(data, q=pushed)
    config = FitConfig().resolved(data)
    found = search_of_many(data, estimate_baseline(data), config, outliers=False)
    assert found.sigma is None
    assert found.config is config
    assert "miss the data by more than the noise" in found.reason


def test_dampers_between_bodies_are_found():
    # fails if a damper between two bodies is no offer, or if the settings of the fit do not have it
    damped = with_dampers()
    found = search_of_many(damped, estimate_baseline(damped), FitConfig().resolved(damped), outliers=False)
    assert found.config.drag == ("(v1 - v2)", "(v2 - v3)", "(v3 - v4)")


def test_springs_and_dampers_between_coordinates_of_different_units():
    # fails if differences are those of the numbers: the larger coordinate alone, and a small difference of large forces
    # for the other one, with which no fit came near the data
    damped = with_dampers()
    size = torch.tensor([1.0, 1e-3, 1.0, 1.0], dtype=torch.float64)
    damped = replace(damped, q=damped.q * size, units=("mm", "rad", "mm", "mm"))
    found = search_of_many(damped, estimate_baseline(damped), FitConfig().resolved(damped), outliers=False)
    assert found.sigma == pytest.approx(0.003, rel=0.1)
    between = [parse_drag(text, damped.angles) for text in found.config.drag]
    assert [(f.on, f.of) for f in between] == [(0, 1), (1, 2), (2, 3)]
    assert [f.ratio for f in between] == pytest.approx([1e-3, 1e3, 1.0], rel=0.5)


def test_a_wall_that_moves_drives_angles_by_a_spring_and_a_damper(monkeypatch):
    # fails if many driven coordinates, or angles, get a network, or if no rate of the input is offered: a network
    # missed such a chain by 9 times the noise; or if a network is fitted before the recording is read anew
    monkeypatch.setattr(import_module("herglotz.training.look"), "_probe", None)
    driven = with_dampers(wall=(0.9, 2.3), trajectories=3, steps=60)
    driven = replace(driven, angles=(True,) * 4, units=("rad",) * 4)
    run = fit(driven, FitConfig(train_fraction=1.0), progress=False)
    plan = run.metrics["plan"]
    assert (plan["network"], plan["turning"], plan["input_terms"]) == ("none", False, ("u'",))
    assert set(plan["drag"]) == {"(v1 - v2)", "(v2 - v3)", "(v3 - v4)"}
    assert plan["reasons"]["turning"] == "terms of positions on a line meet the data"
    assert plan["reasons"]["input_terms"] == "held-out blocks of time are missed by less with them"
    assert run.metrics["verdict"].startswith("fits to the noise")
    gains = run.model.get_parameter("friction.input_map").detach()
    # The spring, 1, and the damper, 0.2, of the first body.
    assert gains[0].tolist() == pytest.approx([1.0, 0.2], abs=0.02)
    assert gains[1:].abs().max() < 0.02


def test_the_rate_of_a_wall_is_found_in_noise():
    # fails if a model at about the noise, 1.3 times as much, is asked for no term of its inputs: the damper to the wall
    # was lost, and errors went on from sample to sample
    driven = with_dampers(noise=0.03, trajectories=6, steps=80, wall=(0.9, 2.3))
    found = search_of_many(driven, estimate_baseline(driven), FitConfig().resolved(driven), outliers=False)
    assert found.input_terms == ("u'",)
    assert found.sigma == pytest.approx(0.03, rel=0.05)


@pytest.mark.parametrize(("most", "taken"), [(36, 36), (35, 33), (32, None)])
def test_numbers_that_a_kernel_takes_are_offered(monkeypatch, most, taken):
    # fails if a search without a kernel begins, whose fits take minutes, or if terms go with dampers that are too many
    offered = []
    monkeypatch.setattr(structure, "MAX_PARAMETERS", most)
    monkeypatch.setattr(Search, "full", property(lambda self: offered.append(len(self.fitter(Variant(2)).start))))
    data = chain(4)
    found = search_of_many(data, estimate_baseline(data), FitConfig().resolved(data), outliers=False)
    assert found.sigma is None
    assert offered == ([] if taken is None else [taken])
    assert ("too many forces" in found.reason) is (taken is None)


def drive(ratio=20.0, h=0.001, samples=1200, seed=0, gain=5000.0):
    """A motor [rad] and a carriage [mm] on a belt, with a torque that jumps: exact motion by exp(hA), with noise.

    φ″ = −2 φ′ + gain u − F/10, x″ = −2 x′ + F/1.5 with the belt's force F = 2000 (ρ φ − x) + 1 (ρ φ′ − x′), ρ = ratio.
    """
    k, d = 2000.0, 1.0
    A = torch.tensor(
        [[0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [-k * ratio / 10, k / 10, -2 - d * ratio / 10, d / 10, gain],
         [k * ratio / 1.5, -k / 1.5, d * ratio / 1.5, -2 - d / 1.5, 0], [0, 0, 0, 0, 0]],
        dtype=torch.float64,
    )  # fmt: skip
    make, step = torch.Generator().manual_seed(seed), torch.linalg.matrix_exp(h * A)
    x, path, u = torch.zeros(5, dtype=torch.float64), [], []
    for n in range(samples):
        if n % 60 == 0:
            x[4] = 1.2 * float(torch.rand((), generator=make)) - 0.6
        path, u = [*path, x[:2]], [*u, x[4].clone()]
        x = torch.cat([(step @ x)[:4], x[4:]])
    q = torch.stack(path)
    q = q + torch.tensor([1e-4, 2e-3]) * torch.randn(q.shape, generator=make, dtype=q.dtype)
    t = h * torch.arange(samples, dtype=torch.float64)
    data = Trajectories.of(t, q, u=torch.stack(u)[:, None], hold="zero")
    return replace(data, names=("motor", "carriage"), units=("rad", "mm"))


def test_a_belt_pulls_by_a_difference_of_two_units():
    # fails if a difference of coordinates is that of their numbers in any units: what holds motor [rad] and carriage
    # [mm] together was three terms, none of which alone was better, and a stiff belt was not found
    data = drive()
    (ratio,) = proportions(data).values()
    assert float(ratio) == pytest.approx(20.0, rel=1e-4)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    fitter = search.fitter(Variant(2, substeps=2))
    taken = {f"({ratio} q1 - q2)^2", f"({ratio} v1 - v2)"}
    assert taken <= {offer.name for offer in fitter.offers}
    found = search.climbed(fitter, fitter.simple | taken, {})
    assert found is not None
    assert found.segments_at_the_noise
    assert taken <= found.taken
    value = {fitter.keys[name]: x for name, x in found.values.items()}
    # V = ½ k (ρ φ − x)² over the mass 10/ρ of the motor, and so the damper.
    assert value[f"({ratio} q1 - q2)^2"] == pytest.approx(2000 / 20 / 10 / 2, rel=0.05)
    assert value[f"({ratio} v1 - v2)"] == pytest.approx(1 / 20 / 10, rel=0.1)


@pytest.mark.parametrize("changes", [{"units": ("mm", "mm")}, {"angles": (True, False)}])
def test_one_unit_and_angles_have_no_ratio(changes):
    # fails if the differences of coordinates of one unit, which springs have, get another ratio
    assert proportions(replace(drive(samples=400), **changes)) == {}


SHAFTS = {"units": ("rad", "rad"), "names": ("motor", "load")}


def test_a_gear_has_the_ratio_of_its_shafts():
    # fails if a motor and a load behind a gear are joined by no term, so that a rigid body is all that is found; if
    # shafts without a gear have a ratio of 0.9999; or if angles have one that a spring may hold to the frame
    assert float(proportions(replace(drive(samples=400), **SHAFTS))[1, 2]) == pytest.approx(20.0, rel=1e-3)
    assert proportions(replace(drive(ratio=1.0), **SHAFTS)) == {}
    little = drive(samples=400, gain=20.0)
    assert proportions(replace(little, **SHAFTS)) == {}
    assert proportions(little)  # of rad and mm


def test_a_shaft_twists_by_a_spring_and_not_by_the_sine_of_its_twist():
    # fails if a wave of the twist stays wherever it meets the noise: the stiffness was 0.1 % off, 40 deviations
    data = replace(drive(ratio=1.0, gain=100.0), angles=(True, True), **SHAFTS)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    fitter = search.fitter(Variant(2))
    taken = fitter.simple | {"cos(q1 - q2)", "coupling.viscous"}
    wave = fitter.fit(taken, {}, 5, None, 60)
    assert wave is not None
    wave = search.finer(fitter.grow(search.finer(wave)))
    assert wave.at_the_noise
    found = search.wound(wave)
    assert "(q1 - q2)^2" in found.taken
    assert "cos(q1 - q2)" not in found.taken


def test_a_damper_in_proportion_brakes_both():
    # fails if the force on the first coordinate lacks the ratio: power and loss would differ
    config = ModelConfig(
        angles=(False, False), level="forced", scale=(1.0, 1.0), speed=(1.0, 1.0), stiffness=(0.0, 0.0),
        tilt=(0.0, 0.0), potential_width=0, rate=0.0, drag=("(2.5 v1 - v2)",),
    )  # fmt: skip
    model: Any = ContactLagrangian(config)
    v = torch.tensor([[0.7, -0.4]], dtype=torch.float64)
    with torch.no_grad():
        model.drag.coefficient.fill_(3.0)
        forces = model.forces(0 * v, 0.1 * v, torch.zeros(1).double(), torch.full((1,), 0.1).double())
    total = (forces[0] + forces[1]) / 0.1
    slip = 2.5 * 0.7 + 0.4
    assert total[0].tolist() == pytest.approx([-3 * 2.5 * slip, 3 * slip])
