"""How tests of several rooms write numbers and compare them."""

import pytest
import torch


def f64(*x):
    """Numbers as a tensor."""
    return torch.tensor(x, dtype=torch.float64)


def relative(value, expected):
    """Largest difference over the largest expected number."""
    value, expected = value.detach().double(), expected.detach().double()
    return float((value - expected).abs().max() / expected.abs().max())


def failed(report):
    """Names of the checks that a report of `verify` failed."""
    return {check.name for check in report.checks if not check.passed}


def assert_gradient(problem, x, rel, make):
    """Hold cost and gradient of the normal equations to the cost, and to differences along three directions drawn."""
    cost, _, b = problem.normal_equations(x)
    assert float(cost) == pytest.approx(float(problem.cost(x)), rel=1e-12)
    for _ in range(3):
        d = torch.randn(len(x), generator=make, dtype=x.dtype)
        slope = (float(problem.cost(x + 1e-6 * d)) - float(problem.cost(x - 1e-6 * d))) / 2e-6
        assert float(b @ d) == pytest.approx(slope, rel=rel, abs=1e-6 * float(cost))
