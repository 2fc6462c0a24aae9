"""The motor axis: exact through reversals, true sticking, and data that carry the force."""

import math

import mpmath as mp
import pytest
import torch

from herglotz.data import simulate
from herglotz.mechanics import contact_defect, flow_derivative
from herglotz.scenes import scene

NUMBERS = {"m": 2.0, "viscous": 0.6, "dry": 0.5, "offset": 0.1, "amplitude": 1.0, "frequency": 1.0}


def at(force, **changes):
    """The scene under a held force, the offset taken off."""
    system = scene("servo_axis", **{**NUMBERS, **changes})
    return system.at(torch.tensor([force - system.parameters["offset"]], dtype=torch.float64))  # type: ignore[misc]


def state(x, v, s=0.0, m=2.0):
    q, p, s = (torch.tensor(y, dtype=torch.float64) for y in ([[x]], [[m * v]], [s]))
    return q, p, s


def slip(t, a, g, x, v):
    """Place and speed after a time t under v̇ = a − g v."""
    return x + a / g * t + (v - a / g) * (1 - mp.exp(-g * t)) / g, a / g + (v - a / g) * mp.exp(-g * t)


def by_mpmath(force, x, v, s, t, m=2.0, d=0.6, dry=0.5):
    """30 digits: slip until rest, found by a root, then rest or slip the other way."""
    with mp.workdps(30):
        force, x, v, s, t, m, d, dry = (mp.mpf(str(y)) for y in (force, x, v, s, t, m, d, dry))
        way = mp.sign(v) if v != 0 else (mp.sign(force) if abs(force) > dry else 0)
        while t > 0:
            a, g = (force - way * dry) / m, d / m
            if way == 0:
                a = mp.mpf(0)
            stop = mp.log(1 - g * v / a) / g if a * v < 0 else mp.inf
            end, path = min(stop, t), (a, g, x, v)

            def rate(r, end=end, path=path):
                y, w = slip(r, *path)
                return mp.exp(-path[1] * (end - r)) * (m * w**2 / 2 + force * y)

            s = mp.exp(-g * end) * s + mp.quad(rate, [0, end])
            (x, v), t = slip(end, *path), t - end
            if t > 0:
                v, way = mp.mpf(0), (mp.sign(force) if abs(force) > dry else 0)
        return float(x), float(m * v), float(s)


@pytest.mark.parametrize(
    ("force", "x", "v"),
    [
        (1.3, 0.1, 0.4),  # slips on
        (-1.3, 0.1, 0.4),  # reverses
        (0.3, 0.1, 0.4),  # comes to rest and sticks
        (-0.3, -0.2, -0.4),  # the same the other way
        (0.3, 0.1, 0.0),  # sticks throughout
        (-0.8, 0.1, 0.0),  # is pushed out of rest
    ],
)
@pytest.mark.parametrize("t", [0.3, 2.5])
def test_against_thirty_digits(force, x, v, t):
    # fails if the time of an event, the speed after it, or the action of a piece is wrong
    wanted = by_mpmath(force, x, v, 0.2, t)
    q, p, s = at(force).flow(*state(x, v, 0.2), t)
    for value, expected in zip((q, p, s), wanted, strict=True):
        assert abs(float(value) - expected) < 1e-13


def test_without_viscous_friction():
    # fails if γ = 0 divides by 0: braking at constant force from 0.4 takes 0.4 m/F_c and 0.4² m/2F_c
    q, p, _ = at(0.0, viscous=0.0).flow(*state(0.0, 0.4), 5.0)
    assert abs(float(q) - 0.4**2 * 2.0 / (2 * 0.5)) < 1e-14
    assert float(p) == 0.0


def test_it_sticks_exactly_and_never_gains_energy():
    # fails if a body at rest creeps below the level of dry friction, or friction drives
    axis, make = at(0.0), torch.Generator().manual_seed(1)
    q, v = (torch.rand(200, 1, generator=make, dtype=torch.float64) - 0.5 for _ in range(2))
    p, s = 2.0 * v, torch.zeros(200, dtype=torch.float64)
    for h in (0.01, 0.3, 4.0):
        _, p1, _ = axis.flow(q, p, s, h)
        assert bool((p1.abs() <= p.abs()).all())
        assert bool((p1 * p >= 0).all())
    assert bool((p1 == 0).all())
    x = state(0.3, 0.0)
    for _ in range(3):
        x = at(0.49).flow(*x, 0.7)
    assert (float(x[0]), float(x[1])) == (0.3, 0.0)


def test_without_dry_friction_it_is_a_contact_map():
    # fails if s does not belong to (q, p), or viscous friction is not the contact term: c = e^{−γh}
    system, (q, p, s) = at(1.3, dry=0.0), state(0.1, 0.4, 0.2)
    (_, p1, _), D = flow_derivative(lambda q, p, s: system.flow(q, p, s, 0.6), q, p, s)
    c = torch.full_like(s, math.exp(-0.3 * 0.6))
    assert float(contact_defect(D, p, p1, c).abs().max()) < 1e-13
    assert float(contact_defect(D, p, p1, 1.001 * c).abs().max()) > 1e-4


def test_simulated_data_stick_and_carry_the_force():
    # fails if data of the scene lack the input, or never come to rest
    system = scene("servo_axis", amplitude=30.0)
    data = simulate(system, trajectories=2, steps=300, h=0.02, seed=1)
    assert data.u is not None
    assert data.u.shape == (data.samples, 1)
    rest = (data.q[1:301] == data.q[:300]).sum()
    assert 20 < int(rest) < 250
