"""The driven pendulum: one Lagrangian a step, and data that carry the torque."""

import math
from typing import Any

import pytest
import torch

from herglotz.data import simulate
from herglotz.mechanics import partials
from herglotz.scenes import scene
from herglotz.stepping import Stepper

SYSTEM: Any = scene("driven_pendulum", gamma=0.35, amplitude=0.7, frequency=0.9)


def start():
    return (
        torch.tensor([[0.4], [-1.1], [1.9]], dtype=torch.float64),
        torch.tensor([[0.3], [0.8], [-0.5]], dtype=torch.float64),
        torch.zeros(3, dtype=torch.float64),
    )


def error(rule, parts, torques=8, h=0.25):
    """Of a rollout with `parts` steps to each held torque, at the end."""
    u = SYSTEM.drive(h * (torch.arange(torques, dtype=torch.float64) + 0.5))
    x = start()
    for one in u:
        x = SYSTEM.at(one).flow(*x, h)
    inputs = u.repeat_interleave(parts, 0)
    out = Stepper(SYSTEM.L_d_rules[rule]).rollout(*start(), h=h / parts, inputs=inputs)
    assert bool(out.ok.all())
    assert out.sigma[:, -1].sub(math.exp(-0.35 * torques * h)).abs().max() < 1e-2
    return float((out.q[:, -1] - x[0]).abs().max())


@pytest.mark.parametrize(("rule", "order"), [("left", 1), ("midpoint_heun", 2), ("strang", 2)])
def test_a_rollout_under_a_given_torque_keeps_its_order(rule, order):
    # fails if the torque of a step is another step's, is dropped, or has another sign than in the flow
    slope = math.log2(error(rule, 4) / error(rule, 8))
    assert order - 0.15 < slope < order + 0.15


def test_a_torque_for_each_sample():
    # fails if inputs of a batch are mixed up
    q, p, s = start()
    u = torch.tensor([[0.2], [-0.4], [0.9]], dtype=torch.float64)
    L_d = SYSTEM.L_d_rules["midpoint"]
    together = partials(L_d.at(u), q, q + 0.1 * p, s, 0.1, 2)
    for i in range(3):
        alone = partials(L_d.at(u[i]), q[i], q[i] + 0.1 * p[i], s[i], 0.1, 2)
        torch.testing.assert_close(alone.D12, together.D12[i])
        torch.testing.assert_close(alone.D1, together.D1[i])
    at = SYSTEM.at(u)
    torch.testing.assert_close(at.flow(q, p, s, 0.3)[0][1], SYSTEM.at(u[1]).flow(q[1], p[1], s[1], 0.3)[0])


def test_the_scene_itself_has_the_torque_of_the_start():
    # fails if the scene's own functions and its L_d stand for different torques
    one = SYSTEM.at(SYSTEM.drive(torch.tensor(0.0, dtype=torch.float64)))
    q, p, s = start()
    torch.testing.assert_close(one.hamiltonian(q, p, s), SYSTEM.hamiltonian(q, p, s))
    h = torch.tensor(1e-3, dtype=torch.float64)
    for name in ("midpoint_heun", "strang"):
        near = SYSTEM.L_d_rules[name](q, q + h * p, s, h) / h
        assert (near - SYSTEM.lagrangian(q, p, s)).abs().max() < 2e-3


def test_simulated_data_carry_the_torque_that_moved_them():
    # fails if the stored input belongs to another step, or if a gap keeps that of its first step only
    data: Any = simulate(SYSTEM, trajectories=3, steps=30, h=0.1, gaps=2, seed=4, keep_state=True)
    assert data.u.shape == (data.samples, 1)
    whole: Any = simulate(SYSTEM, trajectories=3, steps=30, h=0.1, seed=4, keep_state=True)
    one = whole[0]
    for k in (0, 13):
        q1 = SYSTEM.at(one.u[k]).flow(one.q[k], one.p[k], one.s[k], 0.1)[0]
        torch.testing.assert_close(q1, one.q[k + 1], rtol=0, atol=1e-12)
    for first, full in zip(data, whole, strict=True):
        at = (first.t / 0.1).round().long()
        a, b = int(at[:-1][at.diff() > 1][0]), int(at[1:][at.diff() > 1][0])
        k = int((at == a).nonzero())
        torch.testing.assert_close(first.u[k], full.u[a:b].mean(0))
