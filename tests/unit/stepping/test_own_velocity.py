"""Velocities in and out of an L_d that is no model, on a grid of unequal steps, and gradients through them."""

import itertools
import math

import pytest
import torch
from torch import nn

import herglotz as hz

GAMMA = 0.3


class Spring(nn.Module):
    """v²/2 − k q²/2 − γs by the midpoint, with networks' freedom of a bend in s."""

    def __init__(self, k=1.0, gamma=GAMMA, bend=0.0):
        super().__init__()
        self.k, self.gamma = (nn.Parameter(torch.tensor(x, dtype=torch.float64)) for x in (k, gamma))
        self.bend = bend

    def forward(self, q0, q1, s0, h):
        v, q = (q1 - q0) / h[..., None], (q0 + q1) / 2
        L = (v * v).sum(-1) / 2 - self.k * (q * q).sum(-1) / 2
        c = torch.exp(-self.gamma * h)
        return (c - 1) * s0 + c.sqrt() * h * (L - self.bend * s0 * s0)


def moved(L_d, q, v, h):
    """Positions and velocities (..., K+1, n) of a motion that starts at v, over the steps h (K,)."""
    stepper = hz.Stepper(L_d)
    states = stepper.rollout(*stepper.init_qv(q, v, h=h[0]), h=h).states
    return states.q, stepper.velocity(states, torch.cat([h[:1], h]))


def error(refined):
    """Largest error of v over 2 s, steps unequal by 1 to 2 and each cut into `refined`, against q̈ = −q − γq̇."""
    h = (torch.tensor([0.1, 0.2, 0.15, 0.05] * 4, dtype=torch.float64) / refined).repeat_interleave(refined)
    q, v = torch.tensor([0.8], dtype=torch.float64), torch.tensor([-0.5], dtype=torch.float64)
    with torch.no_grad():
        found = moved(Spring(), q, v, h)
    t, a = torch.cat([h.new_zeros(1), h.cumsum(0)])[:, None], GAMMA / 2
    w = math.sqrt(1 - a * a)
    A, B = q, (v + a * q) / w
    decay, c, s = (-a * t).exp(), (w * t).cos(), (w * t).sin()
    true_q, true_v = decay * (A * c + B * s), decay * ((w * B - a * A) * c - (w * A + a * B) * s)
    return max(float((x - y).abs().max()) for x, y in zip(found, (true_q, true_v), strict=True))


def test_velocities_on_a_grid_are_of_order_two():
    # fails if v is q̇ of the step before, or p is returned for v
    errors = [error(1), error(2), error(4)]
    assert errors[0] < 0.02
    assert [math.log2(a / b) for a, b in itertools.pairwise(errors)] == pytest.approx([2, 2], abs=0.1)


def test_velocities_of_turning_points_are_found():
    # fails if the tolerance of v ≈ 0 is below the rounding of positions over h
    q, stepper = torch.linspace(0.5, 5, 200).double()[:, None], hz.Stepper(Spring(bend=0.05))
    with torch.no_grad():
        found = stepper.velocity(stepper.init_qv(q, 1e-9 * q, h=0.01), 0.01)
    assert float((found - 1e-9 * q).abs().max()) < 1e-12


@pytest.mark.parametrize("of", ["q", "v"])
def test_gradients_go_from_velocities_out_to_velocities_in(of):
    # fails if the Legendre transform, a step or its inverse is cut off from the graph
    L_d, h = Spring(bend=0.2), torch.tensor([0.1, 0.2, 0.15, 0.05] * 3, dtype=torch.float64)
    xs = [torch.tensor([0.8, 0.1]).double(), torch.tensor([-0.5, 0.4]).double(), *L_d.parameters()]
    for x in xs:
        x.requires_grad_()
    end = lambda: moved(L_d, xs[0], xs[1], h)[of == "v"][-1, 0]  # noqa: E731
    grads = torch.autograd.grad(end(), xs)
    for x, grad in zip(xs, grads, strict=True):
        for i in range(x.numel()):
            ends = []
            for change in (1e-5, -1e-5):
                with torch.no_grad():
                    x.view(-1)[i] += change
                    ends.append(float(end()))
                    x.view(-1)[i] -= change
            assert float(grad.view(-1)[i]) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6, abs=1e-9)
