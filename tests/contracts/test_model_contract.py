"""What every learnable model must do. A new level or term is one more line in MODELS."""

import copy
from typing import Any

import pytest
import torch
from torch.func import functional_call, jacrev, vmap

from herglotz.errors import InputError
from herglotz.mechanics import (
    Driven,
    Forced,
    Forces,
    autograd_partials,
    contact_defect,
    flow_derivative,
    momentum_minus,
    momentum_plus,
    partials,
    step_derivative,
)
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.stepping.equation import PartialsEquation, model_equation
from tests.lagrangians import randomise


def config(n, angles=None, **settings):
    angles = tuple(i % 2 == 0 for i in range(n)) if angles is None else angles
    sizes = {"scale": (1.3,) * n, "speed": (0.7,) * n, "stiffness": (1.1,) * n, "tilt": (0.1,) * n}
    return ModelConfig(angles=angles, **sizes, **settings)


MODELS = {
    "linear": config(1),
    "linear, correction": config(1, potential_width=0, correction_width=8),
    "linear, two coordinates": config(2, correction_width=5),
    "affine": config(1, level="affine"),
    "affine, correction": config(1, level="affine", correction_width=6),
    "affine, three coordinates": config(3, level="affine"),
    "conservative": config(1, level="conservative"),
    "conservative, correction": config(1, level="conservative", correction_width=6),
    "full": config(1, level="full"),
    "full, two coordinates, correction": config(2, level="full", action_width=2, correction_width=5),
    "full, three coordinates": config(3, level="full", action_width=1),
    "powers of s": config(1, level="full", dissipation=("s^2", "s^3")),
    "powers of s, forces": config(
        2, level="forced", dissipation=("s^3",), coulomb=True, inputs=2, drag=("q2^2 v2",), mass_width=4
    ),
    "forced, viscous": config(2, level="forced"),
    "forced, dry": config(1, level="forced", coulomb=True),
    "forced, inputs": config(2, level="forced", inputs=3),
    "forced, dry, given inputs": config(3, level="forced", coulomb=True, inputs=1, input_map=(1.0, 0.0, -0.5)),
    "forced, correction": config(1, level="forced", correction_width=6),
    "forced, eight coordinates": config(8, level="forced", coulomb=True, inputs=2),
    "mass of position": config(1, mass_width=6),
    "mass of position, two coordinates": config(2, mass_width=5),
    "mass of position, forced": config(2, mass_width=5, level="forced", coulomb=True),
    "mass of position, full": config(1, mass_width=4, level="full", action_width=2),
    "features": config(1, features=("cos(2q1)", "sin(2q1)"), potential_width=0),
    "features of speed, coupled friction": config(
        2, features=("cos(q1 - q2) v1 v2", "q2 v1", "q2^3"), level="forced", coupled=True
    ),
    "drag": config(1, (False,), level="forced", drag=("|v1| v1", "q1^2 v1", "v1^3", "sin(2.5 v1)")),
    "inputs by position": config(
        2, (False, True), level="forced", inputs=2, drag=("u1 sin(q2) on q1", "u2 cos(q2)", "u2 q1", "|v1| v1")
    ),
    "dry friction of position": config(
        2,
        (False, True),
        level="forced",
        coulomb=True,
        drag=("q1^2 sgn(v1)", "|v1| v1", "cos(q2) sgn(v1)", "sin(q2) sgn(v2)"),
    ),
    "dampers and air": config(
        2,
        (False, False),
        level="forced",
        drag=("(0.4 v1 - v2)", "|v1 - v2| (v1 - v2)", "q2^2 (v2 - v1)^3", "|v| v", "cos(0.8 (v1 - v2))"),
    ),
    "drag of position, order four": config(
        2, (False, True), level="forced", drag=("q1^2 |v2| v2", "v1^2"), order=4, potential_width=0, coulomb=True
    ),
    "bent springs": config(
        2, (False, False), level="affine", features=("|q1| q1", "|q2|^3 - 0.5 |q1| q1^2", "q2^3"), potential_width=0
    ),
    "features of r, known": config(
        3, (False,) * 3, features=("r^-1", "central 2"), known=("0.5 q2^2",), level="affine"
    ),
    "features with lever arms": config(
        2, (False, True), features=("q1^2 cos(q2)", "0.1 q1 sin(2q2 + 0.3) v1 v2"), level="forced", coupled=True
    ),
    "alike": config(8, (False,) * 8, alike=True, features=("sites 4", "chain 3"), potential_width=0),
    "order four": config(1, order=4, potential_width=0),
    "order four, conservative": config(
        2, order=4, potential_width=0, features=("cos(q1 - q2) v1 v2", "q2 v1"), level="conservative"
    ),
    "order four, three coordinates": config(
        3, (False,) * 3, order=4, potential_width=0, features=("r^-1", "sin(q1 - q3) v1 v3")
    ),
    "order four, alike": config(8, (False,) * 8, order=4, potential_width=0, alike=True, features=("sites 4",)),
    "translations": config(
        3,
        (False, True, False),
        level="affine",
        correction_width=5,
        features=("cos(q1 - q3)",),
        translations=("q1 + q3", "q2"),
    ),
    "softplus": config(1, activation="softplus", correction_width=6),
    "silu": config(2, activation="silu", level="affine", mass_width=4),
}


def random_model(settings, spread=0.2, seed=0, dtype=torch.float64) -> Any:
    model: Any = ContactLagrangian(settings)
    randomise(model, spread, seed)
    with torch.no_grad():
        if settings.coulomb:  # dry friction that drives has several solutions a step
            model.friction.coulomb.abs_()
    return model.to(dtype)


def points(n, batch=6, dtype=torch.float64):
    make = torch.Generator().manual_seed(1)
    q0 = torch.randn(batch, n, generator=make, dtype=torch.float64)
    q1 = q0 + 0.3 * torch.randn(batch, n, generator=make, dtype=torch.float64)
    s0 = torch.randn(batch, generator=make, dtype=torch.float64)
    h = 0.1 + 0.2 * torch.rand(batch, generator=make, dtype=torch.float64)
    return tuple(x.to(dtype) for x in (q0, q1, s0, h))


def entries(P):
    """Every tensor of `Partials` by name, those of the forces too."""
    own = {k: v for k, v in vars(P).items() if v is not None and not isinstance(v, Forces)}
    return own if P.force is None else own | {k: v for k, v in vars(P.force).items() if v is not None}


@pytest.fixture(params=MODELS, ids=lambda name: name.replace(" ", "_"))
def settings(request):
    return MODELS[request.param]


def test_closed_forms_match_autograd(settings):
    # fails if any closed-form derivative of any term is wrong
    model, x = random_model(settings), points(settings.dof)
    closed, twin = partials(model, *x, order=2), autograd_partials(model, *x, order=2)
    assert entries(closed).keys() == entries(twin).keys()
    for name, value in entries(twin).items():
        torch.testing.assert_close(
            entries(closed)[name], value, rtol=1e-13, atol=1e-13, msg=lambda m, n=name: f"{n}: {m}"
        )


@pytest.mark.parametrize("level", ["conservative", "linear", "full", "forced"])
def test_closed_forms_without_a_baseline(level):
    # fails if the plain network (trap 2) takes another path at some level; it has no regular step to test
    model, x = random_model(config(1, baseline=False, correction_width=6, level=level)), points(1)
    closed, twin = partials(model, *x, order=2), autograd_partials(model, *x, order=2)
    for name, value in entries(twin).items():
        torch.testing.assert_close(entries(closed)[name], value, rtol=1e-13, atol=1e-13)


def test_order_one_is_a_part_of_order_two(settings):
    # fails if the two orders run through different formulas
    model, x = random_model(settings), points(settings.dof)
    first, second = partials(model, *x, order=1), partials(model, *x, order=2)
    for name, value in entries(first).items():
        torch.testing.assert_close(value, entries(second)[name], rtol=0, atol=1e-15)


def test_increments_are_the_same_function(settings):
    # fails if a term subtracts positions where Δ was given, or differentiates with respect to another variable
    model, (q0, q1, s0, h) = random_model(settings), points(settings.dof)
    whole, parts = partials(model, q0, q1, s0, h, 2), model.partials_increment(q0, q1 - q0, s0, h, 2)
    for name, value in entries(whole).items():
        torch.testing.assert_close(entries(parts)[name], value, rtol=1e-12, atol=1e-12)
    K = model.partials_increment(q0, torch.full_like(q0, 1e-18), s0, h).D2 - model.partials(q0, q0, s0, h).D2
    assert K.abs().max() < 1e-12  # finite where q0 + Δ = q0


class Plain:
    """A model behind a name that the engine does not know: it steps by the model's partials alone."""

    def __init__(self, model):
        self.model = model
        for name in ("partials", "partials_increment", "at"):
            setattr(self, name, getattr(model, name))

    def __call__(self, *x):
        return self.model(*x)


@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize(("dtype", "tol"), [(torch.float64, 1e-13), (torch.float32, 1e-4)], ids=str)
def test_the_step_equation_equals_that_of_the_partials(settings, dtype, tol, trained):
    # fails if F, J or what a step ends with lacks a term that the jets of L_d have, in any form of the unknown
    model, (q0, q1, s0, h) = random_model(settings, dtype=dtype), points(settings.dof, dtype=dtype)
    model.requires_grad_(trained)
    known = model_equation(model)
    other = settings.mass_width > 0 or settings.order == 4 or settings.coupled or bool(settings.drag)
    assert (known is None) == (settings.level == "full" or other)
    if known is None:
        return
    p0, u, L_d = torch.cos(q0), None, model
    if settings.inputs:
        u = torch.randn(6, settings.inputs, generator=torch.Generator().manual_seed(3), dtype=torch.float64).to(dtype)
        L_d = model.at(u)
    for increments, step in ((False, h), (True, h[0])):
        x = q1 - q0 if increments else q1
        twin = PartialsEquation(L_d, State(q0, p0, s0), step, 1, increments)
        own = known.at(State(q0, p0, s0), step, u, increments)
        for second in (True, False):
            a, b = own(x, second), twin(x, second)
            ends = own.end(x, a), twin.end(x, b)
            pairs = [(a.F, b.F), (own.push(a), twin.push(b)), *zip(ends[0][:3], ends[1][:3], strict=True)]
            if ends[0].dp is not None:  # of an unsolved step: F is missing in p1 − p0
                pairs.append((ends[0].dp, ends[1].p1 - p0 + b.F))
            assert (a.J is not None) == (b.J is not None) == second
            for got, wanted in [*pairs, *([(a.J, b.J)] if second else [])]:
                assert (got.dtype, got.shape) == (dtype, wanted.shape)
                torch.testing.assert_close(got, wanted, rtol=tol, atol=tol * (1 + float(wanted.detach().abs().max())))


def test_a_step_by_terms_equals_one_by_partials(settings):
    # fails if a batch, a sample alone or a rollout that hands V on goes another way than the partials of L_d
    model, (q, _, s, h) = random_model(settings), points(settings.dof)
    if model_equation(model) is None:
        return
    p = 0.5 * torch.cos(q)
    inputs = torch.ones(5, settings.inputs, dtype=torch.float64) if settings.inputs else None
    with torch.no_grad():
        twin = Stepper(Plain(model)).rollout(q, p, s, h=0.1, steps=5, inputs=inputs)
        for own in (Stepper(model), Stepper(model, explicit=False)):
            for part in (slice(None), 2):
                out = own.rollout(q[part], p[part], s[part], h=0.1, steps=5, inputs=inputs)
                for name in ("q", "p", "s", "sigma"):
                    got, wanted = getattr(out, name), getattr(twin, name)[part]
                    torch.testing.assert_close(got, wanted, rtol=1e-12, atol=1e-12)
    leaves = [x.clone().requires_grad_() for x in (q, p, s)]
    pair = []
    for L_d in (model, Plain(model)):
        out = Stepper(L_d, explicit=False).step(State(*leaves), h).state
        parameters = [w for w in model.parameters() if w.numel()]
        pair.append(torch.autograd.grad(out.q.sum() + 2 * out.p.sum() + out.s.sum(), [*leaves, *parameters],
                                        allow_unused=True, materialize_grads=True))  # fmt: skip
    for a, b in zip(*pair, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_shapes_and_batch_independence(settings):
    # fails if samples of a batch influence one another, or leading dimensions are not respected
    model, (q0, q1, s0, h) = random_model(settings), points(settings.dof)
    whole = partials(model, q0, q1, s0, h, 2)
    folded = partials(model, q0.reshape(2, 3, -1), q1.reshape(2, 3, -1), s0.reshape(2, 3), h.reshape(2, 3), 2)
    assert folded.D12.shape == (2, 3, settings.dof, settings.dof)
    torch.testing.assert_close(folded.D12.flatten(0, 1), whole.D12)
    alone = partials(model, q0[4], q1[4], s0[4], h[4], 2)
    for name, value in entries(alone).items():
        torch.testing.assert_close(value, entries(whole)[name][4], rtol=1e-14, atol=1e-14)


def test_conformal_factor_is_positive(settings):
    # fails if c can reach zero, where the step is not defined
    spread = 0.5 if settings.dissipation else 3.0  # large powers leave the reals within a step, which is then NaN
    model, (q0, q1, s0, h) = random_model(settings, spread=spread), points(settings.dof)
    assert partials(model, q0, q1, s0, h).c.min().item() > 0


def test_a_step_is_a_contact_map(settings):
    # fails if the stepper and the Lagrangian disagree anywhere: DΦ̃ᵀη − c η = −F⁻dq0 − F⁺dq1 is an identity
    model, (q, _, s, h) = random_model(settings), points(settings.dof)
    p = 0.5 * torch.cos(q)
    stepper = Stepper(model)
    (q1, p1, _), D = flow_derivative(lambda q, p, s: stepper.step(State(q, p, s), h).state, q, p, s)
    P = partials(model, q, q1, s, h, 2)
    defect = contact_defect(D, p, p1, P.c)
    if P.force is None:
        assert settings.level != "forced"
        torch.testing.assert_close(torch.linalg.det(D), P.c ** (settings.dof + 1), rtol=1e-11, atol=1e-12)
    else:
        n = settings.dof
        assert defect.abs().max().item() > 1e-4
        assert (momentum_minus(P) - p).abs().max().item() < 1e-11
        assert (momentum_plus(P) - p1).abs().max().item() < 1e-11
        defect = defect + (D[..., :n, :].mT @ P.force.plus[..., None])[..., 0].detach()
        defect[..., :n] += P.force.minus
    assert defect.abs().max().item() < 2e-12
    torch.testing.assert_close(step_derivative(P, p), D, rtol=1e-10, atol=1e-11)


def test_float32(settings):
    # fails if a float64 constant sneaks into a float32 model
    model, x = random_model(settings, dtype=torch.float32), points(settings.dof, dtype=torch.float32)
    P = partials(model, *x, order=2)
    assert all(value.dtype == torch.float32 for value in entries(P).values())
    exact = partials(random_model(settings), *points(settings.dof), order=2)
    torch.testing.assert_close(P.D1.double(), exact.D1, rtol=1e-4, atol=1e-4)


def test_state_dict_round_trip(settings):
    # fails if a parameter is not registered or a config value is lost
    model = random_model(settings)
    clone = ContactLagrangian(ModelConfig.from_dict(copy.deepcopy(settings.to_dict())))
    clone.load_state_dict(model.state_dict())
    x = points(settings.dof)
    assert torch.equal(clone(*x), model(*x))


def test_new_model_equals_its_baseline(settings):
    # fails if the zero-initialised networks contribute before training (the collapse trap needs a baseline)
    if settings.known or settings.order == 4 or settings.translations:  # another baseline: tests/unit/models
        return
    model, (q0, q1, s0, h) = ContactLagrangian(settings), points(settings.dof)
    F = model.forces(q0, q1, s0, h)
    assert (F is None) == (settings.level != "forced")
    assert F is None or not any(bool(x.any()) for x in F)
    a, k, b = torch.tensor(settings.angles), settings.stiffness[0], settings.tilt[0]
    V = lambda q: (k * torch.where(a, 1 - q.cos(), q * q / 2) + b * torch.where(a, q.sin(), q)).sum(-1)  # noqa: E731
    c = torch.exp(-settings.rate * h * (settings.level != "conservative"))
    K = ((q1 - q0) ** 2).sum(-1) / (2 * h)
    expected = (c - 1) * (s0 - h / 2 * V(q0)) + c.sqrt() * K - h / 2 * (V(q0) + V(q1))
    torch.testing.assert_close(model(q0, q1, s0, h), expected, rtol=1e-13, atol=1e-13)


def test_motion_depends_on_s_exactly_where_the_model_says_so(settings):
    # fails if s is carried through training where it cannot matter, or dropped where it does
    model, (q, _, s, _) = random_model(settings), points(settings.dof)
    p = 0.5 * torch.cos(q)
    with torch.no_grad():
        a = Stepper(model).rollout(q, p, s, h=0.1, steps=5).q
        b = Stepper(model).rollout(q, p, s + 1, h=0.1, steps=5).q
    assert bool((a - b).abs().max() > 1e-6) == model.s_enters_motion


def test_one_newton_step_solves_a_linear_step(settings):
    # fails if `linear_in_q1` is claimed for a model whose step equation is not linear
    model, (q, _, s, _) = random_model(settings), points(settings.dof)
    with torch.no_grad():
        iterations = Stepper(model).step(State(q, torch.cos(q), s), 0.2).iterations
    # With powers of s and one mass F is linear times a factor, and the guess is right already.
    assert (iterations == 1) == (
        model.capabilities.linear_in_q1 or (settings.level, settings.dissipation) == ("full", ("s^2", "s^3"))
    )


def test_parameters_differentiate_inside_vmap(settings):
    # fails if a jet reads a value or writes in place: training takes vmap(jacrev) of partials over the parameters
    model, (q0, q1, s0, h) = random_model(settings), points(settings.dof, batch=3)
    names, values = zip(*model.named_parameters(), strict=True)

    def quantities(values, q0, q1, s0, h):
        P = functional_call(model, dict(zip(names, values, strict=True)), (q0, q1, s0, h, 2))
        return torch.cat([P.L[None], momentum_minus(P), momentum_plus(P), P.D12.flatten(), P.c[None]])

    J = vmap(jacrev(quantities), (None, 0, 0, 0, 0))(tuple(v.detach() for v in values), q0, q1, s0, h)
    make = torch.Generator().manual_seed(2)
    values = [v.detach() for v in values]
    d = [torch.randn(v.shape, generator=make, dtype=torch.float64) for v in values]  # all parameters move at once
    ends = []
    for e in (1e-5, -1e-5):
        moved = [v + e * x for v, x in zip(values, d, strict=True)]
        ends.append(torch.stack([quantities(moved, *x) for x in zip(q0, q1, s0, h, strict=True)]).detach())
    expected = (ends[0] - ends[1]) / 2e-5
    got = sum(slope.reshape(*slope.shape[:2], -1) @ x.flatten() for slope, x in zip(J, d, strict=True))
    torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-7 * (1 + float(expected.abs().max())))


def test_a_model_pays_only_for_what_it_names(settings):
    # fails if a level evaluates a network, an action or a force that it has no use for
    model, x = random_model(settings), points(settings.dof)
    calls = []
    for name, module in model.named_modules():
        module.register_forward_hook(lambda *_, name=name: calls.append(name))
    P = model.partials(*x, order=2)
    c = settings
    expected = {
        "potential": c.baseline,
        "potential.network": c.baseline and c.potential_width > 0,
        "damping": c.level != "conservative",
        "damping.network": c.level == "affine",
        "correction.network": c.correction_width > 0,
        "kinetic.network": c.mass_width > 0,
        "action": c.level == "full" or bool(c.dissipation),
        "friction": c.level == "forced",
    }
    for name, used in expected.items():
        assert (name in calls) == used, name
    assert calls.count("potential.network") <= 1  # both ends in one call
    assert (P.force is None) == (c.level != "forced")
    if c.level == "conservative":
        assert not any("rate" in name or "drag" in name for name, _ in model.named_parameters())
        assert torch.equal(P.c, torch.ones_like(P.c))


def test_increments_keep_a_step_that_positions_lose():
    # fails if Δ is rounded by going through q1 = q0 + Δ: K and friction must see it
    model = random_model(MODELS["forced, viscous"])
    with torch.no_grad():
        for parameter in model.potential.parameters():
            parameter.zero_()
    q0, _, s0, h = points(2)
    delta = torch.full_like(q0, 1e-18)
    P = model.partials_increment(q0, delta, s0, h)
    root_c = torch.exp(-0.5 * model.damping.rate * h)[:, None]
    torch.testing.assert_close(P.D2, root_c * (delta @ model.kinetic.mass()) / h[:, None], rtol=1e-12, atol=0)
    torch.testing.assert_close(P.force.plus, -model.friction.viscous * delta / 2, rtol=1e-12, atol=0)


def test_inputs_act_through_their_map():
    # fails if u enters with another sign or factor, at one end only, or a step without u keeps the last one
    model = random_model(MODELS["forced, inputs"])
    q0, q1, s0, h = points(2)
    u = torch.randn(6, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    driven: Any = model.at(u)
    assert [isinstance(x, kind) for x, kind in ((model, Driven), (driven, Forced))] == [True, True]
    free: Any = partials(model, q0, q1, s0, h, 2)
    P: Any = partials(driven, q0, q1, s0, h, 2)
    twin = autograd_partials(driven, q0, q1, s0, h, 2)
    for name, value in entries(twin).items():
        torch.testing.assert_close(entries(P)[name], value, rtol=1e-13, atol=1e-13)
    Gu = u @ model.friction.input_map.T
    torch.testing.assert_close(P.force.plus - free.force.plus, h[:, None] / 2 * Gu, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(P.force.minus - free.force.minus, (P.c * h)[:, None] / 2 * Gu, rtol=1e-12, atol=1e-13)
    assert torch.equal(driven(q0, q1, s0, h), model(q0, q1, s0, h))
    parts = driven.partials_increment(q0, q1 - q0, s0, h)
    torch.testing.assert_close(parts.force.plus, P.force.plus, rtol=1e-12, atol=1e-13)
    with pytest.raises(InputError, match=r"u needs shape \(\.\.\., 3\), got \(6, 2\)"):
        partials(model.at(u[:, :2]), q0, q1, s0, h)
    with pytest.raises(InputError, match="has no inputs: fit a recording that has input columns"):
        random_model(MODELS["linear"]).at(u)


def test_a_given_input_map_is_kept_and_not_trained():
    # fails if G is learned where it was given, transposed, or left out of the saved state
    settings = MODELS["forced, dry, given inputs"]
    model = random_model(settings)
    assert model.friction.input_map.flatten().tolist() == [1.0, 0.0, -0.5]
    assert model.friction.input_map.shape == (3, 1)
    assert "friction.input_map" not in dict(model.named_parameters())
    assert "friction.input_map" in model.state_dict()


def test_unknown_level_and_settings_are_named():
    # fails if a typo is accepted silently
    ladder = "conservative, linear, affine, full, forced"
    with pytest.raises(InputError, match=f"unknown level 'cubic'; choose one of {ladder}"):
        ModelConfig(level="cubic")
    wrong = [
        ({"activation": "relu"}, "unknown activation 'relu'; choose one of tanh, softplus, silu"),
        ({"coulomb": True}, "coulomb and inputs are forces; set level='forced', not 'linear'"),
        ({"level": "full", "action_width": 0}, "the full level needs action_width >= 1, got 0"),
        ({"level": "forced", "inputs": 2, "input_map": (1.0,)}, "input_map needs n · inputs = 2 numbers"),
        ({"level": "forced", "inputs": -1}, "cannot be negative, got -1"),
        ({"baseline": False, "correction_width": 4, "mass_width": 4}, "without a baseline has no mass"),
        ({"baseline": False}, "needs a correction network"),
    ]
    for given, words in wrong:
        with pytest.raises(InputError, match=words):
            ModelConfig(**given)
    with pytest.raises(InputError, match="unknown setting colour for ModelConfig"):
        ModelConfig.from_dict({"colour": 1})
    with pytest.raises(InputError, match="speed needs one number a coordinate"):
        ModelConfig(angles=(True, False), scale=(1.0, 1.0), speed=(1.0,))
