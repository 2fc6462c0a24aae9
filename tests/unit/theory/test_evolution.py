"""Steps that keep H: discrete gradients, order, the relation that H obeys along X_H, and sections carried along."""

from functools import partial

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics.contact import join
from herglotz.mechanics.partials import gradient
from herglotz.scenes import reference_flow, scene
from herglotz.stepping import State, Status
from herglotz.theory import (
    EvolutionStepper,
    commutation_defect,
    contact_vector_field,
    energy_on_section,
    evolution_vector_field,
    legendrian_defect,
    midpoint_gradient,
    prolongation,
)
from tests.lagrangians import wavy

PENDULUM = scene("damped_pendulum").hamiltonian


def coupled(q, p, s):
    """Two degrees of freedom, mass that depends on q, nonlinear in s."""
    kinetic = 0.5 * (p * p).sum(-1) / (1 + 0.3 * torch.cos(q[..., 0])) + 0.2 * p[..., 0] * p[..., 1]
    potential = torch.cos(q[..., 0] * q[..., 1]) + 0.25 * (q * q).sum(-1)
    return kinetic + potential + 0.3 * s + 0.1 * torch.sin(s) * (1 + 0.2 * q[..., 1])


def start(n, batch=3, seed=0):
    make = torch.Generator().manual_seed(seed)
    q, p = torch.randn(2, batch, n, generator=make, dtype=torch.float64)
    return State(q, p, 0.5 + torch.rand(batch, generator=make, dtype=torch.float64))


def drift(stepper, state, steps, h=0.1):
    """Largest relative change of H, measured against the factor σ for the contact field."""
    with torch.no_grad():
        out = stepper.rollout(*state, h=h, steps=steps)
    assert bool(out.ok.all())
    energy = stepper.H(out.q, out.p, out.s)
    expected = energy[..., :1] * (out.sigma if stepper.field == "contact" else 1.0)
    return float(((energy - expected) / energy[..., :1]).abs().max()), out


@pytest.mark.parametrize(("H", "n", "steps"), [(PENDULUM, 1, 100), (coupled, 2, 50)])
def test_H_is_kept_to_round_off(H, n, steps):
    # fails if B is not antisymmetric, or the discrete gradient misses the secant condition, at rest included (t = 100)
    worst, out = drift(EvolutionStepper(H), start(n), steps)
    print(f"drift of H over {steps} steps, n = {n}: {worst:.1e}")
    assert worst <= 1e-13
    assert float((out.s[:, -1] - out.s[:, 0]).min()) > 0.1  # something happened


def test_H_shrinks_by_c_along_the_contact_field():
    # fails if H̄ is not the mean of both ends: H1 = c H0 with the c that the step reports
    worst, out = drift(EvolutionStepper(coupled, field="contact"), start(2), 40)
    assert worst <= 1e-13
    assert float(out.sigma[:, -1].max()) < 0.5


@pytest.mark.parametrize("field", ["evolution", "contact"])
def test_order_two_on_a_nonlinear_damped_problem(field):
    # fails if p in B is taken at an end (order 1), or H̄ is H0
    vector_field = {"evolution": evolution_vector_field, "contact": contact_vector_field}[field]
    exact = join(*reference_flow(partial(vector_field, coupled), *start(2), 0.8))
    errors = []
    with torch.no_grad():
        for steps in (5, 10):
            out = EvolutionStepper(coupled, field=field).rollout(*start(2), h=0.8 / steps, steps=steps)
            errors.append(float((join(*out.final) - exact).abs().max()))
    slope = torch.log2(torch.tensor(errors[0] / errors[1])).item()
    print(f"{field}: errors {errors[0]:.1e}, {errors[1]:.1e}, slope {slope:.2f}")
    assert slope == pytest.approx(2, abs=0.15)


def overdamped(q):
    """F = a q²/2 + e/γ with a² + 3a + 1 = 0: H∘j¹F = e = 0.6 for the oscillator with γ = 3."""
    return 0.5 * (-1.5 + 1.25**0.5) * (q * q).sum(-1) + 0.2


def test_discrete_hamilton_jacobi_of_a_quadratic_section():
    # fails if a section with d(H∘γ) = 0 that E_H keeps is not kept by its discrete step; linear damping is exact
    H = scene("damped_oscillator", gamma=3.0).hamiltonian
    stepper, q = EvolutionStepper(H), start(2).q
    value, slope = energy_on_section(H, overdamped, q)
    torch.testing.assert_close(value, torch.full_like(value, 0.6))
    assert float(slope.abs().max()) < 1e-14

    def step(q, p, s):
        return stepper.step(State(q, p, s), 0.2).state

    assert float(commutation_defect(step, overdamped, overdamped, q).abs().max()) < 1e-14
    # fails if any section passes
    assert float(commutation_defect(step, lambda q: 1.1 * overdamped(q), overdamped, q).abs().max()) > 1e-2


def made_for_wavy(q, p, s):
    """A nonlinear H with H∘j¹(wavy) = 0.5 and damping 0.2."""
    x, y = q[..., 0], q[..., 1]
    V = 0.5 - 0.5 * ((torch.cos(x) + y) ** 2 + (1.2 * y * y + x) ** 2) - 0.2 * wavy(q)
    return 0.5 * (p * p).sum(-1) + V + 0.2 * s


def test_discrete_hamilton_jacobi_of_a_nonlinear_section():
    # fails if more is claimed than holds: the carried section keeps H; it stays on j¹F, and Legendrian, to O(h³)
    q = 0.5 * start(2, batch=8).q

    def step(q, p, s, h):
        return EvolutionStepper(made_for_wavy).step(State(q, p, s), h).state

    related, legendrian = [], []
    for h in (0.01, 0.005):
        energy = made_for_wavy(*step(*prolongation(wavy, q), h))
        assert float((energy - 0.5).abs().max()) < 1e-14
        flow = partial(step, h=h)
        related.append(float(commutation_defect(flow, wavy, wavy, q).abs().max()))
        pulled_back = legendrian_defect(lambda u, flow=flow: flow(*prolongation(wavy, u)), q).pullback
        legendrian.append(float(pulled_back.abs().max()))
    print(f"one step off j¹F: {related}, η on it: {legendrian}")
    assert torch.log2(torch.tensor(related[0] / related[1])).item() == pytest.approx(3, abs=0.2)
    assert torch.log2(torch.tensor(legendrian[0] / legendrian[1])).item() == pytest.approx(3, abs=0.2)


def test_a_step_is_differentiable_by_the_implicit_function_theorem():
    # fails if the derivative stops at the solve
    stepper = EvolutionStepper(coupled)
    q, p, s = (x[:1] for x in start(2))
    q = q.requires_grad_()
    (slope,) = torch.autograd.grad(stepper.step(State(q, p, s), 0.1).state.s.sum(), q)
    e = 1e-6 * torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        above, below = (stepper.step(State(q + d, p, s), 0.1).state.s for d in (e, -e))
    assert float(slope[0, 0]) == pytest.approx(float(above - below) / 2e-6, rel=1e-7)


def test_rest_and_samples_apart():
    # fails if Δ = 0 divides by 0, or a sample depends on its neighbours
    rest = State(
        torch.zeros(2, 1, dtype=torch.float64), torch.zeros(2, 1, dtype=torch.float64), torch.zeros(2).double()
    )
    out = EvolutionStepper(PENDULUM).rollout(*rest, h=0.1, steps=3)
    assert bool(out.ok.all())
    assert float(out.q.abs().max()) == 0
    state, h = start(1), torch.tensor([0.1, 0.2, 0.05], dtype=torch.float64)
    together = EvolutionStepper(PENDULUM).step(state, h)
    for i in range(3):
        alone = EvolutionStepper(PENDULUM).step(State(*(x[i] for x in state)), h[i])
        torch.testing.assert_close(together.state.q[i], alone.state.q, rtol=1e-14, atol=1e-15)
        torch.testing.assert_close(together.c[i], alone.c, rtol=1e-14, atol=1e-15)


def test_float32():
    # fails if the tolerance is that of float64
    state = State(*(x.float() for x in start(1)))
    out = EvolutionStepper(PENDULUM).rollout(*state, h=0.1, steps=20)
    assert out.q.dtype == torch.float32
    assert bool(out.ok.all())
    energy = PENDULUM(out.q, out.p, out.s)
    assert float((energy / energy[:, :1] - 1).abs().max()) < 1e-5


def test_failures_are_per_sample():
    # fails if one failed sample stops the batch or comes back as a number
    def wall(q, p, s):
        return 0.5 * (p * p).sum(-1) + torch.log(q).sum(-1) + 0.1 * s  # no H beyond q = 0

    q = torch.tensor([[1.0], [0.01], [2.0]], dtype=torch.float64)
    state = State(q, torch.tensor([[0.1], [-9.0], [0.1]], dtype=torch.float64), q[:, 0])
    out = EvolutionStepper(wall).step(state, 0.1)
    assert out.status[[0, 2]].tolist() == [Status.CONVERGED] * 2
    assert int(out.status[1]) != Status.CONVERGED
    assert bool(out.state.q[1].isnan().all())


def test_an_unknown_field_is_named():
    # fails if a wrong field reaches the solver
    with pytest.raises(InputError, match="unknown field 'symplectic'; choose one of evolution"):
        EvolutionStepper(PENDULUM, field="symplectic")


def trigonometric(x):
    return torch.sin(x[..., 0] * x[..., 1]) + 0.3 * x[..., 2] ** 3 * x[..., 0] + torch.exp(0.4 * x[..., 1])


def pair(step):
    make = torch.Generator().manual_seed(0)
    x0, d = torch.randn(2, 9, 3, generator=make, dtype=torch.float64)
    return x0, x0 + step * d


@pytest.mark.parametrize("step", [1.0, 0.1, 1e-3, 1e-5, 1e-7, 1e-12])
def test_the_secant_condition(step):
    # fails if the correction has a wrong factor, or a small Δ makes it noise: then H would drift
    x0, x1 = pair(step)
    secant = (midpoint_gradient(trigonometric, x0, x1) * (x1 - x0)).sum(-1)
    assert float((secant - (trigonometric(x1) - trigonometric(x0))).abs().max()) < 4e-15


def test_consistency_symmetry_and_zero_increments():
    # fails if equal points, or one equal coordinate, divide 0 by 0; or the two ends are not treated alike
    x0, x1 = pair(0.3)
    torch.testing.assert_close(midpoint_gradient(trigonometric, x0, x0), gradient(trigonometric, x0)[1])
    torch.testing.assert_close(midpoint_gradient(trigonometric, x0, x1), midpoint_gradient(trigonometric, x1, x0))
    x1[:, 1] = x0[:, 1]
    g = midpoint_gradient(trigonometric, x0, x1)
    assert bool(torch.isfinite(g).all())
    assert float(((g * (x1 - x0)).sum(-1) - (trigonometric(x1) - trigonometric(x0))).abs().max()) < 4e-15
