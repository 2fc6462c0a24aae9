"""The terms that recordings of one coordinate need, found with nothing told, and the equation that is printed."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.smoothing import local_polynomials, smooth_triples
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.drag import parse_drag
from herglotz.scenes import scene
from herglotz.training import Plan, fit, laplace
from herglotz.training.equation import Equation, Term, equation_of
from herglotz.training.equation_words import number
from herglotz.training.fit import _joint, _of_short_steps
from herglotz.training.named_terms import candidates
from herglotz.training.solvers.lifted_newton import linear_recurrence


def printed(model, data):
    """The equation of a model of these data as text."""
    return str(equation_of(SimpleNamespace(model=model, data=data)))  # pyright: ignore


@pytest.fixture(scope="module")
def duffing():
    data = simulate(scene("duffing"), trajectories=1, steps=200, h=0.1, noise=0.003, seed=0)
    return fit(data, progress=False)


def test_duffing_is_found_from_one_noisy_recording(duffing):
    # fails if the dictionary, its linear start, the terms that join or leave, or the plan that follows them are broken
    plan = duffing.metrics["plan"]
    assert set(plan["features"]) == {"q1^2", "q1^4"}
    assert plan["drag"] == ()
    assert plan["network"] == "none"
    assert duffing.metrics["train_rms"] < 1.2 * 0.003
    assert duffing.metrics["extrapolation_rms"] < 1.5 * 0.003


def test_the_equation_is_printed_with_deviations(duffing):
    # fails if a sign, a factor of a derivative, a unit or a covariance is wrong: 4 deviations are 6e-5 of chance
    terms = {term.what: term for term in duffing.equation().terms}
    for what, value, unit in (("x′", -0.15, "1/s"), ("x", -1.0, "1/s²"), ("x³", -25.0, "m⁻²/s²")):
        assert abs(terms[what].value - value) < 4 * terms[what].deviation
        assert terms[what].deviation < 0.1 * abs(value)
        assert terms[what].unit == unit
    text = str(duffing.equation())
    assert text.startswith("x″ = −0.1")
    assert max(map(len, text.splitlines())) <= 78
    stored = json.loads(json.dumps(duffing.metrics["equation"]))
    assert str(Equation.from_dict(stored)) == text


def test_the_final_fit_takes_no_longer_segments_than_the_search(duffing):
    # fails if whole trajectories are fitted of a motion that a search could follow over segments alone
    plan = replace(Plan.from_dict(duffing.metrics["plan"]), longest=40)
    assert duffing.metrics["segment_steps"] > 130 * plan.substeps
    assert fit(duffing.data, plan=plan, progress=False).metrics["segment_steps"] < 50 * plan.substeps


def test_the_equation_has_the_names_of_the_file():
    # fails if a force is called u where its column has a name, its unit is lost, or degrees are not told
    one = (1.0,)
    config = ModelConfig((True,), "forced", one, one, one, (0.0,), potential_width=0, inputs=1)
    t = torch.arange(5, dtype=torch.float64)
    columns = (("t", "time", "s"), ("theta", "coordinate", "deg"), ("F", "input", "N"))
    data = Trajectories.of(t, t, u=t, names=("theta",), angles=(True,), columns=columns)
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.get_parameter("friction.input_map").fill_(2.0)
    text = printed(model, data)
    assert " + 2 F " in text
    assert "theta in rad, F in N, theta recorded in deg" in " ".join(text.split())
    model = ContactLagrangian(replace(config, input_zero=True))
    for zero, shown in ((0.25, "2 (F − 0.25)"), (-0.25, "2 (F + 0.25)"), (0.0, "2 F")):
        # fails if a sensor that shows −0.25 at no force is printed as F − -0.25
        with torch.no_grad():
            model.get_parameter("friction.input_map").fill_(2.0)
            model.get_parameter("friction.input_zero").fill_(zero)
        assert shown in printed(model, data)


@pytest.mark.parametrize("names", [("q0", "q1"), ("q2", "q1"), ("v1", "x")])
def test_names_that_look_like_the_grammar_stay_apart(names):
    # fails if names are put in one after the other: the first one's name is then taken for the second coordinate
    one = (1.0, 1.0)
    config = ModelConfig(
        (False, False), "linear", one, one, one, (0.0, 0.0), potential_width=0, features=("q1 v2 - q2 v1",)
    )
    t = torch.arange(5, dtype=torch.float64)
    data = Trajectories.of(t, torch.stack([t, t], -1), names=names)
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.get_parameter("kinetic.sum.coefficient").fill_(0.7)
    a, b = names
    assert f"({a} {b}′ − {b} {a}′)" in " ".join(printed(model, data).split())


def test_signs_of_an_equation():  # fails if the first minus inside a line loses its blank
    line = Equation((Term("L", "a", 2.0, None, ""), Term("L", "b", -1.0, None, "")), ("L",), "m", None)
    assert str(line).splitlines()[0] == "L = 2 a − 1 b"
    assert str(replace(line, terms=line.terms[::-1])).splitlines()[0] == "L = −1 b + 2 a"


def test_a_lagrangian_has_its_kinetic_energy():
    # fails if L of several coordinates is printed without ½ vᵀ M v ("L = 0" where V is a network)
    two = (1.0, 1.0)
    model = ContactLagrangian(ModelConfig((False, False), "linear", two, two, (0.0, 0.0), (0.0, 0.0)))
    t = torch.arange(5, dtype=torch.float64)
    data = Trajectories.of(t, torch.stack([t, t], 1), names=("a", "b"))
    assert printed(model, data).startswith("L = 0.5 a′² + 0.5 b′²")
    config = ModelConfig(
        (False, False), "linear", two, two, (0.0, 0.0), (0.0, 0.0), potential_width=0, features=("q1 v2 - q2 v1",)
    )
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.get_parameter("kinetic.sum.coefficient").fill_(0.85)
    # fails if ½ vᵀ M v is lost beside a product of speeds, or the second of its products without the coefficient
    text = printed(model, data)
    assert text.startswith("L = 0.5 a′² + 0.5 b′² + 0.85 (a b′ − b a′) − 0.1 s")
    # fails if the law of motion is not told, without which nobody can integrate L, or a force of 0 has a line
    assert "motion: d/dt ∂L/∂a′ = ∂L/∂a + (∂L/∂s) ∂L/∂a′, so for every coordinate; s′ = L" in " ".join(text.split())
    assert "force on a = " not in text


def test_the_contact_form_damps_every_coordinate():
    # fails if the rate is printed for the first coordinate alone, without the mass, or left out of L
    data = Trajectories.of(torch.arange(3.0), torch.zeros(3, 2), (3,), names=("a", "b"))
    settings = {"angles": (False, False), "scale": (1.0, 1.0), "speed": (1.0, 1.0), "tilt": (0.0, 0.0), "rate": 0.3}
    settings |= {"stiffness": (4.0, 4.0), "potential_width": 0, "level": "linear"}
    alone = ContactLagrangian(ModelConfig(**settings, diagonal=True))
    with torch.no_grad():
        alone.get_parameter("kinetic.log_diagonal").fill_(0.5 * math.log(2.0))
    lines = printed(alone, data).splitlines()
    # fails if a line that shares nothing with others keeps a mass that no motion tells: 0.48417(±32) y″ = …
    assert lines[:2] == ["a″ = −0.3 a′ − 4 a", "b″ = −0.3 b′ − 2 b"]
    shared = ContactLagrangian(ModelConfig(**settings, diagonal=True, features=("(q1 - q2)^2",)))
    with torch.no_grad():
        shared.get_parameter("kinetic.log_diagonal").fill_(0.5 * math.log(2.0))
        shared.get_parameter("potential.features.sum.coefficient").fill_(0.5)
    lines = printed(shared, data).splitlines()
    assert lines[:2] == ["a″ = −0.3 a′ − 4 a − 1 (a − b)", "2 b″ = −0.6 b′ − 4 b + 1 (a − b)"]
    both = ContactLagrangian(ModelConfig(**settings))
    assert "− 0.3 s" in printed(both, data)


def test_no_number_is_left_out_of_an_equation():
    # fails if a term is dropped where its own deviation is large: with another one it may be determined, and the
    # equation without it is another motion (a damping of 2.955 and a gain of 4.9 were, by 2.3 rad)
    terms = (Term("x″", "x", -2.0, 0.5, "1/s²"), Term("x″", "x′", -0.12, 1.0, "1/s", 0.003))
    wide = Equation(terms, ("x″",), "x in m", None)
    assert str(wide).splitlines()[0] == "x″ = −2.0(5) x − 0.120(±1) x′"


@pytest.mark.slow  # 8 s
def test_van_der_pol_is_found_with_its_negative_damping():
    # fails if forces of position and velocity are no candidates, or dry friction is taken for them
    run = fit(simulate(scene("van_der_pol"), trajectories=1, steps=400, h=0.1, noise=0.01, seed=0), progress=False)
    assert run.metrics["plan"]["drag"] == ("q1^2 v1",)
    assert run.metrics["extrapolation_rms"] < 1.5 * 0.01


@pytest.mark.parametrize(("noise", "worst"), [(0.0, 2e-3), (0.001, 0.1)])
def test_local_polynomials_read_accelerations(noise, worst):
    # fails if the width ignores noise or motion, or a window is not centred; measured 1e-3 and 0.04 of their size
    data = simulate(scene("duffing"), trajectories=2, steps=200, h=0.05, noise=noise, seed=1)
    local = local_polynomials(data)
    assert local is not None
    t, _ = smooth_triples(data, local)
    a, v = (t.q2 - 2 * t.q1 + t.q0) / t.h0[:, None] ** 2, (t.q2 - t.q0) / (2 * t.h0[:, None])
    error = a + 0.15 * v + t.q1 + 25 * t.q1**3
    assert float(error.square().mean().sqrt()) < worst * float(a.square().mean().sqrt())


@pytest.mark.parametrize("K", [1, 2, 7, 50])
def test_a_recurrence_in_blocks_is_the_recurrence(K):
    # fails if a block starts from the wrong state, or padding reaches the result
    make = torch.Generator().manual_seed(0)
    A, B, z = (torch.randn(*s, generator=make, dtype=torch.float64) for s in ((3, K, 2, 2), (3, K, 2, 4), (3, 2, 4)))
    A, found = A / 2, linear_recurrence(A / 2, B, z)
    assert found.shape == (3, K + 1, 2, 4)
    for k in range(K):
        assert torch.allclose(found[:, k], z, rtol=1e-12, atol=1e-12)
        z = A[:, k] @ z + B[:, k]
    assert torch.allclose(found[:, K], z, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [("q1 q1", "write"), ("|v2| v1", "are one speed"), ("v3", "numbered 1 … 2"), ("q1^2 v2", "not periodic"),
     ("v1^10", "from 1 to 9"), ("(v1 - v1)", "named twice"), ("(2.5 v2 - v2)", "named twice"),
     ("(0 v1 - v2)", "v1 is 0"), ("(1e999 v1 - v2)", "v1 is inf"), ("sin(2.5 (20.5 v1 - v2))", "write"),
     ("(v1 - v3)", "numbered 1 … 2"), ("v1 - v2", "write"),
     ("|v1| (v1 - v2)", "are one speed"), ("q1 sgn(v1)", "not periodic"), ("cos(q3) sgn(v1)", "numbered 1 … 2"),
     ("q2^10 sgn(v1)", "from 1 to 9"), ("q2^0 v1", "from 1 to 9"), ("sgn(v1)", "write"),
     ("cos(q1) sgn(v3)", "numbered 1 … 2"), ("sin(2 v3)", "numbered 1 … 2"), ("cos(v1 - v2)", "write"),
     ("cos((v2 - v2))", "named twice"), ("sin(2 v1) v1", "write")],
)  # fmt: skip
def test_wrong_drag_is_an_input_error(text, says):
    # fails if a text is read as another force
    with pytest.raises(InputError, match=says):
        parse_drag(text, (True, False))


def test_a_planet_is_found_in_noise_with_its_rotation():
    # fails if 1/r is missed or a term that noise brings joins it: the rotation is lost with either
    data = simulate(scene("kepler"), trajectories=3, steps=60, h=0.1, noise=1e-3, seed=1)
    run = fit(data, progress=False)
    assert run.metrics["plan"]["features"] == ("r^-1",)
    assert run.metrics["train_rms"] < 1.2e-3
    symmetries = run.symmetries()
    assert len(symmetries) == 1
    assert "rotation" in str(symmetries)


def test_deviations_are_no_smaller_than_rounding(duffing):
    # fails if terms of exact data that rounding has made are told from 0: `1.7e-16 ± 2e-17 x²`
    posterior, least = laplace(duffing), 50 * duffing.metrics["sigma"]
    by = 50 / posterior.inflation
    for term, wide in zip(duffing.equation().terms, equation_of(duffing, _joint(posterior, least)).terms, strict=True):
        assert wide.deviation == pytest.approx(by * term.deviation)
        assert wide.alone == pytest.approx(50 * term.alone)
    assert equation_of(_of_short_steps(duffing, posterior), _joint(posterior, 0.0)).terms == duffing.equation().terms


def test_lines_of_an_equation_break_between_terms():
    # fails if a number stands at the end of a line, x on the next, or it is not said what deviations do not hold
    terms = tuple(
        Term("x″", what, -0.123456, 1e-5, "1/s²") for what in ("x′", "|x′| x′", "(u_0 + 0.1)", "x", "x³", "x⁵", "x⁷")
    )
    lines = str(Equation(terms, ("x″",), "x in m", None)).splitlines()
    assert [line.strip() for line in lines] == [
        "x″ = −0.12346(1) x′ − 0.12346(1) |x′| x′ − 0.12346(1) (u_0 + 0.1)",
        "− 0.12346(1) x − 0.12346(1) x³ − 0.12346(1) x⁵ − 0.12346(1) x⁷",
        "with x in m; in brackets: standard deviation, of the last digits or as ±, by",
        "noise alone",
    ]
    assert "brackets" not in str(Equation((Term("x″", "x", -1.0, None, "1/s²"),), ("x″",), "x in m", None))


@pytest.mark.parametrize(
    ("value", "deviation", "alone", "written"),
    [
        (4.7512e-8, 2e-10, 2e-10, "4.75(2)e-8"),
        (3e-5, 2e-4, 2e-4, "0.0000(2)"),
        (9.9e-5, 1e-9, 1e-9, "9.9000(1)e-5"),
        (25.0, 0.3, 0.2, "25.0(3)"),
        (25.0312, 0.3, 0.02, "25.03(30)"),
        (2.955123, 4.12, 0.002, "2.955(±4.1)"),  # its digits are those that the motion needs
        (2.955123, None, 0.002, "2.955"),
        (2.955123456789, None, None, "2.955123"),
        (12345678.9, 30.0, 2.0, "1.2345679(30)e7"),
        (1234.5, 300.0, 20.0, "1234(±300)"),
    ],
)
def test_numbers_with_their_deviations(value, deviation, alone, written):
    # fails if a small coefficient stands behind a row of zeros, or loses its power of ten, or a number that others can
    # make up for is rounded by its own deviation
    assert number(value, deviation, alone) == written


def test_a_constant_force_is_the_zero_of_an_input():
    # fails if both are candidates: they grew to 2860 m/s² that cancelled
    t = torch.arange(9.0)
    free, driven = (candidates(Trajectories.of(t, t[:, None], u=u)) for u in (None, t[:, None]))
    assert "q1" in free.features
    assert set(free.features) - set(driven.features) == {"q1"}


def test_friction_even_in_the_speed_is_offered_where_the_motion_goes_both_ways():
    # fails if v² is no offer, so that waves and a drift of the sensor stand for it, or if v² or |v| is one over a fall,
    # where it is the force of |v| v or v, though the body rises for an instant
    t = torch.arange(150, dtype=torch.float64)
    for q, offered in ((torch.sin(t / 3), True), (t, False), (t**2 - 4 * t, False)):
        drag = candidates(Trajectories.of(t, q[:, None])).drag
        assert {"v1^2", "|v1|"}.intersection(drag) == ({"v1^2", "|v1|"} if offered else set())
        assert "|v1| v1" in drag
    # Masses of several coordinates have forces in v² of their own.
    both = candidates(Trajectories.of(t, torch.stack([torch.sin(t / 3), torch.cos(t / 5)], 1))).drag
    assert {"|v1|", "|v2|"} <= set(both)
    assert "v1^2" not in both
