"""Networks, the one training loop that all network peers share, and the fit of a vector field to rates."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from .rollouts import SUBSTEP, Flow
from .samples import Motion, Samples

WIDTH = 64  # units of each of two hidden layers, for every peer
BATCH = 256  # samples in a step of Adam, for every peer
LEARNING_RATE = 3e-3  # of Adam, falling as a cosine
ADAM_PART = 0.6  # of the budget; L-BFGS has the rest
PATIENCE = 0.35  # part of the budget without a better validation loss after which a fit stops
ROWS = 2000  # that L-BFGS looks at, at most
Rates = Callable[..., tuple[Tensor, Tensor]]  # (q, y) → (q̇, ẏ), y the velocity or the momentum; and inputs if any


class Network(nn.Module):
    """Two hidden layers; float64; weights from the given generator."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator, activation: nn.Module | None = None):
        super().__init__()
        sizes = (inputs, WIDTH, WIDTH, outputs)
        layers: list[nn.Module] = []
        for a, b in pairwise(sizes):
            linear = nn.Linear(a, b, dtype=torch.float64)
            with torch.no_grad():
                linear.weight.copy_(torch.randn(b, a, generator=generator, dtype=torch.float64) / math.sqrt(a))
                linear.bias.zero_()
            layers += [linear, activation or nn.Tanh()]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, x: Tensor) -> Tensor:
        """The network at x, (..., inputs) → (..., outputs)."""
        return self.layers(x)


@dataclass(frozen=True)
class Scales:
    """What inputs and targets are divided by, and which coordinates enter as sine and cosine."""

    angles: tuple[bool, ...]
    middle: Tensor  # (n,) of q
    q: Tensor  # (n,) spread
    v: Tensor  # (n,) spread
    a: Tensor  # (n,) spread

    @classmethod
    def of(cls, angles: Sequence[bool], q: Tensor, v: Tensor, a: Tensor) -> Scales:
        """Spreads of points (N, n)."""
        spread = [x.square().mean(0).sqrt().clamp_min(1e-12) for x in (q - q.mean(0), v, a)]
        return cls(tuple(angles), q.mean(0), *spread)

    @property
    def q_inputs(self) -> int:
        """Number of inputs that positions make."""
        return sum(2 if angle else 1 for angle in self.angles)

    def of_q(self, q: Tensor) -> Tensor:
        """Network inputs of positions: sine and cosine of an angle, a scaled length."""
        x = (q - self.middle) / self.q
        columns = []
        for i, angle in enumerate(self.angles):
            columns += [q[..., i].sin(), q[..., i].cos()] if angle else [x[..., i]]
        return torch.stack(columns, -1)

    def of_state(self, q: Tensor, v: Tensor) -> Tensor:
        """Network inputs of positions and velocities."""
        return torch.cat([self.of_q(q), v / self.v], -1)


def count(parameters: Sequence[Tensor]) -> int:
    """Number of trained values."""
    return sum(x.numel() for x in parameters)


class _Best:
    """The weights of the least validation loss so far, and the part of the budget that is used."""

    def __init__(self, parameters: Sequence[Tensor], judge: Callable[[], Tensor], budget: float):
        self.parameters, self.judge, self.budget, self.began = parameters, judge, budget, time.process_time()
        self.value, self.at, self.weights = math.inf, 0.0, [x.detach().clone() for x in parameters]

    def used(self) -> float:
        return (time.process_time() - self.began) / self.budget

    def look(self) -> bool:
        """Keep the weights if they are the best; whether to go on."""
        value = float(self.judge().detach())
        if value < self.value:
            self.value, self.at, self.weights = value, self.used(), [x.detach().clone() for x in self.parameters]
        return self.used() < 1.0 and self.used() - self.at < PATIENCE

    def restore(self) -> None:
        with torch.no_grad():
            for x, value in zip(self.parameters, self.weights, strict=True):
                x.copy_(value)
        self.at = self.used()


def train(
    loss: Callable[[Tensor], Tensor],  # of these rows of the training data
    rows: int,
    validation: Callable[[], Tensor],
    parameters: Sequence[Tensor],
    generator: torch.Generator,
    budget: float,  # seconds of processor time
) -> None:
    """Adam with minibatches and a falling rate, then L-BFGS; the weights of the best validation loss are kept."""
    parameters = list(parameters)
    best = _Best(parameters, validation, budget)
    fixed = torch.randperm(rows, generator=generator)[:ROWS]
    optimiser, step, going = torch.optim.Adam(parameters, lr=LEARNING_RATE), 0, True
    while going and (used := best.used()) < ADAM_PART:
        for group in optimiser.param_groups:
            group["lr"] = LEARNING_RATE * (0.5 + 0.5 * math.cos(math.pi * used / ADAM_PART)) + 1e-6
        optimiser.zero_grad()
        loss(torch.randint(rows, (min(BATCH, rows),), generator=generator)).backward()
        nn.utils.clip_grad_norm_(parameters, 10.0)
        optimiser.step()
        step += 1
        if step % 50 == 0:
            going = best.look()
    best.look()
    best.restore()
    polish = torch.optim.LBFGS(parameters, max_iter=10, history_size=50, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        polish.zero_grad()
        value = loss(fixed)
        value.backward()
        return value

    going = best.used() < 1.0
    while going:
        value = polish.step(closure)  # type: ignore[arg-type]
        going = bool(torch.isfinite(value)) and best.look()
    best.restore()


def split(rows: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rows to train on and rows to validate on, at random."""
    order = torch.randperm(rows, generator=generator)
    held = max(1, round(0.12 * rows))
    return order[held:], order[:held]


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
) -> Flow:
    """Least squares of (q̇, ẏ) against the data's rates, each divided by its spread.

    y is the `momentum`, or else the velocity, where q̇ = v by construction and only v̇ is fitted.
    """
    parameters, motion = list(parameters), samples.motion()
    y, y_rate = (motion.p, motion.f) if momentum else (motion.v, motion.a)
    scales = scales_of(samples, motion)
    y_spread = y_rate.square().mean(0).sqrt().clamp_min(1e-12)
    rows, held = split(len(motion.q), generator)
    inputs = () if motion.u is None else (motion.u,)

    def loss(at: Tensor) -> Tensor:
        q_rate, found = rates(motion.q[at], y[at], *(u[at] for u in inputs))
        value = ((found - y_rate[at]) / y_spread).square().mean()
        return value + ((q_rate - motion.v[at]) / scales.v).square().mean() if momentum else value

    train(lambda i: loss(rows[i]), len(rows), lambda: loss(held), parameters, generator, budget)
    n = samples.dof

    def field(state: Tensor, *u: Tensor) -> Tensor:
        with torch.enable_grad():
            return torch.cat(rates(state[:, :n].detach(), state[:, n:].detach(), *u), -1).detach()

    return Flow(field, samples.h, substeps(samples.h, scales), count(parameters), momentum=momentum)
