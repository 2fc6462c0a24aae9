"""Closed forms against 50-digit motions at random parameters."""

import mpmath as mp
import pytest
import torch

from herglotz.mechanics import partials
from herglotz.scenes import scene


def draws(seed, *ranges):
    unit = torch.rand(len(ranges), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return [lo + (hi - lo) * x for (lo, hi), x in zip(ranges, unit.tolist(), strict=True)]


def oscillator(h, q0, v0, s0, m, omega0, gamma):
    """(q1, p1, s1) from the complex exponential solution and quadrature of e^{−γ(h−t)}(T − V)."""
    nu = mp.sqrt(mp.mpc(omega0**2 - gamma**2 / 4))

    def q(t):
        ratio = mp.sin(nu * t) / nu if nu != 0 else t
        return mp.re(mp.exp(-gamma * t / 2) * (q0 * mp.cos(nu * t) + (v0 + gamma * q0 / 2) * ratio))

    def v(t):
        ratio = mp.sin(nu * t) / nu if nu != 0 else t
        return mp.re(mp.exp(-gamma * t / 2) * (v0 * mp.cos(nu * t) - (omega0**2 * q0 + gamma * v0 / 2) * ratio))

    action = mp.quad(lambda t: mp.exp(-gamma * (h - t)) * (m * v(t) ** 2 - m * omega0**2 * q(t) ** 2) / 2, [0, h])
    return q(h), m * v(h), mp.exp(-gamma * h) * s0 + action


def parachute(h, q0, v0, s0, m, g, lam):
    """(q1, p1, s1): Riccati velocity in complex ω, and s1 = e^{2λΔ}s0 + ∫e^{2λ(q1−q)}(T − V)dt."""
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

    s1 = mp.exp(2 * lam * (q(h) - q0)) * s0 + mp.quad(density, [0, h])
    return q(h), m * v(h) + 2 * lam * s1, s1


def linear_drag(h, q0, v0, s0, m, gamma):
    """(q1, p1, s1) from v = v0 e^{−γt} and ṡ = mv²/2 − γs, solved by variation of constants."""
    E = mp.exp(-gamma * h)
    return q0 + v0 * (1 - E) / gamma, m * v0 * E, E * s0 + m * v0**2 / 2 * E * (1 - E) / gamma


def quadratic_drag(h, q0, v0, s0, m, lam):
    """(q1, p1, s1) from v = v0/(1 − λv0t) and d/dt(e^{−2λq}s) = e^{−2λq}mv²/2; e^{−λ(q−q0)} = 1 − λv0t."""
    y = 1 - lam * v0 * h
    s1 = (s0 + m * v0**2 * h / 2) / y**2
    return q0 - mp.log(y) / lam, m * v0 / y + 2 * lam * s1, s1


def oscillator_bounds(h, q0, v0, s0, m, omega0, gamma):  # noqa: ARG001
    size, action, t = abs(q0) + abs(v0), m * (q0**2 + v0**2) + abs(s0), min(h, 1.0)
    flow = 1e-14 * size, 1e-14 * m * size * (1 + omega0**2), 1e-14 * action
    return *flow, 1e-14 * action / t, 1e-14 * action / t, 1e-14 * action / t**2


def parachute_bounds(h, q0, v0, s0, m, g, lam):
    # λ = 1e-6: t − 1 and e^{2λΔ} − 1 are small numbers divided by λ; their rounding grows like ε g h/λ.
    action = 2e-14 * (m * (v0**2 + g * abs(q0) + g * h) + abs(s0)) / h + 2e-16 * m * g * h / abs(lam)
    flow = 1e-14 * (abs(q0) + abs(v0) + 1), 1e-13 * m * (abs(v0) + g * h), action
    return *flow, action, action / h, action / h


def drag_bounds(h, q0, v0, s0, m, rate):  # noqa: ARG001
    return (2e-14 * (1 + m) / h,) * 6


# Largest errors of q1, p1 and s1 of the flow, then of L_d, p1 and p0.
BOUNDS = {
    oscillator: oscillator_bounds, parachute: parachute_bounds, linear_drag: drag_bounds, quadratic_drag: drag_bounds,
}  # fmt: skip
NAMES = {oscillator: ("damped_oscillator", "m", "omega0", "gamma"), parachute: ("parachute", "m", "g", "lam"),
         linear_drag: ("linear_drag", "m", "gamma"), quadratic_drag: ("quadratic_drag", "m", "lam")}  # fmt: skip
CASES = [
    # ω² = Ω² − γ²/4: under-damped, over-damped, critical, critical to round-off, free, nearly undamped
    *((oscillator, *draws(i, (0.3, 3), (0.5, 2), (0.01, 0.9), (0.01, 1.2))) for i in range(3)),
    *((oscillator, *draws(i, (0.3, 3), (0.1, 1), (2.5, 5), (0.01, 1.2))) for i in range(3, 6)),
    (oscillator, 0.7, 0.83, 1.66, 0.37),
    (oscillator, 0.7, 0.83, 1.66 * (1 + 1e-13), 0.37),
    (oscillator, 1.3, 1e-9, 0.4, 0.21),
    (oscillator, 1.3, 0.0, 0.4, 0.21),
    (oscillator, 1.3, 1.1, 1e-12, 0.21),
    *((parachute, *draws(i, (0.3, 3), (1, 20), (0.003, 0.2), (0.01, 0.8))) for i in range(1, 5)),
    (parachute, 1.7, 0.0, 0.05, 0.3),
    (parachute, 1.7, 9.81, 1e-6, 0.3),
    (parachute, 0.6, 3.0, -0.04, 0.3),
    *((linear_drag, *draws(i, (0.3, 3), (-0.5, 3), (0.05, 0.8))) for i in range(4)),
    # where 1 − E cancels
    (linear_drag, 1.3, 1e-9, 0.4),
    (linear_drag, 1.3, 1e-30, 0.4),
    *((quadratic_drag, *draws(i, (0.3, 3), (0.003, 0.2), (0.05, 0.8))) for i in range(3)),
    (quadratic_drag, 0.8, -0.05, 0.6),
    (quadratic_drag, 0.8, 1e-6, 0.6),
]


@pytest.mark.parametrize("case", range(len(CASES)))
def test_against_50_digits(case):
    # fails if one damping regime uses another's formula, critical damping divides by ω = 0, a power of m, Ω, g, γ or λ
    # is off (defaults of 1 hide them), or a small γ or λ cancels
    answer, *numbers, h = CASES[case]
    name, *names = NAMES[answer]
    q0, v0, s0 = draws(100 + case, (-2, 2), (-2, 1), (-1, 1))
    with mp.workdps(50):
        q1, p1, s1 = answer(*(mp.mpf(x) for x in (h, q0, v0, s0, *numbers)))
        p0 = numbers[0] * mp.mpf(v0) + (2 * mp.mpf(numbers[-1]) * s0 if names[-1] == "lam" else 0)
        wanted = [float(x) for x in (q1, p1, s1, s1 - s0, p1, p0)]
    system = scene(name, **dict(zip(names, numbers, strict=True)))
    q, p, end_q = (torch.tensor([float(x)], dtype=torch.float64) for x in (q0, p0, q1))
    s = torch.tensor(s0, dtype=torch.float64)
    P = partials(system.L_d, q, end_q, s, h)
    found = *system.flow(q, p, s, h), P.L, P.D2, -P.D1 / P.c
    for value, number, bound in zip(found, wanted, BOUNDS[answer](h, q0, v0, s0, *numbers), strict=True):
        assert abs(value.item() - number) < bound


def test_no_drag_at_all():
    # fails if γ = 0 divides 0 by 0 in a value or in its derivatives with respect to h
    system = scene("linear_drag", m=2.0, gamma=0.0)
    q0, q1, s0 = (torch.tensor(x, dtype=torch.float64) for x in ([0.1], [0.7], 0.4))
    h = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    L = system.L_d(q0, q1, s0, h)
    assert abs(L.item() - 0.36 / 0.3) < 1e-15
    assert abs(torch.autograd.grad(L, h)[0].item() + 0.36 / 0.09) < 1e-14
