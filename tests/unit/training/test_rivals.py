"""Named terms or networks: what decides, what it saves, and what the winner goes on from."""

import math
from types import SimpleNamespace

import pytest

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig, rivals
from herglotz.training.plan import Plan
from herglotz.training.stages import Stages

NOISE = 0.01


def plan(network):
    plain = {"coulomb": False, "sticking": False, "coupled": False, "diagonal": False, "alike": False}
    return Plan(
        level="linear", objective="trajectory", network=network, order=2, features=(), hold="",
        delay=0.0, lag=0.0, drag=(), substeps=1,
        forces=plain, start={"stiffness": (1.0,), "tilt": (0.0,), "rate": (0.1,)}, outliers=False,
        continues_probe=False, sigma=None, fitted_before=network == "none", restarts=1, departures=(2e-4, 6e-3),
        reasons={"network": "", "objective": ""},
    )  # fmt: skip


@pytest.fixture
def held(monkeypatch):
    """Plans of both rivals with the errors that a test gives them; the looks that were taken are counted."""
    errors, looks = {}, []

    def look(*_, named, zeros):
        looks.append((named, zeros))
        return SimpleNamespace(name="networks")

    def held_out(seen, config, plan, every=1):  # noqa: ARG001
        return errors[plan.network]

    monkeypatch.setattr(rivals, "look", look)
    monkeypatch.setattr(rivals, "choose", lambda seen, _: plan("potential" if seen.name == "networks" else "none"))
    monkeypatch.setattr(rivals, "_held_out", held_out)
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=60, h=0.2, noise=NOISE, seed=0)
    found = SimpleNamespace(doubt=True, apart=False)
    seen = SimpleNamespace(name="named", kept=data, train=data, found=found, zeros=(), apart="")

    def winner(named, networks):
        errors.update({"none": named, "potential": networks})
        return rivals.held_out_winner(data, FitConfig(), Stages(False, None, "", resume=False), seen)  # type: ignore[arg-type]

    return SimpleNamespace(winner=winner, looks=looks)


def test_named_terms_at_the_noise_have_no_rival(held):
    # fails if networks are fitted, or looked for, where they could win nothing
    seen, chosen = held.winner({"rms": 1.2 * NOISE, "sigma": NOISE}, None)
    assert seen.name == "named"
    assert chosen.network == "none"
    assert "noise" in chosen.reasons["objective"]
    assert held.looks == []


def test_networks_have_to_err_less_by_a_twentieth(held):
    # fails if a richer model wins by what a held-out stretch of time cannot tell (3 % on a motor axis)
    assert held.winner({"rms": 0.103, "sigma": NOISE}, {"rms": 0.1, "sigma": NOISE})[0].name == "named"
    assert held.winner({"rms": 0.107, "sigma": NOISE}, {"rms": 0.1, "sigma": NOISE})[0].name == "networks"


def test_the_smaller_error_wins_and_networks_go_on_from_their_fit(held):
    # fails if the larger error wins, or if the last fit starts from nothing or searches the prior again
    values = {"potential.network.weights.0": (0.5, 0.25)}
    second = {"rms": 3 * NOISE, "sigma": NOISE, "departure": 6e-3, "start": values}
    seen, chosen = held.winner({"rms": 5 * NOISE, "sigma": NOISE}, second)
    assert (seen.name, chosen.network) == ("networks", "potential")
    assert chosen.fitted_before
    assert chosen.departures == (6e-3,)
    assert chosen.sigma == NOISE
    assert chosen.start["potential.network.weights.0"] == (0.5, 0.25)
    assert chosen.start["stiffness"] == (1.0,)


@pytest.mark.parametrize("networks", [6 * NOISE, math.inf])
def test_networks_that_err_more_lose(held, networks):
    # fails if a free run that breaks off wins, or a tie is decided for the larger model
    seen, chosen = held.winner({"rms": 5 * NOISE, "sigma": NOISE}, {"rms": networks, "sigma": NOISE})
    assert (seen.name, chosen.network) == ("named", "none")
    assert chosen.departures == (2e-4, 6e-3)
