"""Singular M: a drift motion with damping, a multiplier as a coordinate, and the relation that stays Legendrian."""

from functools import partial

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import momentum_jacobian, partials
from herglotz.scenes import damped_oscillator, reference_flow, strang
from herglotz.stepping import State, Status, Stepper
from herglotz.theory import (
    ConstrainedStepper,
    LegendrianStepper,
    contact_vector_field,
    legendrian_defect,
    legendrian_relation,
)

B, GAMMA = 2.0, 0.3


def phi(x, y):
    return 0.5 * (x * x + y * y) + 0.2 * x * x * y + 0.1 * torch.cos(y)


def drift(q0, q1, s0, h):
    """L = B x ẏ − φ(x, y) − γs, linear in the velocity: x0 is a stage in the middle of the step, x1 does not occur."""
    x, y0, y1 = q0[..., 0], q0[..., 1], q1[..., 1]

    def L(s):
        return B * x * (y1 - y0) / h - phi(x, 0.5 * (y0 + y1)) - GAMMA * s

    return h * L(s0 + 0.5 * h * L(s0))


def nonlinear_drift(q0, q1, s0, h):
    """The same with a friction nonlinear in s, so that the step ahead feels s1."""
    return drift(q0, q1, s0, h) - 0.4 * h * torch.sin(2.0 * s0) * (1.0 + q0[..., 0] ** 2)


def drift_start(dtype=torch.float64):
    """(x, y), (0, Bx), s: p_x = 0 and p_y = Bx are the primary constraints."""
    y, pi = torch.tensor([[0.5], [-0.3]], dtype=dtype), torch.tensor([[0.8], [1.1]], dtype=dtype)
    return State(torch.cat([pi / B, y], -1), torch.cat([0 * pi, pi], -1), torch.tensor([0.2, 0.0], dtype=dtype))


def test_the_plain_stepper_is_singular_where_the_legendrian_one_goes_on():
    # fails if the example is regular after all, or the pseudo-inverse gives up
    x, h = drift_start(), 0.1
    assert Stepper(drift).step(x, h).status.tolist() == [Status.SINGULAR] * 2
    M = momentum_jacobian(partials(drift, x.q, x.q, x.s, h, order=2), x.p)
    assert torch.linalg.matrix_rank(M).tolist() == [1, 1]
    stepper = LegendrianStepper(drift)
    out = stepper.step(stepper.consistent(x, h), h)
    assert out.status.tolist() == [Status.CONVERGED] * 2
    assert float(out.residual.max()) < 1e-14


def test_drift_with_damping_is_of_order_two():
    # fails if x1 is left where the guess put it, or c is missing in the step ahead
    x, T, errors = drift_start(), 2.0, []
    H = lambda q, p, s: phi(p[..., 0] / B, q[..., 0]) + GAMMA * s  # noqa: E731  reduced: y and π = Bx are conjugate
    reference = reference_flow(partial(contact_vector_field, H), x.q[:, 1:], x.p[:, 1:], x.s, T)
    stepper = LegendrianStepper(drift)
    for steps in (10, 20, 40):
        out = stepper.rollout(*stepper.consistent(x, T / steps), h=T / steps, steps=steps)
        assert bool(out.ok.all())
        assert float(out.residual.max()) < 2e-13
        last = (out.q[:, -1, 1:], out.p[:, -1, 1:], out.s[:, -1])
        errors.append([float((a - b).abs().max()) for a, b in zip(last, reference, strict=True)])
    slopes = torch.log2(torch.tensor(errors[:-1]) / torch.tensor(errors[1:]))
    assert bool(((slopes > 1.85) & (slopes < 2.15)).all()), slopes
    assert errors[-1][1] < 2e-4
    assert float(out.p[..., 0].abs().max()) == 0.0  # the primary constraint p_x = 0


def test_the_step_ahead_starts_at_the_new_action():
    # fails if the step ahead is taken at s0: the x1 found would then start no step
    stepper = LegendrianStepper(nonlinear_drift)
    out = stepper.rollout(*stepper.consistent(drift_start(), 0.1), h=0.1, steps=10)
    assert bool(out.ok.all())
    assert float(out.residual.max()) < 1e-13
    assert float((out.sigma[:, 1:] / out.sigma[:, :-1]).std()) > 1e-3  # c is no constant here


def test_a_state_off_the_constraint_starts_no_step():
    # fails if a least-squares compromise is reported as a step
    x, h = drift_start(), 0.1
    stepper = LegendrianStepper(drift)
    out = stepper.step(x, h)  # x at the start of the step where its stage belongs: inconsistent at O(h)
    assert out.status.tolist() == [Status.SINGULAR] * 2
    assert float(out.residual.min()) > 1e-3
    assert bool(out.state.q.isnan().all())
    good = stepper.consistent(x, h)
    mixed = State(torch.stack([good.q[0], x.q[1]]), x.p, x.s)
    out = stepper.step(mixed, h)
    assert out.status.tolist() == [Status.CONVERGED, Status.SINGULAR]
    torch.testing.assert_close(out.state.q[0], stepper.step(good, h).state.q[0], rtol=0, atol=1e-15)
    assert torch.equal(good.q[:, 1], x.q[:, 1])  # only the stage was moved
    nothing = LegendrianStepper(lambda q0, q1, s0, h: 0.0 * (q0 * q1).sum(-1) + 0.0 * s0 * h)  # c p0 = 0
    assert bool(nothing.consistent(x, h).q.isnan().all())


def test_the_kernel_of_M_need_not_be_a_coordinate():
    # fails if rows of V are taken for its columns: the state moves along the stage x, here in the direction (3, 1, 2)
    toward = torch.linalg.qr(torch.tensor([[3.0, 1.0, 0.0], [1.0, 0.0, 1.0], [2.0, 1.0, 1.0]]).double())[0]

    def turned(q0, q1, s0, h):  # beside the drift, a third coordinate that is an oscillator of its own
        x0, x1 = q0 @ toward, q1 @ toward
        z = 0.5 * ((x1 - x0)[..., 2] / h) ** 2 - 0.5 * x0[..., 2] ** 2
        return drift(x0, x1, s0, h) + h * z

    x, h, z = drift_start(), 0.1, torch.tensor([[0.3], [-0.2]]).double()
    q, p = (torch.cat([y, z], -1) @ toward.mT for y in (x.q, x.p))
    start = LegendrianStepper(turned).consistent(State(q, p, x.s), h)
    expected = LegendrianStepper(drift).consistent(x, h)
    torch.testing.assert_close((start.q @ toward)[:, :2], expected.q, rtol=0, atol=1e-12)
    torch.testing.assert_close((start.q @ toward)[:, 2:], z, rtol=0, atol=1e-12)


def test_a_step_without_a_number_or_without_c_says_so():
    # fails if NaN counts as a state off the constraint, or a step with c = 0, which forgets s0 and p0, as a step
    x, h = drift_start(), 0.1
    lost = LegendrianStepper(lambda q0, q1, s0, h: drift(q0, q1, s0, h) * torch.nan).step(x, h)
    assert lost.status.tolist() == [Status.DIVERGED] * 2
    forgets = lambda q0, q1, s0, h: 0.5 * ((q1 - q0) ** 2).sum(-1) / h - s0  # noqa: E731
    assert LegendrianStepper(forgets, ahead=0).step(x, h).status.tolist() == [Status.SINGULAR] * 2


def test_without_looking_ahead_the_open_direction_stays_at_the_guess():
    # fails if `ahead` has no effect: the test above would then say nothing
    stepper = LegendrianStepper(drift, ahead=0)
    x = LegendrianStepper(drift).consistent(drift_start(), 0.1)
    guess = x.q + torch.tensor([0.37, 0.0], dtype=torch.float64)
    out = stepper.step(x, 0.1, guess)
    assert out.status.tolist() == [Status.CONVERGED] * 2
    torch.testing.assert_close(out.state.q[:, 0], guess[:, 0], rtol=0, atol=1e-15)
    assert LegendrianStepper(drift).step(out.state, 0.1).status.tolist() == [Status.SINGULAR] * 2


def sphere(q):
    return 0.5 * ((q * q).sum(-1, keepdim=True) - 1.0)


BASE = strang(lambda q: 1.0 + q[..., -1], 1.0, GAMMA)


def with_multiplier(q0, q1, s0, h):
    """A pendulum whose rod's force λ is a third coordinate: L_d + (h/2) λ0 (g(x0) + g(x1)), without λ1."""
    x0, x1, force = q0[..., :2], q1[..., :2], q0[..., 2]
    return BASE(x0, x1, s0, h) + 0.5 * h * force * (sphere(x0) + sphere(x1))[..., 0]


def test_a_multiplier_coordinate_gives_the_constrained_stepper():
    # fails if the step ahead does not fix λ, or `consistent` moves anything but λ
    theta, omega = torch.tensor([[1.2], [-0.6]]).double(), torch.tensor([[0.5], [1.1]]).double()
    q = torch.cat([theta.sin(), -theta.cos()], -1)
    p = omega * torch.cat([theta.cos(), theta.sin()], -1)
    s, zero, h = torch.tensor([0.1, -0.2]).double(), torch.zeros(2, 1).double(), 0.1
    rattle = ConstrainedStepper(BASE, sphere, lambda *x: x[1])
    expected = rattle.rollout(q, p, s, h=h, steps=8)
    assert Stepper(with_multiplier).step(State(torch.cat([q, zero], -1), torch.cat([p, zero], -1), s), h).status[0] > 0
    stepper = LegendrianStepper(with_multiplier)
    start = stepper.consistent(State(torch.cat([q, zero], -1), torch.cat([p, zero], -1), s), h)
    torch.testing.assert_close(start.q[:, 2:], -2 / h * rattle.multiplier(State(q, p, s), h), rtol=1e-11, atol=1e-12)
    out = stepper.rollout(*start, h=h, steps=8)
    assert bool(out.ok.all())
    assert float(out.residual.max()) < 1e-13
    torch.testing.assert_close(out.q[..., :2], expected.q, rtol=0, atol=1e-12)
    torch.testing.assert_close(out.s, expected.s, rtol=0, atol=1e-12)
    assert float(sphere(out.q[..., :2]).abs().max()) < 1e-13


@pytest.mark.parametrize("L_d", [drift, with_multiplier, damped_oscillator().L_d])
def test_the_relation_is_legendrian_whatever_the_rank(L_d):
    # fails if p1 is divided by c, or c is missing at the start: η1 − c η0 then does not vanish on the relation
    n = {drift: 2, with_multiplier: 3}.get(L_d, 1)
    u = torch.randn(4, 2 * n + 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def submanifold(u, wrong=1.0):
        h = torch.tensor(0.1, dtype=u.dtype)
        base, momenta, z = legendrian_relation(L_d, u[..., :n], u[..., n : 2 * n], u[..., 2 * n], h)
        return base, torch.cat([momenta[..., :n], wrong * momenta[..., n:]], -1), z

    defect = legendrian_defect(submanifold, u)
    assert float(defect.pullback.abs().max()) < 1e-13
    assert float(defect.spread.min()) > 0.5
    null = legendrian_defect(lambda u: submanifold(u, 1.01), u)
    assert float(null.pullback.abs().max()) > 1e-3


def test_float32_and_wrong_options():
    # fails if a tolerance is fixed in float64, or ahead is not checked
    stepper = LegendrianStepper(drift)
    single = stepper.rollout(*stepper.consistent(drift_start(torch.float32), 0.1), h=0.1, steps=5)
    double = stepper.rollout(*stepper.consistent(drift_start(), 0.1), h=0.1, steps=5)
    assert single.q.dtype == torch.float32
    assert bool(single.ok.all())
    torch.testing.assert_close(single.q.double(), double.q, rtol=0, atol=5e-6)
    with pytest.raises(InputError, match="ahead must be >= 0"):
        LegendrianStepper(drift, ahead=-1)
