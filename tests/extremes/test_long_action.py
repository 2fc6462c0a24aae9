"""A long action without overflow or cancellation: another scale or origin of s leaves q as it was."""

import pytest
import torch
from extreme_cases import build, state

from herglotz.mechanics import partials
from herglotz.scenes import scene
from herglotz.stepping import State, Status, Stepper


def test_the_mass_carries_the_scale_of_an_action_that_overflows():
    # fails if a smaller mass changes the motion: s ~ 1e312 here, s′ ~ 1e192
    oscillator = scene("damped_oscillator", m=1e290)
    start = state([3e11], [1e300])
    with torch.no_grad():
        plain = Stepper(oscillator.L_d).step(start, 0.3)
        assert plain.status.tolist() == [Status.DIVERGED]
        light = scene("damped_oscillator", m=1e170)  # a = 1e−120: the mass carries the scale of L_d
        step = Stepper(light.L_d).step(State(start.q, start.p * 1e-120, start.s), 0.3)
    q = light.flow(start.q, start.p * 1e-120, start.s, 0.3)[0]
    assert step.status.tolist() == [Status.CONVERGED]
    torch.testing.assert_close(step.state.q, q, rtol=1e-14, atol=0)


@pytest.mark.parametrize("level", ["conservative", "linear"])
@pytest.mark.parametrize("s0", [0.0, 1e9])
def test_an_action_joined_from_short_runs(level, s0):
    # fails if q or p changes with s at a level where it does not enter, or a joined action is worse than a plain one
    model, h = build(0.3, level=level), 0.1
    start = state([1.0], [0.5], s0)
    with torch.no_grad():
        plain = Stepper(model).rollout(*start, h=h, steps=1200)
        pieces, carried, x = [], start.s, start
        for _ in range(12):
            part = Stepper(model).rollout(x.q, x.p, torch.zeros_like(x.s), h=h, steps=100)
            pieces.append((part, part.sigma * carried[..., None] + part.s))
            carried, x = pieces[-1][1][..., -1], part.final
        q, p = (torch.cat([getattr(part, k)[..., 1:, :] for part, _ in pieces], -2) for k in "qp")
        assert torch.equal(q, plain.q[..., 1:, :])
        assert torch.equal(p, plain.p[..., 1:, :])
        # The truth: the same increments summed in twice the precision (c and A of each step, from q alone).
        P = partials(model, plain.q[0, :-1], plain.q[0, 1:], torch.zeros(1200, dtype=torch.float64), h)
    exact, scale = _recurrence(s0, P.c.tolist(), P.L.tolist())
    error, before = abs(float(carried) - exact), abs(float(plain.s[0, -1]) - exact)
    eps = torch.finfo(torch.float64).eps
    assert error <= 40 * eps * scale  # a few roundings for each of 12 pieces
    if s0 and level == "conservative":
        assert error < before / 5  # 1200 roundings of 1e9


def _recurrence(s, factors, increments):
    from fractions import Fraction

    # exact rational numbers would grow without end; 200 bits are three times what float64 has
    total, scale, unit = Fraction(s), abs(s), 2**200
    for c, A in zip(factors, increments, strict=True):
        total = Fraction(round((total * Fraction(c) + Fraction(A)) * unit), unit)
        scale = max(scale, abs(float(total)))
    return float(total), scale
