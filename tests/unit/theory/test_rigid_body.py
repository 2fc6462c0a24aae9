"""A damped rigid body: spatial momentum, orthogonality, order, and the undamped body in another time."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import reference_flow
from herglotz.stepping import Status
from herglotz.theory import BodyState, RigidBodyStepper, cayley, hat

J, GAMMA = torch.tensor([1.0, 2.0, 2.6], dtype=torch.float64), 0.3
F64 = torch.float64


def start(dtype=torch.float64):
    M = torch.tensor([[0.3, 2.0, 0.4], [1.5, -0.2, 0.9]], dtype=F64)
    R = cayley(torch.tensor([[0.2, 0.1, -0.4], [2.0, 0.5, 0.3]], dtype=F64))
    return BodyState(*(x.to(dtype) for x in (R, M, torch.tensor([0.2, -0.1], dtype=F64))))


def exact(state, t, gamma):
    """The damped body is the undamped one at τ = (1 − e^{−γt})/γ, its momentum scaled by e^{−γt}."""
    tau = -torch.expm1(torch.tensor(-gamma * t, dtype=F64)) / gamma

    def field(R, M, s):  # R as 9 numbers, M padded to 9: the reference flow wants q and p of one size
        M = M[..., :3]
        omega = M / J
        turn = (R.unflatten(-1, (3, 3)) @ hat(omega)).flatten(-2)
        return turn, torch.nn.functional.pad(torch.linalg.cross(M, omega), (0, 6)), 0 * s

    R, M, _ = reference_flow(field, state.R.flatten(-2), torch.nn.functional.pad(state.M, (0, 6)), state.s, tau)
    scale = torch.exp(torch.tensor(-gamma * t, dtype=F64))
    energy = 0.5 * (state.M**2 / J).sum(-1)
    return R.unflatten(-1, (3, 3)), scale * M[..., :3], scale * (state.s + energy * tau)


def axes(count=4):
    w = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return w / w.norm(dim=-1, keepdim=True)


def test_hat_is_the_cross_product():
    # fails if a sign or an index of hat is wrong
    a, b = axes(), axes(8)[4:]
    torch.testing.assert_close((hat(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


def test_cayley_turns_by_twice_the_arctangent():
    # fails if the Cayley map has the factor ½ of the other convention; matrix_exp itself loses 1.5e-11
    f = axes() * torch.tensor([1e-9, 0.2, 1.0, 30.0], dtype=torch.float64)[:, None]
    angle = 2 * torch.atan(f.norm(dim=-1, keepdim=True))
    turned = torch.linalg.matrix_exp(hat(f / f.norm(dim=-1, keepdim=True) * angle))
    torch.testing.assert_close(cayley(f), turned, rtol=0, atol=1e-10)
    R = cayley(f)
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), rtol=0, atol=2e-15)


def test_the_step_solves_the_discrete_equation():
    # fails if F J_d − J_d Fᵀ has another factor, J_d is J, or c enters twice
    x, h = start(), 0.2
    out = RigidBodyStepper(J, GAMMA).step(x, h)
    assert out.status.tolist() == [Status.CONVERGED] * 2
    F = x.R.mT @ out.state.R
    J_d = 0.5 * J.sum() * torch.eye(3, dtype=F64) - torch.diag(J)
    E = torch.exp(torch.tensor(-GAMMA * h, dtype=F64))
    torch.testing.assert_close(F @ J_d - J_d @ F.mT, hat(h * E.sqrt() * x.M), rtol=0, atol=2e-15)
    torch.testing.assert_close((F @ out.state.M[..., None])[..., 0], E * x.M, rtol=0, atol=2e-15)
    action = E.sqrt() / h * ((torch.eye(3, dtype=F64) - F) @ J_d).diagonal(dim1=-2, dim2=-1).sum(-1)
    torch.testing.assert_close(out.state.s, E * x.s + action, rtol=0, atol=2e-15)


def test_order_two_against_the_undamped_body_in_rescaled_time():
    # fails if damping enters at one end of the step only: R is then of order 1
    x, T = start(), 2.0
    reference = exact(x, T, GAMMA)
    errors = []
    for steps in (10, 20, 40, 80):
        out = RigidBodyStepper(J, GAMMA).rollout(*x, h=T / steps, steps=steps)
        assert bool(out.ok.all())
        last = (out.R[:, -1], out.M[:, -1], out.s[:, -1])
        errors.append([float((a - b).abs().max()) for a, b in zip(last, reference, strict=True)])
    slopes = torch.log2(torch.tensor(errors[:-1]) / torch.tensor(errors[1:]))
    assert errors[-1][0] < 2e-3
    assert bool(((slopes > 1.8) & (slopes < 2.2))[1:].all()), slopes


def conserved(out, stepper):
    """Worst defects of orthogonality, of R_kM_k = σ_k R_0M_0 (relative), and of e^{2γt}·energy (relative)."""
    orthogonal = (out.R.mT @ out.R - torch.eye(3, dtype=out.R.dtype)).abs().max()
    spatial = (out.R @ out.M[..., None])[..., 0] / out.sigma[..., None]
    energy = stepper.energy(out.M) / out.sigma**2
    momentum = (spatial - spatial[:, :1]).abs().max() / spatial.abs().max()
    return float(orthogonal), float(momentum), float((energy / energy[:, :1] - 1).abs().max())


def test_spatial_momentum_scales_with_sigma_and_attitudes_stay_rotations():
    # fails if M_{k+1} = F_k M_k, c is forgotten, or rounding in R adds up
    stepper = RigidBodyStepper(J, 0.02)
    out = stepper.rollout(*start(), h=0.05, steps=1000)
    orthogonal, momentum, energy = conserved(out, stepper)
    assert orthogonal < 3e-15
    assert momentum < 1e-13
    assert energy < 2e-3  # energy falls like e^{−2γt}, with the bounded error of a symplectic method
    t = 0.05 * torch.arange(1001, dtype=F64)
    torch.testing.assert_close(out.sigma, torch.exp(-0.02 * t).expand(2, -1), rtol=1e-12, atol=0)
    kinetic = 0.5 * (start().M ** 2 / J).sum(-1)
    torch.testing.assert_close(stepper.energy(start().M), kinetic)


def test_float32_and_matrix_inertia():
    # fails if a constant drops to another dtype, or a turned inertia gives another motion
    A = cayley(torch.tensor([0.3, -0.8, 0.5], dtype=F64))
    x = start()
    principal = RigidBodyStepper(J, GAMMA).rollout(*x, h=0.1, steps=5)
    turned_inertia = A @ torch.diag(J) @ A.T
    turned_inertia = 0.5 * (turned_inertia + turned_inertia.T)
    turned = RigidBodyStepper(turned_inertia, GAMMA).rollout(x.R @ A.T, x.M @ A.T, x.s, h=0.1, steps=5)
    torch.testing.assert_close(turned.R @ A, principal.R, rtol=0, atol=1e-14)
    torch.testing.assert_close(turned.s, principal.s, rtol=0, atol=1e-14)
    single = RigidBodyStepper(J, GAMMA).rollout(*start(torch.float32), h=0.1, steps=5)
    assert single.R.dtype == torch.float32
    assert bool(single.ok.all())
    torch.testing.assert_close(single.R.double(), principal.R, rtol=0, atol=2e-6)


def test_a_step_too_large_for_any_rotation_has_a_status():
    # fails if a root off the flow's branch, or none, is returned as a step; its neighbour must not notice
    x = start()
    M = torch.stack([x.M[0], torch.tensor([0.0, 0.0, 60.0], dtype=F64)])
    out = RigidBodyStepper(J, GAMMA).step(BodyState(x.R, M, x.s), 0.1)
    assert out.status[0] == Status.CONVERGED
    assert out.status[1] != Status.CONVERGED
    assert bool(out.state.M[1].isnan().all())
    alone = RigidBodyStepper(J, GAMMA).step(BodyState(x.R[:1], M[:1], x.s[:1]), 0.1)
    assert torch.equal(alone.state.R[0], out.state.R[0])


def test_gradients_pass_the_solve():
    # fails if the solved F is detached
    x = start()

    def end(M, s):
        out = RigidBodyStepper(J, GAMMA).step(BodyState(x.R, M, s), 0.2).state
        return out.R, out.M, out.s

    assert torch.autograd.gradcheck(end, (x.M.clone().requires_grad_(), x.s.clone().requires_grad_()))


@pytest.mark.parametrize("wrong", [[1.0, 2.0], [1.0, -2.0, 3.0], [1.0, float("nan"), 3.0]])
def test_wrong_inertia_is_named(wrong):
    # fails if an impossible inertia is accepted
    with pytest.raises(InputError, match="inertia must be"):
        RigidBodyStepper(torch.tensor(wrong))


def test_wrong_shapes_are_named():
    # fails if a state of another batch shape is broadcast silently
    x = start()
    with pytest.raises(InputError, match="R, M, s need shapes"):
        RigidBodyStepper(J).step(BodyState(x.R[0], x.M, x.s), 0.1)
    with pytest.raises(InputError, match="h must be > 0"):
        RigidBodyStepper(J).step(x, -0.1)
