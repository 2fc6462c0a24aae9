"""Learned peers of the open zoo: what they are given of a system, and their steps as the zoo's free runs ask for them.

A peer sees what our fit sees: the positions of the training part and the input. The neural ODE takes the positions as
they are. The others are defined by second differences or accelerations, which noise spoils: they are given local
polynomials of degree 4, whose width leave-one-out cross-validation chooses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchmarks.peers.continuous import train_delan
from benchmarks.peers.discrete import DiscreteLagrangian, fit_discrete_lagrangian
from benchmarks.peers.gaussian import fit_gaussian_lagrangian
from benchmarks.peers.rollouts import Flow, solve
from benchmarks.peers.samples import Motion, Samples, half_width, local_polynomials
from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.neural_ode import fit_neural_ode
from benchmarks.zoo_systems.prediction import trained
from benchmarks.zoo_systems.systems import ZooSystem

HALVES, DEGREE = (3, 4, 6, 8, 12, 16, 24), 4  # of the local polynomials
SEED = 0  # of every peer, on every system
Step = Callable[..., tuple[Tensor, Tensor]]  # (q, v, *u) → (q, v) a step later, each (B, n)


def samples_of(of: ZooSystem) -> Samples:
    """The training part; the input, where there is one, over its spread.

    Raises
    ------
    ValueError
        If the sample times are not equally spaced, as those of an open zoo are.
    """
    m = trained(of.train)
    t, unit = of.train.t[:m], _unit(of)
    h = float(t[-1] - t[0]) / (m - 1)
    if not np.allclose(np.diff(t), h, rtol=1e-6):
        raise ValueError(f"{of.name}: steps from {np.diff(t).min():g} to {np.diff(t).max():g}; peers need equal ones")
    u = tuple(torch.tensor(x[:m, None] / unit) for x in of.train.u) if of.driven else ()
    return Samples(tuple(torch.tensor(x[:m]) for x in of.train.q), h, of.mechanism.angles, u=u)


def smoothed(samples: Samples) -> Samples:
    """Positions, velocities and accelerations of local polynomials in place of the recorded positions.

    Where a step is driven the acceleration is smoothed over the input's steps, so it is given the input smoothed alike:
    the curvature of the polynomials through the double integral of the held input.
    """
    t, h = samples.h * np.arange(len(samples.q[0]), dtype=np.float64), samples.h
    half = half_width(t, np.stack([q.numpy() for q in samples.q]), HALVES, DEGREE)
    smooth = lambda x: [torch.as_tensor(y) for y in local_polynomials(t, x.numpy(), np.arange(len(t)), half, DEGREE)]  # noqa: E731
    before = lambda x: torch.cat([0 * x[:1], x[:-1]]).cumsum(0)  # noqa: E731
    felt = [smooth(h**2 * (before(before(u)) + before(u) / 2))[2] for u in samples.u] or [None] * len(samples.q)
    parts = [smooth(q) for q in samples.q]
    motions = tuple(Motion(q, v, v, a, a, u) for (q, v, a), u in zip(parts, felt, strict=True))
    return replace(samples, q=tuple(m.q for m in motions), exact=motions)


@dataclass(frozen=True)
class LearnedModel:
    """A peer's steps of length h, as an `EquationModel`."""

    step: Step
    of: ZooSystem

    def advance(self, q: Array, v: Array, u: Array, h: float) -> tuple[Array, Array]:  # noqa: ARG002
        """One recorded step of arrays."""
        inputs = [torch.tensor(u[:, None] / _unit(self.of))] if self.of.driven else []
        with torch.no_grad():
            q1, v1 = self.step(torch.tensor(q), torch.tensor(v), *inputs)
        return q1.numpy(), v1.numpy()


def _unit(of: ZooSystem) -> float:
    """Spread of the input over the training part."""
    return float(of.train.u[:, : trained(of.train)].std())


def flow_step(flow: Flow) -> Step:
    """Steps of a vector field on (q, v)."""
    return lambda q, v, *u: flow.advance(torch.cat([q, v], -1), *u).chunk(2, -1)  # type: ignore[return-value]


def momentum_step(model: DiscreteLagrangian, samples: Samples) -> Step:
    """Steps of a discrete Lagrangian on (q, v), v the velocity whose linear function the momentum is, by regression.

    So a start velocity that is read from positions is a good first guess of the start state.
    """
    q0, q1, q2 = samples.triples()
    v = torch.cat([(q2 - q0) / (2 * samples.h), torch.ones_like(q0[:, :1])], -1)
    p = model.momenta(q0, q1, samples.held()[0])[1].detach()
    A = torch.linalg.lstsq(v, p).solution  # (n + 1, n)

    def step(q: Tensor, v: Tensor, *u: Tensor) -> tuple[Tensor, Tensor]:
        q1, p1 = model.step(q, v @ A[:-1] + A[-1], *u)
        return q1, solve(A[:-1].mT.expand(len(q), -1, -1), p1 - A[-1])

    return step


def _forced_net(samples: Samples, budget: float) -> Step:
    samples = smoothed(samples)
    return momentum_step(fit_discrete_lagrangian(samples, SEED, budget, forced=True)[0], samples)


def _gaussian(samples: Samples, budget: float) -> Step:
    samples = smoothed(samples)
    return momentum_step(fit_gaussian_lagrangian(samples, SEED, budget), samples)


# Name → (samples, processor time of the fit [s]) → the steps of the fitted model.
LEARNED: dict[str, Callable[[Samples, float], Step]] = {
    "neural_ode": lambda samples, budget: flow_step(fit_neural_ode(samples, SEED, budget)),
    "forced_net": _forced_net,
    "delan": lambda samples, budget: flow_step(train_delan(smoothed(samples), SEED, budget)),
    "gaussian": _gaussian,
}


def fit_learned(of: ZooSystem, name: str, budget: float) -> LearnedModel:
    """One of `LEARNED` fitted to the training part."""
    return LearnedModel(LEARNED[name](samples_of(of), budget), of)
