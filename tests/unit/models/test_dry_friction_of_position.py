"""Dry friction that depends on the position or the direction: the law, its derivative, and that a fit finds it."""

import math
from typing import Any

import numpy as np
import pytest
import torch

import herglotz as hz
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Status, Stepper

H = 0.05


def body(drag, coefficients, *, coulomb=1.0, angle=False, sticking=True, inputs=0, rate=0.0):
    """A unit mass without a potential, and with this friction."""
    model: Any = ContactLagrangian(
        ModelConfig(
            angles=(angle,), stiffness=(0.0,), rate=rate, level="forced", coulomb=True, sticking=sticking, drag=drag,
            inputs=inputs, input_map=(1.0,) * inputs, potential_width=0,
        )
    )  # fmt: skip
    with torch.no_grad():
        model.friction.coulomb.fill_(coulomb)
        if drag:
            model.drag.coefficient.copy_(torch.tensor(coefficients, dtype=torch.float64))
    return model


def numbers(*values):
    return torch.tensor([values], dtype=torch.float64)


def step(model, q, p, u=None):
    state = State(numbers(q), numbers(p), torch.zeros(1, dtype=torch.float64))
    return Stepper(model).step(state, H, **({} if u is None else {"u": numbers(u)}))


@pytest.mark.parametrize(
    ("drag", "coefficient", "angle", "law"),
    [("q1^2 sgn(v1)", 3.0, False, lambda q: 1 + 3 * q * q), ("q1 sgn(v1)", -0.8, False, lambda q: 1 - 0.8 * q),
     ("cos(q1) sgn(v1)", 0.6, True, lambda q: 1 + 0.6 * math.cos(q)),
     ("sin(q1) sgn(v1)", 0.6, True, lambda q: 1 + 0.6 * math.sin(q))],
)  # fmt: skip
@pytest.mark.parametrize("q", [-0.9, 0.3, 1.1])
def test_a_body_slides_and_sticks_by_the_force_at_its_place(drag, coefficient, angle, law, q):
    # fails if the force is taken at another place, its sign is wrong, or it has no part in what holds a joint
    force, model = law(q), body((drag,), [coefficient], angle=angle, inputs=1)
    for way in (-1.0, 1.0):
        slides = step(model, q, 2.0 * way, 0.0)
        assert slides.status.item() == Status.CONVERGED
        # p1 = p0 − h F sgn(v), of which Moreau's step has the whole impulse before the motion
        assert slides.state.p.item() == pytest.approx(way * (2.0 - H * force), rel=1e-12)
        assert slides.state.q.item() == pytest.approx(q + H * way * (2.0 - H * force), rel=1e-12)
        held = step(model, q, 0.0, 0.999 * way * 2 * force)  # half of an input acts at each end of a step
        assert held.state.q.item() == q
        assert step(model, q, 0.0, 1.001 * way * 2 * force).state.q.item() != q


def test_friction_that_would_push_is_none():
    # fails if a coefficient below 0 lets friction create energy
    slides = step(body(("q1^2 sgn(v1)",), [-3.0]), 1.0, 2.0)
    assert slides.state.p.item() == pytest.approx(2.0, rel=1e-14)
    assert step(body(("q1^2 sgn(v1)",), [-3.0]), 1.0, 0.0).state.q.item() == 1.0


@pytest.mark.parametrize("sticking", [True, False])
def test_the_derivative_of_a_step_knows_the_place(sticking):
    # fails if ∂F⁻/∂q0 leaves out how friction changes with the position: the map is then not the one that is stepped
    model = body(("q1^2 sgn(v1)", "|v1| v1"), [0.7, 0.1], sticking=sticking, rate=0.2)
    x = torch.tensor([0.8, 1.3, 0.0], dtype=torch.float64)

    def stepped(x):
        return Stepper(model).step(State(x[:1], x[1:2], x[2]), H).state

    def flat(state):
        return torch.cat([state.q, state.p, state.s[None]])

    eps = 1e-6
    rows = [(flat(stepped(x + eps * e)) - flat(stepped(x - eps * e))) / (2 * eps) for e in torch.eye(3, dtype=x.dtype)]
    D = Stepper(model).linearise(State(x[:1], x[1:2], x[2]), H)
    assert torch.allclose(D.by_state.detach(), torch.stack(rows, 1).detach(), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("coefficient", [0.7, -3.0])
def test_the_closed_form_of_a_slide_knows_the_place(coefficient):
    # fails if ∂F⁻/∂q0 of set-valued friction has another sign or size than F⁻, or a slope where friction is 0
    model = body(("q1^2 sgn(v1)",), [coefficient], rate=0.2)
    q1, s0, h = numbers(0.95), torch.zeros(1, dtype=torch.float64), torch.full((1,), H, dtype=torch.float64)
    P = model.partials(numbers(0.8), q1, s0, h, 2)
    by_q0 = torch.func.jacrev(lambda q0: model.partials(q0, q1, s0, h, 1).force.minus)(numbers(0.8))
    assert torch.allclose(P.force.minus_1.reshape(()), by_q0.reshape(()), rtol=1e-12, atol=1e-14)


def test_friction_by_direction_is_friction_and_a_constant_force():
    # fails if a constant force does not shift what holds a joint: τ + a brakes one way, τ − a the other
    tau, a = 1.0, 0.3
    model = body(("load 1",), [a], coulomb=tau, inputs=1)  # −a, both ways
    for way, force in ((1.0, tau + a), (-1.0, tau - a)):
        p = step(model, 0.2, 2.0 * way, 0.0).state.p.item()
        assert p == pytest.approx(way * (2.0 - H * force), rel=1e-12)
        # a force that starts from rest holds through its first half: Moreau's impulse is whole, an input's is not
        assert step(model, 0.0, 0.0, way * 0.99 * force).state.q.item() == 0.0
        assert step(model, 0.0, 0.0, way * (2 * tau + a * way) * 1.001).state.q.item() != 0.0


def test_dry_terms_need_dry_friction():
    # fails if a model steps without the width or the hold of its friction
    with pytest.raises(InputError, match="set coulomb=True"):
        ModelConfig(angles=(False,), level="forced", drag=("q1^2 sgn(v1)",))


def test_dry_terms_bring_dry_friction():
    # fails if a user has to name dry friction twice
    data = hz.simulate("damped_oscillator", trajectories=1, steps=30, h=0.1)
    assert hz.FitConfig(level="forced", drag=("q1^2 sgn(v1)",)).resolved(data).coulomb
    assert not hz.FitConfig(level="forced", drag=("q1^2 v1",)).resolved(data).coulomb


def recorded(seed):
    """A driven axis whose friction is twice as strong at its ends: 1 + q² (unit mass), integrated in fine steps."""
    rng = np.random.default_rng(seed)
    fine, steps, parts = 0.001, 300, 40
    q, v, rows = 0.0, 0.0, []
    for k in range(steps):
        t = k * fine * parts
        u = 3.0 * math.sin(2.1 * t) + 1.5 * math.sin(0.7 * t + 1.0)
        rows.append((t, q, u))
        for _ in range(parts):
            free, grip = v + fine * (u - 0.4 * v), fine * (1.0 + q * q)
            v = math.copysign(max(abs(free) - grip, 0.0), free)
            q += fine * v
    t, q, u = np.array(rows).T
    return t, q + 1e-4 * rng.standard_normal(len(q)), u


def test_a_fit_finds_friction_that_grows_to_the_ends():
    # fails if the coefficient has no slope in the fit, or the equation does not name it. At seeds 0 to 4 it was 1.02 to
    # 1.12 (the truth is 1; viscous friction and Stribeck's excess make up for it), the free run 0.9 to 1.2 of the noise
    t, q, u = recorded(0)
    run: Any = hz.fit(
        {"t[s]": t, "x[m]": q, "u": u}, level="forced", sticking=True, drag=("q1^2 sgn(v1)",),
        objective="trajectory", potential_width=0, progress=False,
    )  # fmt: skip
    assert run.model.drag.coefficient.item() == pytest.approx(1.1, abs=0.2)
    assert run.metrics["extrapolation_rms"] < 2e-4
    assert "x² sgn(x′)" in str(run.equation())
