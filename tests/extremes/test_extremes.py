"""Where things break: each extreme has a bound or a status, and nothing is NaN without one."""

import time

import pytest
import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Status, Stepper
from herglotz.systems import scene


def model(scale=0.0, seed=0, **settings):
    made = ContactLagrangian(ModelConfig(correction_width=8, **settings))
    make = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in made.parameters():
            p += scale * torch.randn(p.shape, generator=make, dtype=p.dtype)
    return made


def starts(batch):
    make = torch.Generator().manual_seed(1)
    q, p = torch.randn(2, batch, 1, generator=make, dtype=torch.float64)
    return q, p, torch.zeros(batch, dtype=torch.float64)


@pytest.mark.parametrize("h", [1e-8, 1e-4, 1e-2, 1.0, 1e2])
def test_any_step_is_solved_or_says_why(h):
    # fails if a step that has no solution is returned as a number, or the solver hangs
    begun = time.perf_counter()
    with torch.no_grad():
        out = Stepper(model(0.3)).rollout(*starts(50), h=h, steps=5)
    assert time.perf_counter() - begun < 20
    good = out.status == Status.CONVERGED
    assert bool(torch.isfinite(out.q[:, 1:][good]).all())
    assert bool(out.q[:, 1:][~good].isnan().all())
    if h <= 1e-2:
        assert bool(good.all())


def test_networks_thirty_times_too_large():
    # fails if one sample's failed Newton poisons its batch neighbours
    wild = model(30.0, seed=1)
    q, p, s = starts(40)
    with torch.no_grad():
        out = Stepper(wild).rollout(q, p, s, h=0.5, steps=1)
        ok = out.ok
        assert 0 < int(ok.sum()) < 40
        alone = Stepper(wild).rollout(q[ok], p[ok], s[ok], h=0.5, steps=1)
    assert torch.equal(alone.q[:, 1], out.q[ok][:, 1])


@pytest.mark.parametrize("gamma", [-1.0, 0.0, 1e-12, 2.0, 1e3])
def test_damping_from_negative_to_stiff(gamma):
    # fails if c, the flow or critical damping (γ = 2Ω) loses accuracy at the ends of the axis
    oscillator = scene("damped_oscillator", gamma=gamma)
    q, p, s = starts(5)
    h = 0.1 if gamma < 100 else 1e-3
    with torch.no_grad():
        out = Stepper(oscillator.L_d).rollout(q, p, s, h=h, steps=10)
    exact = oscillator.flow(q, p, s, 10 * h)
    assert bool(out.ok.all())
    torch.testing.assert_close(out.final.q, exact[0], rtol=1e-10, atol=1e-11)
    torch.testing.assert_close(out.sigma[:, -1], torch.full((5,), -gamma * 10 * h, dtype=torch.float64).exp())


def test_conjugate_point_of_the_oscillator_is_reported():
    # fails if h = π/ω, where L_d has a pole, is stepped over silently
    oscillator = scene("damped_oscillator")
    with torch.no_grad():
        out = Stepper(oscillator.L_d).rollout(*starts(3), h=3.15741941699827646, steps=1)
    exact = oscillator.flow(*starts(3), 3.15741941699827646)
    solved = out.ok
    assert bool(out.q[~solved][:, 1].isnan().all())
    torch.testing.assert_close(out.q[solved][:, 1], exact[0][solved], rtol=1e-3, atol=1e-3)


def test_left_rule_at_its_singular_step():
    # fails if c = 1 − γh = 0 counts as a converged step (erratum E4: FL⁻ is not defined there)
    oscillator = scene("damped_oscillator", gamma=0.5)
    with torch.no_grad():
        out = Stepper(oscillator.L_d_rules["left"]).rollout(*starts(3), h=2.0, steps=1)
    assert not bool(out.ok.any())


def test_long_rollout_keeps_sigma():
    # fails if σ_k drifts from e^{−γt} over many steps, or decay to rest ends in NaN
    quiet = ContactLagrangian(ModelConfig(rate=0.01, potential_width=0))
    with torch.no_grad():
        out = Stepper(quiet).rollout(*starts(1), h=0.1, steps=5000)
    assert bool(out.ok.all())
    t = 0.1 * torch.arange(5001, dtype=torch.float64)
    torch.testing.assert_close(out.sigma[0], torch.exp(-0.01 * t), rtol=1e-11, atol=0)
    assert float(out.q[0, -500:].abs().max()) < 0.15


def test_float32_follows_float64():
    # fails if float32 loses more than rounding over a damped rollout
    wide = model(0.1, rate=0.4)
    q, p, s = starts(10)
    with torch.no_grad():
        exact = Stepper(wide).rollout(q, p, s, h=0.2, steps=100)
        single = Stepper(model(0.1, rate=0.4).float()).rollout(q.float(), p.float(), s.float(), h=0.2, steps=100)
    both = exact.ok & single.ok
    assert int(both.sum()) >= 9
    error = (exact.q[both] - single.q[both].double()).abs() / (1 + exact.q[both].abs())
    assert error.max().item() < 1e-3  # the start nearest the separatrix; the others stay below 5e-5
    assert error.flatten(1).amax(1).median().item() < 5e-5
