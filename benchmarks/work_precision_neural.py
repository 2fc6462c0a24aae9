"""A neural ODE, q'' = net(q, v), as good as Levenberg–Marquardt can make it on the same data."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.func import jacrev, vmap
from work_precision_native import Weights
from work_precision_scenes import Setup

from herglotz.training import levenberg_marquardt

PAIRS, ROWS = 700, 2000  # pairs of states; of several coordinates fewer
PARTS = 4  # RK4 steps between two samples


def train_neural_ode(data: Any, setup: Setup, width: int, layers: int, iterations: int, seed: int = 0) -> Weights:
    """Weights of a = net(sin q, cos q, v), or net(q, v) where q is no angle, fitted to exact states h apart.

    It is given what the learned steppers are not: the exact velocities. An input u is added to a, known.
    """
    system = setup.scene
    n, angles = system.dof, all(system.angles)
    blank = Weights(torch.empty(0), n, width, layers, angles)
    sizes = [(blank.inputs, width), (width,), *([(width, width), (width,)] if layers == 2 else []), (n, width)]
    generator = torch.Generator().manual_seed(seed)
    first = [torch.randn(s, generator=generator, dtype=torch.float64) / s[0] ** 0.5 for s in sizes]
    first[-1] = first[-1] * 0.1
    theta = torch.cat([x.flatten() for x in first])
    y = torch.cat([data.q, system.velocity(data.q, data.p, data.s)], -1)
    keep = torch.ones(len(y), dtype=torch.bool)
    keep[torch.tensor(data.offsets) + torch.tensor(data.lengths) - 1] = False
    rows = keep.nonzero()[:, 0]
    rows = rows[torch.randperm(len(rows), generator=generator)[: min(PAIRS, ROWS // n)]]
    u = torch.zeros(len(y), n, dtype=y.dtype) if data.u is None else data.u
    pairs = (y[rows], y[rows + 1], u[rows])
    k = setup.h / PARTS

    def rhs(w: list[Tensor], y: Tensor, u: Tensor) -> Tensor:
        q, v = y[..., :n], y[..., n:]
        x = torch.cat([q.sin(), q.cos(), v] if angles else [q, v], -1)
        x = torch.tanh(x @ w[0] + w[1])
        if layers == 2:
            x = torch.tanh(x @ w[2] + w[3])
        return torch.cat([v, x @ w[-1].T + u], -1)

    def local(theta: Tensor, y: Tensor, y1: Tensor, u: Tensor) -> Tensor:
        w = [x.reshape(s) for x, s in zip(theta.split([math.prod(s) for s in sizes]), sizes, strict=True)]
        for _ in range(PARTS):
            k1 = rhs(w, y, u)
            k2 = rhs(w, y + k / 2 * k1, u)
            k3 = rhs(w, y + k / 2 * k2, u)
            k4 = rhs(w, y + k * k3, u)
            y = y + k / 6 * (k1 + 2 * (k2 + k3) + k4)
        return (y - y1) / setup.h

    class Problem:
        sigma = 1e-8

        def cost(self, x: Tensor) -> Tensor:
            return (local(x, *pairs) / self.sigma).square().sum() / 2 + (x - theta).square().sum() / 200

        def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            r = local(x, *pairs).reshape(-1) / self.sigma
            J = vmap(jacrev(local), (None, 0, 0, 0))(x, *pairs).reshape(-1, len(x)) / self.sigma
            A, b = torch.eye(len(x), dtype=x.dtype) / 100, (x - theta) / 100
            return self.cost(x), A + J.T @ J, b + J.T @ r

    found = levenberg_marquardt(Problem(), theta, max_iterations=iterations, rtol=1e-4)
    return Weights(found.x.detach(), n, width, layers, angles)
