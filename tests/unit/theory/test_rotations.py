"""hat and Cayley on SO(3)."""

import torch

from herglotz.theory.rotations import cayley, hat


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


def test_derivatives_are_right_at_the_identity():
    # fails if a branch that is not taken sends NaN into the gradient
    for size in (0.0, 1e-9, 1.0, 2.0):
        assert torch.autograd.gradcheck(cayley, ((axes(2) * size).requires_grad_(),))
