"""Discrete forces: p_k = −(D1L + F⁻)/c, p_{k+1} = D2L + F⁺ (trap 4 of `docs/mathematics.md`)."""

import torch

from herglotz.mechanics import (
    Forced,
    flow_derivative,
    herglotz_residual,
    legendre_minus,
    legendre_plus,
    partials,
    step_derivative,
)
from herglotz.stepping import State, Stepper
from tests.lagrangians import states_in_turn

H = 0.2


class ForcedPendula:
    """Two coupled pendula; viscous friction at each joint of its own, on top of the damping by s."""

    def __init__(self, gamma=0.1, friction=(0.3, 0.05)):
        self.gamma, self.friction = gamma, torch.tensor(friction, dtype=torch.float64)

    def __call__(self, q0, q1, s0, h):
        h = torch.as_tensor(h, dtype=q0.dtype)
        v, q = (q1 - q0) / h[..., None], (q0 + q1) / 2
        L = v.square().sum(-1) / 2 + 0.2 * v[..., 0] * v[..., 1] * torch.cos(q[..., 0]) + torch.cos(q).sum(-1)
        return torch.expm1(-self.gamma * h) * s0 + h * L

    def forces(self, q0, q1, s0, h):
        h = torch.as_tensor(h, dtype=q0.dtype)
        force = -self.friction.to(q0) * (q1 - q0) / h[..., None] * (1 + 0.1 * torch.sin(s0))[..., None]
        c = torch.exp(-self.gamma * h)
        return (c * h / 2)[..., None] * force, (h / 2)[..., None] * force


def test_a_step_solves_the_forced_equations():
    # fails if F⁻ or F⁺ is left out of a momentum, or enters with the wrong sign
    L_d, state = ForcedPendula(), states_in_turn(2, 5)
    assert isinstance(L_d, Forced)
    with torch.no_grad():
        step = Stepper(L_d).step(state, H)
        q1 = step.state.q
        P = partials(L_d, state.q, q1, state.s, H)
        minus, plus = L_d.forces(state.q, q1, state.s, torch.tensor(H, dtype=torch.float64))
    torch.testing.assert_close(-(P.D1 + minus) / P.c[..., None], state.p, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(P.D2 + plus, step.state.p, rtol=0, atol=1e-13)
    # fails if a transform forgets what the step equation knows
    torch.testing.assert_close(legendre_minus(L_d, state.q, q1, state.s, H)[1], state.p, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(legendre_plus(L_d, state.q, q1, state.s, H)[1], step.state.p, rtol=0, atol=1e-13)


def test_the_derivative_of_a_forced_step_is_the_closed_form():
    # fails if a derivative of F⁻ or F⁺ is missing from J or from DΦ̃
    L_d, state = ForcedPendula(), states_in_turn(2, 5)
    stepper = Stepper(L_d)
    (q1, _, _), D = flow_derivative(lambda q, p, s: stepper.step(State(q, p, s), H).state, *state)
    with torch.no_grad():
        P = partials(L_d, state.q, q1, state.s, H, 2)
        torch.testing.assert_close(step_derivative(P, state.p), D, rtol=1e-11, atol=1e-12)


def test_the_forced_residual_vanishes_along_steps():
    # fails if the two-step equation and the one-step map place forces differently
    L_d, state = ForcedPendula(), states_in_turn(2, 5)
    with torch.no_grad():
        out = Stepper(L_d).rollout(*state, h=H, steps=2)
        q0, q1, q2 = out.q.unbind(-2)
        R = herglotz_residual(L_d, q0, q1, q2, state.s, H, H)
    assert R.abs().max() < 1e-12
