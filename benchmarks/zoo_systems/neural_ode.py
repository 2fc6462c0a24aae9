"""A plain neural ODE as a peer: q̈ = net(q, q̇, u), two layers of 64, tanh, fitted by multiple shooting with Adam.

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

from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.prediction import trained
from benchmarks.zoo_systems.systems import ZooSystem

WIDTH, WINDOW, RATE = 64, 12, 1e-2  # units of a layer, samples of a window, first rate of Adam, which falls to 0
LONGEST = 0.2  # natural units: longest RK4 step, of error 1e-5
SLOPES = 4  # samples on either side that a start velocity is read from


class NeuralODE(torch.nn.Module):
    """A second-order equation with a network for the acceleration; steps positions and velocities (`EquationModel`)."""

    def __init__(self, of: ZooSystem, speed: Array, force: float):
        super().__init__()
        n, angles = of.mechanism.n, list(of.mechanism.angles)
        self.size, self.speed = torch.tensor(of.size), torch.tensor(speed)
        self.angles = torch.tensor(angles)
        one = torch.ones(2 * sum(angles), dtype=torch.float64)
        self.scale = torch.cat([one, self.size[~self.angles], self.speed, torch.tensor([force]).double()])
        inputs = 2 * n + sum(angles) + 1
        torch.manual_seed(0)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(inputs, WIDTH), torch.nn.Tanh(), torch.nn.Linear(WIDTH, WIDTH), torch.nn.Tanh(),
            torch.nn.Linear(WIDTH, n),
        ).double()  # fmt: skip

    def acceleration(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """(B, n), (B, n), (B,) → (B, n)."""
        turning, others = q[:, self.angles], q[:, ~self.angles]
        x = torch.cat([turning.sin(), turning.cos(), others, v, u[:, None]], -1)
        return self.net(x / self.scale) * (self.speed.square() / self.size)

    def step(self, q: Tensor, v: Tensor, u: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """One recorded step, of lengths h (B, 1), in equal RK4 steps."""
        count = max(1, math.ceil(float(h.max()) / LONGEST - 1e-9))
        h = h / count
        for _ in range(count):
            a1 = self.acceleration(q, v, u)
            v2 = v + h / 2 * a1
            a2 = self.acceleration(q + h / 2 * v, v2, u)
            v3 = v + h / 2 * a2
            a3 = self.acceleration(q + h / 2 * v2, v3, u)
            v4 = v + h * a3
            a4 = self.acceleration(q + h * v3, v4, u)
            q, v = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return q, v

    def advance(self, q: Array, v: Array, u: Array, h: float) -> tuple[Array, Array]:
        """One recorded step of arrays."""
        with torch.no_grad():
            out = self.step(*map(torch.tensor, (q, v, u)), torch.full((len(q), 1), h, dtype=torch.float64))
        return out[0].numpy(), out[1].numpy()


def fit_neural_ode(of: ZooSystem, budget: float) -> NeuralODE:
    """Train for this processor time, in seconds."""
    end = time.process_time() + budget
    m = trained(of.train)
    firsts = np.arange(0, m - WINDOW + 1, WINDOW - 1)
    at = firsts[:, None] + np.arange(WINDOW)  # (windows of a recording, WINDOW)
    v0 = np.concatenate([_velocities(of.train.t[:m], q[:m], firsts) for q in of.train.q])
    q, u = (torch.tensor(np.concatenate([x[b][at] for b in range(len(x))])) for x in (of.train.q, of.train.u))
    h = torch.tensor(np.tile(np.diff(of.train.t[at]), (len(of.train.q), 1)))[..., None]
    model = NeuralODE(of, np.maximum(v0.std(0), 1e-6), max(float(of.train.u.std()), 1e-6))
    start = [q[:, 0].clone().requires_grad_(), torch.tensor(v0, requires_grad=True)]
    follows = torch.arange(len(q)) % len(firsts) != len(firsts) - 1  # windows that another one continues
    optimiser = torch.optim.Adam([*model.parameters(), *start], lr=RATE)
    while (left := end - time.process_time()) > 0:
        optimiser.param_groups[0]["lr"] = RATE * (1 - math.cos(math.pi * min(1.0, left / budget))) / 2
        x, out = tuple(start), [start[0]]
        for k in range(WINDOW - 1):
            x = model.step(*x, u[:, k], h[:, k])
            out.append(x[0])
        cost = ((torch.stack(out, 1) - q) / model.size).square().mean()
        for reached, begun, unit in zip(x, start, (model.size, model.speed), strict=True):
            gap = (reached[follows] - begun[1:][follows[:-1]]) / unit
            cost = cost + gap.square().sum() / (len(q) * WINDOW * q.shape[-1])
        optimiser.zero_grad()
        cost.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
    return model


def _velocities(t: Array, q: Array, at: Array) -> Array:
    """Slopes of local cubics at some samples, (len(at), n)."""
    found = []
    for k in at:
        near = np.arange(max(0, k - SLOPES), min(len(t), k + SLOPES + 1))
        A = np.stack([(t[near] - t[k]) ** power for power in range(4)], -1)
        found.append(np.linalg.lstsq(A, q[near], rcond=None)[0][1])
    return np.stack(found)
