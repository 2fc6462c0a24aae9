"""cosw, sincw, versw against 40-digit values, with their derivatives."""

import mpmath as mp
import pytest
import torch

from herglotz.scenes.special import cosw, sincw, versw

POINTS = [-60.0, -3.7, -1 - 1e-9, -1 + 1e-9, -0.3, -1e-7, -1e-300, 0.0, 1e-12, 0.04, 0.97, 1.0, 1.5, 9.0, 80.0]


def exact(name, x, order):
    """The order-th derivative, from the power series Σ (−x)^k/(2k+shift)! at 60 digits."""
    shift = 0 if name == "cosw" else 1
    with mp.workdps(60):
        terms = range(order, 90)
        return mp.fsum(
            (-1) ** k * mp.ff(k, order) * mp.mpf(x) ** (k - order) / mp.factorial(2 * k + shift) for k in terms
        )


@pytest.mark.parametrize("x", POINTS)
@pytest.mark.parametrize("name", ["cosw", "sincw"])
def test_value_and_two_derivatives(name, x):
    # fails if the branch not taken leaks a NaN gradient at 0, or the series is cut a few terms too early at |x| = 1
    f = {"cosw": cosw, "sincw": sincw}[name]
    at = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    value = f(at)
    (first,) = torch.autograd.grad(value, at, create_graph=True)
    (second,) = torch.autograd.grad(first, at)
    for order, got in enumerate((value, first, second)):
        expected = float(exact(name, x, order))
        assert abs(got.item() - expected) <= 4e-15 * max(1.0, abs(expected))


def test_versw_does_not_cancel():
    # fails if versw is computed as 1 − cosw: 0 instead of x/2 at x = 1e-18
    x = torch.tensor([1e-18, -1e-18, 1e-8, 2.0], dtype=torch.float64)
    expected = torch.tensor([5e-19, -5e-19, float(1 - exact("cosw", 1e-8, 0)), float(1 - exact("cosw", 2.0, 0))])
    torch.testing.assert_close(versw(x), expected.double(), rtol=1e-7, atol=0)
    torch.testing.assert_close(versw(x[:3]), 0.5 * x[:3] * (1 - x[:3] / 12), rtol=1e-15, atol=0)


def test_float32_stays_float32():
    # fails if a constant promotes float32 to float64
    x = torch.tensor([-2.0, 0.0, 2.0])
    assert cosw(x).dtype == sincw(x).dtype == versw(x).dtype == torch.float32
