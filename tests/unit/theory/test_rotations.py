"""hat, exp, log and Cayley on SO(3), against 40-digit arithmetic and against one another."""

import mpmath
import pytest
import torch

from herglotz.theory.rotations import cayley, exp_so3, hat, inverse_cayley, log_so3, vee

ANGLES = (0.0, 1e-12, 1e-6, 1e-4, 0.03, 0.5, 0.999, 1.001, 2.0, 3.0, 3.1415)


def axes(count=4, dtype=torch.float64):
    w = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (w / w.norm(dim=-1, keepdim=True)).to(dtype)


def test_hat_is_the_cross_product_and_vee_its_inverse():
    # fails if a sign or an index of hat is wrong, or vee keeps a symmetric part
    a, b = axes(), axes(8)[4:]
    torch.testing.assert_close((hat(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))
    symmetric = b[..., :, None] * b[..., None, :]
    torch.testing.assert_close(vee(hat(a) + symmetric), a)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_agrees_with_many_digits(angle):
    # fails if the series or the closed form loses digits (torch.matrix_exp: 1.5e-11 near 0.03)
    for w in axes() * angle:
        with mpmath.workdps(40):
            a, b, c = (mpmath.mpf(float(x)) for x in w)
            exact = mpmath.expm(mpmath.matrix([[0, -c, b], [c, 0, -a], [-b, a, 0]]), method="taylor")
        reference = torch.tensor([[float(exact[i, j]) for j in range(3)] for i in range(3)], dtype=torch.float64)
        assert float((exp_so3(w) - reference).abs().max()) < 1e-15


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp_up_to_a_half_turn(angle):
    # fails if log loses digits near the identity (arccos of the trace: 1e-8) or near π (R − Rᵀ: all of them)
    w = axes(20) * angle
    assert float((log_so3(exp_so3(w)) - w).abs().max()) < 3e-15
    assert float((log_so3(exp_so3(w.float())) - w.float()).abs().max()) < 2e-6


def test_log_of_exact_half_turns():
    # fails if the quaternion is taken from its real part, which vanishes there
    for R in (torch.diag(torch.tensor(d, dtype=torch.float64)) for d in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1))):
        w = log_so3(R)
        assert abs(float(w.norm()) - torch.pi) < 1e-15
        torch.testing.assert_close(exp_so3(w), R, rtol=0, atol=1e-15)


def test_cayley_turns_by_twice_the_arctangent():
    # fails if the Cayley map has the factor ½ of the other convention
    f = axes() * torch.tensor([1e-9, 0.2, 1.0, 30.0], dtype=torch.float64)[:, None]
    angle = 2 * torch.atan(f.norm(dim=-1, keepdim=True))
    torch.testing.assert_close(cayley(f), exp_so3(f / f.norm(dim=-1, keepdim=True) * angle), rtol=0, atol=2e-15)
    torch.testing.assert_close(inverse_cayley(cayley(f)), f, rtol=1e-12, atol=0)


def test_derivatives_are_finite_and_right_at_the_identity_and_at_the_switch():
    # fails if a branch that is not taken sends NaN into the gradient
    for size in (0.0, 1e-9, 1.0, 2.0):
        w = (axes(2) * size).requires_grad_()
        assert torch.autograd.gradcheck(exp_so3, (w,))
        assert torch.autograd.gradcheck(cayley, (w,))
    w = (axes(2) * 0.7).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: log_so3(exp_so3(w)), (w,))
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    log_so3(exp_so3(zero)).sum().backward()
    assert zero.grad is not None
    torch.testing.assert_close(zero.grad, torch.ones(3, dtype=torch.float64))
