"""A plain neural ODE as a peer: q̈ = net(q, q̇, u), fitted by multiple shooting with Adam.

The training part is cut into windows of 12 samples, each with a start state of its own, which is trained beside the
network from local cubics. The cost is the squared error of the positions, and that of the gaps between a window's end
and the next one's start, both over the spread. Steps are RK4. Angles enter as sine and cosine, so that the network is
periodic as the system is.

Source: R. T. Q. Chen, Y. Rubanova, J. Bettencourt and D. Duvenaud, NeurIPS 2018; H. G. Bock, multiple shooting, 1983.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch
from torch import Tensor

from benchmarks.peers.networks import Network, Scales, count
from benchmarks.peers.rollouts import Flow, rk4
from benchmarks.peers.samples import Samples, local_polynomials

WINDOW, RATE = 12, 1e-2  # samples of a window; first rate of Adam, which falls to 0
LONGEST = 0.2  # RK4 step in units of the spread of positions over that of velocities, of error 1e-5
SLOPES = 4  # samples on either side that a start velocity is read from


class NeuralODE:
    """A network for the acceleration, of order one in units of the squared velocity over the position."""

    def __init__(self, scales: Scales, inputs: int, generator: torch.Generator):
        n = len(scales.angles)
        self.scales, self.net = scales, Network(scales.q_inputs + n + inputs, n, generator)

    def acceleration(self, q: Tensor, v: Tensor, *u: Tensor) -> Tensor:
        """(B, n), (B, n), (B, inputs) → (B, n)."""
        return self.net(torch.cat([self.scales.of_state(q, v), *u], -1)) * self.scales.a

    def field(self, y: Tensor, *u: Tensor) -> Tensor:
        """(q̇, q̈) at y = (q, q̇), with inputs."""
        q, v = y.chunk(2, -1)
        return torch.cat([v, self.acceleration(q, v, *u)], -1)

    def flow(self, h: float) -> Flow:
        """Its steps of length h."""
        parts = math.ceil(h / (LONGEST * float((self.scales.q / self.scales.v).min())) - 1e-9)
        return Flow(self.field, h, parts, count(list(self.net.parameters())))


def fit_neural_ode(samples: Samples, seed: int, budget: float) -> Flow:
    """Train for this processor time, in seconds."""
    end, n, m = time.process_time() + budget, samples.dof, len(samples.q[0])
    firsts = np.arange(0, m - WINDOW + 1, WINDOW - 1)
    t = samples.h * np.arange(m, dtype=np.float64)
    v0 = torch.as_tensor(np.concatenate([local_polynomials(t, q.numpy(), firsts, SLOPES, 3)[1] for q in samples.q]))
    size, speed = torch.cat(samples.q).std(0), v0.std(0).clamp_min(1e-6)
    scales = Scales(samples.angles, torch.cat(samples.q).mean(0), size, speed, speed.square() / size)
    model = NeuralODE(scales, samples.inputs, torch.Generator().manual_seed(seed))
    flow, q = model.flow(samples.h), samples.windows(WINDOW)
    u = [x.unfold(0, WINDOW, WINDOW - 1).transpose(1, 2) for x in samples.u]
    held = [torch.cat(u)] if u else []
    start = torch.cat([q[:, 0], v0], -1).requires_grad_()
    follows = torch.arange(len(q)) % len(firsts) != len(firsts) - 1  # windows that another one continues
    optimiser = torch.optim.Adam([*model.net.parameters(), start], lr=RATE)
    while (left := end - time.process_time()) > 0:
        optimiser.param_groups[0]["lr"] = RATE * (1 - math.cos(math.pi * min(1.0, left / budget))) / 2
        y, out = start, [start[:, :n]]
        for k in range(WINDOW - 1):
            y = rk4(flow.field, y, flow.h, flow.substeps, *(x[:, k] for x in held))
            out.append(y[:, :n])
        cost = ((torch.stack(out, 1) - q) / size).square().mean()
        gap = (y[follows] - start[1:][follows[:-1]]) / torch.cat([size, speed])
        cost = cost + gap.square().sum() / (len(q) * WINDOW * n)
        optimiser.zero_grad()
        cost.backward()
        torch.nn.utils.clip_grad_norm_(model.net.parameters(), 1.0)
        optimiser.step()
    return flow
