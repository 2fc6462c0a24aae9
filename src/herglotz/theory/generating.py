"""Discrete Hamilton–Jacobi theory: the generating function S^k and the residuals of the equation.

S^k(q̂0, q_k, ŝ0) = s_k − ŝ0 along the discrete solution that joins q̂0 to q_k in k steps. S^k generates Φ̃^k:

    D2 S^k = p_k,    1 + D3 S^k = σ_k,    D1 S^k = −σ_k p̂0.

The left generating function has s_k, the value of s at the other end, as its argument:

    S^{k−}(q̂0, q_k, s_k) = s_k − ŝ0,    p̂0 = −D1 S^{k−},    p_k = D2 S^{k−} / (1 − D3 S^{k−}),    1 − D3 S^{k−} = 1/σ_k.

The functions below compute S from the flow and never from these identities, so that the identities can be checked.
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
    """S^k and its derivatives by (q̂0, q_k, ŝ0), or S^{k−} and those by (q̂0, q_k, s_k), for a batch of solutions.

    (q, p, s) is the end (q_k, p_k, s_k) of the flow. `spread` is the smallest singular value of ∂q_k/∂p̂0: zero at a
    caustic, where S^k is not defined, and after a failed step.
    """

    S: Tensor  # (...)
    D1: Tensor  # (..., n)
    D2: Tensor  # (..., n)
    D3: Tensor  # (...)
    q: Tensor  # (..., n)
    p: Tensor  # (..., n)
    s: Tensor  # (...)
    spread: Tensor  # (...)

    def map(self, change: Callable[[Tensor], Tensor]) -> GeneratingFunction:
        """Apply `change` to every tensor."""
        return GeneratingFunction(**{name: change(x) for name, x in vars(self).items()})

    @classmethod
    def of(cls, s: Tensor, end: tuple[Tensor, Tensor, Tensor], D: Tensor) -> GeneratingFunction:
        """S^k from ŝ0, (q_k, p_k, s_k) and the derivative of Φ̃^k (`mechanics.flow_derivative`)."""
        (q_k, p_k, s_k), n = end, end[0].shape[-1]
        Y_q, Y_p, Y_s = D[..., :n, :n], D[..., :n, n : 2 * n], D[..., :n, 2 * n]
        G_q, G_p, G_s = D[..., 2 * n, :n], D[..., 2 * n, n : 2 * n], D[..., 2 * n, 2 * n]
        D2 = torch.linalg.solve_ex(Y_p.mT, G_p[..., None])[0][..., 0]
        D1 = G_q - (Y_q.mT @ D2[..., None])[..., 0]
        D3 = G_s - 1.0 - (D2 * Y_s).sum(-1)
        return cls(s_k - s, D1, D2, D3, q_k, p_k, s_k, least_singular_value(Y_p))


def generating_function(
    flow_k: Flow,
    q: Tensor,  # (..., n) q̂0
    p: Tensor,  # (..., n) p̂0
    s: Tensor,  # (...) ŝ0
) -> GeneratingFunction:
    """S^k and its three derivatives along the solutions that start at (q̂0, p̂0, ŝ0); `flow_k` is the map Φ̃^k.

    The chain rule through the endpoint map (q̂0, p̂0, ŝ0) ↦ q_k gives D2 S = (∂s_k/∂p̂0)(∂q_k/∂p̂0)⁻¹, and D1 and D3
    follow from D2.

    Source: generating functions of the paper, with the sign of erratum E1.
    """
    return GeneratingFunction.of(s, *flow_derivative(flow_k, q, p, s))


def generating_functions(flows: Iterable[Flow], q: Tensor, p: Tensor, s: Tensor) -> list[GeneratingFunction]:
    """`generating_function` of the first map, of the first two maps composed, and so on; each map is evaluated once."""
    return [GeneratingFunction.of(s, *found) for found in flow_derivatives(flows, q, p, s)]


def left_generating_function(flow_k: Flow, q: Tensor, p: Tensor, s: Tensor) -> GeneratingFunction:
    """S^{k−}(q̂0, q_k, s_k) = s_k − ŝ0 and its three derivatives along the solutions from (q̂0, p̂0, ŝ0).

    The chain rule through (p̂0, ŝ0) ↦ (q_k, s_k) at fixed q̂0 gives D2 and D3 = ∂S^{k−}/∂s_k together, and D1 follows.
    S^{k−} is not defined where σ_k = 0 or at a caustic.

    Source: erratum E5 for k = 1, applied to Φ̃^k.
    """
    n = q.shape[-1]
    (q_k, p_k, s_k), D = flow_derivative(flow_k, q, p, s)
    # ∂(q_k, s_k)/∂(p̂0, ŝ0) and ∂(s_k − ŝ0)/∂(p̂0, ŝ0).
    ends = torch.cat([D[..., :n, n:], D[..., 2 * n :, n:]], -2)
    rate = D[..., 2 * n, n:].clone()
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

    The residual of a solution is zero on an open set of q_k if q_{k+1} = Φ̃^γ(q_k), and only then (erratum E7). A zero
    residual alone does not make S a solution: the left equation must hold too (erratum E10). `check` measures both.

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

    The residual of a solution is zero on an open set of q_k if q_{k+1} = Φ̃^γ(q_k), and only then (erratum E7).

    Source: left discrete contact Hamilton–Jacobi equation, erratum E6.
    """
    return S1 - S0 + (dS0 * q0).sum(-1) + H_minus
