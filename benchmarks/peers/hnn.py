"""Hamiltonian neural network and its dissipative form.

S. Greydanus, M. Dzamba, J. Yosinski, "Hamiltonian neural networks", NeurIPS 2019 (arXiv:1906.01563):
q̇ = ∂H/∂p, ṗ = −∂H/∂q, fitted to rates.

A. Sosanya, S. Greydanus, "Dissipative Hamiltonian neural networks", 2022 (arXiv:2201.10085): a second scalar D adds
its gradient, q̇ = ∂H/∂p + ∂D/∂q, ṗ = −∂H/∂q + ∂D/∂p.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from .fields import fit_rates, gradient
from .networks import Network, Scales
from .rollouts import Flow
from .samples import Samples


class Hamiltonian:
    """H(q, p), and D(q, p) where dissipative, as networks that `network` makes for a number of inputs."""

    def __init__(self, scales: Scales, network: Callable[[int], nn.Module], *, dissipative: bool):
        inputs = scales.q_inputs + len(scales.angles)
        self.scales, self.energy = scales, float((scales.v * scales.v).mean())
        self.H = network(inputs)
        self.D = network(inputs) if dissipative else None
        self.parameters = [*self.H.parameters(), *(self.D.parameters() if self.D else ())]

    def rates(self, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        """(q̇, ṗ) at (q, p), (B, n) each."""
        q, p = q.requires_grad_(), p.requires_grad_()
        x = self.scales.of_state(q, p)
        H_q, H_p = torch.autograd.grad(self.energy * self.H(x).sum(), (q, p), create_graph=True)
        if self.D is None:
            return H_p, -H_q
        D = self.energy * self.D(x)
        return H_p + gradient(D, q), -H_q + gradient(D, p)


def train_hnn(samples: Samples, seed: int, budget: float, *, dissipative: bool = False) -> Flow:
    """Fit H to rates; the momentum is the velocity where only positions were given."""
    generator = torch.Generator().manual_seed(seed)
    motion = samples.motion()
    scales = Scales.of(samples.angles, torch.cat(samples.q), motion.p, motion.f)
    model = Hamiltonian(scales, lambda inputs: Network(inputs, 1, generator), dissipative=dissipative)
    return fit_rates(model.rates, model.parameters, samples, generator, budget, momentum=True)


def train_dissipative_hnn(samples: Samples, seed: int, budget: float) -> Flow:
    """Fit H and D to rates."""
    return train_hnn(samples, seed, budget, dissipative=True)
