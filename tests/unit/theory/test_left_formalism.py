"""L⁻, H⁺ and H⁻ of any L_d, and the right and left Hamilton equations (E5)."""

import math

import pytest
import torch

from herglotz.mechanics import partials
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.theory import (
    LeftHamiltonian,
    LeftLagrangian,
    RightHamiltonian,
    left_equations,
    left_step,
    right_equations,
    right_step,
)
from tests.lagrangians import nonlinear, states

OSCILLATOR = scene("damped_oscillator", m=1.7, omega0=1.3, gamma=0.6)
CASES = {
    "nonlinear": (nonlinear, 2, 0.2),
    "oscillator": (OSCILLATOR.L_d, 1, 0.1),
    "parachute": (scene("parachute").L_d, 1, 0.1),
    "pendulum midpoint": (scene("damped_pendulum").L_d_rules["midpoint"], 1, 0.5),
    # It has no third derivatives.
    "numerically exact": (scene("damped_pendulum").numerical, 1, 0.3),
}


def solved(name, count=12, seed=0):
    """States and one step from each by Newton on FL⁻."""
    L_d, n, h = CASES[name]
    start = states(n, count, seed)
    step = Stepper(L_d).step(start, h)
    return L_d, h, start, step.state, step.c


def close(value, expected, tol):
    scale = float(expected.abs().max())
    assert float((value - expected).abs().max()) <= tol * scale, float((value - expected).abs().max()) / scale


@pytest.mark.parametrize("name", CASES)
def test_left_lagrangian(name):
    # fails if s0 does not solve s0 + L_d = s1, or D3L⁻, p0, p1 miss a factor c
    L_d, h, (q0, p0, s0), (q1, p1, s1), c = solved(name)
    P = partials(LeftLagrangian(L_d), q0, q1, s1, h)
    close(P.L, s1 - s0, 1e-12)
    close(1 - P.D3, 1 / c, 1e-12)
    close(-P.D1, p0, 1e-12)
    close(P.D2 / (1 - P.D3)[..., None], p1, 1e-12)


@pytest.mark.parametrize("unit", [1e-6, 1e-12])
def test_small_actions_are_solved_as_exactly_as_large_ones(unit):
    # fails if Newton's method ends at an action below 1e-8, whatever its unit: L⁻ was off by 2e-4 of itself
    def L_d(q0, q1, s0, h):
        kinetic = ((q1 - q0) ** 2).sum(-1) / (2 * h)
        return kinetic * scale - h * (0.5 * s0 + 0.8 * s0**2 / scale)

    q = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)[:, None]
    s, found = 1 - q[:, 0], []
    for scale in (1.0, unit):
        found.append(LeftLagrangian(L_d)(q, q + 0.1, scale * s, 0.1) / scale)
    close(found[1], found[0], 1e-14)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("name", ["nonlinear", "parachute"])
def test_hamiltonian_derivatives(name, side):
    # fails if the graph of L⁻, H⁺ or H⁻ lacks a derivative of q or s0: differences of H and of its gradient
    L_d, h, (q0, p0, s0), (q1, p1, s1), _ = solved(name)
    H, x = (RightHamiltonian(L_d, q1), (q0, p1, s0)) if side == "right" else (LeftHamiltonian(L_d, q0), (p0, q1, s1))
    P = partials(H, *x, h, order=2)
    n, eps = q0.shape[-1], 1e-5
    flat, moves = torch.cat([x[0], x[1], x[2][:, None]], -1), eps * torch.eye(2 * n + 1, dtype=torch.float64)
    y = flat + torch.stack([moves, -moves])[:, :, None]  # (sign, direction, sample, 2n + 1)
    Q = partials(H, y[..., :n], y[..., n : 2 * n], y[..., -1], h)
    ends = torch.cat([Q.L[..., None], Q.D1, Q.D2, Q.D3[..., None]], -1)
    slope = ((ends[0] - ends[1]) / (2 * eps)).permute(1, 2, 0)  # (sample, value and gradient, direction)
    first = torch.cat([P.D1, P.D2, P.D3[:, None]], -1)
    close(slope[:, 0], first, 1e-7)
    second = torch.cat(
        [
            torch.cat([P.D11, P.D12, P.D13[..., None]], -1),
            torch.cat([P.D12.mT, P.D22, P.D23[..., None]], -1),
            torch.cat([P.D13, P.D23, P.D33[:, None]], -1)[:, None],
        ],
        -2,
    )
    close(slope[:, 1:], second, 1e-6)


def test_hamiltonians_of_the_oscillator_in_closed_form():
    # fails if either transform takes the wrong argument or sign; closed forms of section 3
    L_d, h, (q0, p0, s0), (q1, p1, s1), _ = solved("oscillator")
    m, omega, gamma = (OSCILLATOR.parameters[name] for name in ("m", "omega0", "gamma"))
    w, root = math.sqrt(omega**2 - gamma**2 / 4), math.exp(-gamma * h / 2)
    a, a_plus = (m * (w / math.tan(w * h) + sign * gamma / 2) for sign in (-1, 1))
    b, k = m * w / math.sin(w * h), (m * omega) ** 2
    right = (p1**2 / 2 + root * b * p1 * q0 + root**2 * k * q0**2 / 2)[:, 0] / a + (1 - root**2) * s0
    left = (p0**2 / 2 - b / root * p0 * q1 + k / root**2 * q1**2 / 2)[:, 0] / a_plus + (1 / root**2 - 1) * s1
    close(RightHamiltonian(L_d)(q0, p1, s0, h), right, 1e-12)
    close(LeftHamiltonian(L_d, q1)(p0, q1, s1, h), left, 1e-12)


@pytest.mark.parametrize("name", CASES)
def test_both_sets_of_equations_on_the_flow(name):
    # fails if a left equation is the printed one (E5), or the right ones miss 1 − D3H⁺
    L_d, h, (q0, p0, s0), (q1, p1, s1), _ = solved(name)
    right = right_equations(partials(RightHamiltonian(L_d, q1 + 0.01), q0, p1, s0, h), p1, s0)
    left = left_equations(partials(LeftHamiltonian(L_d, q0 - 0.01), p0, q1, s1, h), p0, s1)
    for value, expected in zip((*right, *left), (q1, p0, s1, q0, p1, s0), strict=True):
        close(value, expected, 1e-12)


# The numerically exact L_d, whose values are integrals, takes thirty times as long as the others.
@pytest.mark.parametrize("name", [name for name in CASES if name != "numerically exact"])
def test_steps_by_right_and_by_left_equations(name):
    # fails if three ways to the same map, Newton on FL⁻, right and left equations, differ
    L_d, h, start, end, _ = solved(name)
    near = start.q + h * start.p
    by_right = right_step(RightHamiltonian(L_d, near), *start, h)
    by_left = left_step(LeftHamiltonian(L_d, start.q), *start, h)
    for value, expected in zip((*by_right, *by_left), (*end, *end), strict=True):
        close(value, expected, 1e-12)


def test_samples_may_share_a_momentum():
    # fails if derivatives by the momentum that samples share are sums over samples: q1 and p1 were NaN
    q0, p0, s0 = (x[:4] for x in states(n=1))
    H = RightHamiltonian(OSCILLATOR.L_d)
    for shared, each in zip(
        right_step(H, q0, p0[0], s0, 0.1), right_step(H, q0, p0[:1].expand(4, 1), s0, 0.1), strict=True
    ):
        close(shared, each, 1e-15)


def test_where_c_vanishes_the_left_side_is_nan_and_the_right_is_not():
    # fails if 1/c is hidden, or one bad sample spoils its neighbours: left rule at h = 1/γ
    L_d = scene("damped_oscillator").L_d_rules["left"]
    x = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
    s, h = torch.tensor([0.3, 0.1], dtype=torch.float64), torch.tensor([5.0, 0.1], dtype=torch.float64)
    left = LeftLagrangian(L_d)(x, x + 0.1, s, h)
    assert left.isnan().tolist() == [True, False]
    assert LeftHamiltonian(L_d)(x, x, s, h).isnan().tolist() == [True, False]
    assert RightHamiltonian(L_d)(x, x, s, h).isnan().tolist() == [False, False]


def test_no_previous_action_is_nan():
    # fails if Newton's last iterate is returned where s0 + L_d = s1 has no solution (c changes sign)
    def fold(q0, q1, s0, h):
        return s0**2 + (q0 * q1).sum(-1) + 0 * h

    q, s1 = torch.zeros(2, 1, dtype=torch.float64), torch.tensor([-1.0, 2.0], dtype=torch.float64)
    s0 = s1 - LeftLagrangian(fold)(q, q, s1, 1.0)
    assert s0.isnan().tolist() == [True, False]
    assert float(s0[1]) == pytest.approx(1.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_and_precision(dtype):
    # fails if leading dimensions are lost or float64 gets in
    L_d, h, start, end, _ = solved("nonlinear")
    p0, q1, s1, q0 = (x.to(dtype).reshape(3, 4, *x.shape[1:]) for x in (start.p, end.q, end.s, start.q))
    H = LeftHamiltonian(L_d, q0)(p0, q1, s1, h)
    assert H.shape == (3, 4)
    assert H.dtype == dtype
    alone = LeftHamiltonian(L_d, q0[1, 2])(p0[1, 2], q1[1, 2], s1[1, 2], h)
    assert math.isclose(float(alone), float(H[1, 2]), rel_tol=1e3 * torch.finfo(dtype).eps)
