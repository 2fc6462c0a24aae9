"""The Herglotz action of discrete curves that are no solutions, and its first variation."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.theory import curve_action, herglotz_action
from tests.lagrangians import nonlinear

CASES = {
    "nonlinear": (nonlinear, 2),
    "oscillator": (scene("damped_oscillator").L_d, 1),
    "parachute": (scene("parachute").L_d, 1),
    "pendulum midpoint": (scene("damped_pendulum").L_d_rules["midpoint"], 1),
}


def curves(n, steps, batch=(5,), seed=0, dtype=torch.float64):
    make = torch.Generator().manual_seed(seed)
    q = torch.randn(*batch, steps + 1, n, generator=make, dtype=torch.float64)
    h = 0.1 + 0.3 * torch.rand(*batch, steps, generator=make, dtype=torch.float64)
    return q.to(dtype), torch.randn(batch, generator=make, dtype=torch.float64).to(dtype), h.to(dtype)


@pytest.mark.parametrize("name", CASES)
def test_gradient_against_autograd(name):
    # fails if the product of the c's after k starts at k, R_k misses c_k, or s_{k−1} and s_k are exchanged (E3)
    L_d, n = CASES[name]
    q, s0, h = curves(n, 6)
    A = herglotz_action(L_d, q, s0, h)
    q, s0 = q.requires_grad_(), s0.requires_grad_()
    dq, ds0 = torch.autograd.grad(curve_action(L_d, q, s0, h)[..., -1].sum(), (q, s0))
    torch.testing.assert_close(A.gradient, dq, rtol=1e-12, atol=1e-12 * float(dq.abs().max()))
    torch.testing.assert_close(A.sigma[..., -1], ds0, rtol=1e-12, atol=1e-13)
    # fails if the test cannot see a gradient without the product: the first interior row differs from R_1 by σ_N/σ_2
    assert float((A.gradient[..., 1, :] - A.residual[..., 0, :]).abs().max()) > 1e-3


def test_gradient_vanishes_on_solutions_only():
    # fails if R is zero for any curve
    q, s0, _ = curves(2, 1)
    out = Stepper(nonlinear).rollout(q[:, 0], q[:, 1], s0, h=0.2, steps=7)
    assert float(herglotz_action(nonlinear, out.q, s0, 0.2).gradient[:, 1:-1].abs().max()) < 1e-11
    bent = out.q.clone()
    bent[:, 3] += 1e-3
    assert float(herglotz_action(nonlinear, bent, s0, 0.2).gradient[:, 1:-1].abs().amax((1, 2)).min()) > 1e-4


def test_a_zero_factor_is_no_division():
    # fails if the products are formed by dividing σ_N by σ_k: at h = 1/γ the left rule has c = 0
    L_d = scene("damped_oscillator").L_d_rules["left"]
    q, s0, h = curves(1, 4)
    h[:, 2] = 5.0
    A = herglotz_action(L_d, q, s0, h)
    assert bool(torch.isfinite(A.gradient).all())
    assert float(A.gradient[:, :2].abs().max()) == 0  # everything before that step is forgotten
    assert float(A.gradient[:, 4].abs().min()) > 0


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_shapes_and_float32(batch):
    # fails if the step axis is taken for a batch axis, or float64 gets in
    q, s0, h = curves(2, 4, batch, dtype=torch.float32)
    A = herglotz_action(nonlinear, q, s0, h)
    assert (A.s.shape, A.gradient.shape, A.residual.shape) == ((*batch, 5), (*batch, 5, 2), (*batch, 3, 2))
    assert A.gradient.dtype == torch.float32
    same = herglotz_action(nonlinear, q, s0, h[(0,) * len(batch)])  # (N,) shared by the batch
    assert same.s.shape == A.s.shape


class Pushed:
    def __call__(self, q0, q1, s0, h):
        return nonlinear(q0, q1, s0, h)

    def forces(self, q0, q1, s0, h):
        return 0.1 * q0 + 0 * h[..., None], 0.1 * q1 + 0 * s0[..., None]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q, s, _: (nonlinear, q[..., :1, :], s, 0.1), "a discrete curve needs shape"),
        (lambda q, s, h: (nonlinear, q, s, h[..., :3]), "a curve of 4 steps needs h of shape"),
        (lambda q, s, _: (nonlinear, q, s, -0.1), "h must be > 0, got -0.1"),
        (lambda q, s, h: (Pushed(), q, s, h), "comes with forces"),
    ],
)
def test_wrong_input_is_named(change, message):
    # fails if a user's mistake ends in a broadcast or in a number
    with pytest.raises(InputError, match=message):
        herglotz_action(*change(*curves(2, 4)))
