"""A function that returns no number a sample, and positions without an axis, are refused at every door."""

from typing import Any, cast

import numpy as np
import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import partials
from herglotz.mechanics.partials import functional_partials, value
from herglotz.stepping import State, Stepper
from herglotz.theory import (
    PointSource,
    Quadratic,
    boundary_value,
    contact_vector_field,
    curve_action,
    germ,
    hopf_lax,
    invariance_defect,
)
from herglotz.verify import verify
from tests.compared import f64


def forgetful(q0, q1, s0, h):
    """A Lagrangian without .sum(-1): with one coordinate everything broadcasts."""
    return (q1 - q0) ** 2 / (2 * h) - h / 2 * q0**2 - 0.02 * s0[..., None]


Q, P, S = f64(1.0)[None], f64(0.5)[None], f64(0.3)
DOORS = {
    "Stepper.step": lambda: Stepper(forgetful).step(State(Q, P, S), 0.1),
    "Stepper.step, no batch": lambda: Stepper(forgetful).step(State(Q[0], P[0], S[0]), 0.1),
    "Stepper.init": lambda: Stepper(forgetful).init(Q, Q + 0.1, S, 0.1),
    "Stepper.rollout": lambda: Stepper(forgetful).rollout(Q, P, S, h=0.1, steps=2),
    "partials": lambda: partials(forgetful, Q, Q + 0.1, S, 0.1, 2),
    "verify": lambda: verify((forgetful, (Q, P, S)), h=0.1),
    "boundary_value": lambda: boundary_value(forgetful, Q, Q + 0.1, S, h=0.1, steps=3),
    "hopf_lax": lambda: hopf_lax(forgetful, Quadratic(f64(1.0)[None], f64(0.0), f64(0.0)[0]), Q, h=0.1),
    "PointSource": lambda: PointSource(forgetful, Q, S, 0.1)(Q + 0.1),
    "curve_action": lambda: curve_action(forgetful, torch.stack([Q, Q + 0.1], 1), S, 0.1),
    "invariance_defect": lambda: invariance_defect(forgetful, lambda e, q: q + e[..., None], 0.1, Q, Q + 0.1, S, 0.1),
}


@pytest.mark.parametrize("door", DOORS)
def test_a_forgotten_sum_is_refused(door):
    # fails if a shape that broadcasts steps to a number that is wrong, with CONVERGED
    with pytest.raises(InputError, match=r"forgetful returned shape \(1,.*where \(.*sum over coordinates with .sum"):
        DOORS[door]()


def test_a_stepper_in_place_of_its_L_d_is_refused():
    # fails if a Stepper of a Stepper ends in "'Stepper' object is not callable"
    def free(q0, q1, s0, h):
        return (q1 - q0).square().sum(-1) / (2 * h) - 0.02 * h * s0

    with pytest.raises(InputError, match="got a Stepper; of a Stepper, give its L_d"):
        Stepper(Stepper(free)).step(State(Q, P, S), 0.1)  # pyright: ignore[reportArgumentType]


def test_a_step_that_is_not_broadcast_is_refused():
    # fails if (q1 − q0) / h with a step a sample pairs every sample with every h, and steps on with CONVERGED
    def hasty(q0, q1, s0, h):
        v = (q1 - q0) / h
        return h * (0.5 * (v * v).sum(-1) - 0.02 * s0)

    q, h = torch.linspace(0, 1, 8).double()[:, None], torch.full((8,), 0.1).double()
    message = r"hasty mixes samples: .* write h\[\.\.\., None\]"
    with pytest.raises(InputError, match=message):
        Stepper(hasty).step(State(q, q + 0.3, q[:, 0]), h)
    with pytest.raises(InputError, match=message):
        value(hasty, q, q + 0.1, q[:, 0], h)
    assert int(Stepper(hasty).step(State(q, q + 0.3, q[:, 0]), 0.1).status.max()) == 0


def test_a_number_instead_of_a_tensor_is_refused():
    # fails if a Python number, which has no graph, ends in a traceback from torch
    with pytest.raises(InputError, match="the function returned a float"):
        partials(lambda q0, q1, s0, h: 1.0, Q, Q, S, 0.1)  # noqa: ARG005  # pyright: ignore


def test_functions_of_the_theory_are_held_to_the_same():
    # fails if only Lagrangians are looked at: S on Q and H on T*Q x R come from users, too
    with pytest.raises(InputError, match=r"returned shape \(1, 1\)"):
        germ(lambda q: q**2, Q)
    with pytest.raises(InputError, match=r"returned shape \(1, 1\)"):
        contact_vector_field(lambda q, p, s: p**2 + q**2 + s[..., None], Q, P, S)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (
            (f64(1.0)[0], f64(0.5)[0], f64(0.3)[0]),
            r"q needs shape \(..., n\), got \(\); one coordinate is q = torch",
        ),
        ((1.0, 0.5, 0.3), "q must be a tensor, got a float; one coordinate is q = torch"),
        ((f64(1.0), [0.5], f64(0.3)[0]), "p must be a tensor, got a list"),
    ],
)
def test_scalars_have_a_remedy(state, message):
    # fails if a scalar ends in an index error, or is stepped as if its batch were its coordinates
    oscillator = lambda q0, q1, s0, h: ((q1 - q0) ** 2).sum(-1) / (2 * h) - 0.02 * s0  # noqa: E731
    for call in (
        lambda: Stepper(oscillator).step(State(*state), 0.1),
        lambda: Stepper(oscillator).rollout(*state, h=0.1, steps=2),
    ):
        with pytest.raises(InputError, match=message):
            call()
    with pytest.raises(
        InputError,
        match=message.replace("q needs", "q0 needs").replace("q must", "q0 must").replace("p must", "q1 must"),
    ):
        partials(oscillator, *state, 0.1)  # pyright: ignore


@pytest.mark.parametrize(
    ("h", "steps", "message"),
    [
        (None, 2, "h must be a number or a tensor, in the unit of time, got None"),
        ("0.1", 2, "h must be a number or a tensor, in the unit of time, got '0.1'"),
        (0.1, 2.5, r"steps must be a whole number >= 1, got 2\.5"),
        (f64(0.1, 0.2, 0.3)[:, None], 1, r"h of shape \(3,\) does not spread over states of shape \(2,\)"),
    ],
)
def test_steps_of_another_kind_have_a_remedy(h, steps, message):
    # fails if a wrong step ends in an error of torch that names no argument
    stepper, q = Stepper(lambda q0, q1, s0, h: ((q1 - q0) ** 2).sum(-1) / (2 * h) - 0.02 * s0), f64(0.1, 0.2)[:, None]
    with pytest.raises(InputError, match=message):
        stepper.rollout(q, q, h=h, steps=steps)
    if steps == 1:
        with pytest.raises(InputError, match=message):
            stepper.step(State(q, q, q[:, 0]), h[:, 0])
    assert stepper.rollout(q, q, h=0.1, steps=cast(Any, np.int64(2))).ok.all()


@pytest.mark.parametrize(("L_d", "message"), [(object, "got the class object; make one"), ("run", "got a str")])
def test_a_stepper_is_of_a_function(L_d, message):
    # fails if a class or a name is taken for an L_d, and the first step ends in an error of Python
    with pytest.raises(InputError, match=message):
        Stepper(L_d)


def test_a_step_a_sample_with_one_position_for_all():
    # fails if h has more samples than q and the derivatives of all of them are added up
    h = f64(0.1, 0.2, 0.4)
    L_d = lambda q0, q1, s0, h: ((q1 - q0) ** 2).sum(-1) / (2 * h) - 0.1 * h * s0  # noqa: E731
    many, one = partials(L_d, f64(0.3), f64(0.7), f64(0.2)[0], h), partials(L_d, f64(0.3), f64(0.7), f64(0.2)[0], h[1])
    assert many.D1.shape == (3, 1)
    torch.testing.assert_close((many.D1[1], many.D3[1]), (one.D1, one.D3))


class Short(torch.nn.Module):
    def forward(self, q0, q1, h):
        return (q1 - q0).square().sum(-1) / (2 * h)


def short(q0, q1, h):
    return (q1 - q0).square().sum(-1) / (2 * h)


@pytest.mark.parametrize(("L_d", "name"), [(short, "short"), (Short(), "Short")])
def test_an_L_d_of_three_arguments_is_told_what_to_take(L_d, name):
    # fails if Python's own error, which has no remedy, is what a user of L_d(q0, q1, h) sees at one of the doors
    for call in (
        lambda: Stepper(L_d).step(State(Q, P, S), 0.1),
        lambda: Stepper(L_d).velocity(State(Q, P, S), 0.1),
        lambda: value(L_d, Q, Q, S, 0.1),
        lambda: functional_partials(L_d, Q, Q, S, S),
    ):
        with pytest.raises(InputError, match=rf"{name} must take four arguments, L_d\(q0, q1, s0, h\): .* 0 \* s0"):
            call()


def test_a_mistake_inside_an_L_d_is_its_own():
    # fails if a function inside that is called wrongly is said to be a wrong number of arguments of L_d
    def wrong(q0, q1, s0, h):
        return short(q0, q1, s0, h)  # pyright: ignore[reportCallIssue]

    with pytest.raises(TypeError, match="takes 3 positional arguments"):
        Stepper(wrong).step(State(Q, P, S), 0.1)
