"""One exact step against 50-digit values (section 4 of docs/mathematics.md)."""

import pytest
import torch

from herglotz.mechanics import partials
from herglotz.scenes import scene
from herglotz.stepping import Stepper

RTOL = 1e-12

# scene, (q, p, s), then q1, p1, s1
STEPS = {
    "damped_oscillator": (
        (1.0, 0.5, 0.3),
        (1.044458152451492156973, 0.3887927731316717946481, 0.2520488244211367966438),
    ),
    "parachute": ((100.0, 1.0, 1.0), (100.0480236968760599992, -6.395195568727422041167, -318.775474142271042683)),
    "linear_drag": ((1.0, 0.5, 0.3), (1.049503316733111744448, 0.4900993366533776511104, 0.3061903733385466486547)),
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
def test_stepper_finds_the_exact_step(name):
    # fails if FL⁻ of L_d is not the momentum of the flow (then Newton lands elsewhere)
    start, end = STEPS[name]
    out = Stepper(scene(name).L_d).rollout(*state(*start), h=0.1, steps=1)
    for value, expected in zip(out.final, end, strict=True):
        assert relative_error(value, expected) < RTOL


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
