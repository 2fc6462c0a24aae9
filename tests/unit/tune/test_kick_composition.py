"""Large steps of learned kicks and drifts: contact maps whatever their numbers, fitted, and the same in C."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import contact_defect, flow_derivative
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.stepping import State, Status, Stepper
from herglotz.tune import CompiledKicks, KickStepper, export_kicks_c, fit_kicks
from herglotz.tune.distil import FlowProblem
from herglotz.tune.kick_composition import _leapfrog, _misses, kicks_c
from tests.compilers import needs_compiler

H = 1.0


def states(count, seed=0, dtype=torch.float64):
    make = torch.Generator().manual_seed(seed)
    q, p = 3 * torch.rand(2, count, 1, generator=make, dtype=torch.float64) - 1.5
    s = torch.rand(count, generator=make, dtype=torch.float64)
    return State(q.to(dtype), p.to(dtype), s.to(dtype))


def random_kicks(angle, seed=0):
    make = torch.Generator().manual_seed(seed)
    d, a, b = (torch.randn(n, generator=make, dtype=torch.float64) for n in (4, 12, 12))
    b = b.reshape(3, 4) if angle else torch.zeros(3, 0, dtype=torch.float64)
    return KickStepper(H, 0.3, angle, 0.2, 1.7, 0.3 + 0.1 * d, 0.2 * a.reshape(3, 4), 0.2 * b, 0.07)


@pytest.mark.parametrize("angle", [True, False], ids=["angle", "length"])
def test_any_numbers_make_a_contact_map(angle):
    # fails if a kick's slope is not that of its potential, s misses a term, or c is not e^{−γh}
    stepper, x = random_kicks(angle), states(6)

    def flow(q, p, s):
        return stepper.step(State(q, p, s), H).state

    (_, p1, _), D = flow_derivative(flow, *x)
    c = stepper.step(x, H).c
    torch.testing.assert_close(c, torch.full_like(c, math.exp(-0.3)))
    assert float(contact_defect(D, x.p, p1, c).abs().max()) < 1e-12
    # fails if the check cannot see a wrong c
    assert float(contact_defect(D, x.p, p1, 1.01 * c).abs().max()) > 1e-4


def pairs(count, seed, h, system):
    q, p, s = states(count, seed)
    return State(q, p, s), State(*system.flow(q, p, s, h))


def test_a_few_kicks_reproduce_a_large_step_of_the_pendulum():
    # fails if the fit does not converge, γ is not the model's, or s is off by a constant
    system, kicks, worst = scene("damped_pendulum"), 3, 1e-4
    model = ContactLagrangian(ModelConfig(rate=0.2, potential_width=0))
    found = fit_kicks(model, *pairs(300, 0, H, system), H, kicks=kicks, iterations=60)
    start, end = pairs(200, 1, H, system)
    out = found.step(start, H).state
    assert float((out.q - end.q).square().mean().sqrt()) < worst
    assert float((out.p - end.p).square().mean().sqrt()) < 2 * worst
    assert float((out.s - end.s).square().mean().sqrt()) < 2 * worst
    assert found.error < worst
    # a null model: leapfrog with as many kicks of the true force is worse by orders
    drifts, cosines = torch.full((kicks + 1,), H / kicks).double(), torch.zeros(kicks, 1).double()
    drifts[0] = drifts[-1] = H / kicks / 2
    plain = KickStepper(H, 0.2, True, 0.0, 1.0, drifts, cosines - H / kicks, cosines)
    assert float((plain.step(start, H).state.q - end.q).square().mean().sqrt()) > 10 * worst


def test_two_kicks_are_the_oscillator_wherever_the_data_lie():
    # fails if a kick vanishes at the middle of the data instead of where the force does: 1e-3 a step was left
    system, h = scene("damped_oscillator"), 3.0
    model = ContactLagrangian(ModelConfig(angles=(False,), rate=0.2, potential_width=0))
    start = State(torch.linspace(-0.4, 1.6, 40).double()[:, None], torch.cos(torch.arange(40.0)).double()[:, None],
                  torch.zeros(40).double())  # fmt: skip
    found = fit_kicks(model, start, State(*system.flow(*start, h)), h, kicks=2, iterations=60)
    assert found.error < 1e-12
    torch.testing.assert_close(found.step(start, h).state.p, system.flow(*start, h)[1], rtol=0, atol=1e-12)


def test_the_unit_of_length_decides_nothing():
    # fails if q or p is weighted by anything but its own size: two kicks cannot follow this spring, and what they do
    # instead would depend on the unit
    found = []
    start, end = pairs(60, 1, H, scene("duffing"))
    for unit in (1.0, 1000.0):
        model = ContactLagrangian(ModelConfig(angles=(False,), scale=(unit,), rate=0.1, potential_width=0))
        before, after = (State(unit * x.q, unit * x.p, unit**2 * x.s) for x in (start, end))
        kicks = fit_kicks(model, before, after, H, kicks=2, iterations=40)
        found.append(kicks.step(before, H).state.q / unit)
        assert kicks.error / unit > 1e-3
    assert float((found[0] - found[1]).abs().max()) < 1e-7


def test_the_normal_equations_of_a_flow_are_the_derivatives_of_its_cost():
    # fails if a factor or a sign of the cost is not that of its slope, or σ divides another residual
    start, end = pairs(20, 1, H, scene("damped_pendulum"))
    own = random_kicks(angle=True)
    x = torch.cat([own.drifts, own.cosines.flatten(), own.sines.flatten()]).requires_grad_(True)
    sigma = torch.tensor([0.7, 0.4], dtype=torch.float64)
    cost, A, b = FlowProblem(partial(_misses, own), start, end, sigma).normal_equations(x.detach())
    q1, p1, _ = own.step(start, H).state
    errors = (q1 - end.q).square().sum() / 0.7**2 + (p1 - end.p).square().sum() / 0.4**2
    torch.testing.assert_close(cost, errors / 2)
    scaled = lambda x: (_misses(own, x, start, end) / sigma).reshape(-1)  # noqa: E731
    torch.testing.assert_close(b, torch.autograd.grad(scaled(x).square().sum() / 2, x)[0])
    J = torch.func.jacrev(scaled)(x.detach())
    torch.testing.assert_close(A, J.T @ J)


@needs_compiler
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-13), ("float32", 1e-4)])
@pytest.mark.parametrize("angle", [True, False], ids=["angle", "length"])
def test_c_is_the_same_step(angle, dtype, tolerance):
    # fails if an operation of the map is lowered wrongly, or the loop reads another motion's state; angles of many
    # turns are among them. Measured in float64: 3e-15.
    stepper, number = random_kicks(angle), getattr(torch, dtype)
    x = states(50, dtype=number)
    if angle:
        turns = 2 * math.pi * (torch.arange(50) % 5 - 2)[:, None]
        x = State((x.q + turns).to(number), x.p, x.s)
    else:
        x = State(x.q / 2, x.p / 2, x.s)
    a = stepper.rollout(*(y.double() for y in x), h=H, steps=1)
    b = CompiledKicks(stepper, dtype).rollout(*x, h=H, steps=1)
    assert b.q.dtype == number
    # A rounded angle of two turns, 1e-6 in float32, times the slopes of three random kicks, about 4 each.
    # A polynomial far from its data is rounding.
    good = a.q.abs().amax((1, 2)) < 20
    assert int(good.sum()) > 20
    for name in ("q", "p", "s"):
        one, two = getattr(a, name)[good], getattr(b, name)[good].double()
        assert float(((one - two).abs() / (1 + one.abs())).max()) < tolerance, name
    torch.testing.assert_close(a.sigma.to(number), b.sigma)


@needs_compiler
def test_a_kick_in_c_takes_one_sine_and_one_cosine():
    # fails if multiple angles call sines of their own, which are most of the work of a step
    text = kicks_c(random_kicks(True))
    assert [text.count(f" {name}(") for name in ("sin", "cos")] == [3, 3]


@needs_compiler
def test_what_is_not_finite_says_so():
    # fails if a motion that overflows is reported as converged, has a σ, or poisons the next motion of its batch
    d = torch.full((2,), 0.5, dtype=torch.float64)
    wild = KickStepper(H, 0.0, False, 0.0, 1.0, d, torch.full((1, 4), 1.0, dtype=torch.float64), torch.zeros(1, 0))
    x = State(*(torch.tensor(y, dtype=torch.float64) for y in ([[50.0], [1e-3]], [[0.0], [0.0]], [0.0, 0.0])))
    for stepper in (wild, CompiledKicks(wild)):
        out = stepper.rollout(*x, h=H, steps=8)
        assert out.status[0, -1] == Status.DIVERGED
        assert bool(out.q[0, -1].isnan().all())
        assert bool(out.sigma[0, -1].isnan())
        assert bool(out.ok[1])


def test_wrong_input(tmp_path):
    # fails if several coordinates, a varying c, or a number type without a C form are accepted
    stepper = random_kicks(True)
    two: Any = State(*(x.expand(*x.shape[:-1], 2) if x.ndim > 1 else x for x in states(2)))
    with pytest.raises(InputError, match="one coordinate, got 2"):
        stepper.step(two, H)
    affine = ContactLagrangian(ModelConfig(level="affine"))
    with pytest.raises(InputError, match="one coordinate at the conservative or linear level"):
        fit_kicks(affine, states(3), states(3), H, kicks=2)
    with pytest.raises(InputError, match="float64 or float32"):
        export_kicks_c(stepper, tmp_path / "a.h", "bfloat16")


@pytest.mark.parametrize("angle", [True, False], ids=["angle", "length"])
def test_the_first_guess_is_leapfrog_of_the_potential(angle):
    # fails if a kick of the guess has another sign or size than the force: the fit would have to find that, too.
    # Measured with 20 kicks: 1.9e-4 (angle), 2.9e-4 (length); with 40 a quarter of it.
    model = ContactLagrangian(ModelConfig(level="conservative", angles=(angle,), potential_width=0))
    # The force of a length is 0 at the middle.
    q = torch.linspace(-1, 1, 11, dtype=torch.float64)[:, None]
    start = State(q, torch.cos(3 * q), 0 * q[:, 0])
    with torch.no_grad():
        end = Stepper(model).rollout(*start, h=H / 1000, steps=1000).q[:, -1]
    errors = [float((_leapfrog(model, start, H, kicks).step(start, H).state.q - end).abs().max()) for kicks in (20, 40)]
    assert errors[0] < 5e-4
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


@needs_compiler
def test_kicks_step_at_their_own_h_only():
    # fails if a right step among several lets the other steps pass, or the bound is not relative to h
    start = states(2)
    stepper = replace(random_kicks(True), h=0.1)
    with pytest.raises(InputError, match=r"fitted to h = 0\.1, got 0\.2"):
        stepper.step(start, torch.tensor([0.1, 0.2], dtype=torch.float64))
    for one in (stepper, CompiledKicks(stepper)):
        with pytest.raises(InputError, match=r"fitted to h = 0\.1"):
            one.rollout(start.q, start.p, h=0.1 + 1e-6, steps=2)
        one.rollout(start.q, start.p, h=0.1 + 1e-8, steps=2)
