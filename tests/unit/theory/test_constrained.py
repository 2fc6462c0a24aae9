"""Holonomic constraints: a pendulum in Cartesian coordinates, a spherical pendulum, and constraints that fail."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import damped_pendulum, midpoint_heun, strang
from herglotz.stepping import State, Status
from herglotz.theory import ConstrainedStepper

GAMMA = 0.3


def height(q):
    return 1.0 + q[..., -1]


def sphere(q):
    return 0.5 * ((q * q).sum(-1, keepdim=True) - 1.0)


def velocity(q, p, s):  # noqa: ARG001
    return p


def lagrangian(q, v, s):
    return 0.5 * (v * v).sum(-1) - height(q) - GAMMA * s


def lift(theta, omega):
    """Position and momentum in the plane from angle and rate, (..., 1) each."""
    up = torch.cat([theta.sin(), -theta.cos()], -1)
    return up, omega * torch.cat([theta.cos(), theta.sin()], -1)


def angles(q, p):
    theta = torch.atan2(q[..., 0], -q[..., 1])[..., None]
    return theta, (p * lift(theta, torch.ones_like(theta))[1]).sum(-1, keepdim=True)


def planar(dtype=torch.float64):
    theta, omega = torch.tensor([[1.2], [-0.6]], dtype=dtype), torch.tensor([[0.5], [1.1]], dtype=dtype)
    return theta, omega, torch.tensor([0.1, -0.2], dtype=dtype)


def spherical(dtype=torch.float64):
    q = torch.tensor([[0.6, 0.0, -0.8], [0.0, 0.96, 0.28]], dtype=dtype)
    p = torch.tensor([[0.0, 0.7, 0.0], [0.5, -0.28, 0.96]], dtype=dtype)
    return State(q, p, torch.zeros(2, dtype=dtype))


def test_planar_pendulum_is_the_pendulum_to_order_two():
    # fails if λ is scaled by c, Dg is taken at the wrong end, or s is updated with the projected momentum
    theta, omega, s = planar()
    T, errors = 2.0, []
    reference = damped_pendulum(gamma=GAMMA).flow(theta, omega, s, T)
    stepper = ConstrainedStepper(midpoint_heun(lagrangian), sphere, velocity)
    for steps in (10, 20, 40):
        out = stepper.rollout(*lift(theta, omega), s, h=T / steps, steps=steps)
        assert bool(out.ok.all())
        last = (*angles(out.q[:, -1], out.p[:, -1]), out.s[:, -1])
        errors.append([float((a - b).abs().max()) for a, b in zip(last, reference, strict=True)])
    slopes = torch.log2(torch.tensor(errors[:-1]) / torch.tensor(errors[1:]))
    assert bool(((slopes > 1.9) & (slopes < 2.1)).all()), slopes
    assert errors[-1][0] < 1e-3


def constraint_defects(stepper, state, h, steps):
    out = stepper.rollout(*state, h=h, steps=steps)
    assert bool(out.ok.all())
    J = out.q[..., 0] * out.p[..., 1] - out.q[..., 1] * out.p[..., 0]
    decay = (J / out.sigma / J[:, :1] - 1).abs().max()
    return float(sphere(out.q).abs().max()), float((out.q * out.p).sum(-1).abs().max()), float(decay), out


def test_spherical_pendulum_stays_on_the_sphere_and_its_angular_momentum_decays_with_sigma():
    # fails if p is not projected, the projection turns J, or σ_k misses a factor (contact Noether)
    stepper = ConstrainedStepper(strang(height, 1.0, GAMMA), sphere, velocity)
    g, tangent, decay, out = constraint_defects(stepper, spherical(), 0.05, 100)
    assert g < 1e-13
    assert tangent < 1e-13
    assert decay < 1e-12
    torch.testing.assert_close(out.sigma[:, -1], torch.exp(torch.tensor([-GAMMA * 5.0] * 2, dtype=torch.float64)))
    unscaled = out.q[..., 0] * out.p[..., 1] - out.q[..., 1] * out.p[..., 0]
    assert float((unscaled[:, -1] / unscaled[:, 0] - 1).abs().min()) > 0.5  # null model: J is not conserved


def test_the_multiplier_is_half_the_impulse_of_the_rod():
    # fails if the sign or the factor in the documentation of λ is wrong
    theta, omega, s = planar()
    stepper = ConstrainedStepper(strang(height, 1.0, GAMMA), sphere, velocity)
    tension = omega[:, 0] ** 2 + theta[:, 0].cos()
    coarse, fine = (2 * stepper.multiplier(State(*lift(theta, omega), s), h)[:, 0] / h - tension for h in (1e-3, 1e-4))
    assert float(fine.abs().max()) < 2e-3
    assert float((coarse / fine - 10).abs().max()) < 0.5


def test_a_momentum_off_the_tangent_space_is_as_good_as_its_projection():
    # fails if λ does not absorb the normal part of p
    stepper = ConstrainedStepper(strang(height, 1.0, GAMMA), sphere, velocity)
    x = spherical()
    off = State(x.q, x.p + 0.3 * x.q, x.s)
    a, b = stepper.step(off, 0.1), stepper.step(x, 0.1)
    torch.testing.assert_close(a.state.q, b.state.q, rtol=0, atol=1e-14)
    torch.testing.assert_close(stepper.project(off).p, x.p, rtol=0, atol=1e-15)


def test_a_velocity_nonlinear_in_p_is_projected():
    # fails if the projection stops after its first Newton step
    def relativistic(q, p, s):  # noqa: ARG001
        return p / torch.sqrt(1 + 0.5 * (p * p * torch.tensor([1.0, 2.0, 3.0], dtype=p.dtype)).sum(-1, keepdim=True))

    stepper = ConstrainedStepper(strang(height, 1.0, GAMMA), sphere, relativistic)
    x = stepper.project(spherical()._replace(p=spherical().p + 0.4 * spherical().q))
    assert float((x.q * relativistic(*x)).sum(-1).abs().max()) < 1e-14


def test_float32_and_gradients():
    # fails if a constant drops to another dtype, or the solved λ is detached
    stepper = ConstrainedStepper(strang(height, 1.0, GAMMA), sphere, velocity)
    single = stepper.rollout(*spherical(torch.float32), h=0.1, steps=10)
    double = stepper.rollout(*spherical(), h=0.1, steps=10)
    assert single.q.dtype == torch.float32
    assert bool(single.ok.all())
    torch.testing.assert_close(single.q.double(), double.q, rtol=0, atol=5e-6)
    assert float(sphere(single.q).abs().max()) < 5e-7
    x = spherical()

    def end(p, s):
        return stepper.step(State(x.q, p, s), 0.1).state

    assert torch.autograd.gradcheck(end, (x.p.clone().requires_grad_(), x.s.clone().requires_grad_()))


def test_failures_have_a_status_and_leave_neighbours_alone():
    # fails if a step that cannot reach g = 0 is reported as a step
    stepper = ConstrainedStepper(strang(height, 1.0, GAMMA), sphere, velocity)
    x = spherical()
    fast = State(x.q, torch.stack([x.p[0], 60 * x.p[1]]), x.s)  # h|v| = 6: no point of the sphere is that far away
    out = stepper.step(fast, 0.1)
    assert out.status[0] == Status.CONVERGED
    assert out.status[1] != Status.CONVERGED
    assert bool(out.state.q[1].isnan().all())
    assert torch.equal(out.state.q[0], stepper.step(State(*(y[:1] for y in x)), 0.1).state.q[0])


def test_dependent_constraints_are_singular():
    # fails if a rank-deficient Dg passes as a solution
    twice = ConstrainedStepper(strang(height, 1.0, GAMMA), lambda q: sphere(q).expand(*q.shape[:-1], 2), velocity)
    out = twice.step(spherical(), 0.1)
    assert bool((out.status != Status.CONVERGED).all())
    assert bool(out.state.q.isnan().all())


def test_wrong_constraints_are_named():
    # fails if a constraint of shape (...) is broadcast silently
    for wrong in (lambda q: (q * q).sum(-1), lambda q: q):
        with pytest.raises(InputError, match="constraint must map"):
            ConstrainedStepper(strang(height, 1.0, GAMMA), wrong, velocity).step(spherical(), 0.1)
