"""The models that the tests of exported files share, and the eager stepper beside them."""

from typing import Any

import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from tests.lagrangians import random_model, randomise, states

SIZES = (("q", 2, 1.0), ("p", 2, 1.0), ("s", 1, 0.5))
BOX = {name + end: [sign * x] * n for name, n, x in SIZES for end, sign in (("_low", -1), ("_high", 1))}
SMALL = {key: [0.5 * x for x in values[:1]] for key, values in BOX.items()}


def model_of(n, level, correction=0, dtype=torch.float64):
    """A model whose every parameter is random."""
    ones = (1.0,) * n
    angles = tuple(i % 2 == 0 for i in range(n))
    config = ModelConfig(
        angles, level, ones, ones, ones, (0.0,) * n, potential_width=4, damping_width=4, correction_width=correction
    )
    return random_model(config, dtype, spread=0.2, seed=n)


def damped(level, dtype, inputs=0):
    """One coordinate, and motions that die out at rate 0.3 (at all levels but the conservative one)."""
    one = (1.0,)
    config = ModelConfig(
        (True,), level, one, one, one, (0.0,), rate=0.3, potential_width=4, damping_width=4, inputs=inputs,
        input_zero=inputs > 0,
    )  # fmt: skip
    return random_model(config, dtype, spread=0.05, seed=1)


def beside(model):
    """The eager stepper with Newton to rounding: at its own tolerance (64 eps of q) it is itself 1e-12 off."""
    double = next(model.parameters()).dtype == torch.float64
    return Stepper(model, tol=1e-15 if double else None)


def states_of(n, batch, dtype=torch.float64, seed=0):
    return states(n, batch, seed, dtype)


TERMS: dict[str, tuple[int, dict[str, Any]]] = {
    "order 4": (1, {"order": 4}),
    "m(q), coupled": (2, {"mass_width": 3, "level": "forced", "coupled": True}),
    "drag": (
        3,
        {"level": "forced", "drag": ("|v1| v1", "q2^2 v2", "(v1 - v2)^3", "|v| v", "load 1", "cos(1.5 q1) v1")},
    ),
    "sticking": (1, {"level": "forced", "coulomb": True, "sticking": True, "inputs": 1}),
}


def with_terms(case) -> Any:
    n, settings = TERMS[case]
    ones = (1.0,) * n
    config = {"potential_width": 0, "rate": 0.3, "level": "linear"} | settings
    angles = tuple(i == 0 and n < 3 for i in range(n))
    model = ContactLagrangian(
        ModelConfig(angles=angles, scale=ones, speed=ones, stiffness=ones, tilt=(0.0,) * n, **config)
    )
    with torch.no_grad():
        randomise(model, 0.05, seed=2)
        if model.drag is not None:  # so large that a missing force is seen
            model.drag.coefficient.abs_().add_(0.2)
        if model.friction is not None and model.friction.sticking:  # so strong that joints stop
            model.friction.coulomb.abs_().add_(0.2)
    return model


def near(n, batch):
    """Starts at which every case has a step; for powers of r, away from r = 0."""
    q, p, s = states_of(n, batch)
    return State(1.0 + 0.2 * q, 0.3 * p, s)
