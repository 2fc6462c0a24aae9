"""The paper's diagram of Φ on Q × Q × R and Φ̃ on T*Q × R, joined by FL⁻ and FL⁺, arrow by arrow."""

from typing import Any

import pytest
import torch

from herglotz.mechanics import legendre_minus, legendre_plus
from herglotz.scenes import scene
from herglotz.stepping import State, Status, Stepper
from tests.lagrangians import nonlinear, states

CASES: dict[str, Any] = {"nonlinear": (nonlinear, 2, 0.2, 0.0)}
for name, h, shift in (("damped_oscillator", 0.2, 0.0), ("damped_pendulum", 0.3, 0.0), ("parachute", 0.1, 100.0)):
    system = scene(name)
    CASES[f"{name}: principal"] = (system.L_d, 1, h, shift)
    CASES |= {f"{name}: {rule}": (L_d, 1, h, shift) for rule, L_d in system.L_d_rules.items()}


def pairs(name):
    """(q_k, q_{k+1}, s_k) that belong to no trajectory in particular, and the next position by Φ."""
    L_d, n, h, shift = CASES[name]
    q, p, s = states(n, 10, seed=1)
    q0 = q + shift
    # the default tolerance, 64 eps of q ≈ 100 m, over h is 1.8e-12 of the parachute's momentum
    return Stepper(L_d, tol=4 * torch.finfo(q0.dtype).eps), (q0, q0 + h * p, s), h


def gap(one, two):
    """Largest difference of two points (a, b, s), each part over its own size."""
    parts = zip(one, two, strict=True)
    return max(float((a - b).detach().abs().max() / b.detach().abs().max()) for a, b in parts)


@pytest.mark.parametrize("name", CASES)
def test_every_arrow_commutes(name):
    # fails if FL⁻ or FL⁺ has a wrong factor c, Φ carries s at the wrong index (E3), or Φ and Φ̃ are different maps
    stepper, pair, h = pairs(name)
    image = stepper.step_pair(*pair, h)
    plus, minus = legendre_plus(stepper.L_d, *pair, h), legendre_minus(stepper.L_d, *pair, h)
    plus_after, minus_after = legendre_plus(stepper.L_d, *image, h), legendre_minus(stepper.L_d, *image, h)
    assert gap(minus_after, plus) < 1e-12  # FL⁻∘Φ = FL⁺: momenta match
    along_plus, along_minus = (stepper.step(State(*x), h) for x in (plus, minus))
    assert along_plus.status.eq(Status.CONVERGED).all()
    assert gap(plus_after, along_plus.state) < 1e-12  # FL⁺∘Φ = Φ̃∘FL⁺
    assert gap(minus_after, along_minus.state) < 1e-12  # FL⁻∘Φ = Φ̃∘FL⁻
    assert gap(plus, along_minus.state) < 1e-12  # Φ̃∘FL⁻ = FL⁺, the definition of Φ̃


def test_a_transform_without_c_does_not_commute():
    # null model: FL⁻ of a symplectic integrator, p0 = −D1. Fails if the diagram accepts it
    stepper, pair, h = pairs("nonlinear")
    q0, p0, s0 = legendre_minus(stepper.L_d, *pair, h)
    c = stepper.step(State(q0, p0, s0), h).c
    wrong = stepper.step(State(q0, p0 * c[:, None], s0), h).state
    assert gap(legendre_plus(stepper.L_d, *pair, h), wrong) > 1e-3
