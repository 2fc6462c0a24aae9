"""Hamilton–Jacobi on Q (Theorem 1, corrected by E2) and on Q × R, continuous and discrete."""

from functools import partial

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.stepping import State, Stepper
from herglotz.theory import (
    commutation_defect,
    contact_vector_field,
    discrete_section_residuals,
    energy_on_section,
    evolution_vector_field,
    projected_field,
    relatedness_defect,
    section_asymmetry,
    section_hamilton_jacobi_residual,
    section_relatedness_defect,
    transport_section,
)
from herglotz.theory.hj_on_qxr import section_derivatives
from tests.lagrangians import wavy

GAMMA = 3.0  # overdamped with Ω = 1


def grid(n=1, batch=12, seed=0):
    return torch.randn(batch, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def fields(H):
    return partial(contact_vector_field, H), partial(evolution_vector_field, H)


def worst(x):
    return float(x.abs().max())


def plane(q, p, s):  # noqa: ARG001
    return p.sum(-1)


def line(q):
    return q.sum(-1)


def roots():
    """a² + γa + 1 = 0: the rates of the slow and the fast decay."""
    spread = (GAMMA**2 / 4 - 1) ** 0.5
    return -GAMMA / 2 + spread, -GAMMA / 2 - spread


def mixed(q):
    """F = ½ Σ aᵢ qᵢ²: the first coordinate decays slowly, the second fast."""
    return 0.5 * (torch.tensor(roots(), dtype=q.dtype) * q * q).sum(-1)


def made_for_wavy(q, p, s):
    """A nonlinear damped H that vanishes on j¹(wavy): H = |p|²/2 + V + γs with V = −|dF|²/2 − γF written out."""
    x, y = q[..., 0], q[..., 1]
    V = -0.5 * ((torch.cos(x) + y) ** 2 + (1.2 * y * y + x) ** 2) - 0.2 * wavy(q)
    return 0.5 * (p * p).sum(-1) + V + 0.2 * s


def test_the_counterexample_to_the_printed_theorem():
    # fails if d(H∘γ) = 0 is taken to be enough for X_H (E2): H = p, F = q has H∘γ = 1 and X_H is not related
    q = grid()
    value, slope = energy_on_section(plane, line, q)
    assert worst(slope) == 0
    assert worst(value - 1) == 0
    contact, evolution = fields(plane)
    defect = relatedness_defect(contact, line, q)
    assert worst(defect - torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)) == 0
    assert worst(relatedness_defect(evolution, line, q)) == 0


@pytest.mark.parametrize("case", ["oscillator", "nonlinear"])
def test_theorem_1_where_H_vanishes_on_the_section(case):
    # fails if X^γ is not H_p on the section, or a component of Tγ is wrong; on an open set of q
    H, F = (
        (scene("damped_oscillator", gamma=GAMMA).hamiltonian, mixed) if case == "oscillator" else (made_for_wavy, wavy)
    )
    q = grid(2)
    value, slope = energy_on_section(H, F, q)
    assert worst(value) < 1e-13
    assert worst(slope) < 1e-13
    for field in fields(H):
        assert worst(relatedness_defect(field, F, q)) < 1e-13
    # fails if any F passes: the null model is the same F scaled
    for field in fields(H):
        assert worst(relatedness_defect(field, lambda q: 1.01 * F(q), q)) > 1e-3


def test_the_defect_is_the_energy_and_its_slope():
    # fails if the defect of X_H is not (0, d(H∘γ), H∘γ), and that of E_H the same without its last part
    H, q = scene("damped_oscillator", gamma=0.2).hamiltonian, grid(2)
    value, slope = energy_on_section(H, wavy, q)
    zero = torch.zeros_like(q)
    contact, evolution = fields(H)
    expected = torch.cat([zero, slope, value[:, None]], -1)
    torch.testing.assert_close(relatedness_defect(contact, wavy, q), expected)
    expected[..., -1] = 0
    torch.testing.assert_close(relatedness_defect(evolution, wavy, q), expected)
    assert worst(slope) > 0.1


def test_the_section_reduces_the_flow():
    # fails if the projected field is not the motion: q̇ = (a₁q₁, a₂q₂), lifted by γ it is the flow of the oscillator
    oscillator, q = scene("damped_oscillator", gamma=GAMMA), grid(2)
    rates = torch.tensor(roots(), dtype=torch.float64)
    torch.testing.assert_close(projected_field(fields(oscillator.hamiltonian)[0], mixed, q), rates * q)
    defect = commutation_defect(lambda q, p, s: oscillator.flow(q, p, s, 0.7), mixed, mixed, q)
    assert worst(defect) < 1e-13
    assert worst(oscillator.flow(q, rates * q, mixed(q), 0.7)[0] - torch.exp(0.7 * rates) * q) < 1e-13
    stepper = Stepper(oscillator.L_d)
    discrete = commutation_defect(lambda q, p, s: stepper.step(State(q, p, s), 0.3).state, mixed, mixed, q)
    assert worst(discrete) < 1e-12


def radial(factor=2.0):
    """γ(q, s) = 2 s q/|q|², for n = 1 the golden 2s/q."""
    return lambda q, s: factor * s[..., None] * q / (q * q).sum(-1, keepdim=True)


def away_from_zero(n, batch=12):
    x = grid(n + 1, batch, seed=4)
    q = x[:, :n]
    return q + torch.nn.functional.normalize(q, dim=-1), x[:, n]


@pytest.mark.parametrize("n", [1, 2])
def test_the_golden_section_on_QxR(n):
    # fails if (H∘γ)γ_s is left out or has the other sign; γ = 2s/q, and its radial form in the plane
    H, (q, s) = scene("damped_oscillator").hamiltonian, away_from_zero(n)
    assert worst(section_asymmetry(radial(), q, s)) < 1e-13
    assert worst(section_hamilton_jacobi_residual(H, radial(), q, s)) < 1e-12
    assert worst(section_relatedness_defect(H, radial(), q, s)) < 1e-12
    # fails if a wrong γ passes
    assert worst(section_hamilton_jacobi_residual(H, radial(2.1), q, s)) > 1e-2
    assert worst(section_relatedness_defect(H, radial(2.1), q, s)) > 1e-2


def foliation(q, s):
    """Symmetric, not a solution: im γ is foliated by j¹(a f + g), so γ = (s − g) f_q/f + g_q."""
    x, y = q[..., 0], q[..., 1]
    f = 2 + torch.sin(x) * y
    g = 0.3 * x * x * y
    f_q = torch.stack([torch.cos(x) * y, torch.sin(x)], -1)
    g_q = torch.stack([0.6 * x * y, 0.3 * x * x], -1)
    return ((s - g) / f)[..., None] * f_q + g_q


def test_residual_and_tangency_are_the_same_where_the_symmetry_holds():
    # fails if the residual is not what tangency of X_H asks: equal on a symmetric γ, different on another
    H, (q, s) = made_for_wavy, away_from_zero(2)
    assert worst(section_asymmetry(foliation, q, s)) < 1e-13
    residual = section_hamilton_jacobi_residual(H, foliation, q, s)
    torch.testing.assert_close(residual, section_relatedness_defect(H, foliation, q, s))
    assert worst(residual) > 0.1

    def twisted(q, s):
        return foliation(q, s) + 0.3 * torch.stack([-q[..., 1], q[..., 0]], -1)

    assert worst(section_asymmetry(twisted, q, s)) > 0.1
    difference = section_hamilton_jacobi_residual(H, twisted, q, s) - section_relatedness_defect(H, twisted, q, s)
    assert worst(difference) > 0.1


@pytest.mark.parametrize("n", [1, 2])
def test_the_golden_section_is_discrete_too(n):
    # fails if D1 is not divided by c or s1 is not s0 + L_d, with the exact L_d: γ^{k+1} = γ^k = 2s/q
    oscillator, (q, s) = scene("damped_oscillator"), away_from_zero(n)
    q1 = Stepper(oscillator.L_d).step(State(q, radial()(q, s), s), 0.1).state.q
    for residual in discrete_section_residuals(oscillator.L_d, radial(), radial(), q, q1, s, 0.1):
        assert worst(residual) < 1e-11
    # fails if a wrong γ passes
    wrong = radial(2.1)
    q1 = Stepper(oscillator.L_d).step(State(q, wrong(q, s), s), 0.1).state.q
    minus, plus = discrete_section_residuals(oscillator.L_d, wrong, wrong, q, q1, s, 0.1)
    assert worst(minus) < 1e-11
    assert worst(plus) > 1e-3


def pendula(q0, q1, s0, h):
    """Two coupled pendula with damping that depends on s and on the motion: nothing is quadratic."""
    v, q = (q1 - q0) / h, (q0 + q1) / 2
    L = 0.5 * (v * v).sum(-1) + 0.2 * v[..., 0] * v[..., 1] + torch.cos(q).sum(-1) - 0.5 * q[..., 0] * q[..., 1]
    return h * (L - 0.3 * s0 - 0.1 * torch.sin(s0) * (1 + v[..., 0] * q[..., 1]))


def test_transport_commutes_with_the_step():
    # fails if γ1 is not carried by the flow: Φ̃∘γ0 = γ1∘Φ̃^γ on an open set, for a section that solves nothing
    (q, s), h = away_from_zero(2), torch.tensor(0.1, dtype=torch.float64)
    q, s = 0.5 * q, 0.5 * s
    carried = transport_section(pendula, foliation, h)
    step = Stepper(pendula).step(State(q, foliation(q, s), s), h)
    q1, p1, s1 = step.state
    torch.testing.assert_close(carried(q1, s1), p1, rtol=1e-12, atol=1e-12)
    for residual in discrete_section_residuals(pendula, foliation, carried, q, q1, s, h):
        assert worst(residual) < 1e-11
    # fails if γ1 carries no derivative, or a step does not keep the symmetry: q- and s-slopes of γ1
    assert worst(section_asymmetry(carried, q1, s1)) < 1e-11
    e = 1e-6
    slope = (carried(q1, s1 + e) - carried(q1, s1 - e)) / (2 * e)
    torch.testing.assert_close(section_derivatives(carried, q1, s1)[2], slope, rtol=1e-7, atol=1e-8)


def test_a_point_that_is_not_reached_is_named():
    # fails if a failed solve comes back as a number
    q = torch.tensor([[1.0]], dtype=torch.float64)

    def bounded(q0, q1, s0, h):
        return ((q1 - q0) ** 2).sum(-1) / (2 * h) + 0 * s0

    def infinite(q, s):
        return q * torch.inf + s[..., None]

    with pytest.raises(InputError, match=r"no point of the section is carried to .* at sample \(0,\)"):
        transport_section(bounded, infinite, 0.1)(q, q[:, 0])
