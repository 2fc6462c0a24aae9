"""The terms that recordings of one coordinate need, found with nothing told, and the equation that is printed."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.smoothing import local_polynomials, smooth_triples
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.drag import parse_drag
from herglotz.scenes import scene
from herglotz.training import FitConfig, Plan, dictionary_search, fit, laplace
from herglotz.training.baseline import estimate_baseline
from herglotz.training.dictionary_search import DictionarySearch
from herglotz.training.equation import Equation, Term, equation_of
from herglotz.training.equation_words import number
from herglotz.training.fewer_numbers import FewerNumbers
from herglotz.training.fit import _joint
from herglotz.training.found_terms import Found
from herglotz.training.linear_terms import starts_of
from herglotz.training.named_terms import NamedTerms, candidates, loads, offered, turns_one_way
from herglotz.training.pruning import joining
from herglotz.training.solvers.lifted_newton import linear_recurrence


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


def test_a_search_begins_with_as_few_samples_as_tell_the_motion(monkeypatch):
    # fails if a search works on all samples of a recording that is finer than its motion, or the fit on some of them
    data, begun = simulate(scene("duffing"), trajectories=1, steps=1500, h=0.02, noise=1e-5, seed=0), []
    begin = DictionarySearch._begun
    monkeypatch.setattr(DictionarySearch, "_begun", lambda self: begun.append(self.data.samples) or begin(self))
    found = DictionarySearch(data, estimate_baseline(data), FitConfig()).run()
    assert found is not None
    assert begun
    assert max(begun) < 600
    assert set(found.terms.names) == {"q1^2", "q1^4"}
    assert found.rms == pytest.approx(1e-5, rel=0.1)
    assert len(found.fit.states()) == 1501
    assert found.config.substeps == 1


@pytest.mark.parametrize("where", ["joins", "begins"])
def test_dry_friction_that_pushes_is_no_term(where, monkeypatch):
    # fails if friction that would create energy joins the terms, or stays with those of the linear start
    data = simulate(scene("duffing"), trajectories=1, steps=200, h=0.1, noise=0.003, seed=0)
    dry, begin = "friction.coulomb", DictionarySearch._begun

    def begun(self):
        found = begin(self)
        if where == "begins":
            assert found is not None
            found = self.refit(found, replace(found.terms, dry=True))
            assert found is not None
            found = replace(found, values={**found.values, dry: (-1.0,)})
            assert found.pushes
        return found

    asked = iter([dry, None, None])
    refit = DictionarySearch.refit

    def pushed(self, found, terms, *rest, **settings):
        more = refit(self, found, terms, *rest, **settings)
        assert more is not None
        return more if not more.terms.dry else replace(more, values={**more.values, dry: (-1.0,)})

    monkeypatch.setattr(DictionarySearch, "_begun", begun)
    for last in ("_pruned", "_likeliest", "_last_terms"):  # which may leave the term out as well
        monkeypatch.setattr(DictionarySearch, last, lambda _self, found: found)
    monkeypatch.setattr(FewerNumbers, "of", lambda _self, found: found)
    if where == "joins":
        monkeypatch.setattr(DictionarySearch, "_missing", lambda _self, _found: next(asked))
        monkeypatch.setattr(DictionarySearch, "refit", pushed)
    found = DictionarySearch(data, estimate_baseline(data), FitConfig()).run()
    assert found is not None
    assert not found.terms.dry


@pytest.mark.parametrize(
    ("rms", "length", "taken"), [(1.0, 300, True), (1.02, 300, True), (1.1, 300, False), (1.0, 150, False)]
)
def test_fewer_terms_are_taken_where_they_are_as_likely(rms, length, taken):
    # fails if what a number is worth, ½ log N, has another sign or size, or shorter segments count as whole
    # trajectories: 900 samples, 8 numbers less: misfits may grow by a factor of exp(27.2 / 900) = 1.031
    def found(numbers, rms, length):
        data = SimpleNamespace(q=torch.zeros(450, 2))
        problem = SimpleNamespace(grid=SimpleNamespace(length=length), data=data)
        return SimpleNamespace(rms=rms, fit=SimpleNamespace(problem=problem, theta=torch.zeros(numbers)))

    rich, simple = found(9, 1.0, 300), found(1, rms, length)
    assert Found.as_likely(simple, rich, 0.0) is taken  # pyright: ignore


@pytest.mark.parametrize("moved", [0.0, 3.0])
def test_the_change_of_a_motion_is_counted_sample_by_sample(moved):
    # fails if misfits of two problems are added: every sample moves by `moved` times the size of its own misfit
    def problem(misfit):
        path = SimpleNamespace(x=torch.zeros(2, 1, 3))
        return SimpleNamespace(d=2, pack=lambda *_: None, solve=lambda _: path, misfit=lambda _: misfit)

    misfit = torch.tensor([1.0, -2.0, 2.0])
    own, other = (problem(size * misfit) for size in (1.0, 1.0 + moved))
    found = SimpleNamespace(fit=SimpleNamespace(theta=None, path=own.solve(None), problem=own))
    assert Found.changed_by(found, other) == pytest.approx(moved * 3**0.5)  # pyright: ignore


def test_with_translations_the_candidates_are_those_that_no_translation_moves():
    # fails if the potential of what is not translated is left out, or the baseline's springs, which hold every
    # coordinate where it is, stay
    t = torch.arange(30, dtype=torch.float64) / 10
    q = torch.stack([t.sin(), t.cos(), (2 * t).sin()], 1)
    data = Trajectories.of(t, q, angles=(False, False, True), units=("m", "m", "rad"))
    found = candidates(data, ("q1 + q2",))
    assert (found.one_rate, found.springs, found.drag) == (True, False, ())
    potentials = {text for text in found.features if "v" not in text}
    assert {f"(q1 - q2)^{k}" for k in range(1, 5)} | {"sin(q3)", "cos(q3)"} <= potentials
    assert not any(text.startswith(("q1", "q2")) for text in potentials)


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
    text = str(equation_of(SimpleNamespace(model=model, data=data)))  # pyright: ignore
    assert " + 2 F " in text
    assert "theta in rad, F in N, theta recorded in deg" in " ".join(text.split())
    model = ContactLagrangian(replace(config, input_zero=True))
    for zero, shown in ((0.25, "2 (F − 0.25)"), (-0.25, "2 (F + 0.25)"), (0.0, "2 F")):
        # fails if a sensor that shows −0.25 at no force is printed as F − -0.25
        with torch.no_grad():
            model.get_parameter("friction.input_map").fill_(2.0)
            model.get_parameter("friction.input_zero").fill_(zero)
        assert shown in str(equation_of(SimpleNamespace(model=model, data=data)))  # pyright: ignore


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
    assert f"({a} {b}′ − {b} {a}′)" in " ".join(str(equation_of(SimpleNamespace(model=model, data=data))).split())  # pyright: ignore


def test_a_damper_between_two_bodies_is_found():
    # fails if no damper between coordinates is offered, or it pushes one body alone: friction of each body by itself
    # cannot do what it does, and the search ended in masses and rates that were 400 times too large
    K = torch.tensor([[12.0, -2.0], [-2.0, 2.0]], dtype=torch.float64)
    C = torch.tensor([[0.15, -0.1], [-0.1, 0.1]], dtype=torch.float64)
    weight, eye = torch.tensor([[1.0], [0.3]], dtype=torch.float64), torch.eye(2, dtype=torch.float64)
    A = torch.cat([torch.cat([0 * eye, eye], 1), torch.cat([-K / weight, -C / weight], 1)])
    x = torch.tensor([[0.5, 0.0, 0.0, 0.0], [0.0, 0.4, 0.3, 0.0]], dtype=torch.float64)
    x = torch.stack([x @ torch.linalg.matrix_exp(0.05 * k * A).mT for k in range(301)], 1)[..., :2].flatten(0, 1)
    q = x + 1e-3 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    t = 0.05 * torch.arange(301, dtype=torch.float64).repeat(2)
    run = fit(Trajectories.of(t, q, (301, 301), names=("a", "b")), progress=False)
    terms = {(term.left[-2:], term.what): term for term in run.equation().terms}
    for left, by in (("a″", -0.1), ("b″", 0.1)):
        found = terms[left, "(a′ − b′)"]
        assert found.deviation is not None
        assert found.deviation < 0.002  # measured: 0.0003
        assert abs(found.value - by) < 5 * found.deviation
    assert run.metrics["verdict"].startswith("fits to the noise")


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
    assert str(equation_of(SimpleNamespace(model=model, data=data))).startswith("L = 0.5 a′² + 0.5 b′²")  # pyright: ignore
    config = ModelConfig(
        (False, False), "linear", two, two, (0.0, 0.0), (0.0, 0.0), potential_width=0, features=("q1 v2 - q2 v1",)
    )
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.get_parameter("kinetic.sum.coefficient").fill_(0.85)
    # fails if ½ vᵀ M v is lost beside a product of speeds, or the second of its products without the coefficient
    text = str(equation_of(SimpleNamespace(model=model, data=data)))  # pyright: ignore
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
    lines = str(equation_of(SimpleNamespace(model=alone, data=data))).splitlines()  # pyright: ignore
    assert lines[:2] == ["a″ = −0.3 a′ − 4 a", "2 b″ = −0.6 b′ − 4 b"]
    both = ContactLagrangian(ModelConfig(**settings))
    assert "− 0.3 s" in str(equation_of(SimpleNamespace(model=both, data=data)))  # pyright: ignore


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
     ("v1^10", "from 1 to 9"), ("(v1 - v1)", "is 0"), ("(v1 - v3)", "numbered 1 … 2"), ("v1 - v2", "write"),
     ("|v1| (v1 - v2)", "are one speed"), ("q1 sgn(v1)", "not periodic"), ("cos(q3) sgn(v1)", "numbered 1 … 2"),
     ("q2^10 sgn(v1)", "from 1 to 9"), ("sgn(v1)", "write"), ("cos(q1) sgn(v3)", "numbered 1 … 2")],
)  # fmt: skip
def test_wrong_drag_is_an_input_error(text, says):
    # fails if a text is read as another force
    with pytest.raises(InputError, match=says):
        parse_drag(text, (True, False))


def test_a_distance_is_found_where_it_matters():
    # fails if powers of r are no candidates, one of them does not stand alone, or springs are taken for a distance
    names = {}
    for system, noise in (("kepler", 0.0), ("kepler", 1e-3), ("chain", 1e-3)):
        settings = {"masses": 2} if system == "chain" else {}
        data = simulate(scene(system, **settings), trajectories=3, steps=50, h=0.1, noise=noise, seed=1)
        local, every = local_polynomials(data), candidates(data)
        assert local is not None
        starts = starts_of(data, estimate_baseline(data), every, local)
        names[system, noise] = {name for name in starts[0].terms.features if name.startswith("r")}
        assert not any(name.startswith("r^") for name in every.names)
        assert ("r^-1" in offered(data, every, starts[0].terms, lacks=False).names) is (system == "kepler")
    assert names == {("kepler", 0.0): {"r^-1"}, ("kepler", 1e-3): {"r^-1"}, ("chain", 1e-3): set()}


def test_a_planet_is_found_in_noise_with_its_rotation():
    # fails if 1/r is missed or a term that noise brings joins it: the rotation is lost with either
    data = simulate(scene("kepler"), trajectories=3, steps=60, h=0.1, noise=1e-3, seed=1)
    run = fit(data, progress=False)
    assert run.metrics["plan"]["features"] == ("r^-1",)
    assert run.metrics["train_rms"] < 1.2e-3
    symmetries = run.symmetries()
    assert len(symmetries) == 1
    assert "rotation" in str(symmetries)


def test_the_best_of_many_terms_has_to_bring_more():
    # fails if a term joins that is no better than the best of twenty terms of noise is by chance: 12.3 of 400 residuals
    J = torch.linalg.qr(torch.randn(400, 21, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    free, others = torch.tensor([0]), torch.arange(1, 21)
    for gain, found in ((math.log(400) + 5.0, None), (math.log(400) + 7.0, 4)):
        b = J.T @ (J[:, 5] * gain**0.5 + 0.1 * J[:, 7])
        assert joining(J.T @ J, b, free, others, math.log(400)) == found


def test_rounding_is_no_reason_for_a_term():
    # fails if a term may join that lowers a misfit which is below that of exact data
    search = SimpleNamespace(all=candidates(simulate(scene("duffing"), trajectories=1, steps=9, h=0.1)), floor=1e-8)
    assert DictionarySearch._missing(search, SimpleNamespace(terms=NamedTerms(), rms=0.9e-8)) is None  # pyright: ignore


def test_deviations_are_no_smaller_than_rounding(duffing):
    # fails if terms of exact data that rounding has made are told from 0: `1.7e-16 ± 2e-17 x²`
    plan, least = Plan.from_dict(duffing.metrics["plan"]), 50 * duffing.metrics["sigma"]
    posterior = laplace(duffing)
    by = 50 / posterior.inflation
    for term, wide in zip(
        duffing.equation().terms, equation_of(duffing, _joint(duffing, plan, least)).terms, strict=True
    ):
        assert wide.deviation == pytest.approx(by * term.deviation)
        assert wide.alone == pytest.approx(50 * term.alone)
    assert equation_of(duffing, _joint(duffing, plan, 0.0)).terms == duffing.equation().terms


@pytest.mark.parametrize("pushes", [True, False])
def test_likelier_terms_do_not_push(monkeypatch, pushes):  # fails if friction that creates energy is kept for its fit
    search: Any = object.__new__(DictionarySearch)
    found, other = (SimpleNamespace(terms=SimpleNamespace(names=names), coloured=False) for names in (("a", "b"), ()))
    found.config, other.pushes = SimpleNamespace(substeps=1), pushes
    search.data, search.all, search.floor = SimpleNamespace(dof=1), SimpleNamespace(names=()), 0.0
    search._problem = lambda *_: (SimpleNamespace(task=SimpleNamespace(config=None)), None)
    search.refit = lambda *_, **_settings: other
    search._held = search._longer = lambda it: it
    monkeypatch.setattr(dictionary_search, "likelier", lambda *_: [SimpleNamespace(values={}, terms=(), states=None)])
    monkeypatch.setattr(dictionary_search, "preferred", lambda *_: True)
    monkeypatch.setattr(dictionary_search, "replace", lambda it, **_: it)
    assert search._likeliest(found) is (found if pushes else other)


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


@pytest.mark.parametrize(
    ("rms", "coloured", "beaten", "joins"),
    [(0.9, False, False, True), (0.9, True, False, False), (0.9, True, True, True), (0.6, True, False, True),
     (1.1, False, True, False), (1.1, True, True, False), (0.98, False, True, False)],
)  # fmt: skip
def test_a_term_joins_where_it_halves_the_misfit(rms, coloured, beaten, joins):
    # fails if blocks of time, which are foretold to first order, turn away a term that takes half of the squared
    # misfit; or if one stays that takes less of white noise than the criterion which proposed it had foretold
    fit = SimpleNamespace(problem=SimpleNamespace(data=SimpleNamespace(q=torch.zeros(60, 1))))
    found, more = (
        SimpleNamespace(rms=x, coloured=c, beaten_by=lambda *_: beaten, fit=fit)
        for x, c in ((1, True), (rms, coloured))
    )
    assert Found.joined_by(found, more, 0.0) is joins  # pyright: ignore


def test_a_constant_force_is_the_zero_of_an_input():
    # fails if both are candidates: they grew to 2860 m/s² that cancelled
    t = torch.arange(9.0)
    free, driven = (candidates(Trajectories.of(t, t[:, None], u=u)) for u in (None, t[:, None]))
    assert "q1" in free.features
    assert set(free.features) - set(driven.features) == {"q1"}


@pytest.mark.parametrize(
    ("finer", "most", "substeps"),
    [({2: 1.03}, 4, 2), ({2: 1.1, 4: 1.0}, 4, 4), ({2: 1.1, 4: 1.1}, 4, 1), ({2: 1.1, 4: 1.0}, 3, 1)],
)
def test_shorter_steps_may_cost_what_one_number_is_worth(finer, most, substeps):
    # fails if noise alone keeps steps that are too long, or the next length is not tried: of 60 samples ½ log N is
    # worth 3.5 % of the RMS, and dry friction errs by the step in which a velocity changes sign; or if there are more
    # steps than a search has time for
    search = stepping_search(finer, most)
    assert search._finer(search.at(1, 1.0)).config.substeps == substeps
    vars(search).pop("in_vain", None)
    search._longer = None  # the same segments stay, to be compared over
    assert search._finer(search.at(1, 1.0), longer=False).config.substeps == substeps


@pytest.mark.parametrize(
    ("n", "coloured", "rms", "substeps"),
    [(2, True, 0.97, 2), (2, True, 0.9, 4), (1, True, 0.97, 4), (2, False, 0.97, 4)],
)
def test_steps_of_several_coordinates_are_halved_again_where_that_misses_less(n, coloured, rms, substeps):
    # fails if two motors with a force that no term has are fitted with 16 steps a sample, which miss the data as much
    # and cost 16 times as much; if an axis with dry friction, or noise, is held to the same: from 13 samples a period
    # of one its free runs then missed 7.2 times the noise instead of 3.4
    search = stepping_search({4: rms, 8: 0.5}, 4, n, coloured=coloured)
    assert search._finer(search.at(2, 1.0)).config.substeps == substeps


class Stepped(SimpleNamespace):
    """Of a `Found` what tells whether its steps are worth halving."""

    halved_before = Found.halved_before
    worth_halving = Found.worth_halving


def stepping_search(finer: dict[int, float], most: int, n: int = 1, *, coloured: bool = False) -> Any:
    """A search whose fits with so many steps in a recorded one miss the data by `finer`; steps are halved once."""
    search: Any = object.__new__(DictionarySearch)
    search.floor, search.finest, search.data = 0.0, most, SimpleNamespace(q=torch.zeros(60, 1))
    fit, started = SimpleNamespace(problem=SimpleNamespace(n=n, data=search.data)), []

    def at(m: int, rms: float) -> Stepped:
        started.append(m)
        config = SimpleNamespace(substeps=m, sticking=None)
        return Stepped(rms=rms, terms=(), config=config, fit=fit, coloured=coloured)

    search.at, search.refit = at, lambda *steps: at(steps[-1], finer[steps[-1]])
    search._longer = lambda found: found
    search._too_long = lambda found: found.config.substeps == started[0] and not hasattr(search, "in_vain")
    return search


@pytest.mark.parametrize(("back", "offered"), [(0.0, ()), (3.0, ("load 1",))])
def test_a_load_and_dry_friction_are_one_force_where_a_joint_never_turns_back(back, offered):
    # fails if both are candidates: 5369604 − 5369599 sgn θ′ met a rotating pendulum to 1e-8 rad, and its free runs
    # from unseen starts missed by 40 % of the motion; or if the load is lost where the motion turns back
    t = torch.linspace(0, 6, 300, dtype=torch.float64)
    q = (5 * t + back * (3 * t).sin())[:, None]  # turns back where 3 back > 5
    data = Trajectories.of(t, q, angles=(True,))
    assert tuple(x for x in candidates(data).drag if x.startswith("load")) == offered
    assert loads(data, one_way=True) == tuple({"load 1"} - set(offered))
    q[100] -= 0.2  # fails if one sample that noise has moved is a turn: the step before it is 0.1
    assert turns_one_way(Trajectories.of(t, q, angles=(True,)), 0) is (back == 0)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_what_pushes_on_a_joint_that_turns_one_way_is_a_load(way, monkeypatch):
    # fails if such a joint is left without a constant force once its friction has turned out to push
    t = torch.arange(60.0, dtype=torch.float64)
    data = Trajectories.of(t, way * t[:, None], angles=(True,))
    search = object.__new__(DictionarySearch)
    search.data = data
    monkeypatch.setattr(search, "refit", lambda found, terms: SimpleNamespace(terms=terms, of=found), raising=False)
    start = Found(NamedTerms((), (), True), FitConfig(), {"friction.coulomb": (-3.0,)}, None, None, True, 1.0)  # type: ignore[arg-type]
    left: Any = search._braking(start)
    assert left.terms.drag == ("load 1",)
    assert left.of.values["load 1"] == -3.0 * way  # the force −(−3) sgn θ′
    assert not left.terms.dry


def test_a_load_is_asked_for_once_friction_that_joins_a_one_way_joint_pushes(monkeypatch):
    # fails if such a joint has neither constant force any more
    t = torch.arange(60.0, dtype=torch.float64)
    search: Any = object.__new__(DictionarySearch)
    search.data, search.floor, search.all = (
        Trajectories.of(t, t[:, None], angles=(True,)),
        0.0,
        NamedTerms((), (), True),
    )
    start: Any = SimpleNamespace(terms=NamedTerms(), pushes=False, coloured=False, rms=1.0)
    asked, names = iter(["friction.coulomb", None]), []

    def missing(_found):
        names.append(search.all.names)
        return next(asked)

    search._begun, search._missing = lambda: start, missing
    search.refit = lambda _found, terms: SimpleNamespace(terms=terms, pushes=True)
    for last in ("_pruned", "_likeliest", "_last_terms"):
        setattr(search, last, lambda found: found)
    search._problem, search.order = None, 2
    monkeypatch.setattr(FewerNumbers, "of", lambda _self, found: found)
    monkeypatch.setattr(dictionary_search, "exchanged", lambda found, *_: found)
    assert search.run() is start
    assert names == [("friction.coulomb",), ("load 1",)]
