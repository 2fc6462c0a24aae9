"""The explicit step: the same step as Newton's, without an iteration."""

from dataclasses import replace

import pytest
import torch

from herglotz.models import TERMS, ModelConfig, Term
from herglotz.stepping import Status, Stepper
from herglotz.stepping.explicit import FieldOf, leapfrog
from tests.lagrangians import random_model, states_in_turn


def config_of(angles, **settings):
    """A model whose sizes differ between coordinates."""
    sizes = {"scale": (2.0, 1.0, 0.5), "speed": (1.0, 1.5, 2.0), "stiffness": (1.0, 2.0, 0.5), "tilt": (0.1, 0.0, 0.3)}
    return ModelConfig(angles=angles, **{name: x[: len(angles)] for name, x in sizes.items()}, **settings)


SETTINGS = {
    "pendulum": ModelConfig(),
    "conservative": ModelConfig(level="conservative"),
    "no network": ModelConfig(potential_width=0),
    "mixed coordinates": config_of((False, True, False), potential_depth=2, activation="silu"),
    "two angles": config_of((True, True), activation="softplus"),
    "viscous joints and a motor": config_of((True, False), level="forced", inputs=1),
    "features and a term by name": config_of((True, False), features=("cos(2 q1)", "q2^3")),
}


class Quartic(Term):
    """V = q₂⁴ / 2."""

    def potential(self, q):
        x = q.select(1)
        return x * x * x * x * 0.5


def states(config, batch=5, dtype=torch.float64):
    return states_in_turn(config.dof, batch, 4, dtype)


@pytest.fixture(params=SETTINGS, ids=lambda name: name.replace(" ", "_"))
def config(request, monkeypatch):
    if "term by name" not in request.param:
        return SETTINGS[request.param]
    monkeypatch.setitem(TERMS, "quartic", Quartic)
    return replace(SETTINGS[request.param], terms=("quartic",))


def test_it_equals_the_newton_step(config):
    # fails if a term of the closed form is missing, or c, √c and the friction enter in another place
    model, start = random_model(config), states(config)
    h = torch.tensor([0.05, 0.1, 0.2, 0.3, 0.15], dtype=torch.float64)
    u = torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None] if config.inputs else None
    assert leapfrog(model) is not None
    explicit, newton = (Stepper(model, explicit=on).step(start, h, u=u) for on in (True, False))
    for a, b in zip((*explicit.state, explicit.c), (*newton.state, newton.c), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)
    assert explicit.iterations == 1


def test_the_change_of_momentum(config):
    # fails if friction enters p1 and p1 − p0, which float32 sums, with another sign
    model, start = random_model(config), states(config)
    frog = leapfrog(model)
    assert frog is not None
    u = torch.ones(5, 1, dtype=torch.float64) if config.inputs else None
    move = frog(start, torch.tensor(0.1, dtype=torch.float64), u=u, increments=True)
    torch.testing.assert_close(move.dp, move.p1 - start.p, rtol=0, atol=1e-14)


def test_a_rollout_reuses_the_force_of_the_last_step(config):
    # fails if the kept field belongs to another position, or a segment starts with a stale field
    model, start = random_model(config), states(config)
    inputs = torch.linspace(-1, 1, 12, dtype=torch.float64)[:, None] if config.inputs else None
    with torch.no_grad():
        out = Stepper(model).rollout(*start, h=0.1, steps=12, inputs=inputs, chunk=5)
        newton = Stepper(model, explicit=False).rollout(*start, h=0.1, steps=12, inputs=inputs)
    torch.testing.assert_close((out.q, out.p, out.s), (newton.q, newton.p, newton.s), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(out.sigma, newton.sigma, rtol=1e-13, atol=1e-13)


def test_an_event_leaves_the_kept_force_of_its_neighbours_alone():
    # fails if a step that is tried for the time of an event leaves its field for the next step
    model, start = random_model(ModelConfig()), states(ModelConfig())
    wall = float(start.q.max()) + 0.1
    with torch.no_grad():
        out, newton = (
            Stepper(model, explicit=on).rollout(*start, h=0.2, steps=15, events=[lambda x: x.q[..., 0] - wall])
            for on in (True, False)
        )
    stopped = (out.status == Status.STOPPED).any(-1)
    assert bool(stopped.any())
    assert not bool(stopped.all())
    torch.testing.assert_close((out.q, out.p, out.s), (newton.q, newton.p, newton.s), rtol=1e-11, atol=1e-11)


def test_one_potential_evaluation_per_step(monkeypatch):
    # fails if the force at q1 is computed again as the force at the next q0
    model, count = random_model(ModelConfig()), []
    plain = FieldOf.__call__
    monkeypatch.setattr(FieldOf, "__call__", lambda self, q: count.append(1) or plain(self, q))
    Stepper(model).rollout(*states(ModelConfig()), h=0.1, steps=30)
    assert len(count) == 31


def test_the_field_equals_its_jet_twin(config):
    # fails if the reverse sweep differs from the jets of the model in value or slope
    # Far from 0, where softplus has no shortcut.
    model, q = random_model(config), 20 * states(config).q
    V, slope = FieldOf(model.potential)(q)
    twin = model.potential(q, 1)
    torch.testing.assert_close(V, twin.value, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(slope, twin.gradient.movedim(0, -1), rtol=1e-13, atol=1e-13)


def test_gradients_equal_those_of_the_implicit_step(config):
    # fails if a parameter, the state or h is cut off from the explicit step
    model, start = random_model(config), states(config)
    weight = torch.linspace(1, 2, 5, dtype=torch.float64)

    def gradients(explicit):
        leaves = [x.clone().requires_grad_() for x in (*start, torch.tensor(0.2, dtype=torch.float64))]
        out = Stepper(model, explicit=explicit).rollout(*leaves[:3], h=leaves[3], steps=4)
        value = (weight * (out.q[:, -1].sum(-1) + out.p[:, -1].sum(-1) + out.s[:, -1])).sum()
        return torch.autograd.grad(value, [*leaves, *model.parameters()], allow_unused=True, materialize_grads=True)

    for a, b in zip(gradients(True), gradients(False), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)
