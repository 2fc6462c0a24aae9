"""The continuous equation of an L_d: field, Hamiltonian, Lagrangian and steps of any length, against closed forms."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.stepping import State, Status, Stepper
from herglotz.stepping.continuous_equation import weights
from herglotz.theory import ContinuousEquation, FractionalStepper, contact_vector_field, inverse_step
from tests.compared import f64


def states(system, count=5, seed=0):
    make = torch.Generator().manual_seed(seed)
    draws = []
    for low, high in (system.q_range, system.v_range):
        draws.append(low + (high - low) * torch.rand(count, 1, generator=make, dtype=torch.float64))
    s = torch.rand(count, generator=make, dtype=torch.float64)
    return State(draws[0], system.momentum(*draws, s), s), draws[1]


# Quadratic drag alone is the parachute without weight.
EXACT = {"damped_oscillator": 0.2, "parachute": 0.1}


@pytest.mark.parametrize("name", EXACT)
def test_the_equation_of_an_exact_lagrangian_is_the_systems(name):
    # fails if a weight, the sign of H = p·q̇ − ṡ, the transform to L or the rate ∂H/∂s is wrong
    system, h = scene(name), EXACT[name]
    x, v = states(system)
    E = ContinuousEquation(system.L_d, h)
    for value, expected in zip(E.field(*x), contact_vector_field(system.hamiltonian, *x), strict=True):
        assert float((value - expected).abs().max()) < 1e-11 * float(expected.abs().max())
    H = system.hamiltonian(*x)
    assert float((E.hamiltonian(*x) - H).abs().max()) < 1e-11 * float(H.abs().max())
    L = system.lagrangian(x.q, v, x.s)
    assert float((E.lagrangian(x.q, v, x.s) - L).abs().max()) < 1e-11 * float(L.abs().max())
    rate = torch.autograd.functional.jacobian(lambda s: system.hamiltonian(x.q, x.p, s).sum(), x.s)
    assert isinstance(rate, torch.Tensor)
    torch.testing.assert_close(E.damping(*x), rate, rtol=1e-9, atol=1e-11)
    assert float(E.error(*x).max()) < 1e-10


@pytest.mark.parametrize("ratio", [0.5, 2.0, 1 / 7, 1.3])
@pytest.mark.parametrize("name", EXACT)
def test_steps_of_any_length(name, ratio):
    # fails if whole steps are miscounted, a part of a step has wrong weights, or c is not c^θ
    system, h = scene(name), EXACT[name]
    x, _ = states(system)
    step = FractionalStepper(ContinuousEquation(system.L_d, h)).step(x, ratio * h)
    assert step.status.tolist() == [Status.CONVERGED] * 5
    for value, expected in zip(step.state, system.flow(*x, ratio * h), strict=True):
        assert float((value - expected).abs().max()) < 1e-12 * max(1.0, float(expected.abs().max()))
    direct = Stepper(system.L_d).step(x, ratio * h)  # this L_d is exact at every h
    torch.testing.assert_close(step.c, direct.c, rtol=1e-11, atol=0)


def test_the_series_starts_with_the_rules_own_error():
    # fails if order does not cut the series: a rule of order 2 has H̃ = H + h² H₂ + …, and the cut at h² an error h²
    system = scene("damped_pendulum")
    x, _ = states(system)
    H, gap, cut = system.hamiltonian(*x), [], []
    for h in (0.1, 0.05):
        whole = ContinuousEquation(system.L_d, h).hamiltonian(*x)
        gap.append(float((whole - H).abs().max()))
        cut.append([float((ContinuousEquation(system.L_d, h, m).hamiltonian(*x) - whole).abs().max()) for m in (2, 4)])
    assert abs(gap[0] / gap[1] - 4) < 0.1
    assert abs(cut[0][0] / cut[1][0] - 4) < 0.3
    assert abs(cut[0][1] / cut[1][1] - 16) < 2


def test_the_energy_decays_as_a_contact_hamiltonian():
    # fails if X̃ is not contact: dH̃/dt = −R(H̃) H̃ along X̃, and H̃ along the discrete motion is that of the motion
    system = scene("damped_pendulum")
    x, _ = states(system)
    E = ContinuousEquation(system.L_d, 0.1)
    y = [z.clone().requires_grad_() for z in x]
    H = E.hamiltonian(*y)
    slope = torch.autograd.grad(H.sum(), y)
    q_dot, p_dot, s_dot = E.field(*x)
    dH = (slope[0] * q_dot + slope[1] * p_dot).sum(-1) + slope[2] * s_dot
    assert float((dH + E.damping(*x) * H.detach()).abs().max()) < 1e-9
    assert float(dH.abs().max()) > 0.05
    end = Stepper(system.L_d).step(x, 0.1)
    torch.testing.assert_close(E.hamiltonian(*end.state), end.c * H.detach(), rtol=0, atol=1e-9)  # c constant here


def test_the_step_backwards():
    # fails if a row of FL⁺ is wrong, with forces and without, or the derivative is not that of the inverse map
    class Dragged:
        def __call__(self, q0, q1, s0, h):
            return scene("damped_pendulum").L_d(q0, q1, s0, h)

        def forces(self, q0, q1, s0, h):  # noqa: ARG002
            f = -0.3 * (q1 - q0) - 0.1 * torch.sin(q0) * s0[..., None]
            return 0.4 * f, 0.6 * f

    x, _ = states(scene("damped_pendulum"))
    for L_d in (scene("damped_pendulum").L_d, Dragged()):
        there = Stepper(L_d).step(x, 0.2)
        back = inverse_step(L_d, there.state, 0.2)
        for value, expected in zip(back.state, x, strict=True):
            torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(back.c, there.c)
        y = torch.cat([there.state.q, there.state.p, there.state.s[:, None]], -1).requires_grad_()

        def round_trip(y, L_d=L_d):
            state = inverse_step(L_d, State(y[:, :1], y[:, 1:2], y[:, 2]), 0.2).state
            again = Stepper(L_d).step(state, 0.2).state
            return torch.cat([again.q, again.p, again.s[:, None]], -1)

        z = round_trip(y)
        for i in range(3):
            (row,) = torch.autograd.grad(z[:, i].sum(), y, retain_graph=True)
            torch.testing.assert_close(row, torch.eye(3, dtype=torch.float64)[i].expand(5, 3), rtol=0, atol=1e-9)


def test_weights_by_hand():
    # fails if a weight is that of another node: parabola through −1, 0, 1, and central differences of order 4
    value, slope = weights(f64(-1.0, 0.0, 1.0), 0.5)
    torch.testing.assert_close(value, f64(-0.125, 0.75, 0.375))
    torch.testing.assert_close(slope, f64(0.0, -1.0, 1.0))
    torch.testing.assert_close(weights(f64(-2, -1, 0, 1, 2), 0.0)[1], f64(1, -8, 0, 8, -1) / 12)


def test_a_motion_that_the_step_does_not_resolve_is_said_to_be():
    # fails if a sum that does not converge is returned as a motion: at h = 3 the pendulum makes half a turn a step
    system = scene("damped_pendulum")
    x, _ = states(system)
    stepper = FractionalStepper(ContinuousEquation(system.L_d, 1.5))
    assert Status.UNRESOLVED in stepper.step(x, 0.75).status.tolist()
    assert (
        stepper.step(x, 3.0).status.tolist() == Stepper(system.L_d).rollout(*x, h=1.5, steps=2).status.amax(-1).tolist()
    )


def test_a_rollout_between_the_samples():
    # fails if the fractional stepper does not fit the one driver: 14 parts are two steps
    L_d = scene("damped_pendulum").L_d
    x, _ = states(scene("damped_pendulum"))
    parts = FractionalStepper(ContinuousEquation(L_d, 0.1)).rollout(*x, h=0.1 / 7, steps=14)
    whole = Stepper(L_d).rollout(*x, h=0.1, steps=2)
    for a, b in zip(parts.final, whole.final, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)
    torch.testing.assert_close(parts.sigma[:, -1], whole.sigma[:, -1], rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda L: ContinuousEquation(L, 0.0), "h must be > 0, got 0"),
        (lambda L: ContinuousEquation(L, 0.1, 3), "order must be even, from 2 to 36, got 3"),
        (
            lambda L: FractionalStepper(ContinuousEquation(L, 0.1)).step(
                State(f64(1.0), f64(1.0), f64(1.0)[0]), f64(0.1, 0.2)
            ),
            "needs a scalar h",
        ),
    ],
)
def test_what_is_refused(make, message):
    # fails if a wrong setting is used in silence
    with pytest.raises(InputError, match=message):
        make(scene("damped_oscillator").L_d)


def test_more_neighbours_make_the_field_contact():
    # fails if 9 neighbours are all (dH̃/dt + RH̃ = 4e-9 then), or if the sum stops before two orders agree: Hénon–Heiles
    # with damping by a rule of order 2, whose energy is not that of the equation; measured 1.3e-11 at worst
    def L_d(q0, q1, s0, h):
        x, v = torch.stack([q0, q1]), (q1 - q0) / h
        V = 0.5 * (x * x).sum(-1) + x[..., 0] ** 2 * x[..., 1] - x[..., 1] ** 3 / 3
        return h * (0.5 * (v * v).sum(-1) - 0.5 * V.sum(0)) - 0.02 * s0

    make = torch.Generator().manual_seed(0)
    q, p = (0.35 * (2 * torch.rand(6, 2, generator=make, dtype=torch.float64) - 1) for _ in range(2))
    E, x = ContinuousEquation(L_d, 0.2), [q, p, torch.zeros(6, dtype=torch.float64)]
    x = [y.requires_grad_() for y in x]
    H = E.hamiltonian(*x)
    H_q, H_p, H_s = torch.autograd.grad(H.sum(), x)
    q_dot, p_dot, s_dot = (y.detach() for y in E.field(*(y.detach() for y in x)))
    power = (H_q * q_dot).sum(-1) + (H_p * p_dot).sum(-1) + H_s * s_dot
    assert float((power + H_s * H.detach()).abs().max()) < 1e-9
    assert float(power.abs().max()) > 1e-3
