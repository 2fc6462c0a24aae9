"""The identities of a contact integrator on random models and on every scene."""

import pytest
import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene, scene_names
from herglotz.stepping import State
from herglotz.verify import verify
from herglotz.verify.subject import subject
from tests.lagrangians import randomise


def random_model(n, level, seed, correction=8):
    """A model whose every parameter, zero-initialised ones included, is random; mixed angles and lengths."""
    ones = (1.0,) * n
    angles = tuple(i % 2 == 0 for i in range(n))
    config = ModelConfig(angles, level, ones, ones, ones, (0.0,) * n, correction_width=correction, seed=seed)
    model = ContactLagrangian(config)
    make = randomise(model, 0.2, seed)
    x = torch.randn(32, 2 * n + 1, generator=make, dtype=torch.float64)
    return model, State(x[:, :n], x[:, n : 2 * n], x[:, -1])


SLOW = pytest.mark.slow  # every n and both levels are tested always; the slow suite has all pairs


@pytest.mark.parametrize(
    ("level", "n"),
    [("affine", 1), ("linear", 2), ("affine", 3),
     *(pytest.param(*x, marks=SLOW) for x in (("linear", 1), ("affine", 2), ("linear", 3)))],
)  # fmt: skip
def test_random_models_are_contact_integrators(level, n):
    # fails if any closed-form derivative, FL⁻, FL⁺, c or the step's own derivative is wrong
    report = verify(random_model(n, level, seed=n), h=0.1, steps=4)
    assert report.passed, report.table()
    assert report["contact"].value <= 1e-12
    for name in ("volume", "momentum", "D1S", "D2S", "D3S", "hamilton_jacobi"):
        assert report[name].value <= 1e-11, report.table()


@pytest.mark.parametrize("h", [0.02, 0.5])
def test_the_identities_hold_at_any_step(h):
    # fails if a term scales with h in its value and not in its derivative
    report = verify(random_model(1, "affine", seed=5), h=h, steps=4)
    assert report.passed, report.table()


def test_float32_has_its_own_bounds():
    # fails if a float32 model is held to float64 bounds, or if its bounds let anything pass
    model, states = random_model(2, "affine", seed=2)
    report = verify((model.float(), State(*(x.float() for x in states))), h=0.1, steps=4)
    assert report.passed, report.table()
    assert 1e-10 < report["contact"].value < report["contact"].bound == 5e-4


@pytest.mark.parametrize("name", scene_names())
def test_every_scene_verifies(name):
    # fails if a scene's L_d, its closed-form derivatives or its closed-form flow is wrong
    report = verify(name)
    assert report.passed, report.table()


# A rule takes any L, so a fault of a rule or of a scene shows in a fifth of the pairs, every rule and every scene among
# them; the slow suite has all.
PAIRS = [
    ((i + j) % 5, name, rule) for i, name in enumerate(scene_names()) for j, rule in enumerate(scene(name).L_d_rules)
]
RULES = [pytest.param(name, rule, marks=pytest.mark.slow if share else ()) for share, name, rule in PAIRS]


@pytest.mark.parametrize("part", [1, 2], ids=["scene", "rule"])
def test_every_scene_and_every_rule_has_a_pair(part):
    # fails if a scene or a rule joins whose pairs are all in the slow suite
    assert {pair[part] for pair in PAIRS if pair[0] == 0} == {pair[part] for pair in PAIRS}


@pytest.mark.parametrize(("name", "rule"), RULES)
def test_every_rule_of_every_scene_verifies(name, rule):
    # fails if a rule's value is not differentiable as its derivatives say (the implicit midpoint above all)
    system = scene(name)
    states = subject(system, None, 8, 0).states
    report = verify((system.L_d_rules[rule], states), h=system.h / 2, steps=2)
    assert report.passed, report.table()
