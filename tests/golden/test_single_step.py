"""One exact step against 50-digit values (section 4 of docs/mathematics.md)."""

import pytest
import torch

from herglotz.mechanics import autograd_partials, partials
from herglotz.scenes import scene
from herglotz.stepping import Stepper

RTOL = 1e-12

# scene, (q, p, s), then q1, p1, s1, L_d, c, H⁺, H⁻
STEPS = {
    "damped_oscillator": (
        (1.0, 0.5, 0.3),
        (
            1.044458152451492156973,
            0.3887927731316717946481,
            0.2520488244211367966438,
            -0.0479511755788632033562,
            0.9801986733067553022208,
            0.4540289570904612664217,
            -0.4520488244211367966438,
        ),
    ),
    "parachute": (
        (100.0, 1.0, 1.0),
        (
            100.0480236968760599992,
            -6.395195568727422041167,
            -318.775474142271042683,
            -319.775474142271042683,
            1.000960935340323493156,
            -320.0512036639268492816,
            219.775474142271042683,
        ),
    ),
    "linear_drag": (
        (1.0, 0.5, 0.3),
        (
            1.049503316733111744448,
            0.4900993366533776511104,
            0.3061903733385466486547,
            0.006190373338546648654746,
            0.9801986733067553022208,
            0.5081705060078711184327,
            -0.5061903733385466486547,
        ),
    ),
}


def state(q, p, s):
    return (
        torch.tensor([q], dtype=torch.float64),
        torch.tensor([p], dtype=torch.float64),
        torch.tensor(s, dtype=torch.float64),
    )


def relative_error(value, expected):
    return abs(value.item() - expected) / abs(expected)


@pytest.mark.parametrize("name", STEPS)
def test_flow_and_lagrangian(name):
    # fails if any coefficient, sign or exponent of the flow or of L_d is off
    start, (q1, p1, s1, L, c, H_plus, H_minus) = STEPS[name]
    system = scene(name)
    q, p, s = state(*start)
    end = system.flow(q, p, s, 0.1)
    P = partials(system.L_d, q, end[0], s, 0.1)
    assert relative_error(end[0], q1) < RTOL
    assert relative_error(end[1], p1) < RTOL
    assert relative_error(end[2], s1) < RTOL
    assert relative_error(P.L, L) < RTOL
    assert relative_error(P.c, c) < RTOL
    assert relative_error(P.D2, p1) < RTOL
    # fails if H⁺ or H⁻ has a wrong sign or a wrong power of E
    assert system.H_plus is not None
    assert system.H_minus is not None
    assert relative_error(system.H_plus(q, end[1], s, 0.1), H_plus) < RTOL
    assert relative_error(system.H_minus(p, end[0], end[2], 0.1), H_minus) < RTOL


@pytest.mark.parametrize("name", STEPS)
def test_stepper_finds_the_exact_step(name):
    # fails if FL⁻ of L_d is not the momentum of the flow (then Newton lands elsewhere)
    start, (q1, p1, s1, *_) = STEPS[name]
    out = Stepper(scene(name).L_d).rollout(*state(*start), h=0.1, steps=1)
    for value, expected in zip(out.final, (q1, p1, s1), strict=True):
        assert relative_error(value, expected) < RTOL


def test_oscillator_D1():
    # fails if D1 loses its factor c (p0 = −D1/c = .5)
    q1 = torch.tensor([1.044458152451492156973], dtype=torch.float64)
    q, _, s = state(1.0, 0.5, 0.3)
    assert relative_error(partials(scene("damped_oscillator").L_d, q, q1, s, 0.1).D1, -0.4900993366533776511104) < RTOL


def test_oscillator_ten_steps_in_one():
    # fails if L_d is exact only to some order in h: S^10 must be L_d at 10h, and one flow of 10h ten flows of h
    system = scene("damped_oscillator")
    q, p, s = state(1.0, 0.5, 0.3)
    q10, p10, s10 = system.flow(q, p, s, 1.0)
    P = partials(system.L_d, q, q10, s, 1.0)
    expected = (
        0.9503507302012185080219,
        -0.5545475008882113873167,
        -0.5225707735462871876099,
        0.8187307530779818586699,
    )
    for value, number in zip((q10, p10, P.L, P.c), expected, strict=True):
        assert relative_error(value, number) < RTOL
    out = Stepper(system.L_d).rollout(q, p, s, h=0.1, steps=10)
    for value, number in zip(
        (out.q[-1], out.p[-1], out.s[-1] - out.s[0], out.sigma[-1]),
        (q10, p10, s10 - s, torch.tensor(expected[3], dtype=torch.float64)),
        strict=True,
    ):
        assert relative_error(value, number.item()) < RTOL


def test_parachute_ten_steps():
    # fails if s is not fed back into p = mv + 2λs: the drag would be lost from the second step on
    system = scene("parachute")
    expected = (96.03429338977802741669, -67.33263379812526494495, -2927.491991525168642489)
    out = Stepper(system.L_d).rollout(*state(100.0, 1.0, 1.0), h=0.1, steps=10)
    for value, number in zip(out.final, expected, strict=True):
        assert relative_error(value, number) < RTOL
    for value, number in zip(system.flow(*state(100.0, 1.0, 1.0), 1.0), expected, strict=True):
        assert relative_error(value, number) < RTOL


def test_linear_drag():
    # fails if partials or the flow FL⁺∘(FL⁻)⁻¹ misplace c when L_d is degenerate in neither argument
    gamma, h = 0.2, 0.1

    def L_d(q0, q1, s0, h):
        kinetic = gamma * ((q1 - q0) ** 2).sum(-1) / (2 * torch.expm1(gamma * h))
        return torch.expm1(-gamma * h) * s0 + kinetic

    q, p, s = state(1.0, 0.5, 0.3)
    out = Stepper(L_d).rollout(q, p, s, h=h, steps=1)
    P = autograd_partials(L_d, q, out.q[1], s, h)
    assert relative_error(out.q[1], 1.049503316733111744448) < RTOL
    assert relative_error(P.L, 0.006190373338546648654746) < 1e-11  # Newton leaves ~1 ulp in q1, 1/Δ larger here
    assert relative_error(P.D2 * out.q[1] - P.L, 0.5081705060078711184327) < RTOL
    assert relative_error(-p * q - P.L, -0.5061903733385466486547) < RTOL
    # fails if the oscillator's formulas are singular at Ω = 0, where they are linear drag
    free, step = scene("damped_oscillator", omega0=0.0), torch.tensor(h, dtype=torch.float64)
    end = free.flow(q, p, s, step)[0]
    assert relative_error(end, 1.049503316733111744448) < RTOL
    assert relative_error(free.L_d(q, end, s, step), 0.006190373338546648654746) < 1e-11


@pytest.mark.parametrize("system", [scene("quadratic_drag"), scene("parachute", g=0.0)], ids=lambda s: s.name)
def test_quadratic_drag(system):
    # fails if g = 0 divides by ω = √(λg), or quadratic_drag is not the parachute without gravity
    q, v, s = state(100.0, -20.0, 1.0)
    p = system.momentum(q, v, s)
    q1, _, s1 = system.flow(q, p, s, 0.1)
    assert relative_error(q1, 98.0197372703820286974) < RTOL
    assert relative_error(s1 - s, 19.18454440599769319493) < RTOL
