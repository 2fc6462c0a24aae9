"""What every scene must satisfy: consistency of its own parts, batching, dtypes."""

from functools import partial

import pytest
import torch

from herglotz.mechanics import legendre_minus, legendre_plus, partials
from herglotz.scenes import ORDERS, reference_flow, scene, scene_names
from herglotz.theory import contact_vector_field
from tests.lagrangians import scene_states

# at each scene's own examples, off the default parameters, where m = 1 and Ω = 1 would hide powers
SCENES = [scene(name, **parameters) for name in scene_names() for parameters in scene(name).examples]
EXACT = [s for s in SCENES if s.exact]
CONTACT = [s for s in SCENES if s.external is None]  # the others: test_forced_scenes.py, test_servo_axis.py


def label(s):
    return "-".join([s.name, *(f"{x:g}" for x in s.parameters.values())])


def relative(value, expected):
    """Largest error of a batch relative to the batch's largest entry."""
    value, expected = value.detach(), expected.detach()
    return float((value - expected).abs().max() / expected.abs().max().clamp_min(1e-3))


@pytest.mark.parametrize("system", SCENES, ids=label)
def test_legendre_transform(system):
    # fails if momentum is not L_v, velocity is not its inverse or not H_p, or H ≠ p·v − L
    q, p, s = scene_states(system, 20)
    v = system.velocity(q, p, s)
    v = v.detach().requires_grad_()
    L = system.lagrangian(q, v, s)
    (L_v,) = torch.autograd.grad(L.sum(), v)
    assert relative(L_v, p) < 1e-14
    assert relative(system.momentum(q, v.detach(), s), p) < 1e-14
    assert relative(contact_vector_field(system.hamiltonian, q, p, s)[0], v.detach()) < 1e-14
    assert relative((p * v).sum(-1).detach() - L.detach(), system.hamiltonian(q, p, s)) < 1e-13


@pytest.mark.parametrize("factor_of_h", [3.0, -2.0])
@pytest.mark.parametrize("system", CONTACT, ids=label)
def test_flow_is_the_contact_flow_of_its_hamiltonian(system, factor_of_h):
    # fails if the closed-form flow (or the pendulum's written-out field) is not that of X_H, in any of q, p, s
    q, p, s = scene_states(system, 20, seed=1)
    h = factor_of_h * system.h
    expected = reference_flow(partial(contact_vector_field, system.hamiltonian), q, p, s, h)
    for value, number in zip(system.flow(q, p, s, h), expected, strict=True):
        assert relative(value, number) < 1e-11


@pytest.mark.parametrize("system", EXACT, ids=label)
def test_exact_lagrangian_generates_the_flow(system):
    # fails if FL⁻ or FL⁺ of L_d differs from the flow's momenta or action
    q, p, s = scene_states(system, 20, seed=3)
    h = 0.3
    q1, p1, s1 = system.flow(q, p, s, h)
    assert relative(legendre_minus(system.L_d, q, q1, s, h)[1], p) < 1e-11
    _, p_plus, s_plus = legendre_plus(system.L_d, q, q1, s, h)
    assert relative(p_plus, p1) < 1e-11
    assert relative(s_plus, s1) < 1e-12


@pytest.mark.parametrize("system", SCENES, ids=label)
def test_batch_and_step_per_sample(system):
    # fails if samples interact, if h (...) is not broadcast against (..., n), or if leading dims are not kept
    q, p, s = scene_states(system, 6, seed=7)
    h = torch.linspace(0.05, 0.6, 6, dtype=torch.float64)
    together = system.flow(*(x.reshape(2, 3, *x.shape[1:]) for x in (q, p, s)), h.reshape(2, 3))
    assert together[0].shape == (2, 3, system.dof)
    assert together[2].shape == (2, 3)
    L_ds = {"principal": system.L_d, **system.L_d_rules}
    q1 = q + 0.1
    for i in (1, 4):
        alone = system.flow(q[i], p[i], s[i], float(h[i]))
        for a, b in zip(alone, together, strict=True):
            torch.testing.assert_close(a, b.flatten(0, 1)[i], rtol=1e-14, atol=1e-14)
        for name, L_d in L_ds.items():
            torch.testing.assert_close(
                L_d(q[i], q1[i], s[i], h[i]),
                L_d(q, q1, s, h)[i],
                rtol=1e-13,
                atol=1e-13,
                msg=lambda m, name=name: f"{name}: {m}",
            )


@pytest.mark.parametrize("system", SCENES, ids=label)
def test_float32(system):
    # fails if a constant promotes to float64, or if a formula overflows or cancels in single precision
    q, p, s = scene_states(system, 8, seed=8)
    single = tuple(x.float() for x in (q, p, s))
    for value, expected in zip(system.flow(*single, 0.2), system.flow(q, p, s, 0.2), strict=True):
        assert value.dtype == torch.float32
        assert relative(value, expected) < 2e-5
    q1 = system.flow(q, p, s, 0.2)[0]
    for name, L_d in {"principal": system.L_d, **system.L_d_rules}.items():
        h = torch.tensor(0.2)
        value = L_d(single[0], q1.float(), single[2], h)
        assert value.dtype == torch.float32, name
        assert relative(value, L_d(q, q1, s, h.double())) < 2e-4, name
        P = partials(L_d, single[0], q1.float(), single[2], 0.2, order=2)
        assert P.D12 is not None
        assert P.D12.dtype == torch.float32, name
        assert bool(torch.isfinite(P.D12).all()), name


@pytest.mark.parametrize("name", scene_names())
def test_description_is_complete(name):
    # fails if a scene forgets a unit or an angle, or if exact disagrees with what its rules are for
    system = scene(name)
    assert system.name == name
    assert len(system.coordinates) == len(system.units) == len(system.angles) == system.dof
    assert "\n" not in system.description
    for limits in (system.q_range, system.v_range):
        low, high = (torch.as_tensor(x).expand(system.dof) for x in limits)
        assert bool((low < high).all())
    assert system.h > 0
    assert set(ORDERS) <= set(system.L_d_rules)
    assert system.examples
    assert all(set(parameters) <= set(system.parameters) for parameters in system.examples)
    # a negative control of `exact`: an exact L_d composes, S² = L_d(2h), and no rule does
    q, p, s = scene_states(system, 5, seed=9)
    q1 = system.flow(q, p, s, 2 * system.h)[0]
    gap = (legendre_minus(system.L_d, q, q1, s, 2 * system.h)[1] - p).detach()
    assert (float(gap.abs().max() / p.abs().max()) < 1e-11) is system.exact
