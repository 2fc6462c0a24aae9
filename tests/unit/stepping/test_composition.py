"""Compositions and the contact splitting: measured orders, the contact property, failures."""

import math

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import contact_defect, flow_derivative
from herglotz.scenes import damped_pendulum, left, midpoint, midpoint_heun, reference_flow, right, scene
from herglotz.stepping import Composition, State, Status, Stepper, adjoint_pair, suzuki
from herglotz.theory import ContactSplitting

GAMMA, HORIZON = 0.4, 2.0
PENDULUM = damped_pendulum(gamma=GAMMA)


def potential(q):
    return 2 * torch.sin(0.5 * q[..., 0]) ** 2


def start(batch=3):
    q = torch.tensor([[0.7], [-1.9], [2.3]], dtype=torch.float64)
    p = torch.tensor([[0.9], [0.4], [-1.1]], dtype=torch.float64)
    return State(q[:batch], p[:batch], torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)[:batch])


def slopes(stepper, counts, expected=None):
    """Orders of q, p and s at the horizon from one halving of the step."""
    expected = PENDULUM.flow(*start(), HORIZON) if expected is None else expected
    errors = []
    for count in counts:
        with torch.no_grad():
            end = stepper.rollout(*start(), h=HORIZON / count, steps=count).final
        errors.append([float((a - b).abs().max()) for a, b in zip(end, expected, strict=True)])
    return [math.log2(a / b) for a, b in zip(*errors, strict=True)]


def claim_holds(measured, order):
    return all(-0.25 < slope - order < 0.75 for slope in measured)


L = PENDULUM.lagrangian
STRANG = ContactSplitting(potential, 1.0, GAMMA, lambda q: -torch.sin(q))
PAIR = adjoint_pair(left(L), right(L))
METHODS = {
    "strang": (STRANG, 2, (20, 40)),
    "left-right": (PAIR, 2, (10, 20)),
    "suzuki4-strang": (suzuki(STRANG), 4, (8, 16)),
    "suzuki6-strang": (suzuki(STRANG, 6), 6, (5, 10)),
    "suzuki4-midpoint": (suzuki(midpoint(L)), 4, (6, 12)),
    "suzuki4-left-right": (suzuki(PAIR), 4, (6, 12)),
}


@pytest.mark.parametrize("order", [4, 6])
def test_a_method_that_is_not_its_own_adjoint_is_warned_of(order):
    # fails if a composition claims an order that its method cannot give
    with pytest.warns(UserWarning, match="not its own adjoint: a step forth and back misses by"):
        suzuki(midpoint_heun(L), order).step(start(), 0.2)
    suzuki(midpoint(L), order).step(start(), 0.2)  # warnings are errors here
    suzuki(PAIR, order).step(start(), 0.2)


@pytest.mark.parametrize("name", METHODS)
def test_order_on_the_damped_pendulum(name):
    # fails if a fraction or its sign is off, s is not carried through negative stages, or the pair is no adjoint pair
    method, order, counts = METHODS[name]
    measured = slopes(method, counts)
    assert claim_holds(measured, order), measured
    # fails if the helper lets a claim pass that is one off
    assert not claim_holds(measured, order + 1)
    assert not claim_holds(measured, order - 1)


def test_a_method_that_is_not_its_own_adjoint_gains_one_order_only():
    # fails if the order test is blind to the odd orders: Heun's midpoint under Suzuki's fractions is of order 3, not 4
    with pytest.warns(UserWarning, match="not its own adjoint"):
        measured = slopes(suzuki(midpoint_heun(L)), (8, 16))
    assert claim_holds(measured, 3), measured
    assert not claim_holds(measured, 4)


def bernoulli(s, h):
    """The exact flow of ṡ = −f(s), f = .3s + .2s²."""
    E = torch.exp(-0.3 * h)
    below = 0.3 + 0.2 * s * (1 - E)
    return 0.3 * s * E / below, 0.09 * E / below**2


def test_nonlinear_damping():
    # fails if c is not the derivative of s ↦ ψ(s), or the second half of the damping is taken at the first half's s
    def field(q, p, s):
        rate = 0.3 + 0.4 * s
        return p, -torch.sin(q) - rate[..., None] * p, 0.5 * p[..., 0] ** 2 - potential(q) - 0.3 * s - 0.2 * s**2

    splitting = ContactSplitting(potential, 1.0, bernoulli)  # its force by autograd
    expected = reference_flow(field, *start(), HORIZON)
    assert claim_holds(slopes(splitting, (20, 40), expected), 2)
    assert claim_holds(slopes(suzuki(splitting), (8, 16), expected), 4)


@pytest.mark.parametrize(
    "splitting", [STRANG, ContactSplitting(potential, 1.3, bernoulli)], ids=["linear", "bernoulli"]
)
def test_splitting_is_the_step_of_its_lagrangian(splitting):
    # fails if L_d belongs to another arrangement of the three flows
    explicit, implicit = splitting.step(start(), 0.3), Stepper(splitting.L_d).step(start(), 0.3)
    for a, b in zip((*explicit.state, explicit.c), (*implicit.state, implicit.c), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-13)


def test_splitting_has_the_rule_of_the_scenes():
    # fails if `strang` among the scenes' rules is another method than the explicit stepper
    for system in (PENDULUM, scene("damped_oscillator", m=1.7, omega0=1.3, gamma=0.6)):
        m, w = system.parameters.get("m", 1.0), system.parameters.get("omega0")
        V = potential if w is None else lambda q, k=m * w**2: 0.5 * k * (q * q).sum(-1)
        splitting = ContactSplitting(V, m, system.parameters["gamma"])
        q, p, s = start()
        h = torch.tensor(0.3, dtype=torch.float64)
        torch.testing.assert_close(splitting.L_d(q, q + p, s, h), system.L_d_rules["strang"](q, q + p, s, h))


@pytest.mark.parametrize("name", ["suzuki4-strang", "suzuki4-midpoint", "suzuki4-left-right"])
def test_compositions_are_contact_maps(name):
    # fails if c is not the product over the stages, or a stage with a negative step has a wrong derivative
    method, h = METHODS[name][0], 0.4
    (_, p1, _), D = flow_derivative(lambda q, p, s: method.step(State(q, p, s), h).state, *start())
    c = method.step(start(), h).c
    assert float(contact_defect(D, start().p, p1, c).abs().max()) < 1e-12
    assert float(contact_defect(D, start().p, p1, c * 1.001).abs().max()) > 1e-4
    if name.endswith("strang"):
        torch.testing.assert_close(c, torch.full_like(c, math.exp(-GAMMA * h)), rtol=1e-14, atol=0)


@pytest.mark.parametrize("order", [4, 6])
def test_fractions_satisfy_their_order_conditions(order):
    # fails if a fraction is off by too little for a slope to see
    assert abs(sum(fraction ** (order - 1) for _, fraction in suzuki(STRANG, order).stages)) < 1e-13


def test_composed_pair_is_two_half_steps():
    # fails if the stages run in the wrong order
    h = 0.3
    first = Stepper(left(L)).step(start(), h / 2)
    second = Stepper(right(L)).step(first.state, h / 2)
    out = PAIR.step(start(), h)
    for a, b in zip((*out.state, out.c), (*second.state, first.c * second.c), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-14)


def test_rollout_has_the_doors_of_a_stepper():
    # fails if σ is not accumulated, per-sample or per-step h is not broadcast, or float32 is promoted
    h = torch.tensor([[0.1, 0.2], [0.3, 0.1], [0.2, 0.2]], dtype=torch.float64)
    out = suzuki(STRANG).rollout(*start(), h=h)
    torch.testing.assert_close(out.sigma[:, -1], torch.exp(-GAMMA * h.sum(-1)), rtol=1e-13, atol=0)
    assert bool(out.ok.all())
    alone = suzuki(STRANG).rollout(*(x[1] for x in start()), h=h[1])
    torch.testing.assert_close(alone.q[-1], out.q[1, -1], rtol=1e-14, atol=1e-14)
    single = suzuki(STRANG).rollout(*(x.float() for x in start()), h=0.1, steps=2)
    assert single.q.dtype == single.s.dtype == torch.float32


def test_failure_in_one_sample():
    # fails if a failed stage is overwritten by the next one's status, spreads, or is not named
    state = start()
    state.q[1] = torch.inf
    out = suzuki(STRANG).step(state, 0.1)
    assert out.status.tolist() == [Status.CONVERGED, Status.DIVERGED, Status.CONVERGED]
    assert out.state.q.isnan().flatten().tolist() == [False, True, False]
    singular = Composition([(lambda q0, q1, s0, h: (q0**2 + q1**2).sum(-1) / 2 + 0 * s0 * h, 0.5), (STRANG, 0.5)])
    assert set(singular.step(start(), 0.1).status.tolist()) == {int(Status.SINGULAR)}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Composition([(STRANG, 0.5)]), "fractions of a composition must sum to 1, got 0.5"),
        (lambda: suzuki(STRANG, 5), "suzuki has order 4 or 6, got 5"),
        (lambda: ContactSplitting(potential, 0.0, 0.1), "mass m must be > 0, got 0.0"),
        (lambda: STRANG.step(start(), -0.1), "h must be > 0, got -0.1"),
    ],
)
def test_mistakes_have_a_message(make, message):
    # fails if a wrong argument is taken
    with pytest.raises(InputError, match=message):
        make()
