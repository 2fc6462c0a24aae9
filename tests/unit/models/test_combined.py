"""One number that moves several: the models of all payloads lie on the line between those of two."""

import math

import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.numbers import chosen, combined, values_of, with_values
from herglotz.stepping import State, Stepper

G, LENGTH, FIRST = 9.81, 0.3, 1.0
NAMES = ["kinetic.base.log_diagonal", "kinetic.sum.coefficient", "potential.stiffness", "friction.viscous",
         "friction.input_map"]  # fmt: skip


def numbers(load):
    """Two links of point masses, of which the second carries a load, with the first entry of the mass as unit."""
    whole, tip = (FIRST + load) * LENGTH**2, load * LENGTH**2
    k1, k2 = ((FIRST + load) * G * LENGTH / whole, load * G * LENGTH / whole)
    return dict(zip(chosen(arm(), NAMES), (
        0.5 * math.log(tip / whole), tip / whole, k1, k2, 0.02 / whole, 0.01 / whole, 1 / whole, -1 / whole, 0.0,
        1 / whole,
    ), strict=True))  # fmt: skip


def arm():
    ones = (1.0, 1.0)
    config = ModelConfig((True, True), "forced", ones, (3.0, 3.0), (9.0, 9.0), (0.0, 0.0), rate=0.0, potential_width=0,
                         features=("cos(q1 - q2) v1 v2",), inputs=2, diagonal=True)  # fmt: skip
    return ContactLagrangian(config).requires_grad_(False).double()


def test_the_models_of_all_loads_lie_on_one_line():
    # fails if a mass goes along another curve than e^{2x}, or a number is left out or moved twice
    empty, full, half = (numbers(load) for load in (0.4, 1.2, 0.7))
    model = combined(with_values(arm(), empty), "payload", full)
    assert values_of(model, ["payload"]) == [0.0]
    key = "kinetic.sum.coefficient"
    amount = (half[key] - empty[key]) / (full[key] - empty[key])
    for value, wanted in ((amount, half), (1.0, full), (0.0, empty)):
        found = values_of(with_values(model, {"payload": value}), list(wanted))
        assert found == pytest.approx(list(wanted.values()), rel=1e-13, abs=1e-13)
    again = with_values(with_values(model, {"payload": 0.3}), {"payload": amount, "friction.viscous[0]": 7.0})
    found = values_of(again, [*half, "payload"])  # from its own 0, wherever it stands; what is named stands as given
    assert found == pytest.approx([*(half | {"friction.viscous[0]": 7.0}).values(), amount], rel=1e-13, abs=1e-13)


def test_derivatives_by_it_are_differences():
    # fails if the derivative is that at another value, or of another number beside it
    model = with_values(combined(with_values(arm(), numbers(0.4)), "payload", numbers(1.2)), {"payload": 0.3})
    names = ["payload", "friction.viscous[1]"]
    q, p, u = torch.tensor([[0.5, -0.3], [2.0, 1.0], [0.4, -0.2]], dtype=torch.float64)
    state = State(q, p, q.new_zeros(()))
    found = Stepper(model, tol=4e-16).linearise(state, 0.1, u, names).by_parameters
    assert found is not None
    values = dict(zip(names, values_of(model, names), strict=True))
    for k, name in enumerate(names):
        ends = []
        for side in (-1, 1):
            moved = with_values(model, values | {name: values[name] + side * 1e-5})
            step = Stepper(moved, tol=4e-16).step(state, 0.1, u=u).state
            ends.append(torch.cat([step.q, step.p, step.s[None]]).detach())
        torch.testing.assert_close(found[:, k], (ends[1] - ends[0]) / 2e-5, rtol=1e-6, atol=1e-9)


def test_numbers_that_cannot_be_moved_are_refused():
    # fails if a name hides another number, two names move one number, or nothing is moved at all
    model = combined(arm(), "payload", {"friction.viscous[0]": 0.5})
    for name, values, said in (
        ("payload", {"friction.viscous[1]": 0.5}, "must be a word"),
        ("friction", {"friction.viscous[1]": 0.5}, "must be a word"),
        ("2nd", {"friction.viscous[1]": 0.5}, "must be a word"),
        ("tool", {"friction.viscous[0]": 0.7}, r"friction.viscous\[0\] cannot be moved"),
        ("tool", {"friction.viscous[0]": 0.0}, "nothing differs"),
        ("tool", {"friction.mass": 0.7}, "no number 'friction.mass'"),
        ("tool", {"potential.tilt[0]": math.nan}, "finite"),
    ):
        with pytest.raises(InputError, match=said):
            combined(model, name, values)
    config = ModelConfig((True,), "conservative", (1.0,), (1.0,), (1.0,), (0.0,), potential_width=2)
    with pytest.raises(InputError, match="no weights of a network"):
        combined(ContactLagrangian(config), "load", {"potential.network.weights.0[0]": 0.3})
