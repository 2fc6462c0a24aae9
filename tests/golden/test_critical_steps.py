"""Largest stable steps of the rules (section 4 of docs/mathematics.md); test_explain.py has the loss of c and H±."""

import math

import pytest
import torch

from herglotz.mechanics import partials, step_derivative
from herglotz.scenes import scene


def multipliers(system, rule, h):
    """Eigenvalues of the step of (q, p) at rest, largest first; the motion is linear, so they decide its growth."""
    zero = torch.zeros(1, dtype=torch.float64)
    P = partials(system.L_d_rules[rule], zero, zero, zero[0], h, order=2)
    return torch.linalg.eigvals(step_derivative(P, zero)[:2, :2]).abs().sort(descending=True)[0]


LARGEST = {
    "left": lambda gamma, omega: (-gamma + math.sqrt(gamma**2 + 4 * omega**2)) / omega**2,
    "trapezoid": lambda gamma, omega: 2 / omega,  # noqa: ARG005
    "strang": lambda gamma, omega: 2 / omega,  # noqa: ARG005
}


@pytest.mark.parametrize(("gamma", "omega"), [(0.2, 1.0), (0.5, 1.7)])
@pytest.mark.parametrize("rule", LARGEST)
def test_largest_stable_step(rule, gamma, omega):
    # fails if a rule takes its potential or its damping at another place: a multiplier reaches −1 at exactly this h
    system, h = scene("damped_oscillator", gamma=gamma, omega0=omega), LARGEST[rule](gamma, omega)
    assert abs(multipliers(system, rule, h)[0].item() - 1) < 1e-12
    assert multipliers(system, rule, h * (1 - 1e-3))[0] < 1
    assert multipliers(system, rule, h * (1 + 1e-3))[0] > 1


def test_implicit_midpoint_is_stable_at_any_step():
    # fails if its s is taken at an end: then it has a largest step as well
    system = scene("damped_oscillator")
    for h in (0.5, 2.0, 9.0, 40.0):
        assert multipliers(system, "midpoint", h)[0] < 1
