"""A long action without overflow or cancellation: another scale or origin of s leaves q (and p) as they were."""

import math

import pytest
import torch
from extreme_cases import build, starts, state

from herglotz.errors import InputError
from herglotz.mechanics import autograd_partials, partials
from herglotz.scenes import scene
from herglotz.stepping import State, Status, Stepper
from herglotz.theory import Rescaled, joined_action

FIELDS = ("L", "D1", "D2", "D3", "D11", "D12", "D22", "D13", "D23", "D33")


@pytest.mark.parametrize("level", ["linear", "affine", "full"])
def test_derivatives_of_the_rescaled_lagrangian(level):
    # fails if a derivative in s is not divided by a, or b is added where it is subtracted
    other = Rescaled(build(0.3, level=level), a=-2.5, b=0.7)
    q0, q1, s0 = starts(4)
    closed = partials(other, q0, q1, s0 + 0.2, 0.3, 2)
    twin = autograd_partials(other, q0, q1, s0 + 0.2, torch.tensor(0.3, dtype=torch.float64), 2)
    for name in FIELDS:
        torch.testing.assert_close(getattr(closed, name), getattr(twin, name), rtol=1e-11, atol=1e-12, msg=name)


@pytest.mark.parametrize("level", ["linear", "affine", "full"])
def test_q_does_not_see_the_scale_and_p_does_not_see_the_shift(level):
    # fails if p′ is not a p, c changes, or the motion is another one (trap 3: f(q, s) = a s + b)
    model, start = build(0.3, level=level), starts(4)
    with torch.no_grad():
        plain = Stepper(Rescaled(model)).rollout(*start, h=0.2, steps=20)
        torch.testing.assert_close(plain.q, Stepper(model).rollout(*start, h=0.2, steps=20).q, rtol=0, atol=1e-11)
        for a, b in ((2.0**-40, 0.0), (-4.0, 0.0), (1.0, 3.7), (0.3, -1.1)):
            other = Rescaled(model, a, b)
            out = Stepper(other).rollout(*other.forward(*start), h=0.2, steps=20)
            q, p, s = other.back(out.q, out.p, out.s)
            exact = b == 0 and math.frexp(abs(a))[0] == 0.5
            for x, y in ((q, plain.q), (p, plain.p), (s, plain.s), (out.sigma, plain.sigma)):
                torch.testing.assert_close(x, y, rtol=0 if exact else 1e-11, atol=0 if exact else 1e-11)


def test_scale_carries_an_action_past_overflow():
    # fails if the gauge is applied after s has overflowed: s ~ 1e312 here, s′ ~ 1e192
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
            pieces.append((part, joined_action(carried, part.s, part.sigma)))
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


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (math.inf, 0.0), (1.0, math.nan)])
def test_a_gauge_that_is_none_is_refused(a, b):
    # fails if a = 0, which forgets s, is accepted
    if math.isnan(b):
        b = math.inf
    with pytest.raises(InputError, match="finite scale a != 0"):
        Rescaled(build(), a, b)


def test_forces_are_not_rescaled():
    # fails if F⁻ and F⁺, which are momenta, stay behind when p is scaled
    with pytest.raises(InputError, match="without"):
        Stepper(Rescaled(build(level="forced", coulomb=True), 2.0)).step(state([0.1], [0.2]), 0.1)
