"""Figures of the sources, measured with our implementations at the sources' own settings.

HNN (arXiv:1906.01563), ideal mass–spring: H = q² + p², 50 trajectories of 30 noisy points (σ = 0.1), half of them test;
200 tanh units twice, Adam 1e-3 with decay 1e-4, 2000 full-batch steps. Test loss, and mean squared error of the energy
over 20 time units from 15 random starts with 0.2 < |q|, |p| < 1.

Dissipative HNN (arXiv:2201.10085), damped mass–spring: q̇ = 2p − ρq, ṗ = −2q − ρp, ρ = 0.7, on an 18 × 18 grid over
±1.2, 80 % to train; 256 units twice, Adam 1e-2, batches of 100. Median of the test losses at steps 4000, 4200, … 4800,
as the authors' notebook prints them.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from .hnn import Hamiltonian
from .networks import Scales
from .rollouts import rk4

Rates = Callable[[Tensor], Tensor]  # (N, 2) → (N, 2)
NOTE = (
    "Sources: the tables of github.com/greydanus/hamiltonian-nn (± is theirs) and the last losses printed in "
    "analyze_dampedspring.ipynb of github.com/DrewSosa/dissipative_hnns. torchdiffeq, pysindy and phlearn are the "
    "published packages. Not reproduced: LNN, DeLaN and both discrete Lagrangian nets (their figures need hours of "
    "training, robots, or data that are not public)."
)


class _SourceNet(nn.Module):
    """The sources' networks: orthogonal weights (HNN), or a residual second layer and PyTorch's weights (D-HNN)."""

    def __init__(self, outputs: int, width: int, *, residual: bool):
        super().__init__()
        self.first, self.second, self.last = (
            nn.Linear(a, b, dtype=torch.float64) for a, b in ((2, width), (width, width), (width, outputs))
        )
        self.residual = residual
        if not residual:
            for layer in (self.first, self.second, self.last):
                nn.init.orthogonal_(layer.weight)

    def forward(self, x: Tensor) -> Tensor:
        h = self.first(x).tanh()
        z = self.second(h).tanh()
        return self.last(h + z if self.residual else z)


def _hamiltonian(width: int, *, dissipative: bool, residual: bool) -> tuple[Sequence[Tensor], Rates]:
    one = torch.ones(1, dtype=torch.float64)
    scales = Scales((False,), 0 * one, one, one, one)
    model = Hamiltonian(scales, lambda _: _SourceNet(1, width, residual=residual), dissipative=dissipative)

    def rates(x: Tensor) -> Tensor:
        with torch.enable_grad():
            return torch.cat(model.rates(x[:, :1].detach(), x[:, 1:].detach()), -1)

    return model.parameters, rates


def _plain(width: int) -> tuple[Sequence[Tensor], Rates]:
    net = _SourceNet(2, width, residual=False)
    return list(net.parameters()), net


def mass_spring(seed: int) -> dict[str, float]:
    """Test loss and energy error of an HNN and of a plain network."""
    make = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=make, dtype=torch.float64)

    radius, phase = 0.1 + 0.9 * rand(50, 1), 2 * math.pi * rand(50, 1)
    t = torch.linspace(0, 3, 30, dtype=torch.float64)
    q, p = radius * (2 * t + phase).sin(), radius * (2 * t + phase).cos()
    dx = torch.stack([2 * p, -2 * q], -1).reshape(-1, 2)
    x = torch.stack([q, p], -1).reshape(-1, 2) + 0.1 * torch.randn(1500, 2, generator=make, dtype=torch.float64)
    half, found = 750, {}
    starts = 1.6 * rand(15, 2) - 0.8
    starts = starts + 0.2 * starts.sign()
    for name, (weights, rates) in {
        "HNN": _hamiltonian(200, dissipative=False, residual=False),
        "plain net": _plain(200),
    }.items():
        optimiser = torch.optim.Adam(weights, lr=1e-3, weight_decay=1e-4)
        for _ in range(2000):
            optimiser.zero_grad()
            (rates(x[:half]) - dx[:half]).square().mean().backward()
            optimiser.step()
        found[f"{name}, test loss"] = float((rates(x[half:]) - dx[half:]).square().mean().detach())
        y, errors = starts, []
        for _ in range(100):
            y = rk4(lambda z: rates(z).detach(), y, 0.2, 4)  # noqa: B023
            errors.append((y.square().sum(-1) - starts.square().sum(-1)).square())
        found[f"{name}, energy MSE"] = float(torch.stack(errors).mean())
    return found


def damped_spring(seed: int) -> dict[str, float]:
    """Test loss of a dissipative HNN and of an HNN, which cannot dissipate."""
    make = torch.Generator().manual_seed(seed)
    line = torch.linspace(-1.2, 1.2, 18, dtype=torch.float64)
    x = torch.cartesian_prod(line, line)[torch.randperm(324, generator=make)]
    dx = torch.stack([2 * x[:, 1] - 0.7 * x[:, 0], -2 * x[:, 0] - 0.7 * x[:, 1]], -1)
    cut, found = 259, {}
    for name, dissipative in (("dissipative HNN", True), ("HNN", False)):
        weights, rates = _hamiltonian(256, dissipative=dissipative, residual=True)
        optimiser, tests = torch.optim.Adam(weights, lr=1e-2), []
        for step in range(4801):
            if step % 200 == 0 and step >= 4000:
                tests.append(float((rates(x[cut:]) - dx[cut:]).square().mean().detach()))
            i = torch.arange(100 * step % cut, min(100 * step % cut + 100, cut))
            optimiser.zero_grad()
            (rates(x[i]) - dx[i]).square().mean().backward()
            optimiser.step()
        found[f"{name}, test loss"] = statistics.median(tests)
    return found


FIGURES = {
    "mass–spring, HNN, test loss": "3.59e-02 ± 0.18e-02",
    "mass–spring, plain net, test loss": "3.67e-02 ± 0.19e-02",
    "mass–spring, HNN, energy MSE": "3.8e-04 ± 0.7e-04",
    "mass–spring, plain net, energy MSE": "1.7e-01 ± 0.2e-01",
    "damped spring, dissipative HNN, test loss": "2.1e-05 (1.5e-05 – 4.9e-04)",
    "damped spring, HNN, test loss": "6.2e-01 (6.1e-01 – 6.3e-01)",
}


def reproduce(result: dict[str, Any], seeds: int) -> None:
    """Fill `reproduced` of the result, seed by seed."""
    table: dict[str, list[float]] = {name: [] for name in FIGURES}
    for seed in tqdm(range(seeds), disable=None):
        for task, run in (("mass–spring", mass_spring), ("damped spring", damped_spring)):
            with torch.random.fork_rng():
                torch.manual_seed(seed)  # of the layers' weights
                for name, value in run(seed).items():
                    table[f"{task}, {name}"].append(value)
    result["reproduced"] = {k: {"figure": k, "source": FIGURES[k], "here": v} for k, v in table.items()}
    result["reproduced_note"] = NOTE
