"""γ from −1 through 0 and the critical value to stiff: the exact L_d, every level, and where c rounds to 0."""

import math

import pytest
import torch
from extreme_cases import assert_nothing_silent, build, starts, state

from herglotz.scenes import scene
from herglotz.stepping import Status, Stepper

EPS = torch.finfo(torch.float64).eps


@pytest.mark.parametrize("gamma", [-1.0, 0.0, 1e-300, 1e-12, 2 - 1e-12, 2.0, 2 + 1e-9, 1e3, 1e6])
def test_damping_from_negative_to_stiff(gamma):
    # fails if c, the flow or critical damping (γ = 2Ω) loses accuracy at the ends of the axis
    oscillator, start = scene("damped_oscillator", gamma=gamma), starts(5)
    h = 0.1 if gamma < 100 else 1 / gamma
    with torch.no_grad():
        out = Stepper(oscillator.L_d).rollout(*start, h=h, steps=10)
    q, p, s = oscillator.flow(*start, 10 * h)
    rounding = 10 * 64 * EPS * (1 + 1 / h) * 3  # what each solve leaves in q1, over h
    assert bool(out.ok.all())
    torch.testing.assert_close(out.final.q, q, rtol=0, atol=10 * 64 * EPS * 3)
    torch.testing.assert_close(out.final.p, p, rtol=0, atol=rounding)
    torch.testing.assert_close(out.final.s, s, rtol=0, atol=rounding)
    torch.testing.assert_close(out.sigma[:, -1], torch.full((5,), -gamma * 10 * h, dtype=torch.float64).exp())


@pytest.mark.parametrize("level", ["linear", "affine", "full", "forced"])
@pytest.mark.parametrize("rate", [-1.0, 0.0, 1e-12, 2.0, 1e3, 1e6])  # 2: critical, both at q = 0 and of the baseline
def test_every_level_over_the_range(level, rate):
    # fails if a level refuses small, negative or stiff damping while γh is moderate, or σ is not e^{−γt}
    h = 0.1 if abs(rate) < 100 else 1 / rate
    with torch.no_grad():
        out = Stepper(build(level=level, rate=rate, potential_width=0)).rollout(*state([1.0], [0.5]), h=h, steps=20)
    assert bool(out.ok.all())
    assert float(out.sigma[0, -1]) == pytest.approx(math.exp(-20 * rate * h), rel=1e-13 + 20 * EPS * math.exp(rate * h))
    if rate > 100:  # the momentum is gone after 1/γ; the position creeps by its share and by −sin(q) t/γ
        assert float((out.q - 1.0).abs().max()) < 3 / rate


@pytest.mark.parametrize(("dtype", "below"), [(torch.float64, 36.0), (torch.float32, 16.0)], ids=str)
@pytest.mark.parametrize("level", ["linear", "affine", "full", "forced"])
def test_a_factor_that_rounds_to_zero_is_refused(level, dtype, below):
    # fails if c = 1 + D3 = 0 by rounding (γh > 36.7, float32: 16.6) gives a number; below, σ may be off by ε/c a step
    model = build(level=level, rate=1e6, potential_width=0, dtype=dtype)
    x = state([1.0], [0.5], dtype=dtype)
    with torch.no_grad():
        good, gone = (Stepper(model).step(x, h) for h in (1e-6 * below, 1e-6 * (below + 2)))
    assert good.status.tolist() == [Status.CONVERGED]
    assert float(good.c[0]) == pytest.approx(math.exp(-below), abs=torch.finfo(dtype).eps)
    assert gone.status.tolist() == [Status.SINGULAR]
    assert bool(gone.state.q.isnan().all())


@pytest.mark.parametrize("viscous", [1e3, 1e6, 1e12])
def test_friction_is_stable_however_stiff(viscous):
    # fails if friction as a force has a limit on h as well: that is where to put stiff damping
    model = build(level="forced", rate=0.0, potential_width=0)
    assert model.friction is not None
    with torch.no_grad():
        model.friction.viscous.fill_(viscous)
        out = Stepper(model).rollout(*state([1.0], [0.5]), h=0.1, steps=50)
    assert bool(out.ok.all())
    creep = math.sin(1.0) * 5.0 / viscous  # q̇ = −sin(q)/b
    assert float(1 - out.q[0, -1, 0]) == pytest.approx(creep, rel=0.2, abs=2 / viscous)


@pytest.mark.parametrize("gamma", [1e3, 1e6])
@pytest.mark.parametrize("h", [1e-3, 0.1])
def test_no_rule_is_silent_when_damping_is_stiff(gamma, h):
    # fails if a rule that blows up, or has no solution, returns a number that is not one
    rules = scene("damped_oscillator", gamma=gamma).L_d_rules
    survivors = {}
    for name in ("left", "right", "midpoint", "midpoint_heun", "trapezoid", "trapezoid_heun", "strang"):
        with torch.no_grad():
            out = Stepper(rules[name]).rollout(*state([1.0], [0.5]), h=h, steps=20)
        assert_nothing_silent(out)
        if bool(out.ok.all()):
            survivors[name] = float(out.q.abs().max())
    # Implicit in s: stable at any γh. Only `right` damps; with the two others p alternates, for c tends to −1.
    assert survivors["right"] < 1.06
    assert survivors["midpoint"] < 1.001 + gamma * h**2 / 4
    assert survivors["trapezoid"] < 1.001 + gamma * h**2 / 4
