"""The generating function S^k and the discrete Hamilton–Jacobi equation.

S^k(q̂0, q_k, ŝ0) = s_k − ŝ0 along the discrete solution that joins q̂0 to q_k in k steps. It generates Φ̃^k:

    D2 S^k = p_k,    1 + D3 S^k = σ_k,    D1 S^k = −σ_k p̂0.

Its left twin is a function of (q̂0, q_k, s_k), the value of s at the other end:

    S^{k−}(q̂0, q_k, s_k) = s_k − ŝ0,    p̂0 = −D1 S^{k−},    p_k = D2 S^{k−} / (1 − D3 S^{k−}),    1 − D3 S^{k−} = 1/σ_k.

Everything below takes S through the flow, never through those identities, so that the identities can be checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics.contact import Flow, flow_derivative, flow_derivatives
from herglotz.mechanics.regularity import least_singular_value


@dataclass(frozen=True)
class GeneratingFunction:
    """S^k and its derivatives at (q̂0, q_k, ŝ0), or the left one's at (q̂0, q_k, s_k), for a batch of solutions."""

    S: Tensor  # (...)
    D1: Tensor  # (..., n) ∂S/∂q̂0
    D2: Tensor  # (..., n) ∂S/∂q_k
    D3: Tensor  # (...) ∂S/∂ŝ0; left: ∂S/∂s_k
    q: Tensor  # (..., n) q_k
    p: Tensor  # (..., n) p_k as the flow carries it
    s: Tensor  # (...) s_k
    # (...) smallest singular value of ∂q_k/∂p̂0; zero at a caustic, where S^k is not defined, and after a failed step
    spread: Tensor

    def map(self, change: Callable[[Tensor], Tensor]) -> GeneratingFunction:
        """`change` applied to every tensor."""
        return GeneratingFunction(**{name: change(x) for name, x in vars(self).items()})

    @classmethod
    def of(cls, s: Tensor, end: tuple[Tensor, Tensor, Tensor], D: Tensor) -> GeneratingFunction:
        """S^k from ŝ0, (q_k, p_k, s_k) and the derivative of the map to it (`mechanics.flow_derivative`)."""
        (q_k, p_k, s_k), n = end, end[0].shape[-1]
        Y_q, Y_p, Y_s = D[..., :n, :n], D[..., :n, n : 2 * n], D[..., :n, 2 * n]
        G_q, G_p, G_s = D[..., 2 * n, :n], D[..., 2 * n, n : 2 * n], D[..., 2 * n, 2 * n]
        D2 = torch.linalg.solve_ex(Y_p.mT, G_p[..., None])[0][..., 0]
        D1 = G_q - (Y_q.mT @ D2[..., None])[..., 0]
        D3 = G_s - 1.0 - (D2 * Y_s).sum(-1)
        return cls(s_k - s, D1, D2, D3, q_k, p_k, s_k, least_singular_value(Y_p))


def generating_function(
    flow_k: Flow,  # the k-step map Φ̃^k
    q: Tensor,  # (..., n) q̂0
    p: Tensor,  # (..., n) p̂0, which labels the solution
    s: Tensor,  # (...) ŝ0
) -> GeneratingFunction:
    """S^k and its three derivatives along the solutions that start at (q̂0, p̂0, ŝ0).

    The chain rule through the endpoint map (q̂0, p̂0, ŝ0) ↦ q_k gives D2 S = (∂s_k/∂p̂0)(∂q_k/∂p̂0)⁻¹ and, with it,
    D1 and D3.

    Source: generating functions of the paper, with the sign of erratum E1.
    """
    return GeneratingFunction.of(s, *flow_derivative(flow_k, q, p, s))


def generating_functions(flows: Iterable[Flow], q: Tensor, p: Tensor, s: Tensor) -> list[GeneratingFunction]:
    """Return `generating_function` of the first map, of the first two composed, …; each map is evaluated once."""
    return [GeneratingFunction.of(s, *found) for found in flow_derivatives(flows, q, p, s)]


def left_generating_function(flow_k: Flow, q: Tensor, p: Tensor, s: Tensor) -> GeneratingFunction:
    """S^{k−}(q̂0, q_k, s_k) = s_k − ŝ0 and its three derivatives along the solutions from (q̂0, p̂0, ŝ0).

    The chain rule through (p̂0, ŝ0) ↦ (q_k, s_k) at fixed q̂0 gives D2 and D3 = ∂S^{k−}/∂s_k together, and with them
    D1. Not defined where σ_k = 0 or at a caustic.

    Source: erratum E5 for k = 1, composed.
    """
    n = q.shape[-1]
    (q_k, p_k, s_k), D = flow_derivative(flow_k, q, p, s)
    ends = torch.cat([D[..., :n, n:], D[..., 2 * n :, n:]], -2)  # ∂(q_k, s_k)/∂(p̂0, ŝ0)
    rate = D[..., 2 * n, n:].clone()  # ∂(s_k − ŝ0)/∂(p̂0, ŝ0)
    rate[..., n] -= 1.0
    slopes = torch.linalg.solve_ex(ends.mT, rate[..., None])[0][..., 0]
    D2, D3 = slopes[..., :n], slopes[..., n]
    D1 = (1 - D3)[..., None] * D[..., 2 * n, :n] - (D[..., :n, :n].mT @ D2[..., None])[..., 0]
    return GeneratingFunction(s_k - s, D1, D2, D3, q_k, p_k, s_k, least_singular_value(D[..., :n, n : 2 * n]))


def hamilton_jacobi_residual(
    S1: Tensor,  # (...) S^{k+1}(q_{k+1})
    S0: Tensor,  # (...) S^k(q_k)
    dS1: Tensor,  # (..., n) dS^{k+1}(q_{k+1})
    q1: Tensor,  # (..., n) q_{k+1}
    H_plus: Tensor,  # (...) H⁺(q_k, dS^{k+1}(q_{k+1}), s_k), s_k = ŝ0 + S^k
) -> Tensor:
    """S^{k+1}(q_{k+1}) − S^k(q_k) − dS^{k+1}·q_{k+1} + H⁺(q_k, dS^{k+1}, s_k), shape (...).

    Zero on an open set of q_k when q_{k+1} = Φ̃^γ(q_k), and only there (erratum E7). Zero there does not yet make S a
    solution: the left equation must hold, too (erratum E10); `check` measures both.

    Source: right discrete contact Hamilton–Jacobi equation of the paper.
    """
    return S1 - S0 - (dS1 * q1).sum(-1) + H_plus


def left_hamilton_jacobi_residual(
    S1: Tensor,  # (...) S^{k+1}(q_{k+1})
    S0: Tensor,  # (...) S^k(q_k)
    dS0: Tensor,  # (..., n) dS^k(q_k)
    q0: Tensor,  # (..., n) q_k
    H_minus: Tensor,  # (...) H⁻(dS^k(q_k), q_{k+1}, s_{k+1}), s_{k+1} = ŝ0 + S^{k+1}
) -> Tensor:
    """S^{k+1}(q_{k+1}) − S^k(q_k) + dS^k(q_k)·q_k + H⁻(dS^k(q_k), q_{k+1}, s_{k+1}), shape (...).

    Zero on an open set of q_k when q_{k+1} = Φ̃^γ(q_k), and only there (erratum E7).

    Source: left discrete contact Hamilton–Jacobi equation, erratum E6.
    """
    return S1 - S0 + (dS0 * q0).sum(-1) + H_minus
