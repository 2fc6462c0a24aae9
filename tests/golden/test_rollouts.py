"""Eight discrete steps against 17-digit values, and the Riccati recursion (section 4 of docs/mathematics.md)."""

import pytest
import torch

from herglotz.mechanics import autograd_partials, partials
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from tests.compared import f64
from tests.lagrangians import nonlinear

RTOL = 1e-12

# scene, rule, start, (q8, p8, s8, σ8)
ROLLOUTS = [
    (
        "damped_oscillator",
        "left",
        (1.0, 0.5, 0.3),
        (0.38173749320613888, -0.8831758296416256, -0.132501184684631381, 0.7213895789838336),
    ),
    (
        "damped_oscillator",
        "midpoint",
        (1.0, 0.5, 0.3),
        (0.499210582651036084, -0.905587709943668176, -0.189733581764390555, 0.726118047938149447),
    ),
    (
        "parachute",
        "strang_exponential",
        (100.0, 1.0, 1.0),
        (89.1716983021164166, -94.3987901949469811, -4020.49552779897726, 0.805279357383929896),
    ),
]


@pytest.mark.parametrize(("name", "rule", "start", "expected"), ROLLOUTS)
def test_rule(name, rule, start, expected):
    # fails if a rule takes s, q or v at another place, or if σ is not the product of the c's
    q, p, s = start
    out = Stepper(scene(name).L_d_rules[rule]).rollout(f64(q), f64(p), f64(s)[0], h=0.2, steps=8)
    got = (out.q[-1, 0], out.p[-1, 0], out.s[-1], out.sigma[-1])
    assert bool(out.ok)
    for value, number in zip(got, expected, strict=True):
        assert abs(value.item() - number) < RTOL * abs(number)


@pytest.mark.parametrize("L_d", [nonlinear, scene("nonlinear_action").L_d_rules["midpoint_plain"]])
def test_two_degrees_of_freedom_nonlinear_in_s(L_d):
    # fails if D12 is transposed or D13, D23 exchanged: neither shows with one degree of freedom or constant c; and if
    # the scene's L or its plain midpoint is not the one of tests/lagrangians.py
    out = Stepper(L_d).rollout(f64(0.3, -0.5), f64(0.7, 0.2), f64(0.4)[0], h=0.2, steps=8)
    expected = (
        (0.790147768842206419, -0.321134983997739986),
        (0.105386926461592157, 0.154339975878171863),
        (-1.07261278375611205,),
        (0.517477449149657664,),
    )
    for value, number in zip((out.q[-1], out.p[-1], out.s[-1:], out.sigma[-1:]), expected, strict=True):
        torch.testing.assert_close(value.detach(), f64(*number), rtol=RTOL, atol=0)


@pytest.mark.parametrize("door", [partials, autograd_partials])
def test_hamilton_jacobi_riccati(door):
    # fails if a Hessian block of the exact L_d (closed form or autograd) or its D3 is wrong
    P = door(scene("damped_oscillator").L_d, f64(0.0), f64(0.0), f64(0.0)[0], 0.1, order=2)
    A, B, C, c = P.D11.item(), P.D12.item(), P.D22.item(), P.c.item()
    alpha, beta, delta = 1.0, 0.5, 0.25
    for _ in range(10):
        caustic = A + c * alpha
        delta = c * delta - (c * beta) ** 2 / (2 * caustic)
        alpha, beta = C - B**2 / caustic, -c * B * beta / caustic
    expected = (-0.26006580555808590321, 0.30739377267571633841, 0.1460659481608371959)
    for value, number in zip((alpha, beta, delta), expected, strict=True):
        assert abs(value - number) < RTOL * abs(number)
