"""Discrete Lagrangian networks.

Conservative (arXiv:2211.10830), Kepler: 51 positions, h = 0.1, from (1, 0) with velocity (0, 0.6), GM = 0.40038; the
test motion starts at (1.1, −0.01). L_d(q0, q1) with three layers of 128 softplus units and Glorot's weights, Adam on
all triples (3e-3 for 1000 steps, after that 3e-4), loss |D₂L_d + D₁L_d|² + 1 − σ(det D₁D₂L_d / 100). The loss stays at
½, where L_d = 0, for 20 300 steps in the source; it is measured 10 000 steps after that plateau.

Forced: no number of Hansen et al. 2025 was to be had. The next best is the same equation with a structured Lagrangian:
K. Menda, J. K. Gupta, Z. Manchester, M. J. Kochenderfer, "Training structured mechanical models by minimizing discrete
Euler–Lagrange residual", 2021 (arXiv:2105.01811). Damped double pendulum, m = l = 1, g = 10, friction 0.5 of each
angle, 16 motions of 202 positions, h = 0.05, released between ±π/2, noise 0.1 rad, smoothed; 8 to train, 4 to choose
among the epochs, 4 to test. Three layers of 32 units (theirs with layer norm), Adam 1e-3 · 500/(500 + epoch), batches
of 256, 500 epochs. Mean squared error of accelerations.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ..continuous import acceleration
from ..discrete import ANCHORS, REGULAR, DiscreteLagrangian, jacobian, regularity
from ..networks import Network, Scales
from ..rollouts import ThreePoint, rk4
from .figures import Figure, read_off
from .smoothing import smoothed

PLATEAU, AFTER, LAST = 30_000, 10_000, 1000  # steps: longest plateau, after it, of which the last are judged


class _OfPositions(nn.Module):
    """A network of (q0, q1), as a function of their middle and their difference over h."""

    def __init__(self, net: nn.Module, h: float):
        super().__init__()
        self.net, self.h = net, h

    def forward(self, x: Tensor) -> Tensor:
        q, v = x.chunk(2, -1)
        return self.net(torch.cat([q - self.h / 2 * v, q + self.h / 2 * v], -1))


def kepler_rates(q: Tensor) -> Tensor:
    """Accelerations (B, 2)."""
    return -0.40038 * q / q.norm(dim=1, keepdim=True) ** 3


def kepler_orbit(q0: tuple[float, float], h: float = 0.1, steps: int = 50) -> tuple[Tensor, Tensor]:
    """Positions and velocities, (steps + 1, 2) each."""

    def field(y: Tensor) -> Tensor:
        return torch.cat([y[:, 2:], kepler_rates(y[:, :2])], -1)

    y = torch.tensor([[*q0, 0.0, 0.6]], dtype=torch.float64)
    out = [y]
    for _ in range(steps):
        out.append(rk4(field, out[-1], h, 20))
    return torch.cat(out)[:, :2], torch.cat(out)[:, 2:]


def softplus_net(make: torch.Generator) -> Network:
    """Of four inputs, with Glorot's weights and small biases, as in Lishkova et al."""
    net = Network(4, 1, make, nn.Softplus(), (128, 128, 128))
    with torch.no_grad():
        for layer in net.layers:
            if isinstance(layer, nn.Linear):
                nn.init.xavier_normal_(layer.weight, generator=make)
                nn.init.normal_(layer.bias, std=0.01, generator=make)
    return net


def kepler(seed: int, effort: float = 1.0) -> dict[str, float]:
    """Training and test loss of a discrete Lagrangian network."""
    make, h = torch.Generator().manual_seed(seed), 0.1
    model = DiscreteLagrangian(Scales.unit(False, False), h, _OfPositions(softplus_net(make), h), kinetic=0.0)
    (train, _), (test, _) = kepler_orbit((1.0, 0.0)), kepler_orbit((1.1, -0.01))

    def loss(q: Tensor) -> Tensor:
        q0, q1 = (x.detach().requires_grad_() for x in (q[:-1], q[1:]))
        D1, D2 = model.slopes(q0, q1)
        (a, b), (c, d) = jacobian(D1, q1)[1:].permute(1, 2, 0)
        det = a * d - b * c  # of the later pair of each triple
        return (D2[:-1] + D1[1:]).square().sum(-1).mean() + torch.sigmoid(-det / 100).mean()

    optimiser = torch.optim.Adam(model.weights, lr=3e-3)
    plateau, after, last = (math.ceil(x * effort) for x in (PLATEAU, AFTER, LAST))
    step, end, fits, tests = 0, plateau + after, [], []
    while step < end:
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 if step < 1000 else 3e-4
        optimiser.zero_grad()
        value = loss(train)
        value.backward()
        optimiser.step()
        step += 1
        if end == plateau + after and float(value.detach()) < 0.25:
            end = min(end, step + after)
        if step > end - last and step % 10 == 0:
            fits.append(float(value.detach()))
            tests.append(float(loss(test).detach()))
    return {
        "discrete Lagrangian net, lowest training loss": min(fits),
        "discrete Lagrangian net, test loss": sorted(tests)[len(tests) // 2],
    }


class _Exact(nn.Module):
    """The double pendulum with m = l = 1, g = 10: L of (sin, cos of each angle, velocities)."""

    def forward(self, x: Tensor) -> Tensor:
        s1, c1, s2, c2, v1, v2 = x.unbind(-1)
        return (v1**2 + v2**2 / 2 + v1 * v2 * (c1 * c2 + s1 * s2) + 10 * (2 * c1 + c2))[:, None]


class _Friction(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return -0.5 * x[:, 4:]


def accelerations(model: DiscreteLagrangian, q: Tensor, v: Tensor) -> Tensor:
    """v̇ (B, n) of the Lagrangian and the force whose midpoint rule the model is."""
    q, v = q.detach().requires_grad_(), v.detach().requires_grad_()
    x = model.scales.of_state(q, v)
    L = model.kinetic * (v / model.scales.v).square().sum(-1) / 2 + model.net(x)[:, 0]
    force = None if model.force is None else model.force(x) * model.scales.a / model.scales.v.square()
    return acceleration(L, q, v, force)


def damped_double_pendulum(seed: int, effort: float = 1.0) -> dict[str, float]:
    """Error of accelerations of a discrete Lagrangian network with forces, fitted to noisy angles."""
    make, h = torch.Generator().manual_seed(seed), 0.05
    exact = DiscreteLagrangian(Scales.unit(True, True), h, _Exact(), _Friction(), kinetic=0.0)
    start = math.pi * (torch.rand(16, 2, generator=make, dtype=torch.float64) - 0.5)
    steps = max(20, math.ceil(200 * effort))
    q = ThreePoint(exact.residual, 0).rollout(start, start, steps)
    noisy = q + 0.1 * torch.randn(q.shape, generator=make, dtype=torch.float64)
    parts = torch.randperm(16, generator=make).split([8, 4, 4])
    train, (q_held, v_held, a_held) = smoothed(noisy[parts[0]], h), smoothed(noisy[parts[1]], h)
    q_test, v_test = (x.reshape(-1, 2) for x in ((q[:, 1:] + q[:, :-1]) / 2, (q[:, 1:] - q[:, :-1]) / h))
    test = parts[2].repeat_interleave(q.shape[1] - 1) * (q.shape[1] - 1)
    test = test + torch.arange(q.shape[1] - 1).repeat(4)
    q_test, v_test = q_test[test], v_test[test]
    want = accelerations(exact, q_test, v_test).detach()

    scales = Scales.of((True, True), *(x.reshape(-1, 2) for x in train))
    net = Network(6, 1, make, nn.Softplus(), (32, 32, 32))
    model = DiscreteLagrangian(scales, h, net, Network(6, 2, make, nn.Tanh(), (32, 32, 32)))
    q0, q1, q2 = (train[0][:, k : k + steps].reshape(-1, 2) for k in range(3))
    base = torch.randperm(len(q0), generator=make)[:ANCHORS]
    optimiser = torch.optim.Adam(model.weights, lr=1e-3)
    best = chosen = math.inf
    for epoch in range(math.ceil(500 * effort)):
        for group in optimiser.param_groups:
            group["lr"] = 1e-3 * 500 / (500 + epoch)
        for i in torch.randperm(len(q0), generator=make).split(256):
            optimiser.zero_grad()
            loss = model.residual(q0[i], q1[i], q2[i]).square().mean()
            (loss + REGULAR * regularity(model.mixed(q0[base], q1[base]))).backward()
            optimiser.step()
        held = accelerations(model, q_held.reshape(-1, 2), v_held.reshape(-1, 2)).detach()
        error = float((held - a_held.reshape(-1, 2)).square().mean())
        if error < best:
            best = error
            chosen = float((accelerations(model, q_test, v_test).detach() - want).square().mean())
    return {"forced discrete Lagrangian net, acceleration MSE": chosen}


FIGURES = {
    "Kepler": {
        "discrete Lagrangian net, lowest training loss": read_off(
            "Lishkova et al. 2022, plot of the losses in Kepler_DLNN.ipynb, step 30 000: 1.3e-06", 1.3e-6
        ),
        "discrete Lagrangian net, test loss": read_off(
            "Lishkova et al. 2022, plot of the losses in Kepler_DLNN.ipynb, step 30 000: 6.4e-03 (5.0e-03 – 8.3e-03)",
            6.4e-3,
        ),
    },
    "damped double pendulum": {
        # ± is 0.83, the standard error of 100 seeds; their standard deviation is 8.3, a mean of five has ± 3.7
        "forced discrete Lagrangian net, acceleration MSE": Figure(
            "Menda et al. 2021, damped_results.pdf, rate 1e-3: 11.9 ± 3.7 (of a mean of five seeds)", 8.2, 15.6
        ),
    },
}
