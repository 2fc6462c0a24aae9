"""A plain step map and a neural ordinary differential equation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .fields import scales_of
from .networks import Network, Scales, count, split, train
from .rollouts import Flow, rk4
from .samples import Samples

WINDOW = 9  # samples of a window of the neural ODE
FINEST = 0.25  # its Runge–Kutta step at most, in units of velocity over acceleration


class StepMap:
    """q2 = 2q1 − q0 + h² σ_a net(q1, (q1 − q0)/h): a network that predicts the second difference."""

    def __init__(self, samples: Samples, generator: torch.Generator):
        q0, q1, q2 = samples.triples()
        h = self.h = samples.h
        self.scales = Scales.of(samples.angles, q1, (q1 - q0) / h, (q2 - 2 * q1 + q0) / h**2)
        self.net = Network(self.scales.q_inputs + samples.dof, samples.dof, generator)
        self.parameters = count(list(self.net.parameters()))

    def second_difference(self, q0: Tensor, q1: Tensor) -> Tensor:
        """Predicted (q2 − 2q1 + q0) / (h² σ_a), (B, n)."""
        return self.net(self.scales.of_state(q1, (q1 - q0) / self.h))

    def rollout(self, q0: Tensor, q1: Tensor, steps: int, exact: Tensor | None = None) -> Tensor:  # noqa: ARG002
        """See `rollouts.Predictor`."""
        out = [q0, q1]
        with torch.no_grad():
            for _ in range(steps):
                bend = self.h**2 * self.scales.a * self.second_difference(out[-2], out[-1])
                out.append(2 * out[-1] - out[-2] + bend)
        return torch.stack(out, 1)


def train_mlp(samples: Samples, seed: int, budget: float) -> StepMap:
    """One-step least squares of the second difference."""
    generator = torch.Generator().manual_seed(seed)
    model = StepMap(samples, generator)
    q0, q1, q2 = samples.triples()
    target = (q2 - 2 * q1 + q0) / (samples.h**2 * model.scales.a)
    rows, held = split(len(q0), generator)

    def loss(i: Tensor) -> Tensor:
        return (model.second_difference(q0[i], q1[i]) - target[i]).square().mean()

    train(lambda i: loss(rows[i]), len(rows), lambda: loss(held), list(model.net.parameters()), generator, budget)
    return model


def integrator(field: Callable[[Tensor], Tensor], h: float, parts: int) -> Callable[[Tensor], Tensor]:
    """One step of length h: torchdiffeq's fixed-step rk4 where it is installed, else the classical one."""
    try:
        from torchdiffeq import odeint
    except ImportError:
        return lambda y: rk4(field, y, h, parts)
    times = torch.linspace(0.0, h, parts + 1, dtype=torch.float64)

    def step(y: Tensor) -> Tensor:
        out: Any = odeint(lambda t, y: field(y), y, times, method="rk4")  # noqa: ARG005
        return out[-1]

    return step


def train_neural_ode(samples: Samples, seed: int, budget: float) -> Flow:
    """Neural ODE, v̇ = net(q, v), fitted to the samples of short windows.

    R. Chen, Y. Rubanova, J. Bettencourt, D. Duvenaud, NeurIPS 2018 (arXiv:1806.07366). Loss: squared error of the
    positions at every sample of a window (and of the velocities where exact ones are given). Without velocities the
    one at the start of each window is trained too, from its finite difference.
    """
    generator = torch.Generator().manual_seed(seed)
    motion = samples.motion()
    scales = scales_of(samples, motion)
    n, h = samples.dof, samples.h
    net = Network(scales.q_inputs + n, n, generator)

    def field(y: Tensor) -> Tensor:
        q, v = y[:, :n], y[:, n:]
        return torch.cat([v, scales.a * net(scales.of_state(q, v))], -1)

    parts = max(1, round(h / (FINEST * float((scales.v / scales.a).min()))))
    step = integrator(field, h, parts)
    weights = list(net.parameters())
    length = min(WINDOW, max(len(q) for q in samples.q))
    if samples.exact is not None:
        state = [torch.cat([m.q, m.v], -1) for m in samples.exact]
        data = torch.cat([x.unfold(0, length, length - 1).transpose(1, 2) for x in state if len(x) >= length])
        spread = torch.cat([scales.q, scales.v])
        rows, held = split(len(data), generator)

        def exact_loss(at: Tensor) -> Tensor:
            y, total = data[at, 0], torch.zeros((), dtype=torch.float64)
            for k in range(1, length):
                y = step(y)
                total = total + ((y - data[at, k]) / spread).square().mean()
            return total / (length - 1)

        train(lambda i: exact_loss(rows[i]), len(rows), lambda: exact_loss(held), weights, generator, budget)
        return Flow(field, h, parts, count(weights), step)
    data = samples.windows(length)
    start = ((-1.5 * data[:, 0] + 2 * data[:, 1] - 0.5 * data[:, 2]) / h).requires_grad_()

    def loss(at: Tensor, first: int, last: int) -> Tensor:
        y, total = torch.cat([data[at, 0], start[at]], -1), torch.zeros((), dtype=torch.float64)
        for k in range(1, last):
            y = step(y)
            if k >= first:
                total = total + ((y[:, :n] - data[at, k]) / scales.q).square().mean()
        return total / (last - first)

    # The last sample of each window judges: its start is trained, so held-out windows would have none.
    everything = torch.arange(len(data))
    train(
        lambda i: loss(i, 1, length - 1),
        len(data),
        lambda: loss(everything, length - 1, length),
        [*weights, start],
        generator,
        budget,
    )
    return Flow(field, h, parts, count(weights), step)
