"""Peers that step from positions only: discrete Lagrangian networks, without and with forces, and a plain step map.

Conservative: Y. Lishkova, P. Scherer, S. Ridderbusch, M. Jamnik, P. Liò, S. Ober-Blöbaum, C. Offen, "Discrete
Lagrangian neural networks with automatic symmetry discovery", IFAC 2023 (arXiv:2211.10830). L_d(q0, q1) is one network,
fitted to the discrete Euler–Lagrange equation D₂L_d(q0, q1) + D₁L_d(q1, q2) = 0. A constant solves it, so L_d is
normalised at base points as in C. Offen (arXiv:2404.19626): the mixed derivative D₁D₂L_d there is that of a unit mass.

With forces: M. D. Hansen, E. Celledoni, B. K. Tapley, "Learning mechanical systems from real-world data using discrete
forced Lagrangian dynamics", 2025 (arXiv:2505.20370): L_d = h L(q̄, Δ) at the midpoint q̄ and Δ = (q1 − q0)/h, forces
F± = ½h F(q̄, Δ), and D₂L_d(q0, q1) + D₁L_d(q1, q2) + F⁺(q0, q1) + F⁻(q1, q2) = 0, with a penalty that keeps L regular.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from .networks import Network, Scales, count, split, train
from .rollouts import ThreePoint, newton
from .samples import Samples

REGULAR = 1.0  # weight of the penalty
ANCHORS = 128  # base points
Function = Callable[[Tensor], Tensor]  # (N, inputs) → (N, outputs)


def scales_of_triples(samples: Samples) -> Scales:
    """Spreads of the middle position, of the difference and of the second difference of triples."""
    q0, q1, q2 = samples.triples()
    return Scales.of(samples.angles, q1, (q1 - q0) / samples.h, (q2 - 2 * q1 + q0) / samples.h**2)


class DiscreteLagrangian:
    """L_d(q0, q1) = h E [½|Δ/σ|² + net(q̄, Δ)], and forces where given; in units in which mass and spreads are 1.

    An input is held over a step, and is one more number that the force of the step depends on.
    """

    def __init__(self, scales: Scales, h: float, net: Function, force: Function | None = None):
        self.h, self.scales, self.net, self.force = h, scales, net, force

    def inputs(self, q0: Tensor, q1: Tensor) -> Tensor:
        """Network inputs of a pair."""
        return self.scales.of_state((q0 + q1) / 2, (q1 - q0) / self.h)

    def slopes(self, q0: Tensor, q1: Tensor) -> tuple[Tensor, Tensor]:
        """(D₁L_d, D₂L_d), (B, n) each, of L_d over h."""
        v = (q1 - q0) / (self.h * self.scales.v)
        value = v.square().sum() / 2 + self.net(self.inputs(q0, q1)).sum()
        return torch.autograd.grad(value, (q0, q1), create_graph=True)  # type: ignore[return-value]

    def momenta(self, q0: Tensor, q1: Tensor, *u: Tensor) -> tuple[Tensor, Tensor]:
        """(D₁L_d + F⁻, D₂L_d + F⁺) over h, (B, n) each, times σ_v² / σ_a: minus the momentum before, that after."""
        q0, q1 = (x if x.requires_grad else x.detach().requires_grad_() for x in (q0, q1))
        D1, D2 = (D * self.scales.v.square() / self.scales.a for D in self.slopes(q0, q1))
        if self.force is None:
            return D1, D2
        half = self.force(torch.cat([self.inputs(q0, q1), *u], -1)) / 2
        return D1 + half, D2 + half

    def residual(self, q0: Tensor, q1: Tensor, q2: Tensor, *u: Tensor) -> Tensor:
        """The (forced) discrete Euler–Lagrange equation: of order one for a unit mass; `u` are the held inputs."""
        return self.momenta(q0, q1, *u[:1])[1] + self.momenta(q1, q2, *u[1:])[0]

    def step(self, q: Tensor, p: Tensor, *u: Tensor) -> tuple[Tensor, Tensor]:
        """Position and momentum after a step of held inputs; NaN where Newton fails."""
        guess = q + self.h * p * self.scales.a * self.h
        q1 = newton(lambda x: p + self.momenta(q, x, *u)[0], guess)
        with torch.enable_grad():
            return q1, self.momenta(q, q1, *u)[1].detach()

    def mixed(self, q0: Tensor, q1: Tensor) -> Tensor:
        """−h² σ D₁D₂L_d σ over h, (B, n, n): the unit matrix for a unit mass."""
        q0, q1 = (x.detach().requires_grad_() for x in (q0, q1))
        scale = self.scales.v[:, None] * self.scales.v
        D1 = self.slopes(q0, q1)[0]
        rows = [torch.autograd.grad(D1[:, i].sum(), q1, create_graph=True)[0] for i in range(D1.shape[1])]
        return -(self.h**2) * scale * torch.stack(rows, 1)


def regularity(mixed: Tensor) -> Tensor:
    """Mean (log |det mixed|)² over base points, which leaves the mass free but regular."""
    return mixed.det().abs().clamp_min(1e-12).log().square().mean()


def train_discrete_lagrangian(samples: Samples, seed: int, budget: float, *, forced: bool = False) -> ThreePoint:
    """`fit_discrete_lagrangian` as a predictor."""
    model, parameters = fit_discrete_lagrangian(samples, seed, budget, forced=forced)
    return ThreePoint(model.residual, parameters)


def fit_discrete_lagrangian(
    samples: Samples, seed: int, budget: float, *, forced: bool = False
) -> tuple[DiscreteLagrangian, int]:
    """Least squares of the residual with the penalty |mixed − 1|² at a base point; where forced with discrete forces,
    and `regularity` in its place. The model, and the number of its trained values.
    """
    generator = torch.Generator().manual_seed(seed)
    scales = scales_of_triples(samples)
    inputs = scales.q_inputs + samples.dof
    net = Network(inputs, 1, generator, nn.Softplus())
    force = Network(inputs + samples.inputs, samples.dof, generator) if forced else None
    model, weights = DiscreteLagrangian(scales, samples.h, net, force), [*net.parameters()]
    weights += force.parameters() if force else []
    q0, q1, q2 = samples.triples()
    u0, u1 = samples.held()
    rows, held = split(len(q0), generator)
    base = rows[torch.randperm(len(rows), generator=generator)[: ANCHORS if forced else 1]]
    eye = torch.eye(samples.dof, dtype=torch.float64)

    def loss(i: Tensor) -> Tensor:
        return model.residual(q0[i], q1[i], q2[i], u0[i], u1[i]).square().mean()

    def penalty() -> Tensor:
        mixed = model.mixed(q0[base], q1[base])
        return regularity(mixed) if forced else (mixed - eye).square().mean()

    fit, judge = (lambda i: loss(rows[i]) + REGULAR * penalty()), (lambda: loss(held) + REGULAR * penalty())
    train(fit, len(rows), judge, weights, generator, budget)
    return model, count(weights)


def train_mlp(samples: Samples, seed: int, budget: float) -> ThreePoint:
    """One-step least squares of a network for the second difference: q2 = 2q1 − q0 + h² σ_a net(q1, (q1 − q0)/h)."""
    generator, h = torch.Generator().manual_seed(seed), samples.h
    scales = scales_of_triples(samples)
    net = Network(scales.q_inputs + samples.dof, samples.dof, generator)

    def residual(q0: Tensor, q1: Tensor, q2: Tensor) -> Tensor:
        return net(scales.of_state(q1, (q1 - q0) / h)) - (q2 - 2 * q1 + q0) / (h**2 * scales.a)

    def loss(i: Tensor) -> Tensor:
        return residual(q0[i], q1[i], q2[i]).square().mean()

    q0, q1, q2 = samples.triples()
    rows, held = split(len(q0), generator)
    weights = list(net.parameters())
    train(lambda i: loss(rows[i]), len(rows), lambda: loss(held), weights, generator, budget)
    return ThreePoint(residual, count(weights))
