"""The open zoo: its motions obey their laws, its draws are repeatable, and its peer learns."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import zoo
from benchmarks.zoo_systems.mechanisms import Array, Mechanism
from benchmarks.zoo_systems.neural_ode import NeuralODE, fit_neural_ode
from benchmarks.zoo_systems.open_laws import LAWS, fixed_law
from benchmarks.zoo_systems.open_systems import (
    AHEAD,
    KINDS,
    WARMUP,
    OpenMechanism,
    attainable,
    cam,
    crank,
    herglotz,
    linkage,
    motion,
    open_draw,
    variable_length,
    wire,
)
from benchmarks.zoo_systems.prediction import MechanismModel, own_predictions
from benchmarks.zoo_systems.report import AT, relative
from benchmarks.zoo_systems.systems import Recording

VALUES = {"b": 0.0, "J": 0.538492, "d": 0.146758, "one": 0.946618, "two": 0.964355}  # of system 2 of open zoo 9001
SAMPLE = -3.3936143528922904


@pytest.fixture(scope="module")
def drawn():
    """A cheap draw: a cam, two recordings with noise."""
    return open_draw(9001, 2)


def still(slope, hidden: int = 0) -> OpenMechanism:
    """A mechanism of one coordinate without a name."""
    return OpenMechanism("", 1, (False,), slope, {}, hidden=hidden)


@pytest.mark.parametrize("f", [crank(0.5), cam(0.6, 2.0), wire(0.9, 0.3, 0.4)])
def test_a_linkage_keeps_its_energy(f):
    # fails if the mass of a linkage is not that of its geometry, or its derivative lacks in the force: the energy is
    # (J + f′²) θ̇² / 2 + pull f + hold f² / 2; or if a derivative of the geometry is wrong
    J, pull, hold = 0.4, 0.7, 0.5
    q = np.array([[0.3], [-1.1], [2.0]])
    (y, y1, y2), e = f(q), 1e-5
    np.testing.assert_allclose(y1, (f(q + e)[0] - f(q - e)[0]) / (2 * e), atol=1e-8)
    np.testing.assert_allclose(y2, (f(q + e)[1] - f(q - e)[1]) / (2 * e), atol=1e-8)
    assert power(linkage(f, J, pull, hold, 0.0, 0.0), lambda q, v: (J + f(q)[1] ** 2) * v**2 / 2 + pull * f(q)[0]
                 + hold * f(q)[0] ** 2 / 2) < 1e-8  # fmt: skip
    assert y.shape == (3, 1)


def test_a_pendulum_of_variable_length_keeps_its_energy():
    # fails if the force of the changing length is left out: E = (ℓ² + ℓ′²) θ̇² / 2 − ℓ cos θ
    e, turns = 0.3, 2

    def energy(q, v):
        length, l1 = 1 + e * np.cos(turns * q), -e * turns * np.sin(turns * q)
        return (length**2 + l1**2) * v**2 / 2 - length * np.cos(q)

    assert power(variable_length(e, turns, 0.0, 0.0), energy) < 1e-8
    assert power(variable_length(e, turns, 0.1, 0.0), energy) > 0.01


def power(slope, energy) -> float:
    """Largest rate of change of the energy at some states, by differences along the motion."""
    q, v, u, e = np.array([[0.3], [-1.1], [2.0]]), np.array([[0.8], [-0.5], [0.3]]), np.zeros(3), 1e-6
    a = slope(q, v, np.zeros((3, 0)), u)[0]
    return float(np.abs((energy(q + e * v, v + e * a) - energy(q - e * v, v - e * a)) / (2 * e)).max())


def test_action_dependent_friction_is_herglotzs():
    # fails if the friction is not ∂L/∂s p, or the action is not the integral of L:
    # d/dt ∂L/∂v = ∂L/∂q + ∂L/∂s ∂L/∂v, ṡ = L, with L = v²/2 − V − γ s − β s² + b u q
    gamma, beta, b = 0.1, 0.3, 0.8
    V = lambda x: x**2 / 2 + x**4 / 4  # noqa: E731
    L = lambda q, v, s, u: v**2 / 2 - V(q) - gamma * s - beta * s**2 + b * u * q  # noqa: E731
    q, v, s, u, e = 0.7, -0.4, 0.5, 0.3, 1e-6
    slopes = [(L(*(x + e * d)) - L(*(x - e * d))) / (2 * e) for d in np.eye(4)[:3] for x in [np.array([q, v, s, u])]]
    slope = herglotz(V, lambda x: x + x**3, gamma, beta, b)
    a, ds = slope(np.array([[q]]), np.array([[v]]), np.array([[s]]), np.array([u]))
    assert a[0, 0] == pytest.approx(slopes[0] + slopes[2] * slopes[1], abs=1e-8)  # ∂L/∂v = v: its rate is q̈
    assert ds[0, 0] == pytest.approx(L(q, v, s, u))


def test_motions_are_as_exact_as_the_zoo_needs():
    # fails if hidden states are left out of the steps, or inputs are not held: q̈ = w, ẇ = u from rest has t³/6 u
    of = still(lambda q, v, w, u: (w, 0 * w + u[:, None]), hidden=1)  # noqa: ARG005
    t, u = np.linspace(0, 2, 5), np.ones((2, 5))
    u[1, 2:] = 0.0
    q = motion(of, np.zeros((2, 3)), t, u)
    np.testing.assert_allclose(q[0, :, 0], t**3 / 6, atol=1e-12)
    np.testing.assert_allclose(q[1, 4, 0], 1 / 6 + 1 / 2 + 1 / 2, atol=1e-12)  # w stays 1 from t = 1 on


def test_what_is_attainable_is_what_the_warm_up_leaves_open():
    # fails if the true equation is given a start that no recording tells, or the noise of the data predicted is left
    # out: a line through 20 samples is off by σ √(1 + x (XᵀX)⁻¹ xᵀ) at x
    of, count = still(lambda q, v, w, u: (0 * q, w)), 400  # noqa: ARG005
    t: Array = 0.01 * np.arange(WARMUP + AHEAD, dtype=np.float64)
    truth = np.zeros((count, len(t), 1))
    data = Recording(t, truth, truth, np.zeros((count, len(t))))
    X = np.stack([t**0, t], -1)
    open_ = np.einsum("ki,ij,kj->k", X[WARMUP:], np.linalg.inv(X[:WARMUP].T @ X[:WARMUP]), X[WARMUP:])
    wanted = np.sqrt(1 + open_.mean())
    found = attainable(of, np.zeros((count, 2)), data, np.array([0.1]))
    assert found == pytest.approx(wanted, rel=0.1)  # 5 % is the spread of 400 starts


def test_a_draw_is_the_same_everywhere(drawn):
    # fails if a draw depends on the count, the order or the machine, or the protocol is not that of the zoo
    assert json.dumps(drawn.facts()["values"]) == json.dumps(VALUES)
    assert abs(drawn.train.truth[1, 77, 0] - SAMPLE) < 1e-9
    assert (drawn.name, drawn.train.q.shape) == ("cam 1, viscous, 35/period, 0.3 % noise", (2, 425, 1))
    assert (drawn.warmup, drawn.test.q.shape) == (WARMUP, (3, WARMUP + AHEAD, 1))
    assert 0.5 < drawn.attainable < 1.3
    noise = (drawn.train.q - drawn.train.truth).std() / drawn.size[0]
    assert noise == pytest.approx(drawn.noise, rel=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_moves_and_loses_energy(kind):
    # fails if a kind runs away, is driven where it has no input, or rests
    rng = np.random.default_rng(5)
    of = KINDS[kind](rng, 0.0)
    x0 = np.concatenate([r * rng.uniform(0.3, 1, (4, of.n)) for r in of.reach] + [np.zeros((4, of.hidden))], -1)
    t = np.linspace(0, 60, 240)
    q = motion(of, x0, t, np.zeros((4, 240)), 0.05)
    assert np.isfinite(q).all()
    early, late = (np.abs(np.diff(part, axis=1)).max(1).mean() for part in (q[:, :60], q[:, -60:]))
    assert early > 0.01
    assert late < 0.9 * early


@pytest.mark.parametrize("number", range(1, len(LAWS) + 1))
def test_a_law_has_the_same_motion_with_and_without_noise(number):
    # fails if a law cannot be recorded, or its rows are of two motions
    exact, noisy = fixed_law(number, 0.0), fixed_law(number, 0.005)
    np.testing.assert_array_equal(exact.train.truth, noisy.train.truth)
    np.testing.assert_array_equal(exact.train.q, exact.train.truth)
    assert (noisy.train.q - noisy.train.truth).std(axis=(0, 1)) == pytest.approx(0.005 * noisy.size, rel=0.1)
    assert exact.driven == (number == 6)


def spring(budget_samples: int = 60) -> Any:
    """A linear spring in three exact recordings, as a member of the zoo."""
    from benchmarks.zoo_systems.open_systems import recorded

    of = OpenMechanism("spring", 1, (False,), lambda q, v, w, u: (-q - 0.1 * v + u[:, None], w), {})
    found = recorded(np.random.default_rng(0), of, (0, 0), True, 31.4, (3, budget_samples), 0.0, (1.0, 1.0))
    assert found is not None
    return found


def test_the_peer_steps_as_its_network_says():
    # fails if velocities, inputs or units are mixed up in the peer: with the true acceleration it has the true motion
    of = spring()
    model = NeuralODE(of, np.array([2.0]), 3.0)
    model.acceleration = lambda q, v, u: -q - 0.1 * v + u[:, None]  # type: ignore[method-assign]
    found = own_predictions(of, model)
    assert relative(of, found) < 1e-4  # of RK4 in steps of 0.2
    known = own_predictions(replace(of), MechanismModel(Mechanism("spring", 1, {"k": 1.0, "d0": 0.1, "b": 1.0})))
    np.testing.assert_allclose(found["unseen"][0], known["unseen"][0], atol=1e-4)


def test_the_peer_turns_with_an_angle():
    # fails if a full turn changes the acceleration of a peer
    named: Any = SimpleNamespace(n=2, angles=(True, False))
    of: Any = SimpleNamespace(mechanism=named, size=np.ones(2))
    model = NeuralODE(of, np.ones(2), 1.0)
    q, v, u = torch.rand(4, 2).double(), torch.rand(4, 2).double(), torch.zeros(4).double()
    turned, moved = (model.acceleration(q + torch.tensor(x).double(), v, u) for x in ((2 * np.pi, 0), (0, 1.0)))
    torch.testing.assert_close(turned, model.acceleration(q, v, u))
    assert not torch.allclose(moved, turned)


def test_the_peer_learns():
    # fails if the peer is weakened: a gradient that is not followed, windows of other recordings, times or inputs
    of = spring(240)
    before, after = (relative(of, own_predictions(of, fit_neural_ode(of, budget))) for budget in (0.0, 1.5))
    assert after < 0.25 * before  # 0.06 measured in twice the time, 0.08 in two thirds of it


def test_the_command_measures_laws_and_open_draws(tmp_path, monkeypatch, capsys, drawn):
    # fails if --open or --laws measures other systems, or a table of them cannot be made
    seen = []

    def measure(of, *_):
        seen.append(of.name)
        numbers = {"score": 1.0, "relative": 0.01, "cpu_s": 3.0}
        row = of.facts() | {"ours": {**numbers, "said": ""}, "neural_ode": numbers, "outcome": AT}
        return row | {"attainable": of.attainable, "ahead_of_neural_ode": True}

    monkeypatch.setattr(zoo, "measure", measure)
    monkeypatch.setattr(zoo, "open_draw", lambda seed, index: {(9001, 2): drawn}[seed, index])
    zoo.main(["--open", "--draw", "9001", "--only", "2", "--out", str(tmp_path)])
    text = capsys.readouterr().out
    assert "ahead of neural ODE" in text
    assert "| attainable |" in text
    assert "SINDy" not in text
    zoo.main(["--laws", "--only", "4", "--json", "--out", str(tmp_path)])
    assert [row["noise"] for row in json.loads(capsys.readouterr().out)["rows"]] == [0.0, 0.005]
    assert seen[1].startswith("two saturating springs")
