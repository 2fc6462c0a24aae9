"""Hamiltonian networks.

HNN (arXiv:1906.01563), ideal mass–spring: H = q² + p², 50 trajectories of 30 noisy points (σ = 0.1), half of them test;
200 tanh units twice, Adam 1e-3 with decay 1e-4, 2000 full-batch steps. Test loss, and mean squared error of the energy
from 15 random starts with 0.2 < |q|, |p| < 1. The authors' notebook changes its time span in place, so that each start
is followed 9 % longer than the one before: over 23.8 time units at first, 79.4 at last; here the same.

Dissipative HNN (arXiv:2201.10085), damped mass–spring: q̇ = 2p − 2q, ṗ = −2q on a 25 × 25 grid over ±1.2, 85 % to
train; 256 units twice, Adam 1e-3, batches of 128, 5000 steps. Mean of the test losses at steps 4500, 4600, … 4900.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from ..continuous import Hamiltonian
from ..networks import Scales
from ..rollouts import rk4
from .figures import Figure, spread

Rates = Callable[[Tensor], Tensor]  # (N, 2) → (N, 2)
HNN_TABLE = "Greydanus et al. 2019, table of the repository: "
DHNN_NOTEBOOK = "Sosanya and Greydanus 2022, analyze_dampedspring.ipynb: "


class _SourceNet(nn.Module):
    """The sources' networks: orthogonal weights (HNN), or a residual second layer and PyTorch's weights (D-HNN).

    The D-HNN's has time as third input, which is zero: it enters the size of the first weights.
    """

    def __init__(self, outputs: int, width: int, *, residual: bool):
        super().__init__()
        inputs = 3 if residual else 2
        self.first, self.second, self.last = (
            nn.Linear(a, b, dtype=torch.float64) for a, b in ((inputs, width), (width, width), (width, outputs))
        )
        self.residual = residual
        if not residual:
            for layer in (self.first, self.second, self.last):
                nn.init.orthogonal_(layer.weight)

    def forward(self, x: Tensor) -> Tensor:
        h = self.first(nn.functional.pad(x, (0, 1)) if self.residual else x).tanh()
        z = self.second(h).tanh()
        return self.last(h + z if self.residual else z)


def _hamiltonian(width: int, *, dissipative: bool, residual: bool) -> tuple[Sequence[Tensor], Rates]:
    model = Hamiltonian(Scales.unit(False), lambda _: _SourceNet(1, width, residual=residual), dissipative=dissipative)

    def rates(x: Tensor) -> Tensor:
        with torch.enable_grad():
            return torch.cat(model.rates(x[:, :1].detach(), x[:, 1:].detach()), -1)

    return model.parameters, rates


def _plain(width: int, *, residual: bool) -> tuple[Sequence[Tensor], Rates]:
    net = _SourceNet(2, width, residual=residual)
    return list(net.parameters()), net


def mass_spring(seed: int, effort: float = 1.0) -> dict[str, float]:
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
    pace = 20 * 1.09 ** torch.arange(2, 17, dtype=torch.float64)[:, None] / 99  # time between the points of each start
    for name, (weights, rates) in {
        "HNN": _hamiltonian(200, dissipative=False, residual=False),
        "plain net": _plain(200, residual=False),
    }.items():
        optimiser = torch.optim.Adam(weights, lr=1e-3, weight_decay=1e-4)
        for _ in range(math.ceil(2000 * effort)):
            optimiser.zero_grad()
            (rates(x[:half]) - dx[:half]).square().mean().backward()
            optimiser.step()
        found[f"{name}, test loss"] = float((rates(x[half:]) - dx[half:]).square().mean().detach())
        y, errors = starts, []
        for _ in range(99):
            y = rk4(lambda z: pace * rates(z).detach(), y, 1.0, math.ceil(16 * effort))  # noqa: B023
            errors.append((y.square().sum(-1) - starts.square().sum(-1)).square())
        found[f"{name}, energy MSE"] = float(torch.stack(errors).mean())
    return found


def damped_spring(seed: int, effort: float = 1.0) -> dict[str, float]:
    """Test loss of a dissipative HNN, of an HNN, which cannot dissipate, and of a plain network."""
    make = torch.Generator().manual_seed(seed)
    line = torch.linspace(-1.2, 1.2, 25, dtype=torch.float64)
    x = torch.cartesian_prod(line, line)[torch.randperm(625, generator=make)]
    dx = torch.stack([2 * x[:, 1] - 2 * x[:, 0], -2 * x[:, 0]], -1)
    cut, last, found = 531, math.ceil(4900 * effort), {}
    for name, (weights, rates) in {
        "dissipative HNN": _hamiltonian(256, dissipative=True, residual=True),
        "HNN": _hamiltonian(256, dissipative=False, residual=True),
        "plain net": _plain(256, residual=True),
    }.items():
        optimiser, tests = torch.optim.Adam(weights, lr=1e-3), []
        for step in range(last + 1):
            i = torch.arange(128 * step % cut, min(128 * step % cut + 128, cut))
            optimiser.zero_grad()
            (rates(x[i]) - dx[i]).square().mean().backward()
            optimiser.step()
            if (last - step) % 100 == 0 and last - step <= 400:
                tests.append(float((rates(x[cut:]) - dx[cut:]).square().mean().detach()))
        found[f"{name}, test loss"] = statistics.mean(tests)
    return found


FIGURES = {
    "mass–spring": {
        "HNN, test loss": Figure(HNN_TABLE + "3.59e-02 ± 0.18e-02", *spread(3.59e-2, 0.18e-2)),
        "plain net, test loss": Figure(HNN_TABLE + "3.67e-02 ± 0.19e-02", *spread(3.67e-2, 0.19e-2)),
        "HNN, energy MSE": Figure(HNN_TABLE + "3.8e-04 ± 0.7e-04", *spread(3.8e-4, 0.7e-4)),
        "plain net, energy MSE": Figure(HNN_TABLE + "1.7e-01 ± 0.2e-01", *spread(1.7e-1, 0.2e-1)),
    },
    "damped spring": {
        "dissipative HNN, test loss": Figure(DHNN_NOTEBOOK + "5.8e-05 ± 6.9e-05", 0.0, 1.27e-4),
        "HNN, test loss": Figure(DHNN_NOTEBOOK + "6.26e-01 ± 0.13e-01", *spread(6.26e-1, 0.13e-1)),
        "plain net, test loss": Figure(DHNN_NOTEBOOK + "9.9e-05 ± 7.9e-05", *spread(9.9e-5, 7.9e-5)),
    },
}
