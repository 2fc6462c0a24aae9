"""Orders of the rules on a nonlinear damped problem, and the implicit rule's derivatives."""

import math

import mpmath as mp
import pytest
import torch

from herglotz.mechanics import autograd_partials, partials
from herglotz.scenes import ORDERS, damped_pendulum, midpoint, midpoint_heun, parachute, scene
from herglotz.scenes.rules import RULES, implicit
from herglotz.stepping import Stepper

HORIZON = 2.0


def measured_orders(system, L_d, q, p, s, horizon, steps=(20, 40, 80)):
    """Slopes of the error of q, p and s at the horizon, from the last two halvings' finest pair."""
    expected = system.flow(q, p, s, horizon)
    errors = []
    for count in steps:
        with torch.no_grad():
            end = Stepper(L_d, throw=True).rollout(q, p, s, h=horizon / count, steps=count).final
        errors.append([float((a - b).abs().max()) for a, b in zip(end, expected, strict=True)])
    return [math.log2(a / b) for a, b in zip(errors[-2], errors[-1], strict=True)]


def pendulum_start():
    q = torch.tensor([[0.7], [-1.9], [2.3]], dtype=torch.float64)
    p = torch.tensor([[0.9], [0.4], [-1.1]], dtype=torch.float64)
    return q, p, torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)


def claim_holds(slopes, order):
    """Whether measured slopes bear out a claimed order: all of them, not a half less nor (a suspicious) 3/4 more."""
    return all(-0.25 < slope - order < 0.75 for slope in slopes)


# numbers of steps over the horizon, chosen so that the finer error stays well above round-off
STEPS = {1: (40, 80), 2: (20, 40)}


@pytest.mark.parametrize("name", [*ORDERS, "strang"])
def test_order_on_the_damped_pendulum(name):
    # fails if a rule takes s at the wrong stage (trap 1: order 1 with damping), or the list of
    # orders is wrong; the plain rules show that this test sees the trap
    system = damped_pendulum(gamma=0.4)
    order = ORDERS.get(name, 2)
    slopes = measured_orders(system, system.L_d_rules[name], *pendulum_start(), HORIZON, STEPS[order])
    assert claim_holds(slopes, order), slopes
    # fails if the helper would let a claim pass that is one too high (two for the rules of even order)
    assert not claim_holds(slopes, order + 1)
    assert not claim_holds(slopes, order - 1)


@pytest.mark.parametrize("name", ["midpoint_plain", "trapezoid_plain"])
def test_trap_is_invisible_without_damping(name):
    # fails if the order test's γ is mistaken for irrelevant: undamped, the plain rules do have order 2
    system = damped_pendulum(gamma=0.0)
    slopes = measured_orders(system, system.L_d_rules[name], *pendulum_start(), HORIZON)
    assert claim_holds(slopes, 2)


def pairs():
    q0, p, s0 = pendulum_start()
    return q0, q0 + 0.3 * p, s0, torch.tensor(0.4, dtype=torch.float64)


def adjoint(L_d):
    """L_d* of the adjoint method (Φ̃_{−h})⁻¹: L_d* = −L_d(q1, q0, s0 + L_d*, −h), implicit in one scalar."""
    return lambda q0, q1, s0, h: implicit(lambda x: -L_d(q1, q0, s0 + x, -h), q0, q1, s0, h)


@pytest.mark.parametrize(("name", "other"), [("left", "right"), *((x, x) for x in ("midpoint", "trapezoid", "strang"))])
def test_adjoint_pairs(name, other):
    # fails if L_d*(q0, q1, s0) takes s at the wrong end or forgets that h changes sign, or strang weights V unevenly
    rules = {rule: make(nonlinear) for rule, make in RULES.items()}
    rules["strang"] = scene("damped_pendulum", gamma=0.4).L_d_rules["strang"]
    torch.testing.assert_close(adjoint(rules[name])(*pairs()), rules[other](*pairs()), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", ["midpoint_heun", "trapezoid_heun", "left"])
def test_not_their_own_adjoint(name):
    # fails if the test above cannot see a difference: then compositions of these would claim order 4
    q0, q1, s0, h = pairs()
    L_d = RULES[name](nonlinear)
    assert float((adjoint(L_d)(q0, q1, s0, h) - L_d(q0, q1, s0, h)).abs().min()) > 1e-6


def test_order_of_strang_exponential():
    # fails if V0 of its first bracket is dropped or is V1: then order 1
    system = parachute(lam=0.03)
    q, v = torch.tensor([[2.0], [-1.0]], dtype=torch.float64), torch.tensor([[-4.0], [1.0]], dtype=torch.float64)
    s = torch.tensor([0.5, -0.5], dtype=torch.float64)
    L_d = system.L_d_rules["strang_exponential"]
    for slope in measured_orders(system, L_d, q, system.momentum(q, v, s), s, 0.8):
        assert abs(slope - 2) < 0.15
    # fails if c is not e^{2λΔ} exactly
    h = torch.tensor(0.1, dtype=torch.float64)
    c = autograd_partials(L_d, q, q + 0.3, s, h).c
    torch.testing.assert_close(c, torch.full_like(s, math.exp(2 * 0.03 * 0.3)), rtol=1e-15, atol=0)


@pytest.mark.parametrize(
    ("rule", "factor"),
    [
        ("left", lambda x: 1 - x),
        ("right", lambda x: 1 / (1 + x)),
        ("trapezoid", lambda x: (1 - x / 2) / (1 + x / 2)),
        ("midpoint_plain", lambda x: 1 - x),
        ("trapezoid_plain", lambda x: 1 - x),
        ("strang", lambda x: math.exp(-x)),
        ("midpoint", lambda x: (1 - x / 2) / (1 + x / 2)),
        ("midpoint_heun", lambda x: 1 - x + x**2 / 2),
        ("trapezoid_heun", lambda x: 1 - x + x**2 / 2),
    ],
)
def test_conformal_factor(rule, factor):
    # fails if the Heun stage has h instead of h/2 (or the reverse), or the implicit one is solved for another s
    gamma, h = 0.7, 0.3
    q = torch.tensor([0.4], dtype=torch.float64)
    L_d = scene("damped_oscillator", gamma=gamma).L_d_rules[rule]
    c = partials(L_d, q, q + 0.2, torch.tensor(0.9, dtype=torch.float64), h).c
    assert abs(c.item() - factor(gamma * h)) < 1e-15


def nonlinear(q, v, s):
    """L with every mixed derivative in q, v and s; works on tensors."""
    q, v = q[..., 0], v[..., 0]
    return 0.5 * v**2 - torch.cos(q) - 0.3 * s - 0.4 * torch.sin(s) * (1 + 0.2 * q) - 0.1 * v * s**2


def implicit_answer(h):
    """x(q0, q1, s0) = h L(q̄, v, s0 + x/2) at 40 digits."""

    def solve(q0, q1, s0):
        def equation(x):
            q, v, s = (q0 + q1) / 2, (q1 - q0) / h, s0 + x / 2
            L = v**2 / 2 - mp.cos(q) - 0.3 * s - 0.4 * mp.sin(s) * (1 + 0.2 * q) - 0.1 * v * s**2
            return x - h * L

        return mp.findroot(equation, (mp.mpf(0), mp.mpf(1) / 10), tol=1e-70)

    return solve


def test_implicit_midpoint_derivatives():
    # fails if the implicit equation is differentiated through fewer than two Newton steps: D33, D13 lose a term and
    # third derivatives (training through second derivatives) more
    h, point = 0.6, (0.4, 0.9, 0.7)
    q0, q1, s0 = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in point)
    L_d = midpoint(nonlinear)

    def of_scalars(a, b, s):
        return L_d(a[None], b[None], s, torch.tensor(h, dtype=torch.float64))

    P = autograd_partials(L_d, q0[None], q1[None], s0, h, order=2)
    third = torch.autograd.grad(P.D33, s0, retain_graph=True)[0]
    with mp.workdps(40):
        answer = implicit_answer(mp.mpf(h))
        orders = {"L": (0, 0, 0), "D1": (1, 0, 0), "D2": (0, 1, 0), "D3": (0, 0, 1), "D11": (2, 0, 0), "D12": (1, 1, 0)}
        orders |= {"D22": (0, 2, 0), "D13": (1, 0, 1), "D23": (0, 1, 1), "D33": (0, 0, 2)}
        exact = {k: float(mp.diff(answer, point, n)) if sum(n) else float(answer(*point)) for k, n in orders.items()}
        exact_third = float(mp.diff(answer, point, (0, 0, 3)))
    for name, expected in exact.items():
        assert abs(getattr(P, name).item() - expected) < 1e-13 * (1 + abs(expected)), name
    assert abs(third.item() - exact_third) < 1e-12
    assert torch.autograd.gradgradcheck(of_scalars, (q0, q1, s0))


def test_implicit_midpoint_without_a_solution_is_nan():
    # fails if a Newton iteration that has not converged is returned as if it had
    L_d = midpoint(lambda q, v, s: 10 + s**2 + 0 * (q + v)[..., 0])
    q = torch.zeros(2, 1, dtype=torch.float64)
    h = torch.tensor([10.0, 1e-3], dtype=torch.float64)
    value = L_d(q, q, torch.zeros(2, dtype=torch.float64), h)
    assert bool(value[0].isnan())
    assert abs(value[1].item() - 0.0100000250001) < 1e-12


def test_implicit_midpoint_of_a_conservative_lagrangian():
    # fails if a Lagrangian that ignores s has no gradient to give and raises
    system = damped_pendulum(gamma=0.0)
    q0, p, s = pendulum_start()
    h = torch.tensor(0.1, dtype=torch.float64)

    def conservative(q, v, s):  # noqa: ARG001
        return system.lagrangian(q, v, torch.zeros_like(v[..., 0]))

    L_d = midpoint(conservative)
    torch.testing.assert_close(L_d(q0, q0 + p, s, h), midpoint_heun(conservative)(q0, q0 + p, s, h))
    assert bool((partials(L_d, q0, q0 + p, s, h).c == 1).all())


def test_implicit_midpoint_graph():
    # fails if plain evaluation drags a graph along, or no_grad is not respected, or parameters get no gradient
    q, p, s = pendulum_start()
    h = torch.tensor(0.1, dtype=torch.float64)
    L_d = scene("damped_pendulum").L_d_rules["midpoint"]
    assert not L_d(q, q + p, s, h).requires_grad
    with torch.no_grad():
        assert not L_d(q.clone().requires_grad_(), q + p, s, h).requires_grad
    gamma = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    learned = midpoint(lambda q, v, s: 0.5 * (v * v).sum(-1) - gamma * s + 0 * q.sum(-1))
    # L_d = (h v²/2 − γh s0)/(1 + γh/2)
    (slope,) = torch.autograd.grad(learned(q[0], q[0] + p[0], s[0], h), gamma)
    x, g, a = 0.1, 0.3, 0.5 * float(p[0]) ** 2 / 0.1
    expected = -x * 0.3 / (1 + g * x / 2) - (a - g * x * 0.3) * (x / 2) / (1 + g * x / 2) ** 2
    assert abs(slope.item() - expected) < 1e-14
