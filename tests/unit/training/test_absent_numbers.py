"""Numbers of a model that are 0 and no unknowns of a fit."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.func import jacrev

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig, numbers_of
from herglotz.training import FitConfig
from herglotz.training.baseline import estimate_baseline
from herglotz.training.equation import equation_of
from herglotz.training.equation_words import Joint
from herglotz.training.foresight import _with_absent_terms
from herglotz.training.named_terms import NamedTerms, settings_of
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.quantities import quantities
from herglotz.training.stages import Stages
from herglotz.training.task import Task, build_model

ABSENT = ("potential.stiffness[0]", "friction.viscous[1]")


def two_bodies(absent=ABSENT):
    pair = {name: (1.0, 1.0) for name in ("scale", "speed", "tilt")}
    settings = {**pair, "angles": (False, False), "stiffness": (4.0, 5.0), "potential_width": 0, "level": "forced"}
    return ContactLagrangian(ModelConfig(**settings, diagonal=True, absent=absent))


def test_absent_numbers_are_zero_and_no_unknowns():
    # fails if one of them is moved, is counted, or shifts the places of those behind it
    whole, model = numbers_of(two_bodies(())), two_bodies()
    vector = ParameterVector(model)
    assert vector.numbers == [name for name in whole if name not in ABSENT]
    assert model.potential.stiffness.tolist() == [0.0, 5.0]
    vector.set(torch.arange(1.0, len(vector.numbers) + 1, dtype=torch.float64))
    values = dict(zip(whole, torch.cat([p.detach().reshape(-1) for p in model.parameters()]).tolist(), strict=True))
    assert [values[name] for name in ABSENT] == [0.0, 0.0]
    assert [values[name] for name in vector.numbers] == vector.get().tolist()
    assert [vector.numbers[i] for i in vector.index("potential")] == [x for x in vector.numbers if "potential" in x]


def test_derivatives_see_what_is_left():
    # fails if an absent number gets a column, or a column its neighbour's derivative
    vector, q = ParameterVector(two_bodies()), torch.tensor([0.3, -0.2], dtype=torch.float64)
    value = lambda theta: vector.partials(theta, q, 2 * q, q[0] * 0, q[0], 1).L  # noqa: E731
    slope = jacrev(value)(vector.get())
    theta, eps = vector.get(), 1e-6
    for i in range(len(theta)):
        ahead, behind = (theta.index_add(0, torch.tensor([i]), theta.new_tensor([d])) for d in (eps, -eps))
        assert float(slope[i]) == pytest.approx(float(value(ahead) - value(behind)) / (2 * eps), abs=1e-9)


def test_the_equation_gives_each_number_its_own_deviation():
    # fails if deviations are read at the places that numbers have in a model without absent ones
    model = two_bodies()
    numbers = ParameterVector(model).numbers
    deviations = torch.arange(1.0, len(numbers) + 1, dtype=torch.float64)
    data = Trajectories.of(torch.arange(3.0), torch.zeros(3, 2), (3,), names=("a", "b"))
    joint = Joint(deviations.square().diag(), deviations, deviations.square().reciprocal().diag())
    terms = equation_of(SimpleNamespace(model=model, data=data), joint).terms  # pyright: ignore
    found = {(term.left.split()[-1], term.what): term.deviation for term in terms}
    of = dict(zip(numbers, deviations.tolist(), strict=True))
    mass = 2 * of["kinetic.log_diagonal"]  # of ln m, which both are over
    assert found[("b″", "b")] == pytest.approx(math.hypot(of["potential.stiffness[1]"], 5 * mass))
    assert found[("b″", "")] == pytest.approx(math.hypot(of["potential.tilt[1]"], mass))
    assert ("a″", "a") not in found
    # fails if a mass that cancels in the rate of b, over which it is, asks for twenty digits: its slope is rounding
    with torch.no_grad():
        model.get_parameter("kinetic.log_diagonal").fill_(0.37)
        model.get_parameter("damping.rate").fill_(0.0799)
    terms = equation_of(SimpleNamespace(model=model, data=data), joint).terms  # pyright: ignore
    (own,) = [term for term in terms if (term.left, term.what) == ("b″", "b′")]
    assert own.alone == pytest.approx(of["damping.rate"])


def test_the_message_on_a_misspelt_number_names_no_weights():
    # fails if a misspelt name changes nothing, or the message lists the hundreds of weights of a network
    config = replace(two_bodies(()).config, potential_width=16)
    with pytest.raises(InputError, match=r"no number 'tilt'; its numbers are .*stiffness\[1\]") as caught:
        ContactLagrangian(replace(config, absent=("tilt",)))
    assert "weights" not in str(caught.value)


def test_numbers_that_were_not_learned_have_no_uncertainty():
    # fails if `herglotz trust` reports a spring that was left out as one that is known to be 0 ± 0
    model = two_bodies()
    vector = ParameterVector(model)
    spread = {name: torch.ones_like(p) for name, p in model.named_parameters()}
    posterior = SimpleNamespace(problem=SimpleNamespace(parameters=vector), standard_deviations=lambda: spread)
    data = Trajectories.of(torch.arange(3.0), torch.zeros(3, 2), (3,), names=("a", "b"))
    found = quantities(posterior, SimpleNamespace(model=model, data=data))  # pyright: ignore
    assert [x.words for x in found if x.name == "potential.stiffness"] == ["the stiffness at q = 0 of b"]
    assert [x.words for x in found if x.name == "friction.viscous"] == ["viscous friction of a"]
    assert all(x.std == 1.0 for x in found if not x.name.startswith("kinetic"))


def test_what_is_stored_as_a_logarithm_is_told_as_what_it_is():
    # fails if an engineer is told the logarithm of a mass or of a speed, or a spread that is not theirs
    model: Any = two_bodies()
    with torch.no_grad():
        model.kinetic.log_diagonal.fill_(0.5 * math.log(3.0))
    spread = {name: 0.01 * torch.ones_like(p) for name, p in model.named_parameters()}
    parameters = SimpleNamespace(parameters=ParameterVector(model))
    posterior = SimpleNamespace(problem=parameters, standard_deviations=lambda: spread)
    data = Trajectories.of(torch.arange(3.0), torch.zeros(3, 2), (3,), names=("a", "b"), units=("m", "mm"))
    (mass,) = (x for x in quantities(posterior, SimpleNamespace(model=model, data=data)) if "kinetic" in x.name)  # pyright: ignore
    assert (mass.words, mass.unit) == ("the mass of b, over that of a", "m²/mm²")
    assert (mass.value, mass.std) == (pytest.approx(3.0), pytest.approx(0.06))


def test_a_width_of_dry_friction_is_the_one_of_the_equation():
    # fails if `herglotz trust` leaves the sharpest width out, and tells 0.002 rad/s where the equation has 0.0098
    model: Any = ContactLagrangian(replace(two_bodies().config, coulomb=True))
    spread = {name: torch.ones_like(p) for name, p in model.named_parameters()}
    parameters = SimpleNamespace(parameters=ParameterVector(model))
    posterior = SimpleNamespace(problem=parameters, standard_deviations=lambda: spread)
    data = Trajectories.of(torch.arange(3.0), torch.zeros(3, 2), (3,), names=("a", "b"))
    found = quantities(posterior, SimpleNamespace(model=model, data=data))  # pyright: ignore
    for name, widths in zip(("smooth", "stribeck"), model.friction.widths, strict=True):
        assert [x.value for x in found if x.name == f"friction.log_{name}"] == pytest.approx(widths.tolist())


@pytest.mark.parametrize("order", [2, 4])
def test_a_number_has_one_name_at_both_orders(order):
    # fails if a tilt of order 4, the second feature of its coordinate, is taken for the spring, the first one
    settings = {"angles": (True, False), "scale": (1.0, 1.0), "speed": (1.0, 1.0), "potential_width": 0}
    config = ModelConfig(**settings, stiffness=(4.0, 5.0), tilt=(6.0, 7.0), order=order, absent=("potential.tilt[0]",))
    model, q = ContactLagrangian(config), torch.tensor([0.0, 0.0], dtype=torch.float64)
    slope = model.potential(q, 1).gradient  # k sin 0 + b cos 0, and k 0 + b
    assert slope.tolist() == [0.0, 7.0]


def test_absent_numbers_are_among_the_terms_too_small_to_be_seen():
    # fails if the verdict is told nothing of a spring that data say little about
    t = torch.arange(0.0, 20.0, 0.1, dtype=torch.float64)
    data = Trajectories.of(t, torch.stack([t.sin(), (1.3 * t).cos()], 1))
    _, _, hidden = without_and_with(data, NamedTerms(absent=("potential.tilt[0]",)))
    assert len(hidden["potential.tilt[0]"]) == 1


def test_what_pushes_one_way_leaves_friction_to_be_seen():
    # fails if the load, no candidate of a joint that turns one way, ends all search for terms that are too small
    t = torch.arange(0.0, 20.0, 0.1, dtype=torch.float64)
    data = Trajectories.of(t, (3 * t + 0.1 * t.sin())[:, None], angles=(True,))
    model, _, hidden = without_and_with(data, NamedTerms(("cos(q1)", "sin(q1)"), ("load 1",)))
    assert "friction.coulomb" in hidden
    assert "load 1" not in hidden
    assert "load 1" in model.config.drag


def without_and_with(data, terms):
    """A model of these terms alone, then with all that it lacks."""
    config = settings_of(terms, data, FitConfig(), 2, 1)
    base = estimate_baseline(data)
    model = build_model(base, config, "none")
    return _with_absent_terms(Task(data, base, config, Stages(False, None, "", resume=False)), model)
