"""The search for inputs that act by their square, their size or their rate."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import herglotz as hz
from herglotz.data import Trajectories
from herglotz.data.input_terms import saturation
from herglotz.training.acting_inputs import beside, offered_terms
from herglotz.training.baseline import estimate_baseline
from herglotz.training.config import FitConfig
from herglotz.training.look import look
from herglotz.training.offers import INPUTS, ZEROS
from herglotz.training.plan import Plan
from herglotz.training.search import Search
from herglotz.training.stages import Stages
from herglotz.training.trials import Trial

H = 0.04


def driven(force, u, steps=8, samples=220, noise=2e-4, seed=0):
    """A damped spring x″ = −20 x − x′ + force(u, u′), integrated finely, with noise."""
    make = np.random.default_rng(seed)
    t, h = np.arange(samples) * H, H / steps
    rate = lambda s: (u(s + 1e-5) - u(s - 1e-5)) / 2e-5  # noqa: E731
    f = lambda s, y: np.array([y[1], -20 * y[0] - y[1] + force(u(s), rate(s))])  # noqa: E731
    y, out = np.array([0.02, 0.0]), []
    for time in t:
        out.append(y[0])
        for k in range(steps):
            s = time + k * h
            a = f(s, y)
            b = f(s + h / 2, y + h / 2 * a)
            y = y + h * f(s + h / 2, y + h / 2 * b)
    q = np.array(out) + noise * make.standard_normal(samples)
    return Trajectories.of(t, q, u=np.array([u(s) for s in t]), hold="smooth")


def sway(s):
    return np.sin(2.3 * s) + 0.6 * np.sin(3.9 * s + 1)


CASES = {"u'": lambda u, rate: 2 * u + 1.5 * rate, "u^2": lambda u, _: 3 * u * u, "|u|": lambda u, _: 3 * abs(u)}


@cache
def run_of(term):
    """The run of a recording whose input acts by this term."""
    return hz.fit(driven(CASES[term], sway), train_fraction=1, progress=False)


# That |u| is a column like u^2 is shown by test_input_terms.py.
@pytest.mark.parametrize("term", ["u'", "u^2", pytest.param("|u|", marks=pytest.mark.slow)])
def test_what_an_input_acts_by_is_found(term):
    # fails if a term is not offered, or columns that nothing asks for stay
    run = run_of(term)
    assert run.metrics["plan"]["input_terms"] == (term,) or run.metrics["plan"]["input_terms"] == [term]
    assert run.metrics["verdict"].startswith("fits to the noise")
    assert term in str(run.equation())


def test_the_level_at_which_an_input_saturates_is_found():
    # fails if saturations are not offered, or a level stays where accelerations put it
    data = driven(lambda u, _: 3 * np.clip(u, -0.6, 0.6), sway, samples=150)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    search.order = 2  # as of noisier data, in half the time
    offered = [saturation(term) for term in offered_terms(data)[3:]]
    assert [(of[0], of[2]) for of in offered if of] == [("sat", "u"), ("tanh", "u")]
    assert offered[0] is not None
    assert offered[0][1] == pytest.approx(0.6, rel=0.15)
    first = search.first
    assert first is not None
    (term,) = search.input_terms(first)
    found = saturation(term)
    assert found is not None
    assert (found[0], found[2]) == ("sat", "u")
    assert found[1] == pytest.approx(0.6, rel=0.01)


def test_a_run_predicts_recordings_without_the_term():
    # fails if a new recording is not given the columns that the model is driven by
    run = run_of("u^2")
    new = driven(CASES["u^2"], lambda s: sway(s + 2), seed=3)
    rms = run.predict(new).rms
    assert rms is not None
    assert rms < 3 * 2e-4


def test_a_plan_repeats_the_terms():
    # fails if a plan is followed with the recorded inputs alone
    run = run_of("u^2")
    again = hz.fit(
        driven(CASES["u^2"], sway), train_fraction=1, progress=False, plan=Plan.from_dict(run.metrics["plan"])
    )
    assert again.data.input_labels == run.data.input_labels
    assert str(again.equation()) == str(run.equation())


def test_gains_keep_their_coordinate_where_inputs_join():
    # fails if the gains of two inputs on two coordinates, row by row, are those of others where three terms join them
    numbers = {
        "friction.input_map[1]": 1.0,
        "friction.input_map[2]": 2.0,
        "friction.input_zero[1]": 3.0,
        "cos(q1)": 4.0,
    }
    data: Any = SimpleNamespace(input_labels=(("f1", "N"), ("f2", "N")))
    trial = Trial(SimpleNamespace(data=data), frozenset(numbers), numbers, None, None)  # pyright: ignore[reportArgumentType]
    found = beside(trial, 3)
    assert found.values == {
        "friction.input_map[1]": 1.0, "friction.input_map[5]": 2.0, "friction.input_zero[1]": 3.0, "cos(q1)": 4.0,
    }  # fmt: skip
    assert found.taken == frozenset(found.values)
    # a single gain has no place in its name
    data.input_labels = (("f1", "N"),)
    single = Trial(SimpleNamespace(data=data), frozenset(), {INPUTS: 1.0, ZEROS: 2.0}, None, None)  # pyright: ignore[reportArgumentType]
    assert beside(single, 1).values == {f"{INPUTS}[0]": 1.0, f"{ZEROS}[0]": 2.0}


def test_inputs_that_act_as_recorded_have_no_terms():
    # fails if terms join where the noise is met without them
    data = driven(lambda u, _: 3 * u, sway)
    seen = look(data, FitConfig(train_fraction=1), Stages())
    assert seen.data.input_labels == data.input_labels


def test_nothing_is_looked_for_where_that_is_said():
    # fails if the setting is not read
    data = driven(CASES["u^2"], sway)
    config = FitConfig(find_input_terms=False).resolved(data)
    missed: Any = SimpleNamespace(at_the_noise=False)
    assert Search(data, estimate_baseline(data), config).input_terms(missed) == ()
