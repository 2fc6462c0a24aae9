"""What the peers that fit a vector field share: points with rates in, a `Flow` out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from .networks import Scales, count, split, train
from .rollouts import SUBSTEP, Flow
from .samples import Motion, Samples

Rates = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # (q, y) → (q̇, ẏ), y the velocity or the momentum


def gradient(value: Tensor, of: Tensor) -> Tensor:
    """∂(Σ value)/∂of, differentiable again."""
    return torch.autograd.grad(value.sum(), of, create_graph=True)[0]


def substeps(h: float, scales: Scales) -> int:
    """Runge–Kutta steps a sample: `SUBSTEP` of the shortest time scale of the data, velocity over acceleration."""
    return max(1, math.ceil(h / (SUBSTEP * float((scales.v / scales.a).min()))))


def scales_of(samples: Samples, motion: Motion) -> Scales:
    """Spreads of all positions given, of velocities and of accelerations."""
    return Scales.of(samples.angles, torch.cat(samples.q), motion.v, motion.a)


def fit_rates(
    rates: Rates,
    parameters: Iterable[Tensor],
    samples: Samples,
    generator: torch.Generator,
    budget: float,
    *,
    momentum: bool,
    velocity_rate: bool = True,
) -> Flow:
    """Least squares of (q̇, ẏ) against the data's rates, each divided by its spread.

    Parameters
    ----------
    rates
        The model.
    parameters
        What it is trained by.
    samples, generator, budget
        See `networks.train`.
    momentum
        Whether y is the momentum; else the velocity.
    velocity_rate
        Whether q̇ is fitted as well; left out where q̇ = v by construction.
    """
    parameters, motion = list(parameters), samples.motion()
    y, y_rate = (motion.p, motion.f) if momentum else (motion.v, motion.a)
    scales = scales_of(samples, motion)
    y_spread = y_rate.square().mean(0).sqrt().clamp_min(1e-12)
    rows, held = split(len(motion.q), generator)

    def loss(at: Tensor) -> Tensor:
        q_rate, found = rates(motion.q[at], y[at])
        value = ((found - y_rate[at]) / y_spread).square().mean()
        return value + ((q_rate - motion.v[at]) / scales.v).square().mean() if velocity_rate else value

    train(lambda i: loss(rows[i]), len(rows), lambda: loss(held), parameters, generator, budget)
    n = samples.dof

    def field(state: Tensor) -> Tensor:
        with torch.enable_grad():
            return torch.cat(rates(state[:, :n].detach(), state[:, n:].detach()), -1).detach()

    return Flow(field, samples.h, substeps(samples.h, scales), count(parameters), momentum=momentum)
