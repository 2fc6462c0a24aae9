"""The derivative of a step: by the implicit-function theorem, against automatic differentiation through the step."""

import math
from typing import Any

import pytest
import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.stepping.linearise import eliminate
from tests.lagrangians import randomise

ONES = (1.0, 1.1)
CASES: dict[str, dict[str, Any]] = {
    "conservative": {"level": "conservative"},
    "linear": {"level": "linear"},
    "linear, correction": {"level": "linear", "correction_width": 4},
    "affine": {"level": "affine", "correction_width": 3},
    "full": {"level": "full", "action_width": 2},
    "viscous, inputs": {"level": "forced", "inputs": 2},
    "dry, inputs": {"level": "forced", "coulomb": True, "inputs": 1, "correction_width": 3},
    "coupled": {"level": "forced", "coupled": True},
    "mass": {"level": "linear", "mass_width": 3},
    "features": {"level": "linear", "features": ("cos(q1 - q1)*v1*v2", "q2^3")},
    "order 4": {"level": "linear", "order": 4, "potential_width": 0, "features": ("q2^4", "cos(q1)*v1*v2")},
    "order 4, forced": {
        "level": "forced", "order": 4, "potential_width": 0, "inputs": 1, "coupled": True, "features": ("q2^4",),
    },
}  # fmt: skip


def problem(case):
    """A model of an angle and a length whose every parameter is random, three states, h and inputs."""
    options = {"potential_width": 3, "damping_width": 3, **CASES[case]}
    config = ModelConfig((True, False), scale=ONES, speed=ONES, stiffness=ONES, tilt=(0.0, 0.0), **options)
    model: Any = ContactLagrangian(config)
    make = randomise(model, 0.05, seed=3)
    with torch.no_grad():
        if model.friction is not None:
            model.friction.viscous.abs_()
        if model.action is not None:
            model.action.rate.mul_(4)
    x = torch.randn(3, 5, generator=make, dtype=torch.float64) / 2
    u = torch.randn(3, model.inputs, generator=make, dtype=torch.float64) if model.inputs else None
    return model, State(x[:, :2], x[:, 2:4], x[:, 4]), torch.tensor([0.1, 0.2, 0.15], dtype=torch.float64), u


def through_the_step(stepper, state, h, u):
    """The same derivatives by autograd through a whole step, column by column."""
    inputs = [*state, h, *(() if u is None else (u,))]

    def flow(q, p, s, h, *u):
        new = stepper.step(State(q, p, s), h, u=u[0] if u else None).state
        # Samples are independent.
        return torch.cat([new.q, new.p, new.s[..., None]], -1).sum(0)

    blocks = torch.autograd.functional.jacobian(flow, tuple(inputs))
    wide = [b if b.ndim == 3 else b[..., None] for b in blocks]  # (2n+1, B, size)
    return torch.cat(wide, -1).movedim(1, 0)


@pytest.mark.parametrize("case", CASES)
def test_the_derivative_of_a_step(case):
    # fails if F_w misses an argument, s1 its own s0, or q1 its own q0
    model, state, h, u = problem(case)
    stepper = Stepper(model, tol=4e-16)
    ours = stepper.linearise(state, h, u)
    blocks = [ours.by_state, ours.by_h[..., None], *(() if ours.by_input is None else (ours.by_input,))]
    wanted = through_the_step(stepper, state, h, u)
    assert (ours.by_input is None) == (u is None)
    assert (torch.cat(blocks, -1) - wanted).abs().max() <= 1e-10 * wanted.abs().max()


def test_one_state_without_a_batch():
    # fails if a size is read off the second axis, which a single state does not have
    model, state, h, u = problem("viscous, inputs")
    assert u is not None
    every, one = (
        Stepper(model).linearise(state, h, u),
        Stepper(model).linearise(State(*(x[0] for x in state)), h[0], u[0]),
    )
    assert one.by_input is not None
    assert every.by_input is not None
    torch.testing.assert_close(one.by_input, every.by_input[0])
    torch.testing.assert_close(one.by_state, every.by_state[0])


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_elimination_is_a_solution(n):
    # fails if a row is not exchanged, reduced or taken back; the first pivot is 0 in every matrix of n > 1. Over 1000
    # draws of such matrices the error was below 1e-10.
    make = torch.Generator().manual_seed(n)
    A, b = (torch.randn(20, n, k, generator=make, dtype=torch.float64) for k in (n, 3))
    A[:, 0, 0] *= n == 1
    torch.testing.assert_close(A @ eliminate(A, b), b, rtol=0, atol=1e-9)


def test_any_discrete_lagrangian_has_a_derivative():
    # fails if only models can be linearised
    def L_d(q0, q1, s0, h):
        v, m = (q1 - q0) / h[..., None], (q0 + q1) / 2
        return h * ((v * v).sum(-1) / 2 + m.cos().sum(-1) - 0.1 * s0)

    state = State(*(torch.tensor(x, dtype=torch.float64) for x in ([0.3, 0.1], [0.2, -0.4], 0.5)))
    stepper, h = Stepper(L_d), torch.tensor(0.1, dtype=torch.float64)
    ours = stepper.linearise(state, h)
    batch = State(*(x[None] for x in state))
    wanted = through_the_step(stepper, batch, h[None], None)[0]
    assert (ours.by_state - wanted[:, :-1]).abs().max() <= 1e-10
    assert (ours.by_h - wanted[:, -1]).abs().max() <= 1e-10


def test_the_derivative_of_a_failed_step_is_not_a_number():
    # fails if a step without a solution has a finite derivative
    model, state, h, u = problem("affine")
    bad = State(state.q, state.p * math.inf, state.s)
    ours = Stepper(model).linearise(bad, h, u)
    assert bool(torch.isnan(ours.by_state).any(-1).any(-1).all())
