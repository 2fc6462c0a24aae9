"""The rigid body in angles against its conserved direction and against the stepper without a chart."""

import math

import torch

from herglotz.scenes import scene
from herglotz.theory import RigidBodyStepper

J = (2.1, 1.7, 0.9)
SYSTEM = scene("rigid_body", J1=J[0], J2=J[1], J3=J[2], gamma=0.3)


def rotation(q):
    """R_z(yaw) R_y(pitch) R_x(roll), (..., 3, 3)."""

    def about(axis, angle):
        K = torch.zeros(3, 3, dtype=torch.float64)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        K[a, b], K[b, a] = -1.0, 1.0
        return torch.linalg.matrix_exp(angle[..., None, None] * K)

    return about(2, q[..., 2]) @ about(1, q[..., 1]) @ about(0, q[..., 0])


def body_velocity(q, v):
    """Ω of RᵀṘ = Ω̂, by differentiating the rotation."""
    _, turn = torch.autograd.functional.jvp(rotation, q, v)
    W = rotation(q).mT @ turn
    return torch.stack([W[..., 2, 1], W[..., 0, 2], W[..., 1, 0]], -1)


def start():
    q = torch.tensor([[0.4, 0.3, -0.7], [-0.9, -0.2, 0.1]], dtype=torch.float64)
    v = torch.tensor([[1.1, -0.2, 0.15], [0.9, 0.1, 0.2]], dtype=torch.float64)
    s = torch.zeros(2, dtype=torch.float64)
    return q, SYSTEM.momentum(q, v, s), s


def body_momentum(q, p, s):
    return torch.tensor(J, dtype=torch.float64) * body_velocity(q, SYSTEM.velocity(q, p, s))


def in_space(q, M):
    return (rotation(q) @ M[..., None])[..., 0]


def test_the_lagrangian_is_that_of_the_rotation():
    # fails if W(q) belongs to another order of the angles, or to the angular velocity in space
    q, p, s = start()
    v = SYSTEM.velocity(q, p, s)
    energy = 0.5 * (torch.tensor(J, dtype=torch.float64) * body_velocity(q, v) ** 2).sum(-1)
    torch.testing.assert_close(SYSTEM.lagrangian(q, v, s), energy)


def test_momentum_in_space_shrinks_and_never_turns():
    # fails if the damping turns it, or acts at another rate than γ
    x = start()
    y = SYSTEM.flow(*x, 2.5)
    before, after = in_space(x[0], body_momentum(*x)), in_space(y[0], body_momentum(*y))
    torch.testing.assert_close(after, math.exp(-0.3 * 2.5) * before, rtol=1e-12, atol=1e-12)


def test_the_stepper_without_a_chart_follows_at_order_two():
    # fails if either describes another body, or if the stepper's order is lost
    x, errors = start(), []
    y = SYSTEM.flow(*x, 2.0)
    stepper = RigidBodyStepper(torch.tensor(J, dtype=torch.float64), 0.3)
    for steps in (40, 80):
        out = stepper.rollout(rotation(x[0]), body_momentum(*x), x[2], h=2.0 / steps, steps=steps)
        errors.append(float((out.R[:, -1] - rotation(y[0])).abs().max()))
        assert abs(float((out.s[:, -1] - y[2]).abs().max())) < 1e-3
    assert 1.9 < math.log2(errors[0] / errors[1]) < 2.1
