"""A single step: one answer by every path, samples apart, small steps in float32."""

from functools import partial

import pytest
import torch

from herglotz.mechanics import autograd_partials, momentum_jacobian, momentum_residual, partials
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Solution, State, Status, Stepper, solve, solve_step
from herglotz.stepping.equation import End, PartialsEquation
from herglotz.stepping.newton import find_root, status_of
from tests import lagrangians
from tests.lagrangians import states_in_turn

LEVELS = {
    "correction": ModelConfig(correction_width=6),
    "affine": ModelConfig(level="affine"),
    "two": ModelConfig(
        level="affine",
        angles=(True, False),
        **{k: (1.0, 1.0) for k in ("scale", "speed", "stiffness", "tilt")},  # pyright: ignore[reportArgumentType]
    ),
}
# Friction of a measured arm with two motors.
SHARP = {
    "kinetic.log_diagonal": [-0.7], "kinetic.off_diagonal": [0.5], "friction.coulomb": [1.0, 2.0],
    "friction.breakaway": [1.2, -1.0], "friction.log_smooth": [-0.3, -6.8], "friction.log_stribeck": [0.2, 1.7],
}  # fmt: skip
random_model = partial(lagrangians.random_model, spread=0.2)
TOL = 64 * torch.finfo(torch.float64).eps


def solved(L_d, state, h, guess, limit=30, order=2):
    """`solve_step`; of order 1 the same with a kept Jacobian, as rollouts without gradients have it."""
    if order == 2:
        return solve_step(L_d, state, h, guess, TOL, limit)
    found = find_root(PartialsEquation(L_d, state, h, 1, False), guess, TOL, limit, 1)
    P = found.point.rest
    return Solution(found.x, P, status_of(found, End(P.D2, P.L, P.c))[0], found.residual, found.iterations)


def states(n, batch=6, dtype=torch.float64):
    return states_in_turn(n, batch, 4, dtype)


class Counted:
    """A discrete Lagrangian that counts its evaluations by order."""

    def __init__(self, L_d):
        self.L_d, self.orders = L_d, []

    def __call__(self, q0, q1, s0, h):
        return self.L_d(q0, q1, s0, h)

    def partials(self, q0, q1, s0, h, order=1):
        self.orders.append(order)
        return partials(self.L_d, q0, q1, s0, h, order)


@pytest.mark.parametrize("name", LEVELS)
def test_both_orders_and_a_plain_newton_agree(name):
    # fails if a kept Jacobian changes the answer, or its P, residual or status belongs to another point
    model, (q, p, s) = random_model(LEVELS[name]), states(LEVELS[name].dof)
    h = torch.tensor(0.2, dtype=torch.float64)
    with torch.no_grad():
        full = solved(model, State(q, p, s), h, q)
        for guess in (q, full.q1 + 1e-4 * p, full.q1 + 1e-9, full.q1):
            fast = solved(model, State(q, p, s), h, guess, order=1)
            torch.testing.assert_close(fast.q1, full.q1, rtol=1e-13, atol=1e-13)
            torch.testing.assert_close(fast.P.D2, partials(model, q, fast.q1, s, h).D2, rtol=1e-13, atol=1e-13)
            assert fast.status.tolist() == [Status.CONVERGED] * 6
            assert bool((fast.residual <= TOL * 10).all())
        q1 = q
        for _ in range(8):
            P = autograd_partials(model, q, q1, s, h, 2)
            step = torch.linalg.solve(momentum_jacobian(P, p), momentum_residual(P, p)[..., None])[..., 0]
            q1 = q1 - step
        torch.testing.assert_close(full.q1, q1, rtol=1e-13, atol=1e-13)


def test_a_good_guess_costs_one_second_derivative():
    # fails if every iteration of a rollout evaluates the Hessian again
    counted = Counted(random_model(LEVELS["correction"]))
    with torch.no_grad():
        Stepper(counted).rollout(*states(1), h=0.02, steps=40)
    second, first = counted.orders.count(2), counted.orders.count(1)
    # More than one a step only at the start, where the guess is poor.
    assert second <= 40 + 12
    assert second + first <= 40 * 3


@pytest.mark.parametrize("order", [1, 2])
def test_bad_samples_cost_their_neighbours_nothing(order):
    # fails if NaN, inf or a hopeless sample changes a neighbour's answer, or keeps the batch iterating
    counted = Counted(random_model(LEVELS["affine"]))
    q, p, s = states(1)
    h = torch.tensor(0.2, dtype=torch.float64)
    with torch.no_grad():
        good = solved(counted, State(q, p, s), h, q, order=order)
        spoiled_q, spoiled_p = q.clone(), p.clone()
        spoiled_q[1], spoiled_p[3], spoiled_p[4] = torch.nan, torch.inf, -torch.inf
        counted.orders.clear()
        bad = solved(counted, State(spoiled_q, spoiled_p, s), h, spoiled_q, order=order)
    assert bad.iterations <= good.iterations
    assert bad.status.tolist() == [0, Status.DIVERGED, 0, Status.DIVERGED, Status.DIVERGED, 0]
    for i in (0, 2, 5):
        torch.testing.assert_close(bad.q1[i], good.q1[i], rtol=1e-14, atol=1e-14)


def test_backtracking_with_a_kept_jacobian():
    # fails if a sample that needs short steps is given up, or drags its neighbours through them
    def stiff(q0, q1, s0, h):
        # F = −q1 − tanh(50 (q1 − 1)) / 10 at q0 = 0: flat, then steep; full Newton steps overshoot
        return (-q0 * (q1 + torch.tanh(50 * (q1 - 1)) / 10)).sum(-1) + 0 * s0 * h

    q = torch.zeros(3, 1, dtype=torch.float64)
    p = torch.tensor([[0.3], [1.0], [1.05]], dtype=torch.float64)
    s, h = torch.zeros(3, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    with torch.no_grad():
        both = [solved(stiff, State(q, p, s), h, q, order=order) for order in (1, 2)]
    for solution in both:
        assert solution.status.tolist() == [Status.CONVERGED] * 3
        F = -(solution.q1 + torch.tanh(50 * (solution.q1 - 1)) / 10) + p
        assert float(F.abs().max()) < 1e-13


def test_the_solution_of_two_equations():
    # fails if the elimination for n = 2 lacks its row exchange, or hides a singular matrix
    make = torch.Generator().manual_seed(6)
    A, b = (torch.randn(50, 2, k, generator=make, dtype=torch.float64) for k in (2, 1))
    A[0, 0, 0], A[1, 0, 0], A[2] = 0.0, 1e-18, 1e-200 * A[2]
    torch.testing.assert_close(solve(A, b[..., 0]), torch.linalg.solve(A, b)[..., 0], rtol=1e-10, atol=1e-12)
    singular = torch.tensor([[[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 0.0]]], dtype=torch.float64)
    assert not bool(torch.isfinite(solve(singular, torch.ones(2, 2, dtype=torch.float64))).all(-1).any())


# The explicit step is compensated in p as well: no growth. The implicit step rounds p1 = D2 L_d at every step.
@pytest.mark.parametrize(("level", "bound"), [("correction", 100 * 4 * 1.2e-7 * 3), ("linear", 2.5e-7)])
def test_small_steps_in_float32_keep_the_velocity(level, bound):
    # fails if a small step is solved for q1: then (q1 − q0)/h is rounding (trap 6)
    config = LEVELS["correction"] if level == "correction" else ModelConfig()
    h, steps = 1e-6, 100
    single, double = random_model(config, torch.float32), random_model(config).float().double()
    start = states(1, dtype=torch.float32)
    with torch.no_grad():
        out = Stepper(single).rollout(*start, h=h, steps=steps)
        h_single = float(torch.tensor(h, dtype=torch.float32))
        exact = Stepper(double).rollout(*(x.double() for x in start), h=h_single, steps=steps)
        naive = Stepper(Counted(single), explicit=False).rollout(*start, h=h, steps=steps)
    assert bool(out.ok.all())
    error, before = ((x.p.double() - exact.p).abs().max() for x in (out, naive))
    assert float(error) < bound
    assert not float(before) < 1e4 * float(error)
    moved = (exact.q[:, -1] - exact.q[:, 0]).abs().max()
    drift = (out.q.double()[:, -1] - exact.q[:, -1]).abs().max()
    # Half a unit in the last place of the position, for any number of steps.
    assert float(drift) < 1.5e-7
    assert float(drift) < 1e-2 * float(moved)


def test_gradient_of_a_small_float32_step():
    # fails if the derivative of the increment form misses the dependence on q0 at fixed Δ
    model = random_model(LEVELS["correction"], torch.float32)
    twin = random_model(LEVELS["correction"]).float().double()
    start = states(1, dtype=torch.float32)

    def gradient(model, start):
        leaves = [x.clone().requires_grad_() for x in start]
        out = Stepper(model).step(State(*leaves), 0.125).state
        return torch.autograd.grad(
            (out.q.sum() + 2 * out.p.sum() + out.s.sum()), [*leaves, *filter(lambda w: w.numel(), model.parameters())]
        )

    pairs = zip(gradient(model, start), gradient(twin, [x.double() for x in start]), strict=True)
    for a, b in pairs:
        torch.testing.assert_close(a.double(), b, rtol=2e-4, atol=2e-5)


def test_sharp_friction_misleads_no_old_jacobian():
    # fails if a move by an old Jacobian that raises |F| is accepted: iterations then went to and fro for ever where
    # smooth dry friction turns a joint back (1 in 400 of such steps, from positions that were continued past the turn)
    two = {k: (1.0, 1.0) for k in ("scale", "speed", "stiffness", "tilt")}
    model = ContactLagrangian(ModelConfig(level="forced", coulomb=True, angles=(True, True), **two))  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        for name, value in SHARP.items():
            model.get_parameter(name).copy_(torch.tensor(value))
    make = torch.Generator().manual_seed(0)
    q, p, near = (torch.randn(20000, 2, generator=make, dtype=torch.float64) for _ in range(3))
    with torch.no_grad():
        step = Stepper(model).step(
            State(0.3 * q, p, torch.zeros(20000, dtype=torch.float64)), 0.008, 0.3 * q + 0.03 * near
        )
    assert int((step.status != Status.CONVERGED).sum()) == 0
