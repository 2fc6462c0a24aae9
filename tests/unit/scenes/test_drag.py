"""Linear and quadratic drag at random parameters against 50-digit closed forms, with both discrete Hamiltonians."""

import mpmath as mp
import pytest
import torch

from herglotz.mechanics import partials
from herglotz.scenes import scene


def draws(seed, *ranges):
    unit = torch.rand(len(ranges), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return [lo + (hi - lo) * x for (lo, hi), x in zip(ranges, unit.tolist(), strict=True)]


def vector(x):
    return torch.tensor([x], dtype=torch.float64)


def scalar(x):
    return torch.tensor(x, dtype=torch.float64)


def linear_answer(m, gamma, h, q0, v0, s0):
    """(q1, p1, s1, c) from v = v0 e^{−γt} and ṡ = mv²/2 − γs, solved by variation of constants."""
    E = mp.exp(-gamma * h)
    travelled = v0 * (1 - E) / gamma
    return q0 + travelled, m * v0 * E, E * s0 + m * v0**2 / 2 * E * (1 - E) / gamma, E


def quadratic_answer(m, lam, h, q0, v0, s0):
    """(q1, p1, s1, c) from v = v0/(1 − λv0t) and d/dt(e^{−2λq}s) = e^{−2λq}mv²/2; e^{−λ(q−q0)} = 1 − λv0t."""
    y = 1 - lam * v0 * h
    s1 = (s0 + m * v0**2 * h / 2) / y**2  # (e^{−2λ(q−q0)} v² is v0² throughout)
    return q0 - mp.log(y) / lam, m * v0 / y + 2 * lam * s1, s1, 1 / y**2


CASES = [
    *[("linear_drag", {"m": m, "gamma": g}) for m, g in (draws(i, (0.3, 3), (-0.5, 3)) for i in range(4))],
    ("linear_drag", {"m": 1.3, "gamma": 1e-9}),  # where 1 − E cancels
    ("linear_drag", {"m": 1.3, "gamma": 1e-30}),
    *[("quadratic_drag", {"m": m, "lam": x}) for m, x in (draws(9 + i, (0.3, 3), (0.003, 0.2)) for i in range(3))],
    ("quadratic_drag", {"m": 0.8, "lam": -0.05}),
    ("quadratic_drag", {"m": 0.8, "lam": 1e-6}),
]


@pytest.mark.parametrize("case", range(len(CASES)))
def test_against_50_digits(case):
    # fails if a power of m, γ or λ is off (defaults of 1 hide m), if γ → 0 divides by γ, or H± has a wrong branch or
    # sign; H⁺ = p1 q1 − L_d and H⁻ = −p0 q0 − L_d along the motion
    name, parameters = CASES[case]
    h, q0, v0, s0 = draws(100 + case, (0.05, 0.8), (-2, 2), (-2, 1), (-1, 1))
    system = scene(name, **parameters)
    answer = linear_answer if name == "linear_drag" else quadratic_answer
    with mp.workdps(50):
        exact = answer(*(mp.mpf(x) for x in (*parameters.values(), h, q0, v0, s0)))
        p0 = parameters["m"] * mp.mpf(v0) + (0 if name == "linear_drag" else 2 * mp.mpf(parameters["lam"]) * s0)
        L = exact[2] - s0
        H_plus, H_minus = float(exact[1] * exact[0] - L), float(-p0 * q0 - L)
        q1, p1, s1, c = (float(x) for x in exact)
    tolerance = 2e-14 * (1 + parameters["m"]) / h
    end = system.flow(vector(q0), vector(float(p0)), scalar(s0), h)
    for value, number in zip(end, (q1, p1, s1), strict=True):
        assert abs(value.item() - number) < tolerance
    P = partials(system.L_d, vector(q0), vector(q1), scalar(s0), h)
    for value, number in ((P.L, float(L)), (P.D2, p1), (-P.D1 / P.c, float(p0)), (P.c, c)):
        assert abs(value.item() - number) < tolerance
    assert system.H_plus is not None
    assert system.H_minus is not None
    assert abs(system.H_plus(vector(q0), vector(p1), scalar(s0), h).item() - H_plus) < 2 * tolerance
    assert abs(system.H_minus(vector(float(p0)), vector(q1), scalar(s1), h).item() - H_minus) < 2 * tolerance


def test_no_drag_at_all():
    # fails if γ = 0 divides 0 by 0 in a value or in its derivatives with respect to h
    system = scene("linear_drag", m=2.0, gamma=0.0)
    h = scalar(0.3).requires_grad_()
    L = system.L_d(vector(0.1), vector(0.7), scalar(0.4), h)
    assert abs(L.item() - 0.36 / 0.3) < 1e-15
    assert abs(torch.autograd.grad(L, h)[0].item() + 0.36 / 0.09) < 1e-14


def test_left_hamiltonian_of_the_parachute_beyond_its_fold_is_nan():
    # fails if beyond the fold, where no q0 has this p0, a number comes back
    system = scene("parachute")
    assert system.H_minus is not None
    S = 0.1 * (1 + 0.1 * 0.1**2 / 6)
    p0 = torch.tensor([[0.2], [0.3]], dtype=torch.float64) / (0.01 * S)  # the fold is at m/4λS, a little shifted by a
    H = system.H_minus(p0, torch.zeros(2, 1).double(), torch.zeros(2).double(), 0.1)
    assert H.isnan().tolist() == [False, True]
