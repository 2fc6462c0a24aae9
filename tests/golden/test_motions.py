"""Motions of half a unit of time against 30-digit Taylor integration of the equations written out by hand."""

from typing import Any

import pytest
import torch

from herglotz.mechanics import legendre_minus, legendre_plus
from herglotz.scenes import scene

H = 0.5
# scene, parameters, q, p, s and after H: q, p, s
MOTIONS = {
    "cart_pole": (
        {"cart": 1.3, "m": 0.6, "length": 0.8, "g": 4.0, "gamma": 0.4},
        ([0.3, 0.9], [0.5, -0.4], 0.2),
        (
            [0.6671724947473986961687, -0.1993261673555571806213],
            [0.409365376538990929335, -0.5312850669718523966443],
            0.4048287595736069649237,
        ),
    ),
    "duffing": (
        {"k": 0.7, "beta": 12.0, "gamma": 0.3},
        ([0.4], [-0.2], 0.3),
        ([0.2147554286281520937932], [-0.4664252592361972199864], 0.2589351286766991258635),
    ),
    "driven_duffing": (
        {"k": 0.7, "beta": 2.5, "gamma": 0.35, "amplitude": 0.3},
        ([0.6], [-0.4], 0.3),
        ([0.364645351691304107276], [-0.4896915431338699133591], 0.3139182770173415636607),
    ),
    "chain": (
        {"masses": 2, "m": 1.3, "k": 0.8, "beta": 1.1, "gamma": 0.3},
        ([0.4, -0.3], [0.2, 0.5], 0.1),
        (
            [0.3638122151521984565415, -0.03271689885739339370733],
            [-0.3227059739474315097486, 0.8134138970941392749566],
            0.06328567443043790234595,
        ),
    ),
    "driven_pendulum": (
        {"gamma": 0.35, "amplitude": 0.7},
        ([0.7], [-0.4], 0.3),
        ([0.5289983619067975166397], [-0.2759494097039489819138], 0.3911665702255657096143),
    ),
    # integrated in body momenta (1.9, -0.3, 0.2), where no chart enters the equations
    "rigid_body": (
        {"J1": 2.1, "J2": 1.7, "J3": 0.9, "gamma": 0.3},
        ([0.4, 0.3, -0.7], [1.9, -0.3542019666625956231728, -0.4971114229829716543619], 0.3),
        (
            [0.8244959784128037995395, 0.1687680496287027350276, -0.6779862018908212916501],
            [1.621880605965614670816, -0.3395573696401692803343, -0.4278677669334545064928],
            0.6211652886995271796055,
        ),
    ),
}


def tensors(q, p, s) -> Any:
    return tuple(torch.tensor(x, dtype=torch.float64) for x in (q, p, s))


@pytest.mark.parametrize("name", MOTIONS)
def test_flow(name):
    # fails if any term of the scene's equations or the chart of the body has another sign, factor or place
    parameters, start, end = MOTIONS[name]
    q, p, s = tensors(*start)
    for value, expected in zip(scene(name, **parameters).flow(q, p, s, H), tensors(*end), strict=True):
        torch.testing.assert_close(value, expected, rtol=0, atol=2e-14)


def test_flow_under_a_force_beside_the_lagrangian():
    # fails if the damping of van der Pol's oscillator has another sign, or leaks into the action
    q, p, s = tensors([0.7], [-0.9], 0.3)
    wanted = tensors([0.03496728922127354203806], [-1.874924464564448874652], 0.7112742996583654496712)
    for value, expected in zip(scene("van_der_pol", mu=1.4).flow(q, p, s, H), wanted, strict=True):
        torch.testing.assert_close(value, expected, rtol=0, atol=2e-14)


@pytest.mark.parametrize("name", MOTIONS)
def test_numerically_exact_lagrangian(name):
    # fails if the L_d found by shooting belongs to another motion: its momenta are those of the two ends
    parameters, (q0, p0, s0), (q1, p1, s1) = MOTIONS[name]
    L_d: Any = scene(name, **parameters).numerical
    q0, p0, s0 = tensors(q0, p0, s0)
    q1, p1, s1 = tensors(q1, p1, s1)
    torch.testing.assert_close(legendre_minus(L_d, q0, q1, s0, H)[1], p0, rtol=0, atol=1e-12)
    _, p_plus, s_plus = legendre_plus(L_d, q0, q1, s0, H)
    torch.testing.assert_close(p_plus, p1, rtol=0, atol=1e-12)
    torch.testing.assert_close(s_plus, s1, rtol=0, atol=1e-12)
