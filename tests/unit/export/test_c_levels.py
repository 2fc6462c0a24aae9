"""C for every level of the ladder: it computes what the eager stepper does, in float64 and in float32."""

import functools
from typing import Any

import pytest
import torch
from export_models import randomise

from herglotz.export import compile_c
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.terms import PositionKinetic
from herglotz.stepping import State, Stepper
from tests.compared import relative
from tests.compilers import needs_compiler

pytestmark = needs_compiler
H = 0.1
CASES: dict[str, dict[str, Any]] = {
    "conservative": {"level": "conservative"},
    "linear": {"level": "linear"},
    "affine, tanh": {"level": "affine"},
    "affine, softplus": {"level": "affine", "correction_width": 5, "activation": "softplus"},
    "viscous": {"level": "forced"},
    "dry": {"level": "forced", "coulomb": True, "correction_width": 4},
    "viscous, motors": {"level": "forced", "inputs": 2},
    "full": {"level": "full", "action_width": 3},
    "full, correction": {
        "level": "full", "correction_width": 3, "activation": "silu", "mass_width": 2, "potential_width": 2,
        "damping_width": 2, "action_width": 2,
    },
    "mass": {"level": "linear", "mass_width": 4, "activation": "softplus"},
    "motors": {"level": "forced", "coulomb": True, "inputs": 3},
    "coupled": {"level": "forced", "coupled": True},
    "drag": {"level": "forced", "drag": ("|v1| v1", "q2^2 v2", "(v1 - v2)^3", "load 1"), "potential_width": 2},
    "sticking": {"level": "forced", "coulomb": True, "sticking": True, "inputs": 1, "potential_width": 2},
    "velocities": {"level": "linear", "features": ("cos(q1) v1 v2", "q2^2 v2^2")},
    "order 4": {"level": "linear", "order": 4, "potential_width": 0, "features": ("q2^4", "cos(q1) v1 v2")},
    "order 4, coupled motors": {
        "level": "forced", "order": 4, "potential_width": 0, "inputs": 1, "coupled": True, "coulomb": True,
        "features": ("q2^4",),
    },
}  # fmt: skip

MATRIX = {
    f"{level}, {activation}, mass {mass}": {
        **CASES[level], "rate": 0.3, "potential_width": 3, "potential_depth": 1, "correction_width": 3,
        "activation": activation, "mass_width": mass,
    }
    for level in ("conservative", "linear", "affine, tanh", "full", "viscous", "dry")
    for activation in ("tanh", "softplus", "silu")
    for mass in (0, 3)
}  # fmt: skip
CASES |= MATRIX
# A closed form, Newton's iteration, networks of every activation and forces; test_every_term.py has every term.
ROLLED = (
    "linear", "affine, tanh", "affine, softplus", "full, correction", "mass", "viscous, motors", "motors", "drag",
    "sticking", "order 4", "order 4, coupled motors",
)  # fmt: skip
LONG = ["coupled", "drag", "sticking", "velocities", "order 4", "order 4, coupled motors", *MATRIX]
SLOW = [pytest.param(case, marks=pytest.mark.slow) for case in ("sticking", "drag", *MATRIX)]


def steps_of(case):
    """A thousand; without damping nothing forgets rounding, and the difference grows with the square of the steps."""
    return 300 if case.startswith("conservative") else 1000


def damped(case):
    """A damped model of an angle and a length whose every parameter is random."""
    sizes = (1.0, 1.1)
    options = {"potential_width": 4, "potential_depth": 2, "damping_width": 4, **CASES[case]}
    config = ModelConfig((True, False), scale=sizes, speed=sizes, stiffness=sizes, tilt=(0.0, 0.0), **options)
    model: Any = ContactLagrangian(config)
    with torch.no_grad():
        randomise(model, 0.05, seed=3)
        if model.friction is not None:
            model.friction.viscous.abs_()
            if model.friction.sticking:  # so strong that joints stop
                model.friction.coulomb.abs_().add_(0.2)
        if model.drag is not None:  # so large that a missing force is seen
            model.drag.coefficient.abs_().add_(0.2)
        if model.action is not None:  # so large that a missing term is seen
            model.action.rate.mul_(6)
        if isinstance(model.kinetic, PositionKinetic):
            model.kinetic.network.weights[-1].mul_(6)
    return model


def problem(case, steps, dtype=torch.float64, batch=3):
    """Model, states and the options of a rollout."""
    model = damped(case).to(dtype)
    x = torch.randn(batch, 5, generator=torch.Generator().manual_seed(5), dtype=torch.float64).to(dtype) / 2
    options: dict[str, Any] = {"h": H, "steps": steps}
    if model.inputs:
        u = torch.randn(batch, steps, model.inputs, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        options["inputs"] = (0.3 * u).to(dtype)
    return model, State(x[:, :2], x[:, 2:4], x[:, 4]), options


@functools.cache
def compiled_of(case, dtype=torch.float64):
    """The compiled stepper of a case, made once for all tests."""
    return compile_c(damped(case).to(dtype))


def blocks(found):
    """All derivatives of a step side by side."""
    parts = [found.by_state, found.by_h[..., None], *(() if found.by_input is None else (found.by_input,))]
    return torch.cat([x.double() for x in parts], -1)


def one(b, states, options):
    """Sample b by itself."""
    inputs = {"inputs": options["inputs"][b]} if "inputs" in options else {}
    return State(*(x[b] for x in states)), {**options, **inputs}


@pytest.mark.parametrize("case", ROLLED)
def test_every_level_agrees_with_the_eager_stepper(case):
    # fails if a force enters one momentum only, an activation's slope is wrong, or lanes differ from single samples
    model, states, options = problem(case, 20)
    with torch.no_grad():
        eager = Stepper(model, tol=4e-16).rollout(*states, **options)
    compiled = compiled_of(case)
    ours = compiled.rollout(*states, **options)
    assert eager.ok.all()
    assert ours.ok.all()
    start, alone = one(0, states, options)
    single = compiled.rollout(*start, **alone)
    for name in ("q", "p", "s", "sigma"):
        assert relative(getattr(ours, name), getattr(eager, name)) <= 1e-12, name
        assert relative(getattr(single, name), getattr(ours, name)[0]) <= 1e-12, name


@pytest.mark.slow
@pytest.mark.parametrize("case", LONG)
def test_a_thousand_steps_agree(case):
    # fails if any combination of terms loses a derivative or a digit, alone (B = 1) or in registers (a prime B), or if
    # rounding of features, of coupled friction or of order 4 adds up
    model, states, options = problem(case, steps_of(case))
    with torch.no_grad():
        eager = Stepper(model, tol=4e-16).rollout(*states, **options)
    compiled = compiled_of(case)
    start, alone = one(0, states, options)
    ours, single = compiled.rollout(*states, **options), compiled.rollout(*start, **alone)
    assert eager.ok.all()
    assert ours.ok.all()
    for name in ("q", "p", "s"):
        assert relative(getattr(ours, name), getattr(eager, name)) <= 1e-12, name
        assert relative(getattr(single, name), getattr(eager, name)[0]) <= 1e-12, name


def test_the_derivative_in_float32():
    # fails if the Jacobian in float is made from numbers of another type; test_every_term.py has the one in double
    model, state, options = problem("motors", 1)
    u = options["inputs"][:, 0]
    wanted = blocks(Stepper(model, tol=4e-16).linearise(state, H, u))
    small = State(*(x.float() for x in state))
    found = blocks(compiled_of("motors", torch.float32).linearise(small, H, u.float()))
    assert (found - wanted).abs().max() <= 2e-5 * wanted.abs().max()


@pytest.mark.parametrize("case", ["linear", "affine, tanh", "full", "mass", "order 4", *SLOW])
def test_float32_keeps_its_digits_over_many_steps(case):
    # fails if c is multiplied into p or sigma: 1 + E rounds, and 1000 steps add it up to 3e-5
    steps = steps_of(case)
    model, states, options = problem(case, steps, torch.float32)
    compiled = compiled_of(case, torch.float32)
    start, alone = one(0, states, options)
    ours, single = compiled.rollout(*states, **options), compiled.rollout(*start, **alone)
    wide = State(*(x.double() for x in states))
    wider = {key: x.double() for key, x in options.items() if key == "inputs"}
    exact = compile_c(model.double()).rollout(*wide, h=float(torch.tensor(H)), steps=steps, **wider)
    assert ours.ok.all()
    for name in ("q", "p", "s", "sigma"):
        assert relative(getattr(ours, name), getattr(exact, name)) <= 1e-5, name
        assert relative(getattr(single, name), getattr(exact, name)[0]) <= 1e-5, name
    for sigma, truth in ((ours.sigma, exact.sigma), (single.sigma, exact.sigma[0])):  # it falls: entry by entry
        rounded = steps * 6e-8 * float((truth[..., 1] / truth[..., 0] - 1).abs().max())  # c - 1, once a step
        assert (sigma / truth - 1).abs().max() <= 1e-6 + rounded


def test_joints_stand_still_and_break_away_as_in_the_eager_stepper():
    # fails if the file loses the bound of z, takes the momentum of a joint at rest from its neighbour, or starts wrong
    model, states, options = problem("sticking", 200)
    with torch.no_grad():
        eager = Stepper(model, tol=4e-16).rollout(*states, **options)
    ours = compiled_of("sticking").rollout(*states, **options)
    still, moves = (run.q[:, 1:] == run.q[:, :-1] for run in (ours, eager)), eager.q.diff(dim=1) != 0
    assert torch.equal(*still)
    assert bool((moves[:, 1:] & ~moves[:, :-1]).any())  # a joint breaks away
    assert bool((~moves[:, 1:] & moves[:, :-1]).any())  # a joint comes to rest
    for q1 in (states.q, states.q + 0.01 * states.p):
        u = options["inputs"][:, 0]
        with torch.no_grad():
            begin = Stepper(model).init(states.q, q1, states.s, H, u)
        assert relative(compiled_of("sticking").init(states.q, q1, states.s, H, u).p, begin.p) <= 1e-13


def test_no_inputs_is_not_a_missing_input():
    # fails if the C reads inputs where there are none, or the input of another step
    model, states, options = problem("motors", 20)
    compiled = compiled_of("motors")
    still = {**options, "inputs": torch.zeros_like(options["inputs"])}
    free = {k: v for k, v in options.items() if k != "inputs"}
    assert torch.equal(compiled.rollout(*states, **still).q, compiled.rollout(*states, **free).q)
    shared = compiled.rollout(*states, h=H, inputs=options["inputs"][1])
    assert relative(shared.q[1], compiled.rollout(*states, **options).q[1]) <= 1e-14
    step = compiled.step(states, H, u=options["inputs"][:, 0])
    assert relative(step.state.q, compiled.rollout(*states, **options).q[:, 1]) <= 1e-14
    with torch.no_grad():
        eager = Stepper(model).init(states.q, states.q + 0.1 * states.p, states.s, H, options["inputs"][:, 0])
    ours = compiled.init(states.q, states.q + 0.1 * states.p, states.s, H, options["inputs"][:, 0])
    assert relative(ours.p, eager.p) <= 1e-13


@pytest.mark.parametrize("case", ["full", "full, correction", "mass", "viscous, motors"])
def test_init_of_the_new_terms(case):
    # fails if p1 is not D2 L_d, or what positions and s have gained is missing in s1
    model, (q, p, s), _ = problem(case, 1)
    with torch.no_grad():
        eager = Stepper(model).init(q, q + 0.1 * p, s, H)
    for ours, theirs in zip(compiled_of(case).init(q, q + 0.1 * p, s, H), eager, strict=True):
        assert relative(ours, theirs) <= 1e-13


def test_viscous_friction_needs_no_iteration():
    # fails if a step equation that is linear in q1 is solved by Newton, or its matrix is kept when h changes
    model, states, _ = problem("viscous, motors", 1)
    h = torch.tensor([0.1, 0.3, 0.1, 0.2], dtype=torch.float64)
    u = torch.ones(4, 2, dtype=torch.float64)
    ours = compiled_of("viscous, motors").rollout(*states, h=h, inputs=u)
    with torch.no_grad():
        eager = Stepper(model).rollout(*states, h=h, inputs=u)
    assert bool((ours.residual == 0).all())
    assert relative(ours.q, eager.q) <= 1e-14


def test_large_steps_are_found_by_halved_moves():
    # fails if C takes full moves where they do not lessen |F|: it solved 97 of 400 steps then, 205 with halved moves,
    # the eager stepper 202
    torch.manual_seed(0)
    model = ContactLagrangian(ModelConfig(
        level="affine", angles=(True, True), scale=(1.0, 1.0), speed=(1.0, 1.0), stiffness=(1.0, 1.0), tilt=(0.0, 0.0),
        rate=0.2, potential_width=16,
    )).double()  # fmt: skip
    make = randomise(model, 0.1, seed=1)
    q, p = (size * torch.randn(400, 2, generator=make, dtype=torch.float64) for size in (2, 4))
    start = q, p, torch.zeros(400, dtype=torch.float64)
    eager, ours = (one.rollout(*start, h=4.0, steps=1).ok.sum() for one in (Stepper(model), compile_c(model)))
    assert ours > 0.7 * eager
