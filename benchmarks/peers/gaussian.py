"""A Gaussian-process Lagrangian from positions only, with a force: linear least squares in random Fourier features.

C. Offen, "Machine learning of continuous and discrete variational ODEs with guaranteed convergence and uncertainty
quantifications", 2024 (arXiv:2404.19626): a Gaussian prior on L_d is conditioned on the discrete Euler–Lagrange
equation of the data and on a normalisation, without which L_d = 0 is the most likely solution.

J.-H. Ewering, K. Flaßkamp, N. Wahlström, T. B. Schön, T. Seel, "Structure-preserving Gaussian processes via discrete
Euler–Lagrange equations", 2026 (arXiv:2605.06246): the same for the forced equation, from positions alone.

Written anew after these (the second by its abstract), with differences. L and F stand at midpoints. The kernel is
squared exponential in the network inputs, by random Fourier features (A. Rahimi, B. Recht, NeurIPS 2007): 10³ samples
take 0.1 s. The prior's mean is a unit mass, and the normalisation is that the mean mass over the data stays it. F has
linear terms in velocity and inputs, too. The lengths and strengths are those of the least held-out error M⁻¹R: the
marginal likelihood of R grows as the mass goes to 0.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from .discrete import DiscreteLagrangian, scales_of_triples
from .samples import Samples

FEATURES = 256  # of L, and of F for each coordinate
BLOCKS = 15  # of neighbouring triples; every third one is held out
# Starts of the search: lengths in position and velocity, over the spread; strengths of L and F, over the noise. A step
# of the search is a factor e^±STEP, halved whenever `PATIENCE` steps in a row were none to the better.
STARTS = ((1.0, 2.0, 1e2, 1e2), (0.3, 2.0, 1e3, 1e3), (1.0, 2.0, 1e4, 1e4), (0.5, 1.0, 1e5, 1e5))
STEP, PATIENCE = 1.0, 8
NORMALISED = 1e4  # weight of the normalisation


@dataclass(frozen=True)
class Features:
    """√(2/m) cos(x Ω/ℓ + b), a Gaussian process of unit variance in m features of inputs x (N, d)."""

    omega: Tensor  # (d, m)
    phase: Tensor  # (m,)

    @classmethod
    def drawn(cls, generator: torch.Generator, inputs: int) -> Features:
        """Features of length 1."""
        omega = torch.randn(inputs, FEATURES, generator=generator, dtype=torch.float64)
        return cls(omega, 2 * math.pi * torch.rand(FEATURES, generator=generator, dtype=torch.float64))

    def of_length(self, length: Tensor) -> Features:
        """The process of these lengths (d,)."""
        return Features(self.omega / length[:, None], self.phase)

    def value(self, x: Tensor) -> Tensor:
        """(N, m)."""
        return math.sqrt(2 / FEATURES) * (x @ self.omega + self.phase).cos()

    def slope(self, x: Tensor, J: Tensor) -> Tensor:
        """Derivatives along the columns of J (N, d, k) or (d, k): (N, k, m)."""
        return -math.sqrt(2 / FEATURES) * (x @ self.omega + self.phase).sin()[:, None] * (J.mT @ self.omega)


class Equation:
    """The rows of the discrete forced Euler–Lagrange equation of all triples, linear in the features' weights."""

    def __init__(self, samples: Samples, generator: torch.Generator):
        self.samples, self.scales, self.n = samples, scales_of_triples(samples), samples.dof
        q0, q1, q2 = samples.triples()
        h, scales, n = samples.h, self.scales, self.n
        self.states = [((a + b) / 2, (b - a) / h) for a, b in ((q0, q1), (q1, q2))]
        self.inputs = samples.held()
        self.target = (q2 - 2 * q1 + q0) / (h**2 * scales.a)  # minus the equation of a unit mass
        self.width = scales.q_inputs + n
        self.L, self.F = (Features.drawn(generator, self.width) for _ in range(2))
        self.by_v = torch.cat([torch.zeros(scales.q_inputs, n).double(), torch.diag(1 / scales.v)])

    def of_lengths(self, along_q: float, along_v: float) -> tuple[Features, Features]:
        """The features of L and of F."""
        length = torch.tensor([along_q] * (self.width - self.n) + [along_v] * self.n, dtype=torch.float64)
        return self.L.of_length(length), self.F.of_length(length)

    def linear(self, x: Tensor, F: Features) -> Tensor:
        """What the force of a coordinate is a sum of, at inputs x, u (N, …): its process, velocities, inputs and 1."""
        return torch.cat([F.value(x[:, : self.width]), x[:, self.width - self.n :], torch.ones_like(x[:, :1])], -1)

    def rows(self, L: Features, F: Features) -> tuple[Tensor, Tensor]:
        """The equation by the weights of L and of each force, (N, n, P); the mass by those of L, (N, n, n, m)."""
        unit, of_L, of_F = self.scales.v.square() / self.scales.a, torch.zeros(()), torch.zeros(())
        for (q, v), u, side in zip(self.states, self.inputs, (1, -1), strict=True):
            x = self.scales.of_state(q, v)
            by_q = torch.cat([vmap(jacrev(self.scales.of_q))(q), torch.zeros(len(q), self.n, self.n).double()], 1)
            of_L = of_L + L.slope(x, by_q) / 2 + side / self.samples.h * L.slope(x, self.by_v)
            of_F = of_F + self.linear(torch.cat([x, u], -1), F) / 2
        blocks = torch.einsum("nf,ij->nijf", of_F, torch.eye(self.n).double()).flatten(2)
        x = self.scales.of_state(*self.states[0])
        bend = L.omega[-self.n :, None] * L.omega[-self.n :]  # (n, n, m) in units of σ_v
        return torch.cat([unit[:, None] * of_L, blocks], -1), -L.value(x)[:, None, None] * bend

    def model(self, L: Features, F: Features, w: Tensor) -> DiscreteLagrangian:
        """The Lagrangian and force of these weights."""
        of_L, of_F = w[:FEATURES, None], w[FEATURES:].reshape(self.n, -1).mT
        h = self.samples.h
        return DiscreteLagrangian(self.scales, h, lambda x: L.value(x) @ of_L, lambda x: self.linear(x, F) @ of_F)


def fit_gaussian_lagrangian(samples: Samples, seed: int, budget: float) -> DiscreteLagrangian:
    """The posterior mean of L and F; a random search finds its lengths and strengths in the processor time given."""
    end = time.process_time() + budget
    generator = torch.Generator().manual_seed(seed)
    equation = Equation(samples, generator)
    N, n = equation.target.shape
    held = torch.arange(N) * BLOCKS // N % 3 == 1
    ratio = equation.scales.v / equation.scales.a

    def solved(choice: Tensor, some: Tensor) -> tuple[float, Tensor]:
        """Held-out error, and the weights from some of the triples."""
        along_q, along_v, *strength = choice.exp().tolist()
        A, mass = equation.rows(*equation.of_lengths(along_q, along_v))
        prior = torch.cat([torch.full((FEATURES,), strength[0]), torch.full((A.shape[-1] - FEATURES,), strength[1])])
        kept, fixed = A[some].flatten(0, 1), NORMALISED * mass[some].mean(0).flatten(0, 1)
        G = kept.mT @ kept + torch.diag(prior.double() ** -2)
        G[:FEATURES, :FEATURES] += len(kept) * fixed.mT @ fixed
        factor, failed = torch.linalg.cholesky_ex(G)
        if failed:
            return math.inf, prior
        w = torch.cholesky_solve((kept.mT @ equation.target[some].flatten())[:, None], factor)[:, 0]
        r = A[held] @ w - equation.target[held]
        M = torch.eye(n).double() + mass[held] @ w[:FEATURES]
        error = torch.linalg.solve_ex(ratio[:, None] * M / ratio, r)[0]
        return float(error.square().mean().nan_to_num(math.inf)), w

    tried = [(solved(choice, ~held)[0], choice) for choice in torch.tensor(STARTS, dtype=torch.float64).log()]
    (least, best), size, idle = min(tried, key=lambda x: x[0]), STEP, 0
    while time.process_time() < end:
        trial = best + size * torch.randn(len(best), generator=generator, dtype=torch.float64)
        error = solved(trial, ~held)[0]
        least, best, idle = (error, trial, 0) if error < least else (least, best, idle + 1)
        size, idle = (size / 2, 0) if idle == PATIENCE else (size, idle)
    w = solved(best, torch.ones(N, dtype=torch.bool))[1]
    return equation.model(*equation.of_lengths(*best[:2].exp().tolist()), w)
