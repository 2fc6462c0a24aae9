"""The exact L_d against quadrature of the action along the exact motion, 50 digits, at parameters nobody wrote down;
with H⁺ = p1 q1 − L_d and H⁻ = −p0 q0 − L_d along the motion."""

import mpmath as mp
import pytest
import torch

from herglotz.mechanics import partials
from herglotz.scenes import scene


def draws(seed, count, *ranges):
    """Uniform draws, one row a case."""
    unit = torch.rand(count, len(ranges), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return [[lo + (hi - lo) * x for (lo, hi), x in zip(ranges, row.tolist(), strict=True)] for row in unit]


def vector(x):
    return torch.tensor([x], dtype=torch.float64)


def scalar(x):
    return torch.tensor(x, dtype=torch.float64)


# ω² = Ω² − γ²/4: under-damped, over-damped, critical, critical to round-off, free
OSCILLATORS = [
    *[(m, w, g, h) for m, w, g, h in draws(1, 3, (0.3, 3), (0.5, 2), (0.01, 0.9), (0.01, 1.2))],
    *[(m, w, g, h) for m, w, g, h in draws(2, 3, (0.3, 3), (0.1, 1), (2.5, 5), (0.01, 1.2))],
    (0.7, 0.83, 1.66, 0.37),
    (0.7, 0.83, 1.66 * (1 + 1e-13), 0.37),
    (1.3, 1e-9, 0.4, 0.21),
    (1.3, 1.1, 1e-12, 0.21),
]


def oscillator_answer(m, w, gamma, h, q0, v0, s0):
    """(q1, p1, L_d) from the complex exponential solution and quadrature of e^{−γ(h−t)}(T − V)."""
    m, w, gamma, h, q0, v0, s0 = (mp.mpf(x) for x in (m, w, gamma, h, q0, v0, s0))
    nu = mp.sqrt(mp.mpc(w**2 - gamma**2 / 4))

    def q(t):
        ratio = mp.sin(nu * t) / nu if nu != 0 else t
        return mp.re(mp.exp(-gamma * t / 2) * (q0 * mp.cos(nu * t) + (v0 + gamma * q0 / 2) * ratio))

    def v(t):
        ratio = mp.sin(nu * t) / nu if nu != 0 else t
        return mp.re(mp.exp(-gamma * t / 2) * (v0 * mp.cos(nu * t) - (w**2 * q0 + gamma * v0 / 2) * ratio))

    action = mp.quad(lambda t: mp.exp(-gamma * (h - t)) * (m * v(t) ** 2 - m * w**2 * q(t) ** 2) / 2, [0, h])
    return q(h), m * v(h), mp.expm1(-gamma * h) * s0 + action


@pytest.mark.parametrize("case", range(len(OSCILLATORS)))
def test_oscillator(case):
    # fails if one damping regime uses another's formula, if critical damping divides by ω = 0,
    # or if γ/4 (in ω²) or mγ/4 (in L_d) is off: the defaults m = Ω = 1 hide the powers of m and Ω
    m, w, gamma, h = OSCILLATORS[case]
    (q0, v0, s0), *_ = draws(100 + case, 1, (-2, 2), (-2, 2), (-1, 1))
    with mp.workdps(50):
        q1, p1, L = oscillator_answer(m, w, gamma, h, q0, v0, s0)
        H_plus, H_minus = float(p1 * q1 - L), float(-mp.mpf(m) * v0 * q0 - L)
        q1, p1, L = float(q1), float(p1), float(L)
    system = scene("damped_oscillator", m=m, omega0=w, gamma=gamma)
    assert system.H_plus is not None
    assert system.H_minus is not None
    end = system.flow(vector(q0), vector(m * v0), scalar(s0), h)
    scale = m * (q0**2 + v0**2) + abs(s0)
    assert abs(end[0].item() - q1) < 1e-14 * (abs(q0) + abs(v0))
    assert abs(end[1].item() - p1) < 1e-14 * m * (abs(q0) + abs(v0)) * (1 + w**2)
    assert abs(end[2].item() - s0 - L) < 1e-14 * scale
    P = partials(system.L_d, vector(q0), vector(q1), scalar(s0), h)
    assert abs(P.L.item() - L) < 1e-14 * scale / min(h, 1.0)
    assert abs(P.D2.item() - p1) < 1e-14 * scale / min(h, 1.0)
    assert abs(-P.D1.item() / P.c.item() - m * v0) < 1e-14 * scale / min(h, 1.0) ** 2
    # fails if either discrete Hamiltonian has a coefficient of its own regime
    assert abs(system.H_plus(vector(q0), vector(p1), scalar(s0), h).item() - H_plus) < 2e-14 * scale / h**2
    assert abs(system.H_minus(vector(m * v0), vector(q1), scalar(s0 + L), h).item() - H_minus) < 2e-14 * scale / h**2


PARACHUTES = [
    *[tuple(x) for x in draws(3, 4, (0.3, 3), (1, 20), (0.003, 0.2), (0.01, 0.8))],
    (1.7, 0.0, 0.05, 0.3),
    (1.7, 9.81, 1e-6, 0.3),
    (0.6, 3.0, -0.04, 0.3),
]


def parachute_answer(m, g, lam, h, q0, v0, s0):
    """(q1, v1, L_d): Riccati velocity in complex ω, and s1 = e^{2λΔ}s0 + ∫e^{2λ(q1−q)}(T − V)dt."""
    m, g, lam, h, q0, v0, s0 = (mp.mpf(x) for x in (m, g, lam, h, q0, v0, s0))
    w = mp.sqrt(mp.mpc(lam * g))

    def ratio(t):
        return mp.re(mp.sinh(w * t) / w) if w != 0 else t

    def q(t):
        return q0 - mp.log(mp.re(mp.cosh(w * t)) - lam * v0 * ratio(t)) / lam

    def v(t):
        cosh = mp.re(mp.cosh(w * t))
        return (v0 * cosh - g * ratio(t)) / (cosh - lam * v0 * ratio(t))

    def density(t):
        return mp.exp(2 * lam * (q(h) - q(t))) * (m * v(t) ** 2 / 2 - m * g * mp.expm1(2 * lam * q(t)) / (2 * lam))

    return q(h), v(h), mp.expm1(2 * lam * (q(h) - q0)) * s0 + mp.quad(density, [0, h])


@pytest.mark.parametrize("case", range(len(PARACHUTES)))
def test_parachute(case):
    # fails if a power of m, g or λ is off (the golden m = 1 hides m), if λ < 0 or g = 0 breaks ω, or if small λ cancels
    m, g, lam, h = PARACHUTES[case]
    (q0, v0, s0), *_ = draws(200 + case, 1, (-3, 5), (-3, 1), (-1, 1))
    with mp.workdps(50):
        q1, v1, L = parachute_answer(m, g, lam, h, q0, v0, s0)
        p1 = m * v1 + 2 * mp.mpf(lam) * (s0 + L)
        H_plus, H_minus = float(p1 * q1 - L), float(-(m * v0 + 2 * mp.mpf(lam) * s0) * q0 - L)
        q1, v1, L, p1 = float(q1), float(v1), float(L), float(p1)
    system = scene("parachute", m=m, g=g, lam=lam)
    p0 = system.momentum(vector(q0), vector(v0), scalar(s0))
    end = system.flow(vector(q0), p0, scalar(s0), h)
    scale = m * (v0**2 + g * abs(q0) + g * h) + abs(s0)
    # λ = 1e-6: t − 1 and e^{2λΔ} − 1 are small numbers divided by λ; their rounding grows like ε g h/λ
    tolerance = 2e-14 * scale / h + 2e-16 * m * g * h / abs(lam)
    assert abs(end[0].item() - q1) < 1e-14 * (abs(q0) + abs(v0) + 1)
    assert abs(system.velocity(*end).item() - v1) < 1e-13 * (abs(v0) + g * h)
    assert abs(end[2].item() - s0 - L) < tolerance
    P = partials(system.L_d, vector(q0), vector(q1), scalar(s0), h)
    assert abs(P.L.item() - L) < tolerance
    assert abs(P.D2.item() - p1) < tolerance / h
    assert abs(-P.D1.item() / P.c.item() - p0.item()) < tolerance / h
    # fails if the root of either quadratic is the wrong one, or cancels
    assert system.H_plus is not None
    assert system.H_minus is not None
    assert abs(system.H_plus(vector(q0), vector(p1), scalar(s0), h).item() - H_plus) < 10 * tolerance / h
    assert abs(system.H_minus(p0, vector(q1), scalar(s0 + L), h).item() - H_minus) < 10 * tolerance / h
