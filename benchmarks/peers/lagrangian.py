"""Lagrangian neural network and deep Lagrangian network.

M. Cranmer, S. Greydanus, S. Hoyer, P. Battaglia, D. Spergel, S. Ho, "Lagrangian neural networks", 2020
(arXiv:2003.04630): L(q, v) is one network and v̇ = (∂²L/∂v²)⁻¹ (∂L/∂q − ∂²L/∂q∂v v). Here the network is added to
½|v|² at the start, so that the first Hessian is regular.

M. Lutter, C. Ritter, J. Peters, "Deep Lagrangian networks", ICLR 2019 (arXiv:1907.04490): L = ½ vᵀM(q)v − V(q) with M
from its Cholesky factor; with the viscous friction of each joint that Lutter, Listmann and Peters (IROS 2019) add. As
no torque is measured the forward model is fitted, v̇ against accelerations.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from .fields import fit_rates, gradient, scales_of
from .networks import Network, Scales
from .rollouts import Flow
from .samples import Samples


def acceleration(L: Tensor, q: Tensor, v: Tensor, force: Tensor | None = None) -> Tensor:
    """v̇ of the Euler–Lagrange equation with a force on its right-hand side, (B, n); L is (B,) at (q, v)."""
    L_q, L_v = torch.autograd.grad(L.sum(), (q, v), create_graph=True)
    rows = [
        torch.autograd.grad(L_v[:, i].sum(), (q, v), create_graph=True, materialize_grads=True)
        for i in range(q.shape[1])
    ]
    mixed, mass = (torch.stack([row[k] for row in rows], 1) for k in (0, 1))
    right = L_q - (mixed @ v[..., None])[..., 0]
    return torch.linalg.solve_ex(mass, right if force is None else right + force)[0]


class FreeLagrangian:
    """L(q, v) = E [½|v/σ|² + net(q, v)]; `kinetic` is the weight of the first term."""

    def __init__(self, scales: Scales, network: Callable[[int], nn.Module], *, kinetic: float = 1.0):
        self.scales, self.kinetic = scales, kinetic
        self.net = network(scales.q_inputs + len(scales.angles))
        self.parameters = list(self.net.parameters())

    def rates(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """(v, v̇) at (q, v)."""
        q, v = q.requires_grad_(), v.requires_grad_()
        L = self.kinetic * (v / self.scales.v).square().sum(-1) / 2 + self.net(self.scales.of_state(q, v))[:, 0]
        return v, acceleration(L, q, v)


class DeepLagrangian:
    """½ vᵀM(q)v − V(q) with M = CCᵀ + ε, and the friction −d v of each coordinate where asked for.

    The diagonal of C is softplus(net + `shift`) + `least`; with the defaults M is near 1 at the start.
    """

    def __init__(
        self,
        scales: Scales,
        generator: torch.Generator,
        *,
        friction: bool = True,
        shift: float = 0.54,
        least: float = 0.0,
    ):
        n = len(scales.angles)
        self.shift, self.least = shift, least
        self.scales, self.index = scales, torch.tril_indices(n, n)
        self.factor = Network(scales.q_inputs, self.index.shape[1], generator)
        self.potential = Network(scales.q_inputs, 1, generator)
        self.parameters: list[Tensor] = [*self.factor.parameters(), *self.potential.parameters()]
        self.log_friction = torch.full((n,), -3.0 if friction else -torch.inf, dtype=torch.float64)
        if friction:
            self.parameters.append(self.log_friction.requires_grad_())

    def mass(self, q: Tensor) -> Tensor:
        """M(q) in units of the scaled velocity, (B, n, n), positive definite."""
        n = q.shape[1]
        entries = self.factor(self.scales.of_q(q))
        C = entries.new_zeros(len(q), n, n)
        C[:, self.index[0], self.index[1]] = entries
        diagonal = nn.functional.softplus(C.diagonal(dim1=-2, dim2=-1) + self.shift) + self.least  # softplus(0.54) = 1
        C = C.tril(-1) + torch.diag_embed(diagonal)
        return C @ C.mT + 1e-3 * torch.eye(n, dtype=q.dtype)

    def equation(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """(M, r) of M ẇ = r + σ τ for the scaled velocity w = v/σ and a torque τ; (B, n, n) and (B, n)."""
        q = q.requires_grad_()
        w = v / self.scales.v
        M = self.mass(q)
        V_q = gradient(self.potential(self.scales.of_q(q)), q)
        Mw = (M @ w[..., None])[..., 0]
        # d/dt (M w) = Ṁ w + M ẇ and ∂T/∂q = ½ wᵀ M_q w, in scaled velocities; S = diag(σ) takes rates back to v.
        M_q_w = torch.stack([gradient(Mw[:, i], q) for i in range(q.shape[1])], 1)
        M_dot_w = (M_q_w @ v[..., None])[..., 0]
        T_q = gradient((w.detach() * (M @ w.detach()[..., None])[..., 0]).sum(-1) / 2, q)
        return M, self.scales.v * (T_q - V_q) - M_dot_w - self.log_friction.exp() * w

    def rates(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """(v, v̇) at (q, v) without torque."""
        M, right = self.equation(q, v)
        return v, self.scales.v * torch.linalg.solve_ex(M, right)[0]

    def torque(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """The torque (B, n) of the motion, the inverse model that Lutter et al. train."""
        M, right = self.equation(q, v)
        return ((M @ (a / self.scales.v)[..., None])[..., 0] - right) / self.scales.v


def train_lnn(samples: Samples, seed: int, budget: float) -> Flow:
    """Fit one network L(q, v) to accelerations."""
    generator = torch.Generator().manual_seed(seed)
    scales = scales_of(samples, samples.motion())
    model = FreeLagrangian(scales, lambda inputs: Network(inputs, 1, generator, nn.Softplus()))
    return fit_rates(model.rates, model.parameters, samples, generator, budget, momentum=False, velocity_rate=False)


def train_delan(samples: Samples, seed: int, budget: float) -> Flow:
    """Fit M(q), V(q) and friction to accelerations."""
    generator = torch.Generator().manual_seed(seed)
    model = DeepLagrangian(scales_of(samples, samples.motion()), generator)
    return fit_rates(model.rates, model.parameters, samples, generator, budget, momentum=False, velocity_rate=False)
