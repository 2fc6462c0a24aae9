"""Discrete gradients: ∇̄f·Δ = f(x1) − f(x0), ∇̄f(x, x) = ∇f(x), symmetry, order."""

import pytest
import torch

from herglotz.mechanics.scalar_fields import gradient
from herglotz.theory import midpoint_gradient


def f(x):
    return torch.sin(x[..., 0] * x[..., 1]) + 0.3 * x[..., 2] ** 3 * x[..., 0] + torch.exp(0.4 * x[..., 1])


def pair(step=1.0, dtype=torch.float64):
    make = torch.Generator().manual_seed(0)
    x0, d = torch.randn(2, 9, 3, generator=make, dtype=torch.float64)
    return x0.to(dtype), (x0 + step * d).to(dtype)


@pytest.mark.parametrize("step", [1.0, 0.1, 1e-3, 1e-5, 1e-7, 1e-12])
def test_the_secant_condition(step):
    # fails if the correction has a wrong factor, or a small Δ makes it noise: then H would drift
    x0, x1 = pair(step)
    secant = (midpoint_gradient(f, x0, x1) * (x1 - x0)).sum(-1)
    assert float((secant - (f(x1) - f(x0))).abs().max()) < 4e-15


def test_consistency_symmetry_and_zero_increments():
    # fails if equal points, or one equal coordinate, divide 0 by 0; or the two ends are not treated alike
    x0, x1 = pair(0.3)
    torch.testing.assert_close(midpoint_gradient(f, x0, x0), gradient(f, x0)[1])
    torch.testing.assert_close(midpoint_gradient(f, x0, x1), midpoint_gradient(f, x1, x0))
    x1[:, 1] = x0[:, 1]
    g = midpoint_gradient(f, x0, x1)
    assert bool(torch.isfinite(g).all())
    assert float(((g * (x1 - x0)).sum(-1) - (f(x1) - f(x0))).abs().max()) < 4e-15


def test_order_two():
    # fails if it approximates ∇f at an end, order 1, instead of at the middle
    def error(h):
        x0, x1 = pair(h)
        return float((midpoint_gradient(f, x0, x1) - gradient(f, 0.5 * (x0 + x1))[1]).abs().max())

    assert error(0.02) / error(0.01) == pytest.approx(4, rel=0.1)


def test_float32_and_single_points():
    # fails if thresholds or quadrature nodes are in float64, or a batch is required
    x0, x1 = pair(0.3, torch.float32)
    g = midpoint_gradient(f, x0, x1)
    assert g.dtype == torch.float32
    torch.testing.assert_close(midpoint_gradient(f, x0[4], x1[4]), g[4])
    assert float(((g * (x1 - x0)).sum(-1) - (f(x1) - f(x0))).abs().max()) < 3e-6
