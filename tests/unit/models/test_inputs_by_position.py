"""Inputs that act through the position: the law, its order, and what names such a force."""

from typing import Any

import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.drag import input_forces, parse_drag
from herglotz.stepping import Stepper
from runge_kutta import step as runge_kutta

U = 1.7  # of every input, over the whole motion


def body(angles, drag, coefficients, dissipation=(), zero=0.0) -> Any:
    """A model with rubbing joints, whose inputs act by these forces alone."""
    n = len(angles)
    model: Any = ContactLagrangian(
        ModelConfig(
            angles=angles, level="forced", scale=(1.0,) * n, speed=(1.0,) * n, stiffness=(2.0,) * n, tilt=(0.1,) * n,
            rate=0.3, inputs=1, input_zero=True, drag=drag, potential_width=0, dissipation=dissipation,
        )
    )  # fmt: skip
    with torch.no_grad():
        model.drag.coefficient.copy_(torch.tensor(coefficients))
        model.friction.viscous.fill_(0.2)
        model.friction.input_zero.fill_(zero)
    return model


def end(model, steps, u, time=2.0):
    """(q, p) of a free run from one start."""
    start = torch.linspace(0.9, 0.5, model.dof).double()
    inputs = torch.full((steps, 1), u, dtype=torch.float64)
    with torch.no_grad():
        out = Stepper(model).rollout(start, 0.4 * start, h=time / steps, inputs=inputs)
    return torch.cat([out.final.q, out.final.p])


LAWS = {
    "an accelerated pivot": ((True,), ("u1 cos(q1)",), [-0.8], lambda q, _, u: -0.8 * u * q.cos()),
    "a brake by eddy currents": ((False,), ("u1^2 v1",), [0.1], lambda _, v, u: -0.1 * u**2 * v),
    "a shaken pivot": ((True,), ("u1 sin(q1)",), [-0.8], lambda q, _, u: -0.8 * u * q.sin()),
    "a spring of an input": ((False,), ("u1 q1^2",), [0.3], lambda q, _, u: 0.3 * u * q**2),
    "a thruster": (
        (False, True), ("u1 sin(q2) on q1", "u1 cos(q2)"), [0.7, 0.2],
        lambda q, _, u: torch.stack([0.7 * u * q[1].sin(), 0.2 * u * q[1].cos()]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
def test_the_motion_is_that_of_the_law_to_order_two(law):
    # fails if a sign, the coordinate or the input is another one, or F⁻ is not c (h/2) f at the midpoint
    angles, drag, coefficients, force = LAWS[law]
    n, spring = len(angles), torch.tensor(angles)

    def rate(x):
        q, v = x[:n], x[n:]
        own = torch.where(spring, 2 * q.sin() + 0.1 * q.cos(), 2 * q + 0.1)
        return torch.cat([v, force(q, v, U) - own - 0.5 * v])  # p = v: the masses are 1

    x = torch.linspace(0.9, 0.5, n).double()
    x = torch.cat([x, 0.4 * x])
    for _ in range(400):
        x = runge_kutta(rate, x, 2.0 / 400)
    model = body(angles, drag, coefficients)
    coarse, fine = (end(model, steps, U) - x for steps in (40, 80))
    assert float(fine.abs().max()) < 1e-3
    assert float(coarse.norm() / fine.norm()) == pytest.approx(4, abs=0.3)


def test_where_s_has_powers_the_force_is_the_same():
    # fails if the force is lost where the work of other inputs is part of L, or has the weight c in place of 1 + D3
    model = body((True,), ("u1 cos(q1)",), [-0.8], dissipation=("s^2",))
    with torch.no_grad():
        model.action.coefficient.fill_(0.2)
    x = [end(model, steps, U) for steps in (24, 48, 96)]
    exact = x[2] + (x[2] - x[1]) / 3
    assert float((x[0] - exact).norm() / (x[1] - exact).norm()) == pytest.approx(4, abs=0.3)
    assert float((x[2] - end(model, 96, 0.0)).norm()) > 0.1


def test_the_zero_of_a_sensor_is_that_of_the_inputs_map_alone():
    # fails if a zero stands for the weight of a pendulum on a shaken pivot: no weight would act where nothing is driven
    q = torch.tensor([0.3], dtype=torch.float64)
    ends = [end(body((True,), ("u1 sin(q1)",), [-0.8], zero=zero), 20, U) for zero in (0.0, 0.4)]
    assert torch.equal(*ends)
    alone, still = (body((True,), ("u1 sin(q1)",), [x], zero=0.4) for x in (-0.8, 0.0))
    assert torch.equal(*(Stepper(x).rollout(q, q, h=0.1, steps=5).final.q for x in (alone, still)))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"drag": ("u2 cos(q1)",), "inputs": 1}, "the model has 1 input, counted from u1"),
        ({"drag": ("u1 cos(q1)",)}, "the model has 0 inputs"),
        ({"drag": ("u0 cos(q1)",), "inputs": 1}, "inputs are numbered from 1"),
        ({"drag": ("u1 cos(q1) on q2",), "inputs": 1}, "the coordinates are numbered 1 … 1"),
        ({"drag": ("u1 q1",), "inputs": 1}, "a power of an angle is not periodic"),
        ({"drag": ("u1 v1 q1",), "inputs": 1}, "'u1 cos"),
        ({"drag": ("u1^0 v1",), "inputs": 1}, "powers are whole numbers from 1"),
    ],
)
def test_a_force_that_there_is_not_is_refused(settings, said):
    # fails if a model is made whose force reads another column, or none
    with pytest.raises(InputError, match=said):
        ModelConfig(level="forced", **settings)


def test_the_names_of_forces_are_no_names_of_columns():
    # fails if the square or the rate of an input whose name begins with u is taken for a force of the position
    assert input_forces(("u1^2", "|u|", "u'", "sat(u1/2)", "u1 cos(q1)", "u2 sin(q3) on q1", "load 1")) == (
        "u1 cos(q1)", "u2 sin(q3) on q1",
    )  # fmt: skip
    found = parse_drag("u2 sin(q3) on q1", (False, False, True))
    assert (found.input, found.on, found.at, found.wave) == (1, 0, 2, "sin")
