"""How tests of several rooms write numbers and compare them."""

from typing import Any

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


def dense(A: Any) -> torch.Tensor:
    """JᵀJ as a tensor, from a tensor or from an `Arrowhead`."""
    if isinstance(A, torch.Tensor):
        return A
    P, (S, d) = len(A.corner), A.border.shape[:2]
    full = A.corner.new_zeros(P + S * d, P + S * d)
    full[:P, :P] = A.corner
    full[P:, :P] = A.border.flatten(0, 1)
    full[:P, P:] = full[P:, :P].T
    T, k = full[P:, P:].unflatten(0, (S, d)).unflatten(2, (S, d)), torch.arange(S)  # (S, d, S, d)
    T[k, :, k] = A.blocks
    T[k[:-1], :, k[1:]] = A.upper[:-1]
    T[k[1:], :, k[:-1]] = A.upper[:-1].mT
    return full
