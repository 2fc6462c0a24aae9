"""Peers that fit a vector field: Hamiltonian networks, Lagrangian networks and the neural ODE.

S. Greydanus, M. Dzamba, J. Yosinski, "Hamiltonian neural networks", NeurIPS 2019 (arXiv:1906.01563):
q̇ = ∂H/∂p, ṗ = −∂H/∂q, fitted to rates.

A. Sosanya, S. Greydanus, "Dissipative Hamiltonian neural networks", 2022 (arXiv:2201.10085): a second scalar D adds
its gradient, q̇ = ∂H/∂p + ∂D/∂q, ṗ = −∂H/∂q + ∂D/∂p.

M. Cranmer, S. Greydanus, S. Hoyer, P. Battaglia, D. Spergel, S. Ho, "Lagrangian neural networks", 2020
(arXiv:2003.04630): L(q, v) is one network and v̇ = (∂²L/∂v²)⁻¹ (∂L/∂q − ∂²L/∂q∂v v). Here the network is added to
½|v|² at the start, so that the first Hessian is regular.

M. Lutter, C. Ritter, J. Peters, "Deep Lagrangian networks", ICLR 2019 (arXiv:1907.04490): L = ½ vᵀM(q)v − V(q) with M
from its Cholesky factor; with the viscous friction of each joint that Lutter, Listmann and Peters (IROS 2019) add. As
no torque is measured the forward model is fitted, v̇ against accelerations.

Neural ODE, v̇ = net(q, v): R. Chen, Y. Rubanova, J. Bettencourt, D. Duvenaud, NeurIPS 2018 (arXiv:1806.07366).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from .networks import Network, Scales, count, fit_rates, gradient, scales_of, split, train
from .rollouts import Flow
from .samples import Samples

WINDOW = 9  # samples of a window of the neural ODE
FINEST = 0.25  # its Runge–Kutta step at most, in units of velocity over acceleration


class Hamiltonian:
    """H(q, p), and D(q, p) where dissipative, as networks."""

    def __init__(self, scales: Scales, generator: torch.Generator, *, dissipative: bool):
        inputs = scales.q_inputs + len(scales.angles)
        self.scales, self.energy = scales, float((scales.v * scales.v).mean())
        self.H = Network(inputs, 1, generator)
        self.D = Network(inputs, 1, generator) if dissipative else None
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
    """Fit H, and D where dissipative, to rates; the momentum is the velocity where only positions were given."""
    generator = torch.Generator().manual_seed(seed)
    motion = samples.motion()
    scales = Scales.of(samples.angles, torch.cat(samples.q), motion.p, motion.f)
    model = Hamiltonian(scales, generator, dissipative=dissipative)
    return fit_rates(model.rates, model.parameters, samples, generator, budget, momentum=True)


def acceleration(L: Tensor, q: Tensor, v: Tensor) -> Tensor:
    """v̇ of the Euler–Lagrange equation, (B, n); L is (B,) at (q, v)."""
    L_q, L_v = torch.autograd.grad(L.sum(), (q, v), create_graph=True)
    rows = [
        torch.autograd.grad(L_v[:, i].sum(), (q, v), create_graph=True, materialize_grads=True)
        for i in range(q.shape[1])
    ]
    mixed, mass = (torch.stack([row[k] for row in rows], 1) for k in (0, 1))
    return torch.linalg.solve_ex(mass, L_q - (mixed @ v[..., None])[..., 0])[0]


class DeepLagrangian:
    """½ vᵀM(q)v − V(q) with M = CCᵀ + ε, and the generalised force −d v + B u of each coordinate.

    The diagonal of C is softplus(net + 0.54), so that M is near 1 at the start.
    """

    def __init__(self, scales: Scales, generator: torch.Generator, inputs: int = 0):
        n = len(scales.angles)
        self.scales, self.index = scales, torch.tril_indices(n, n)
        self.factor = Network(scales.q_inputs, self.index.shape[1], generator)
        self.potential = Network(scales.q_inputs, 1, generator)
        self.log_friction = torch.full((n,), -3.0, dtype=torch.float64, requires_grad=True)
        self.gain = torch.zeros(n, inputs, dtype=torch.float64, requires_grad=True)
        self.parameters = [*self.factor.parameters(), *self.potential.parameters(), self.log_friction, self.gain]

    def mass(self, q: Tensor) -> Tensor:
        """M(q) in units of the scaled velocity, (B, n, n), positive definite."""
        n = q.shape[1]
        entries = self.factor(self.scales.of_q(q))
        C = entries.new_zeros(len(q), n, n)
        C[:, self.index[0], self.index[1]] = entries
        diagonal = nn.functional.softplus(C.diagonal(dim1=-2, dim2=-1) + 0.54)  # softplus(0.54) = 1
        C = C.tril(-1) + torch.diag_embed(diagonal)
        return C @ C.mT + 1e-3 * torch.eye(n, dtype=q.dtype)

    def rates(self, q: Tensor, v: Tensor, *u: Tensor) -> tuple[Tensor, Tensor]:
        """(v, v̇) at (q, v) with inputs: M ẇ = r for the scaled velocity w = v/σ."""
        q = q.requires_grad_()
        w = v / self.scales.v
        M = self.mass(q)
        V_q = gradient(self.potential(self.scales.of_q(q)), q)
        Mw = (M @ w[..., None])[..., 0]
        # d/dt (M w) = Ṁ w + M ẇ and ∂T/∂q = ½ wᵀ M_q w, in scaled velocities; S = diag(σ) takes rates back to v.
        M_q_w = torch.stack([gradient(Mw[:, i], q) for i in range(q.shape[1])], 1)
        M_dot_w = (M_q_w @ v[..., None])[..., 0]
        T_q = gradient((w.detach() * (M @ w.detach()[..., None])[..., 0]).sum(-1) / 2, q)
        right = self.scales.v * (T_q - V_q) - M_dot_w - self.log_friction.exp() * w + sum(x @ self.gain.mT for x in u)
        return v, self.scales.v * torch.linalg.solve_ex(M, right)[0]


def train_lnn(samples: Samples, seed: int, budget: float) -> Flow:
    """Fit one network in L(q, v) = E [½|v/σ|² + net(q, v)] to accelerations."""
    generator = torch.Generator().manual_seed(seed)
    scales = scales_of(samples, samples.motion())
    net = Network(scales.q_inputs + samples.dof, 1, generator, nn.Softplus())

    def rates(q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        q, v = q.requires_grad_(), v.requires_grad_()
        L = (v / scales.v).square().sum(-1) / 2 + net(scales.of_state(q, v))[:, 0]
        return v, acceleration(L, q, v)

    return fit_rates(rates, net.parameters(), samples, generator, budget, momentum=False)


def train_delan(samples: Samples, seed: int, budget: float) -> Flow:
    """Fit M(q), V(q), friction and the gains of inputs to accelerations."""
    generator = torch.Generator().manual_seed(seed)
    model = DeepLagrangian(scales_of(samples, samples.motion()), generator, samples.inputs)
    return fit_rates(model.rates, model.parameters, samples, generator, budget, momentum=False)


def integrator(field: Callable[[Tensor], Tensor], h: float, parts: int) -> Callable[[Tensor], Tensor]:
    """One step of length h, by torchdiffeq's fixed-step rk4."""
    from torchdiffeq import odeint  # pyright: ignore[reportMissingImports]

    times = torch.linspace(0.0, h, parts + 1, dtype=torch.float64)

    def step(y: Tensor) -> Tensor:
        out: Any = odeint(lambda t, y: field(y), y, times, method="rk4")  # noqa: ARG005
        return out[-1]

    return step


def train_neural_ode(samples: Samples, seed: int, budget: float) -> Flow:
    """Neural ODE fitted to the samples of short windows.

    Loss: squared error of the positions at every sample of a window (and of the velocities where exact ones are given).
    Without velocities the one at the start of each window is trained too, from its finite difference.
    """
    generator, n, h = torch.Generator().manual_seed(seed), samples.dof, samples.h
    scales = scales_of(samples, samples.motion())
    net = Network(scales.q_inputs + n, n, generator)
    weights = list(net.parameters())

    def field(y: Tensor) -> Tensor:
        q, v = y[:, :n], y[:, n:]
        return torch.cat([v, scales.a * net(scales.of_state(q, v))], -1)

    parts = max(1, round(h / (FINEST * float((scales.v / scales.a).min()))))
    step = integrator(field, h, parts)
    length = min(WINDOW, max(len(q) for q in samples.q))

    def error(y: Tensor, data: Tensor, first: int, last: int) -> Tensor:
        """Mean square of samples first … last − 1 of windows that start at y, over the spread of what is measured."""
        seen, total = data.shape[-1], torch.zeros((), dtype=torch.float64)
        spread = torch.cat([scales.q, scales.v])[:seen]
        for k in range(1, last):
            y = step(y)
            if k >= first:
                total = total + ((y[:, :seen] - data[:, k]) / spread).square().mean()
        return total / (last - first)

    if samples.exact is not None:
        states = [torch.cat([m.q, m.v], -1) for m in samples.exact]
        data = torch.cat([x.unfold(0, length, length - 1).transpose(1, 2) for x in states if len(x) >= length])
        rows, held = split(len(data), generator)
        exact = lambda i: error(data[i, 0], data[i], 1, length)  # noqa: E731
        train(lambda i: exact(rows[i]), len(rows), lambda: exact(held), weights, generator, budget)
        return Flow(field, h, parts, count(weights), step)
    data = samples.windows(length)
    start = ((-1.5 * data[:, 0] + 2 * data[:, 1] - 0.5 * data[:, 2]) / h).requires_grad_()
    loss = lambda i, first, last: error(torch.cat([data[i, 0], start[i]], -1), data[i], first, last)  # noqa: E731
    # The last sample of each window judges: its start is trained, so held-out windows would have none.
    judge, fit = (lambda: loss(slice(None), length - 1, length)), (lambda i: loss(i, 1, length - 1))
    train(fit, len(data), judge, [*weights, start], generator, budget)
    return Flow(field, h, parts, count(weights), step)
