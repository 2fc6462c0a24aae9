"""Features: their text, their coefficients, and the rule of order 4 that is made of them."""

import math
from typing import Any

import pytest
import torch
from hypothesis import given, strategies as st

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.features import HIGHEST_POWER, LIBRARIES, expand, parse
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training.problems.one_step import MANY, ResidualProblem

ANGLES, LENGTHS = (True, True), (False, False)
# Settings of a length and an angle.
OF_TWO: dict[str, Any] = {"angles": (False, True), **dict.fromkeys(("scale", "speed", "stiffness", "tilt"), (1.0, 1.0))}


def built(angles, **settings) -> Any:
    """A model without networks and without springs of its own."""
    one, zero = (1.0,) * len(angles), (0.0,) * len(angles)
    sizes: dict[str, Any] = {"scale": one, "speed": one, "stiffness": zero, "tilt": zero, "potential_width": 0}
    return ContactLagrangian(ModelConfig(angles=angles, **sizes | settings))


def double_pendulum(level="linear", order=4, gamma=0.4, viscous=0.0) -> Any:
    """The scene's L in units of its first mass, 2: nothing is learned."""
    known = ("0.5 cos(q1 - q2) v1 v2", "-9.81 cos(q1) - 4.905 cos(q2)")
    model = built(ANGLES, level=level, order=order, rate=gamma, known=known)
    with torch.no_grad():
        model.kinetic.base.log_diagonal.fill_(math.log(0.5) / 2)
        if level == "forced":
            model.friction.viscous.fill_(viscous)
    return model


def end(model, steps, unit):
    """(q, p) at t = 0.5 from one state, with steps 1 : 2 : 2 : 1; s depends on the zero of V."""
    q, p = torch.tensor([[1.1, -0.7]]).double(), torch.tensor([[0.9, -0.4]]).double()
    h = torch.tensor([1.0, 2.0, 2.0, 1.0], dtype=torch.float64).repeat(steps // 4)
    with torch.no_grad():
        out = Stepper(model).rollout(q, p / unit, torch.zeros(1).double(), h=0.5 * h / h.sum())
    assert bool(out.ok.all())
    return torch.cat([out.final.q[0], out.final.p[0] * unit])


def exact_end(of_scene):
    q, p = torch.tensor([[1.1, -0.7]]).double(), torch.tensor([[0.9, -0.4]]).double()
    return torch.cat([x.flatten() for x in of_scene.flow(q, p, torch.zeros(1).double(), 0.5)[:2]])


def measured_order(model, exact, unit, steps=8):
    coarse, fine = (float((end(model, k, unit) - exact).abs().max()) for k in (steps, 2 * steps))
    return math.log2(coarse / fine)


def test_a_rule_of_order_four_with_damping_and_a_mass_of_position():
    # fails if a term of e, the mass along y, a weight of γ or Simpson's weight is wrong or missing
    exact = exact_end(scene("double_pendulum", gamma=0.4))
    assert measured_order(double_pendulum(), exact, 2.0) == pytest.approx(4.0, abs=0.3)
    errors = [float((end(double_pendulum(order=order), 8, 2.0) - exact).abs().max()) for order in (2, 4)]
    assert errors[1] < 0.05 * errors[0]


def test_a_rule_of_order_four_in_r():
    # fails if the derivatives of a power of r along y are wrong
    model = built(LENGTHS, order=4, known=("-1 r^-1",), alike=True, rate=0.2)
    assert measured_order(model, exact_end(scene("kepler", gamma=0.2)), 1.0) == pytest.approx(4.0, abs=0.3)


@pytest.mark.xfail(strict=True, reason="order 2, not 4: forces are taken at the velocity of the step")
def test_forces_are_of_order_four():
    # fails (and must be rewritten) when forces too are corrected
    fine = end(double_pendulum("forced", gamma=0.0, viscous=0.3), 64, 2.0)
    assert measured_order(double_pendulum("forced", gamma=0.0, viscous=0.3), fine, 2.0) > 3.5


def test_texts_are_read_as_written():
    # fails if a sign, a factor, a power or a coordinate's number is lost
    one, two, three = parse("-cos(q1 - 2*q2) v1 v2^2 + 1e-1 (2q1 + q2)^3*v1 - .5 q2 v1", LENGTHS)
    assert (one.factor, one.function, one.form, one.velocities) == (-1.0, "cos", (1.0, -2.0), (0, 1, 1))
    assert (two.factor, two.function, two.form, two.power, two.velocities) == (0.1, "power", (2.0, 1.0), 3, (0,))
    assert (three.factor, three.form, three.power) == (-0.5, (0.0, 1.0), 1)
    (radial,) = parse("2 r^-3", LENGTHS)
    assert (radial.factor, radial.function, radial.power) == (2.0, "radius", -3)
    assert parse("v1^2", ANGLES)[0].velocities == (0, 0)


@given(st.text(alphabet="qvr123.+-*^() cosine", max_size=30))
def test_any_text_is_a_feature_or_an_error(text):
    # fails if a text ends in a traceback, in a number that is not finite, or in more velocities than it can have
    try:
        feature = parse(text, LENGTHS)
    except InputError as error:
        assert text in str(error)  # noqa: PT017  either outcome is right
    else:
        assert all(math.isfinite(x) for p in feature for x in (p.factor, *p.form))
        assert all(len(p.velocities) <= HIGHEST_POWER * len(text) for p in feature)


def test_mistakes_in_texts_are_named():
    # fails if a typo is read as something else
    wrong = {
        "tan(q1)": r"cannot read 'tan\(q1\)'",
        "q1 q2": "has 2 functions of the position, and a product takes one",
        "q3^2": "there is no coordinate 3",
        "cos(q1 q2)": "cannot read the linear form 'q1 q2'",
        "3": "a constant moves nothing at the level 'linear'",
        "q1 v1 + q2^2": "some products hold velocities and some do not",
        "r^2 v1": "powers of r join the potential",
        "chain two": "this library takes one whole number, as 'chain 2' does",
        "pendulums 2": "this library takes no number; write 'pendulums'",
    }
    wrong |= {
        "-9.81 q1^1.5": r"a power must be a whole number, got '1.5'",
        "q1^": "a power must be a whole number, got 'nothing'",
        "q1^-2": r"got '-2' \(only r takes negative ones\)",
        "1.1.1 q1": "'1.1' and '.1' stand side by side",
        "2 q1 3": "has two numbers in one product",
        "1e999 q1": "the number 1e999 is too large",
        "1e-400 q1": "the number 1e-400 is too small",
        "cos(1e308 q1 + 1e308 q1)": "the factors of q1 add up to a number that is too large",
        "v1^1000000000": "a power must be at most 16, got 1000000000",
        "q99999999999999999999": "there is no coordinate 99999999999999999999",
        "q1 *": r"cannot read 'q1 \*'",
        "q1 + + q2": r"cannot read '\+ q2'",
        "(q1 - q2": "cannot read the linear form 'q1 - q2'",
        "rad^2": r"cannot read 'rad\^2'",
    }
    for text, words in wrong.items():
        with pytest.raises(InputError, match=words):
            built(LENGTHS, features=(text,))
    with pytest.raises(InputError, match="a power of an angle is not periodic"):
        parse("(q1 + q2)^2", ANGLES)
    wrong_at_4 = {
        "order 4 is for features, without networks": {"potential_width": 8},
        "order 4 takes at most two velocities a product": {"features": ("v1^3",)},
        "order 4 with alike needs features of the position": {"alike": True},
    }
    for words, settings in wrong_at_4.items():
        with pytest.raises(InputError, match=words):
            built((True,), order=4, **settings)


def test_order_four_takes_no_lever_arms():
    # fails if the rule of order 4, whose terms lack their derivatives, is made of them
    with pytest.raises(InputError, match="order 4 takes no power beside a wave; set order=2"):
        ModelConfig(order=4, features=("q1 cos(q2)",), potential_width=0, **OF_TWO)


def test_the_mass_of_a_slide_that_turns():
    # fails if the lever arm is no part of the mass that weighs joints of segments
    model: Any = ContactLagrangian(
        ModelConfig(features=("q1^2 v2^2", "q1 cos(q2) v1 v2"), potential_width=0, damping_width=0, **OF_TWO)
    )
    with torch.no_grad():
        model.kinetic.sum.coefficient.copy_(torch.tensor([0.5, 0.2]))
    off = 0.2 * 0.7 * math.cos(0.3)
    mass = torch.tensor([[0.0, off], [off, 0.7**2]], dtype=torch.float64)
    torch.testing.assert_close(model.kinetic.mass(torch.tensor([0.7, 0.3]).double()), mass)


def test_libraries_stand_for_lists_of_features():
    # fails if a library repeats a feature, or makes one that cannot be read
    assert expand(["chain", "q1^2", "q1^2"], (False,) * 3)[0] == "(q1)^2 + (q2 - q1)^2 + (q3 - q2)^2 + (-q3)^2"
    assert expand(["q1^2", "q1^2"], LENGTHS) == ["q1^2"]
    for name in LIBRARIES:
        turning = name in ("harmonics", "pendulums", "revolute", "slides", "spherical", "windings")
        for angles in ((False, True, True), (True, False, True)) if turning else (LENGTHS, (False,) * 5):
            names = expand([name], angles)
            assert len(set(names)) == len(names) > 0
            for text in names:
                parse(text, angles)


def test_a_diagonal_mass_has_no_other_entries():
    # fails if masses between coordinates are learned all the same, or the first is no longer 1
    model = built((False,) * 3, diagonal=True)
    assert "kinetic.off_diagonal" not in dict(model.named_parameters())
    with torch.no_grad():
        model.kinetic.log_diagonal.copy_(torch.tensor([0.1, -0.2]))
    expected = torch.tensor([1.0, math.exp(0.2), math.exp(-0.4)], dtype=torch.float64).diag()
    torch.testing.assert_close(model.kinetic.mass().detach(), expected)
    with pytest.raises(InputError, match="mass that depends on position is not diagonal"):
        built(LENGTHS, diagonal=True, mass_width=4)
    with pytest.raises(InputError, match="leave features, known, alike, diagonal out"):
        built(LENGTHS, diagonal=True, baseline=False, correction_width=4)


def test_one_coefficient_for_a_whole_sum():
    # fails if the springs of a chain are learned one by one, or a known feature is learned
    model = built((False,) * 5, features=("chain 3",), known=("q1^4",), alike=True)
    shapes = {name: tuple(p.shape) for name, p in model.named_parameters()}
    assert shapes == {"potential.features.sum.coefficient": (2,), "damping.rate": ()}
    with torch.no_grad():
        model.potential.features.sum.coefficient.copy_(torch.tensor([0.5, 2.0]))
    q = torch.tensor([[0.3, -0.2, 0.5, 0.1, 0.4]], dtype=torch.float64)
    d = torch.tensor([0.3, -0.5, 0.7, -0.4, 0.3, -0.4], dtype=torch.float64)
    expected = 0.5 * (d**2).sum() + 2.0 * (d**3).sum() + 0.3**4
    torch.testing.assert_close(model.potential(q, 1).value[0], expected)
    torch.testing.assert_close(model.potential.features.value_and_slope(q)[1], model.potential(q, 1).gradient.T)


@pytest.mark.parametrize("order", [2, 4])
def test_the_jacobian_of_many_coordinates(order):
    # fails if the shortcut for many coordinates is another derivative where the model fits the data
    data = simulate(scene("chain", masses=MANY), trajectories=2, steps=6, h=0.01, seed=0)
    model = built((False,) * MANY, features=("chain",), alike=True, order=order)
    with torch.no_grad():
        model.potential.features.sum.coefficient.copy_(torch.tensor([0.5, 0.0, 0.125]))
    problem = ResidualProblem(model, data)
    assert problem.many
    _, A, _ = problem.normal_equations(problem.start())
    problem.many = False
    _, wanted, _ = problem.normal_equations(problem.start())
    torch.testing.assert_close(A, wanted, rtol=1e-4, atol=1e-4 * float(wanted.abs().max()))
