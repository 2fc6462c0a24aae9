"""Translations that a model has by construction, at every weight of its networks."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.export import compile_c
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.translations import directions, unchanged
from herglotz.stepping import State, Stepper
from herglotz.theory import symmetries
from herglotz.training.named_terms import candidates
from tests.compilers import needs_compiler
from tests.lagrangians import random_model

F64 = torch.float64


def config(**settings):
    n = len(settings.setdefault("angles", (False, False)))
    sizes = {"scale": (1.3, 0.7, 2.0)[:n], "speed": (0.9,) * n, "stiffness": (0.4,) * n, "tilt": (0.2,) * n}
    return ModelConfig(**{**sizes, **settings})


def model(**settings):
    return random_model(config(**settings), spread=0.2, seed=0).requires_grad_(False)


def states(n):
    make = torch.Generator().manual_seed(1)
    q, p = (torch.randn(24, n, generator=make, dtype=F64) for _ in range(2))
    return State(q, p, torch.zeros(24, dtype=F64))


FOURTH = {"level": "linear", "order": 4, "potential_width": 0}
CASES = {  # what is imposed, and what is found in the model: weights are random
    "q1 + q2": ({"level": "linear", "correction_width": 6}, "translation of q1 and q2 together"),
    "q1 - 0.5 q2": ({"level": "linear", "features": ("(2q2 + q1)^2",)}, "translation along (1, -0.5)"),
    "q2": ({"level": "linear", "angles": (False, True)}, "translation along q2"),
    "q1 - q2": ({"level": "linear", "potential_width": 5}, "translation along (-1, 1)"),  # steps in closed form
    "2q1 + 2q2": ({**FOURTH, "features": ("(q1 - q2)^4", "(q1 - q2)^1")}, "translation of q1 and q2 together"),
}


@pytest.mark.parametrize("text", CASES)
def test_what_is_imposed_is_found(text):
    # fails if a network sees a moved coordinate, its scale is left out, or a spring of the baseline is left (at order 4
    # it would be a feature)
    settings, expected = CASES[text]
    made = model(**settings, translations=(text,))
    angles = settings.get("angles", (False, False))
    found = symmetries(made, states(2), 0.1, steps=25, angles=angles)
    assert found.names == (expected,)
    assert float(found.drift.max()) < 1e-11
    free = symmetries(model(**{**settings, "features": ("q1^4",)}), states(2), 0.1, steps=25, angles=angles)
    assert len(free) == 0  # the same random weights without it


def test_springs_act_on_what_is_left():
    # fails if the springs of moved coordinates are thrown away (a network would have to make them), or beside features
    made = ContactLagrangian(config(level="linear", translations=("q1 + q2",), potential_width=0))
    q = torch.tensor([[1.0, -0.4]], dtype=F64)
    x = 0.7  # (q1 − q2)/2: k = 0.4 and b = 0.2 act on x and on −x
    V = made.potential(q, 1)
    assert float(V.value) == pytest.approx(0.4 * x * x)
    assert V.gradient[:, 0].tolist() == pytest.approx([0.4 * x, -0.4 * x])
    assert not [name for name, _ in made.named_parameters() if name.startswith("potential")]  # sizes of the masses
    named = ContactLagrangian(config(level="linear", translations=("q1 + q2",), features=("(q1 - q2)^2",)))
    assert float(named.potential.stiffness.abs().max()) == 0.0


def test_damping_does_not_see_it_either():
    # fails if the projection of features with velocities is another one: c depends on q̄ and v at the affine level
    made = model(level="affine", damping_width=5, translations=("q1 + q2",))
    x = states(2)
    step = Stepper(made).step(x, 0.1)
    moved = Stepper(made).step(State(x.q + 7.0, x.p, x.s), 0.1)
    torch.testing.assert_close(moved.state.q - 7.0, step.state.q, rtol=0, atol=1e-12)
    torch.testing.assert_close(moved.c, step.c, rtol=0, atol=1e-12)
    assert float(step.c.std()) > 1e-4
    other = Stepper(made).step(State(x.q + torch.tensor([1.0, 0.0], dtype=F64), x.p, x.s), 0.1)
    assert float((other.c - step.c).abs().max()) > 1e-4  # the relative position is seen


@pytest.mark.parametrize(
    ("translations", "some", "none"),
    [
        (("q1 + q2 + q3",), {"(q1 - q2)^1", "(q1 - q3)^2", "(q2 - q3)^4"}, "q3^2"),
        (("q1 + q2",), {"q3", "q3^2", "q3^4", "(q1 - q2)^1"}, "(q2 - q3)^2"),  # its spring to the wall stays
        (("q1 - 0.5 q2",), {"(0.5q1 + q2)^1", "(0.5q1 + q2)^4", "q3^2"}, "(q1 - q2)^2"),
        (("2 q1 + q2", "q3"), {"(0.5q1 - q2)^3"}, "q3"),
    ],
)
def test_the_terms_that_are_searched(translations, some, none):
    # fails if a candidate sees the translation, one of what is left alone is missing, or forces spoil J = c J
    t = torch.arange(9.0, dtype=F64)
    data = Trajectories.of(t, torch.randn(9, 3, generator=torch.Generator().manual_seed(0), dtype=F64), (9,))
    every = candidates(data, translations)
    assert some <= set(every.features)
    assert none not in every.features
    assert (every.drag, every.dry, every.one_rate, every.springs) == ((), False, True, False)
    moved = directions(translations, data.angles)
    assert all(unchanged(text, data.angles, moved) for text in every.features)
    assert not unchanged("r^-1", data.angles, moved)
    # The lever arm of the wave moves.
    assert not unchanged("q1 cos(q2)", (False, True), [(1.0, 0.0)])
    assert every.only(("q3^2",)).springs is False  # fails if a pruned model gets its springs back


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"translations": ("q1 q2",)}, "translation 'q1 q2': cannot read the linear form"),
        ({"translations": ("q1 - q1",)}, "is no direction; name what moves together"),
        ({"translations": ("q1 + q2",), "angles": (True, False)}, "an angle is translated alone"),
        ({"translations": ("q1 + q2",), "features": ("r^-1",)}, "changes under the translation"),
        ({"translations": ("q1 + q2", "q1 - q2"), "features": ("(q1 - q2)^2",)}, "changes under the translation"),
        ({"translations": ("q1",), "known": ("q1^2",)}, "feature 'q1\\^2': changes under the translation"),
        ({"translations": ("q1",), "mass_width": 3}, "not possible with a mass that depends on position"),
        ({"translations": ("q1",), "level": "full"}, "not possible with the level full"),
        ({"translations": ("q1",), "level": "forced", "drag": ("q1^2 v1",)}, "drag that depends on position"),
        ({"translations": ("q1",), **FOURTH}, "order 4 with translations needs features of the position"),
        ({"translations": ("q1",), **FOURTH, "features": ("q1^4",)}, "changes under the translation"),
    ],
)
def test_what_would_see_a_translation_is_refused(settings, message):
    # fails if a part of the model breaks what the user asked for, in silence
    with pytest.raises(InputError, match=message):
        config(**settings)


@needs_compiler
def test_translations_hold_in_c():
    # fails if a traced network reads features without the projection
    made, x = model(level="linear", correction_width=5, translations=("q1 + q2",)), states(2)
    expected = Stepper(made).rollout(*x, h=0.1, steps=20)
    out = compile_c(made, h=0.1).rollout(*x, h=0.1, steps=20)
    torch.testing.assert_close(out.q, expected.q, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(out.p, expected.p, rtol=1e-11, atol=1e-11)


def test_rotation_is_imposed_by_features_of_the_distance():
    # fails if `alike` leaves a mass or a spring that tells one direction from another: what docs/theory.md says
    zero = (0.0, 0.0)
    settings = config(level="linear", features=("central",), alike=True, potential_width=0)
    made = ContactLagrangian(replace(settings, stiffness=zero, tilt=zero))  # as a fit builds it
    with torch.no_grad():
        made.get_parameter("potential.features.sum.coefficient").copy_(torch.tensor([0.1, -0.2, -0.5, 0.1, 0.1, 0.1]))
    q, p, s = states(2)
    q = 1.5 * q / q.norm(dim=-1, keepdim=True)
    found = symmetries(made.requires_grad_(False), (q, 0.3 * p, s), 0.1, steps=25)
    assert found.names == ("rotation in the plane (q1, q2)",)
