"""Offers of serial chains of joints, from which a search of many joints starts."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from herglotz.data import Trajectories
from herglotz.training.baseline import estimate_baseline
from herglotz.training.config import FitConfig
from herglotz.training.found_model import settings
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.search import Search
from herglotz.training.serial_chains import serial_chains
from herglotz.training.task import build_model
from herglotz.training.trials import Variant

PLAIN = ["kinetic.off_diagonal[0]", "potential.tilt[0]", "friction.viscous[1]", "friction.input_map[2]"]


def test_a_chain_has_the_masses_of_its_joints_and_no_others():
    # fails if masses depend on the first angle, sums leave out a joint between two others, or friction joins the start
    offers = {
        "cos(q2) v1 v1", "cos(q3) v1 v3", "cos(q2 + q3) v1 v2", "cos(q1 + q2)", "sin(q1 + q2 + q3)",
        "cos(q1 - q3) v1 v3", "cos(q1) v2 v2", "cos(q1 + q2) v1 v1", "sin(q2) v1 v1", "cos(q1 + q3)",
        "cos(q1 - q3) v1 v1", "friction.coulomb[0]", "|v1| v1", *PLAIN,
    }  # fmt: skip
    relative, absolute = serial_chains((True, True, True), offers)
    assert relative == {
        "cos(q2) v1 v1", "cos(q3) v1 v3", "cos(q2 + q3) v1 v2", "cos(q1 + q2)", "sin(q1 + q2 + q3)", *PLAIN,
    }  # fmt: skip
    assert absolute == {"cos(q1 - q3) v1 v3", *PLAIN}


def test_lengths_are_no_joints():
    # fails if a cart between two joints is taken for a joint, or one joint for a chain
    offers = ["cos(q1 + q3)", "cos(q3) v1 v3", "cos(q2) v1 v1", "cos(q3) v2 v2"]
    assert serial_chains((True, False, True), offers)[0] == {"cos(q1 + q3)", "cos(q3) v1 v3"}
    assert serial_chains((True, False), offers) == []


def arm(count, h=0.01, fine=4, noise=1e-3):
    """A driven arm of three rods in the plane with damped joints, in relative angles, from its mass matrix."""
    m, length = np.array([4.0, 3.0, 1.5]), np.array([0.4, 0.35, 0.2])
    reach = np.tril(np.tile(length, (3, 1)), -1) + np.diag(length / 2)  # of the middle of a rod, by rod and joint
    A = np.einsum("b,bi,bj->ij", m, reach, reach)
    inertia, rng = np.diag(m * length**2 / 12), np.random.default_rng(0)
    limits, rub = np.array([8.0, 4.0, 0.8]), np.array([1.0, 0.6, 0.2])
    u = np.repeat(rng.uniform(-limits, limits, (count // 40 + 1, 3)), 40, 0)[:count]

    def rate(x, u):
        angle, speed, torque = np.cumsum(x[:3]), np.cumsum(x[3:]), u - rub * x[3:]
        apart = angle[:, None] - angle
        force = torque - np.append(torque[1:], 0.0) - (A * np.sin(apart)) @ speed**2
        return np.concatenate([x[3:], np.diff(np.linalg.solve(A * np.cos(apart) + inertia, force), prepend=0.0)])

    x, out = np.array([0.0, 0.3, -0.2, 0.0, 0.0, 0.0]), []
    for held in u:
        out.append(x[:3])
        for _ in range(fine):
            k = rate(x, held)
            k = rate(x + h / fine / 2 * k, held)
            x = x + h / fine * rate(x + h / fine / 2 * k, held)
    q = np.array(out) + noise * rng.standard_normal((count, 3))
    return Trajectories.of(h * np.arange(count), q, u=u, hold="zero", angles=(True,) * 3)


def searched(data):
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    search.order = 2
    return search


@pytest.mark.slow  # the kernel of three joints alone takes 10 s
def test_the_law_of_an_arm_of_three_joints_is_found_from_a_chain():
    # fails if a chain has not all terms of an arm, or too many for its fit to follow the motion
    search = searched(arm(600))
    fitter = search.fitter(Variant(2))
    relative, _ = serial_chains(search.data.angles, [offer.name for offer in fitter.offers])
    found = search.climbed(fitter, relative, {})
    assert found is not None
    assert found.at_the_noise
    assert not [name for name in found.taken if "q1" in name]


@pytest.mark.parametrize(("noise", "whole", "asked"), [(False, False, 2), (False, True, 0), (True, False, 0)])
def test_chains_are_asked_for_where_the_whole_dictionary_cannot_be_followed(noise, whole, asked, monkeypatch):
    # fails if every search climbs from chains, too, or none does
    search, tried = searched(arm(60)), []
    first = cast(Any, SimpleNamespace(at_the_noise=noise, length=5, names=[]))
    search.first, search.full = first, cast(Any, SimpleNamespace(whole=whole, length=5))
    monkeypatch.setattr(search, "climbed", lambda _, taken, values: tried.append(taken))  # noqa: ARG005
    for name in ("linear_start", "settled"):
        monkeypatch.setattr(search, name, lambda *_: None)
    monkeypatch.setattr(Search, "undriven", None)
    monkeypatch.setattr(search, "finalist", lambda best, _: best)
    for name in ("without_injecting_friction", "with_sticking", "with_dissipation"):
        monkeypatch.setattr(f"herglotz.training.search.{name}", lambda _, found, *__: found)
    assert search.run() is first
    assert len(tried) == asked


def test_constant_masses_between_three_coordinates_are_those_of_the_search():
    # fails if keys with an index are overlooked, and the model that a search found loses what couples its masses
    t = 0.05 * np.arange(40)
    q = np.stack([np.cos(t), np.sin(1.3 * t), np.cos(0.7 * t + 1)], 1)
    search = searched(Trajectories.of(t, q, angles=(True,) * 3))
    fitter = search.fitter(Variant(2))
    found = fitter.fit({"kinetic.off_diagonal[1]", "potential.stiffness[0]"}, {}, 5, None, 2)
    assert found is not None
    config, base = settings(found, search.config)
    numbers = ParameterVector(build_model(base, config, "none"))
    values = dict(zip(numbers.numbers, numbers.get().tolist(), strict=True))
    number = next(name for name, key in fitter.keys.items() if key == "kinetic.off_diagonal[1]")
    own = [x for name, x in values.items() if "off_diagonal" in name]
    assert own == [pytest.approx(found.values[number])]
    assert own[0] != 0
