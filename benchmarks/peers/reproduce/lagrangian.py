"""Lagrangian networks.

LNN (arXiv:2003.04630), double pendulum with m = l = 1, g = 9.8: accelerations at q uniform over the circle and
|v| < 10, error |v̇| (L1), fresh points every step. Energy error at t = 100 over the largest potential energy 29.4, of
40 starts with q uniform and 0 < v < 0.1; about half of these motions exceed |v| = 10, up to 15, where nothing was
trained. The source trains three layers of 600 units with 512 points for 600 000 steps, on a graphics processor; here
two of 128 with 64 points for 135 000, Adam 5e-3 falling as a cosine.

LNN as measured in arXiv:2211.10830, Kepler: network and orbits of `discrete.kepler`, accelerations at 51 states, Adam
on all of them (3e-3 for 1000 steps, none for 1000, 3e-4 after that), mean square over both halves of the rate. The
authors hand it momenta, for a mass of 100, as velocities; here the same. Losses at step 15 000.

DeLaN (arXiv:2110.01894), inverse model of a simulated arm with two joints, without friction: two layers of 64 tanh
units for M(q) and for V(q), softplus(net + 2) + 0.1 on the diagonal of the factor, AdamW 1e-4 with decay 1e-5, 5000
epochs of whole batches of 512, squared torque error over the variance of the torque. The source tracks 20 characters,
17 to train; here 20 motions of our own, two sines a joint, with the source's spread and correlation of angles,
velocities and accelerations, and as many samples (150, 0.04 s).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ..continuous import DeepLagrangian, FreeLagrangian
from ..known_equation import Equation
from ..networks import Network, Scales
from ..rollouts import rk4
from .discrete import kepler_orbit, kepler_rates, softplus_net
from .figures import Figure, at_most_twice, read_off

# Arms of length and mass 1 in units of the first arm's inertia, see `known_equation.Equation`.
PENDULUM = torch.tensor([[0.5, 0.5, 9.8, 4.9, 0.0, 0.0]], dtype=torch.float64)
ARM = (1.372729167, 1.0, 0.5176145833, 0.5, 2.625, 1.5)  # M11 = a + b cos q2, M12 = c + d cos q2, M22 = c; gravity e, f


def _energy(y: Tensor) -> Tensor:
    """Of the double pendulum, (B,)."""
    (q1, q2, v1, v2) = y.unbind(-1)
    return v1**2 + v2**2 / 2 + v1 * v2 * (q1 - q2).cos() - 9.8 * (2 * q1.cos() + q2.cos())


def double_pendulum(seed: int, effort: float = 1.0) -> dict[str, float]:
    """Energy error of an LNN, and the error of its accelerations."""
    make = torch.Generator().manual_seed(seed)
    equation, steps, batch = Equation(relative=False), math.ceil(135_000 * effort), 64

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=make, dtype=torch.float64)

    def missed(count: int) -> Tensor:
        q, v = 2 * math.pi * rand(count, 2), 20 * rand(count, 2) - 10
        want = equation.acceleration(q, v, PENDULUM.expand(count, -1))
        return (model.rates(q, v)[1] - want).abs().sum(-1).mean()

    starts = torch.cat([2 * math.pi * rand(40, 2), 0.1 * rand(40, 2)], -1)
    model = FreeLagrangian(
        Scales.unit(True, True, v=5.8), lambda inputs: Network(inputs, 1, make, nn.Softplus(), (128, 128))
    )
    optimiser = torch.optim.Adam(model.parameters, lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, eta_min=1e-6)
    for _ in range(steps):
        optimiser.zero_grad()
        missed(batch).backward()
        nn.utils.clip_grad_norm_(model.parameters, 10.0)
        optimiser.step()
        schedule.step()

    def field(y: Tensor) -> Tensor:
        return torch.cat(model.rates(y[:, :2].detach(), y[:, 2:].detach()), -1).detach()

    y = starts
    for _ in range(math.ceil(10_000 * effort)):
        y = rk4(field, y, 0.01, 1)  # exact rates: an energy error of 4e-4
    errors = (_energy(y) - _energy(starts)).abs() / 29.4
    return {
        "LNN, energy error at t = 100": float(errors.mean()),
        "LNN, median energy error at t = 100": float(errors.median()),
        "LNN, acceleration error": float(missed(10_000).detach()),
    }


def kepler_momenta(seed: int, effort: float = 1.0) -> dict[str, float]:
    """Training and test loss of an LNN."""
    make = torch.Generator().manual_seed(seed)
    model = FreeLagrangian(Scales.unit(False, False), lambda _: softplus_net(make), kinetic=0.0)
    train, test = kepler_orbit((1.0, 0.0)), kepler_orbit((1.1, -0.01))

    def loss(orbit: tuple[Tensor, Tensor]) -> Tensor:
        q, v = orbit
        return (model.rates(q.detach(), 100 * v)[1] - kepler_rates(q)).square().mean() / 2

    optimiser = torch.optim.Adam(model.parameters, lr=3e-3)
    for step in range(math.ceil(14_000 * effort)):
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 if step < 1000 else 3e-4
        optimiser.zero_grad()
        loss(train).backward()
        optimiser.step()
    return {"LNN, training loss": float(loss(train).detach()), "LNN, test loss": float(loss(test).detach())}


def arm_motions(make: torch.Generator, count: int = 20, samples: int = 150) -> tuple[Tensor, Tensor, Tensor]:
    """Angles, velocities and accelerations (count, samples, 2)."""
    t = 0.04 * torch.arange(samples, dtype=torch.float64)[:, None]

    def rand(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, generator=make, dtype=torch.float64)

    q = torch.tensor([-0.506, 1.92], dtype=torch.float64).expand(count, samples, 2)
    v, a = torch.zeros_like(q), torch.zeros_like(q)
    for size, low, high in (((0.38, 0.60), 0.6, 1.0), ((0.245, 0.242), 2.7, 3.3)):
        A, w, first = torch.tensor(size, dtype=torch.float64) * rand(0.8, 1.2), rand(low, high), rand(0, 2 * math.pi)
        phase = torch.cat([first, first + math.pi + rand(-1.2, 1.2)], -1)  # the joints move against each other
        q, v, a = (x + y for x, y in zip((q, v, a), _sine(A, w, w * t + phase), strict=True))
    return q, v, a


def _sine(A: Tensor, w: Tensor, phase: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return A * phase.sin(), A * w * phase.cos(), -A * w * w * phase.sin()


def arm_torque(q: Tensor, v: Tensor, a: Tensor) -> Tensor:
    """Torques of the arm, (..., 2)."""
    A, b, c, d, e, f = ARM
    (q1, q2), (v1, v2), (a1, a2) = q.unbind(-1), v.unbind(-1), a.unbind(-1)
    C, S, low = q2.cos(), q2.sin(), f * (q1 + q2).cos()
    t1 = (A + b * C) * a1 + (c + d * C) * a2 - d * S * v2 * (2 * v1 + v2) + e * q1.cos() + low
    return torch.stack([t1, (c + d * C) * a1 + c * a2 + d * S * v1 * v1 + low], -1)


def arm(seed: int, effort: float = 1.0) -> dict[str, float]:
    """Torque error of a DeLaN on motions that it has not seen."""
    make = torch.Generator().manual_seed(seed)
    motions = arm_motions(make)
    train, test = ([x[part].reshape(-1, 2) for x in motions] for part in (slice(17), slice(17, None)))
    torque, want = arm_torque(*train), arm_torque(*test)
    model = DeepLagrangian(Scales.unit(True, True), make, friction=False, shift=2.0, least=0.1)
    optimiser = torch.optim.AdamW(model.parameters, lr=1e-4, weight_decay=1e-5)
    variance, rows = torque.var(0), len(torque)
    for _ in range(math.ceil(5000 * effort)):
        for i in torch.randperm(rows, generator=make)[: rows // 512 * 512].split(512):
            q, v, a = (x[i] for x in train)
            optimiser.zero_grad()
            ((model.torque(q, v, a) - torque[i]).square() / variance).sum(-1).mean().backward()
            optimiser.step()
    found = model.torque(*test).detach()
    return {"DeLaN, torque error": float(((found - want).square() / want.var(0)).sum(-1).mean())}


LOSSES = "Lishkova et al. 2022, plot of the losses in Kepler_LNN.ipynb, step 15 000: "
FIGURES = {
    "Kepler, momenta as velocities": {
        "LNN, training loss": read_off(LOSSES + "3.7", 3.7),
        "LNN, test loss": read_off(LOSSES + "6.3", 6.3),
    },
    "double pendulum": {
        "LNN, energy error at t = 100": at_most_twice(
            "Cranmer et al. 2020: 0.4 % in the text, 4.26e-03 (mean of 40 starts) printed in DoublePendulum.ipynb",
            4.26e-3,
        ),
        "LNN, median energy error at t = 100": Figure(
            "DoublePendulum.ipynb, from the running means of its 40 starts: 1.1e-03, quartiles 2.4e-04 – 3.2e-03",
            2.4e-4,
            3.2e-3,
        ),
        "LNN, acceleration error": at_most_twice("DoublePendulum.ipynb: 6.89e-02 (100 000 points)", 6.89e-2),
    },
    "arm": {
        "DeLaN, torque error": Figure(
            "Lutter and Peters 2021, stored results of ten seeds, characters: 3.5e-05 (2.2e-05 – 5.2e-05)",
            2.2e-5,
            5.2e-5,
        ),
    },
}
