"""Powers of s in L by name: flows in closed form, the weight of forces beside them, and the work of inputs."""

from typing import Any

import pytest
import torch
from torch.func import jacrev, vmap

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.action import ActionPowers, power_increment
from herglotz.models.jet import Jet
from herglotz.stepping import Stepper
from herglotz.training import FitConfig
from tests import runge_kutta

GAMMA, BETA, DELTA = 0.2, 0.15, 0.05


@pytest.mark.parametrize("power", [2, 3])
def test_a_power_is_an_exact_flow(power):
    # fails if s (1 + y)^(−1/(p − 1)) − s or one of its derivatives is wrong, or cancels for small s
    x = torch.tensor([-1.3, -1e-9, 0.0, 0.4, 2.0], dtype=torch.float64)
    for a in (0.3, -0.1, 1e-12):
        a = torch.tensor(a, dtype=torch.float64)
        found = power_increment(Jet(torch.stack([x, torch.ones_like(x), torch.zeros_like(x)]), 1, 2), power, a)
        flow = lambda x, a=a: x * (1 + (power - 1) * a * x ** (power - 1)) ** (-1 / (power - 1)) - x  # noqa: E731
        wanted = [flow(x), vmap(jacrev(flow))(x), vmap(jacrev(jacrev(flow)))(x)]
        torch.testing.assert_close(found.data, torch.stack(wanted), rtol=1e-9, atol=1e-14)
        # at 1e-9 the wanted difference is rounded off; the flow loses as much as the rate says
        assert float(found.value[1]) == pytest.approx(-float(a) * float(x[1]) ** power, rel=1e-6, abs=1e-300)


@pytest.mark.parametrize(("power", "s"), [("s^2", -30.0), ("s^3", 30.0)])
def test_a_flow_that_leaves_the_reals_is_no_step(power, s):
    # fails if s comes back from infinity with the other sign, as s / (1 + y) has it
    model = ContactLagrangian(ModelConfig(level="full", dissipation=(power,), potential_width=0, rate=0.0))
    with torch.no_grad():
        assert isinstance(model.action, ActionPowers)
        model.action.coefficient.fill_(0.5 if power == "s^2" else -0.5)
        q = torch.full((1, 1), 0.1, dtype=torch.float64)
        run = Stepper(model).rollout(q, q, torch.tensor([s], dtype=torch.float64), h=0.2, steps=3)
    assert not bool(run.ok.any())


def driven() -> Any:
    """A spring with damping by s, viscous friction as a force, and an input."""
    config = ModelConfig(
        angles=(False,), level="forced", dissipation=("s^2", "s^3"), inputs=1, input_zero=True, potential_width=0,
        stiffness=(1.3,), tilt=(0.1,), rate=GAMMA, drag=("q1^2 v1",),
    )  # fmt: skip
    model: Any = ContactLagrangian(config)
    with torch.no_grad():
        model.action.coefficient.copy_(torch.tensor([BETA, DELTA]))
        model.friction.input_map.fill_(0.7)
        model.friction.input_zero.fill_(0.2)
        model.friction.viscous.fill_(0.1)
        model.drag.coefficient.fill_(0.3)
    return model


def test_the_motion_is_that_of_the_equation():
    # fails if inputs do no work in s, if friction does, or if the damping is not γ + 2β s + 3δ s²
    model, u = driven(), 0.9
    force = 0.7 * (u - 0.2)

    def rate(x):
        q, v, s = x.unbind(-1)
        a = -1.3 * q - 0.1 + force - (GAMMA + 2 * BETA * s + 3 * DELTA * s**2) * v - (0.1 + 0.3 * q**2) * v
        return torch.stack([v, a, v * v / 2 - 0.65 * q * q - 0.1 * q + force * q - GAMMA * s - BETA * s**2
                            - DELTA * s**3], -1)  # fmt: skip

    exact = x = torch.tensor([[0.6, -0.4, 0.3]], dtype=torch.float64)
    for _ in range(1000):
        exact = runge_kutta.step(rate, exact, 1e-3)
    errors = []
    for steps in (50, 100):
        inputs = torch.full((1, steps, 1), u, dtype=torch.float64)
        with torch.no_grad():
            end = Stepper(model).rollout(x[:, :1], x[:, 1:2], x[:, 2], h=1 / steps, steps=steps, inputs=inputs)
        errors.append(float((end.states.joined[0, -1] - exact[0]).norm()))
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)


def test_derivatives_of_the_forces_are_those_of_their_values():
    # fails if (1 + D3) F⁻ has a derivative left out, the one by s among them
    model, make = driven(), torch.Generator().manual_seed(0)
    q0, q1, s = (torch.randn(4, n, generator=make, dtype=torch.float64) for n in (1, 1, 1))
    h, u = torch.full((4,), 0.2, dtype=torch.float64), torch.full((4, 1), 0.5, dtype=torch.float64)

    def own(q0, q1, s, h, u):
        found = model.forces(q0[None], q1[None], s, h[None], u[None])
        assert found is not None
        return torch.stack(found)[:, 0]

    by = vmap(jacrev(own, (0, 1, 2)), (0, 0, 0, 0, 0))(q0, q1, s, h, u)
    found = model.partials(q0, q1, s[:, 0], h, 2, u).force
    for name, value in zip(("1", "2", "3"), by, strict=True):
        for k, end in enumerate(("minus", "plus")):
            own_value = getattr(found, f"{end}_{name}").reshape(4)
            torch.testing.assert_close(own_value, value[:, k].reshape(4), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"level": "full", "dissipation": ("s^4",)}, "s\\^2, s\\^3; got s\\^4"),
        ({"level": "linear", "dissipation": ("s^2",)}, "not 'linear'"),
        ({"level": "forced", "dissipation": ("s^2",), "coulomb": True, "sticking": True}, "leave sticking"),
        ({"level": "full", "dissipation": ("s^2",), "order": 4, "potential_width": 0}, "order 4"),
        ({"level": "full", "dissipation": ("s^2",), "baseline": False, "correction_width": 3}, "no powers of s"),
    ],
)
def test_what_no_model_has_is_refused(settings, words):
    # fails if a setting that nothing reads is taken without a word
    with pytest.raises(InputError, match=words):
        ModelConfig(**settings)
    if settings.get("sticking") or settings["level"] == "linear":  # before any data are read
        with pytest.raises(InputError, match=words):
            FitConfig(**settings)


@pytest.mark.parametrize("settings", [{}, {"dissipation": ("s^2",)}])
def test_inputs_of_a_model_without_inputs_do_nothing(settings):
    # fails if the full level, which has none, meets what it is given with an assertion: the other levels leave it out
    model = ContactLagrangian(ModelConfig(level="full", **settings))
    x = torch.ones(2, 1, dtype=torch.float64)
    given, without = (model.partials(x, 1.1 * x, x[:, 0], 0.1, 1, u) for u in (x, None))
    torch.testing.assert_close(given.D1, without.D1)
