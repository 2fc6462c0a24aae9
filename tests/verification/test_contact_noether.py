"""Contact Noether: a symmetry's momentum shrinks by exactly c a step, on analytic and on learnable L_d."""

import pytest
import torch

from herglotz.models import ModelConfig
from herglotz.models.network import Network
from herglotz.scenes import left, midpoint_heun
from herglotz.stepping import State, Stepper
from herglotz.theory import (
    dissipation_defect,
    infinitesimal_generator,
    invariance_defect,
    legendre_dual,
    momentum_map,
    noether_defect,
)
from tests.lagrangians import random_model, states as normal_states

H = 0.1  # the step


def rotate(e, q):
    c, s = torch.cos(e), torch.sin(e)
    return torch.stack([c * q[..., 0] - s * q[..., 1], s * q[..., 0] + c * q[..., 1]], -1)


def translate(e, q):
    """Along the first coordinate."""
    return torch.cat([q[..., :1] + e[..., None], q[..., 1:]], -1)


def stretch(e, q):
    return torch.exp(e)[..., None] * q


def central(q, v, s):
    """A rotation-invariant L, nonlinear in everything, with drag that depends on position, speed and s."""
    r2, v2, qv = (q * q).sum(-1), (v * v).sum(-1), (q * v).sum(-1)
    drag = 0.3 * s * (1 + 0.2 * r2) + 0.1 * torch.sin(s) * (1 + 0.3 * qv)
    return 0.5 * v2 * (1 + 0.1 * r2) - torch.sqrt(1 + r2) - drag


def states(batch=8, n=2, seed=0):
    q, p, s = normal_states(n, batch, seed)
    return State(q + 1.0, p, 0.5 * s)


def defects(L_d, action, state, shift=None, steps=5):
    """Largest J_{k+1} − c_k J_k over a rollout, of J_k − σ_k J_0 at its end, and of invariance at its steps."""
    J = momentum_map(action, shift)
    with torch.no_grad():
        out = Stepper(L_d).rollout(*state, h=H, steps=steps)
        assert bool(out.ok.all())
        c = out.sigma[:, 1:] / out.sigma[:, :-1]
        before, after = ((out.q[:, i], out.p[:, i], out.s[:, i]) for i in (slice(None, -1), slice(1, None)))
        each = noether_defect(J, before, after, c).abs().max()
        whole = noether_defect(J, state, out.final, out.sigma[:, -1]).abs().max()
        invariance = invariance_defect(L_d, action, 0.7, before[0], after[0], before[2], H, shift).abs().max()
    size = float(J(*state).abs().max())
    return float(each) / size, float(whole) / size, float(invariance)


def test_generators_and_momenta():
    # fails if ξ is taken at another ε, or J has the wrong components: angular momentum q₁p₂ − q₂p₁
    q, p, s = states()
    torch.testing.assert_close(infinitesimal_generator(rotate, q), torch.stack([-q[:, 1], q[:, 0]], -1))
    torch.testing.assert_close(momentum_map(rotate)(q, p, s), q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0])
    torch.testing.assert_close(momentum_map(translate)(q, p, s), p[:, 0])
    torch.testing.assert_close(momentum_map(translate, lambda e, q: 3 * e * q[..., 1])(q, p, s), p[:, 0] - 3 * q[:, 1])


@pytest.mark.parametrize("rule", [left, midpoint_heun])
def test_rotation_of_a_damped_central_field(rule):
    # fails if FL⁻ lacks its c or J is taken with the wrong momentum
    each, whole, invariance = defects(rule(central), rotate, states())
    print(f"rotation: {each:.1e} a step, {whole:.1e} over 5 steps")
    assert invariance < 1e-13
    assert each <= 1e-12
    assert whole <= 1e-12


def test_a_non_symmetry_is_rejected():
    # fails if the checks accept any action: stretching is no symmetry, and rotation none of an L that is not round
    each, whole, invariance = defects(midpoint_heun(central), stretch, states())
    assert min(each, whole, invariance) > 1e-3

    def squashed(q, v, s):
        return central(q, v, s) - 0.1 * q[..., 0] ** 2

    each, whole, invariance = defects(midpoint_heun(squashed), rotate, states())
    assert min(each, whole, invariance) > 1e-3


def falling(q, v, s):
    """Weight 2 along the first coordinate, with linear drag 0.3."""
    return 0.5 * (v * v).sum(-1) - 2 * q[..., 0] - 0.3 * s


def test_a_symmetry_that_shifts_the_action():
    # fails if χ′ is left out of J or has the other sign: χ = −(g/γ)ε, J = p + g/γ, terminal speed −g/γ
    def shift(e, q):
        return -(2 / 0.3) * e + 0 * q[..., 0]

    L_d = midpoint_heun(falling)
    each, whole, invariance = defects(L_d, translate, states(), shift)
    assert max(each, whole) <= 1e-12
    assert invariance < 1e-13
    assert min(defects(L_d, translate, states())) > 1e-3  # without the shift it is no symmetry


def test_a_shift_that_depends_on_position():
    # fails if χ(q1) − χ(q0) is left out: L + d/dt b(q) with s ↦ s + b, as the gauge of trap 3 has it
    def b(q):
        return torch.sin(q[..., 0]) * q[..., 1]

    central_d = midpoint_heun(central)

    def L_d(q0, q1, s0, h):
        return central_d(q0, q1, s0 - b(q0), h) + b(q1) - b(q0)

    def shift(e, q):  # the rotation, seen after the change of s
        return b(rotate(e, q)) - b(q)

    each, whole, invariance = defects(L_d, rotate, states(), shift)
    assert max(each, whole) <= 1e-12
    assert invariance < 1e-13
    assert min(defects(L_d, rotate, states())) > 1e-3


def blind_model(level, column=0):
    """A random model with networks in all its terms, none of which reads the first position."""
    config = ModelConfig(
        angles=(False, False),
        level=level,
        scale=(1.0, 1.0),
        speed=(1.0, 1.0),
        stiffness=(0.0, 1.0),
        tilt=(0.0, 0.3),
        potential_width=4,
        damping_width=4,
        correction_width=4,
        seed=1,
    )
    model = random_model(config, spread=0.2, seed=2)
    with torch.no_grad():
        model.potential.stiffness[column] = model.potential.tilt[column] = 0.0
        for module in model.modules():
            if isinstance(module, Network):
                module.weights[0][:, column] = 0.0  # the features of q̄ come first
    return model


@pytest.mark.parametrize("level", ["linear", "affine"])
def test_learnable_models_with_a_translation(level):
    # fails if a model's closed-form partials break a symmetry that its weights have: J_{k+1} = c_k J_k
    model = blind_model(level)
    each, whole, invariance = defects(model, translate, states())
    print(f"{level} model: {each:.1e} a step, {whole:.1e} over 5 steps")
    assert invariance < 1e-12
    assert max(each, whole) <= 1e-12
    # fails if a model that reads the first position passes
    assert min(defects(blind_model(level, column=1), translate, states())) > 1e-4


def test_continuous_noether():
    # fails if J̇ = −H_s J does not hold for X_H: {H, J} = 0 for a symmetry, and for H itself
    Hamiltonian, state = legendre_dual(central), states()
    assert float(dissipation_defect(Hamiltonian, momentum_map(rotate), *state).abs().max()) < 1e-12
    assert float(dissipation_defect(Hamiltonian, Hamiltonian, *state).abs().max()) < 1e-12
    assert float(dissipation_defect(Hamiltonian, momentum_map(stretch), *state).abs().max()) > 1e-2
    J = momentum_map(translate, lambda e, q: -(2 / 0.3) * e + 0 * q[..., 0])
    assert float(dissipation_defect(legendre_dual(falling), J, *state).abs().max()) < 1e-12
