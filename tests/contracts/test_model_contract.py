"""What every learnable model must do. A new level or term is one more line in MODELS."""

import copy

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import autograd_partials, contact_defect, flow_derivative, partials
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper


def config(n, **settings):
    angles = tuple(i % 2 == 0 for i in range(n))
    sizes = {"scale": (1.3,) * n, "speed": (0.7,) * n, "stiffness": (1.1,) * n, "tilt": (0.1,) * n}
    return ModelConfig(angles=angles, **sizes, **settings)


MODELS = {
    "linear": config(1),
    "linear, no network": config(1, potential_width=0),
    "linear, correction": config(1, potential_width=0, correction_width=8),
    "linear, two coordinates": config(2, correction_width=5),
    "affine": config(1, level="affine"),
    "affine, correction": config(1, level="affine", correction_width=6),
    "affine, three coordinates": config(3, level="affine"),
}


def random_model(settings, spread=0.2, seed=0, dtype=torch.float64):
    model = ContactLagrangian(settings)
    make = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += spread * torch.randn(parameter.shape, generator=make, dtype=torch.float64)
    return model.to(dtype)


def points(n, batch=6, dtype=torch.float64):
    make = torch.Generator().manual_seed(1)
    q0 = torch.randn(batch, n, generator=make, dtype=torch.float64)
    q1 = q0 + 0.3 * torch.randn(batch, n, generator=make, dtype=torch.float64)
    s0 = torch.randn(batch, generator=make, dtype=torch.float64)
    h = 0.1 + 0.2 * torch.rand(batch, generator=make, dtype=torch.float64)
    return tuple(x.to(dtype) for x in (q0, q1, s0, h))


@pytest.fixture(params=MODELS, ids=lambda name: name.replace(" ", "_"))
def settings(request):
    return MODELS[request.param]


def test_closed_forms_match_autograd(settings):
    # fails if any closed-form derivative of any term is wrong
    model, x = random_model(settings), points(settings.dof)
    closed, twin = partials(model, *x, order=2), autograd_partials(model, *x, order=2)
    for name, value in vars(twin).items():
        torch.testing.assert_close(
            getattr(closed, name), value, rtol=1e-13, atol=1e-13, msg=lambda m, n=name: f"{n}: {m}"
        )


def test_order_one_is_a_part_of_order_two(settings):
    # fails if the two orders run through different formulas
    model, x = random_model(settings), points(settings.dof)
    first, second = partials(model, *x, order=1), partials(model, *x, order=2)
    for name in ("L", "D1", "D2", "D3"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=0, atol=1e-15)


def test_shapes_and_batch_independence(settings):
    # fails if samples of a batch influence one another, or leading dimensions are not respected
    model, (q0, q1, s0, h) = random_model(settings), points(settings.dof)
    whole = partials(model, q0, q1, s0, h, 2)
    folded = partials(model, q0.reshape(2, 3, -1), q1.reshape(2, 3, -1), s0.reshape(2, 3), h.reshape(2, 3), 2)
    assert folded.D12.shape == (2, 3, settings.dof, settings.dof)
    torch.testing.assert_close(folded.D12.flatten(0, 1), whole.D12)
    alone = partials(model, q0[4], q1[4], s0[4], h[4], 2)
    torch.testing.assert_close(alone.D22, whole.D22[4], rtol=1e-14, atol=1e-14)


def test_conformal_factor_is_positive(settings):
    # fails if c can reach zero, where the step is not defined
    model, (q0, q1, s0, h) = random_model(settings, spread=3.0), points(settings.dof)
    assert partials(model, q0, q1, s0, h).c.min().item() > 0


def test_a_step_is_a_contact_map(settings):
    # fails if the stepper and the Lagrangian disagree anywhere: DΦ̃ᵀη = c η is an identity of the exact step
    model, (q, _, s, h) = random_model(settings), points(settings.dof)
    p = 0.5 * torch.cos(q)
    stepper = Stepper(model)
    (q1, p1, _), D = flow_derivative(lambda q, p, s: stepper.step(State(q, p, s), h).state, q, p, s)
    c = partials(model, q, q1, s, h).c
    assert contact_defect(D, p, p1, c).abs().max().item() < 1e-12
    torch.testing.assert_close(torch.linalg.det(D), c ** (settings.dof + 1), rtol=1e-11, atol=1e-12)


def test_float32(settings):
    # fails if a float64 constant sneaks into a float32 model
    model, x = random_model(settings, dtype=torch.float32), points(settings.dof, dtype=torch.float32)
    P = partials(model, *x, order=2)
    assert all(value.dtype == torch.float32 for value in vars(P).values() if value is not None)
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
    model, (q0, q1, s0, h) = ContactLagrangian(settings), points(settings.dof)
    a, k, b = torch.tensor(settings.angles), settings.stiffness[0], settings.tilt[0]
    V = lambda q: (k * torch.where(a, 1 - q.cos(), q * q / 2) + b * torch.where(a, q.sin(), q)).sum(-1)  # noqa: E731
    c = torch.exp(-settings.rate * h)
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
    assert (iterations == 1) == model.linear_in_q1


def test_unknown_level_and_settings_are_named():
    # fails if a typo is accepted silently
    with pytest.raises(InputError, match="unknown level 'cubic'; choose one of linear, affine"):
        ModelConfig(level="cubic")
    with pytest.raises(InputError, match="unknown setting colour for ModelConfig"):
        ModelConfig.from_dict({"colour": 1})
    with pytest.raises(InputError, match="speed needs one number a coordinate"):
        ModelConfig(angles=(True, False), scale=(1.0, 1.0), speed=(1.0,))
