"""The action s along recorded positions, s_{k+1} = s_k + L_d(q_k, q_{k+1}, s_k), and its derivative."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.data import Trajectories
from herglotz.training.parameter_vector import ParameterVector


def action(
    parameters: ParameterVector,
    theta: Tensor,  # (P,)
    data: Trajectories,
    latent: Tensor,  # (B,)
) -> Tensor:
    """The action s at every sample, (N,), from its start values `latent` of every trajectory.

    For L_d affine in s, L_d = L_d(s = 0) + (c − 1) s, all steps need only one evaluation.
    """
    s, h = torch.zeros_like(data.t), data.t.diff()
    affine = not parameters.model.capabilities.action_flow
    P = parameters.partials(theta, data.q[:-1], data.q[1:], s[:-1], h, 1) if affine else None
    for k, (now, live) in enumerate(_samples(data)):
        if k == 0:
            s[now] = latent[live]
        elif P is not None:
            s[now] = (P.c[now - 1] * s[now - 1] + P.L[now - 1]).detach()
        else:
            step = parameters.partials(theta, data.q[now - 1], data.q[now], s[now - 1], h[now - 1], 1)
            s[now] = s[now - 1] + step.L.detach()
    return s


def action_derivative(
    parameters: ParameterVector,
    theta: Tensor,  # (P,)
    data: Trajectories,
    s: Tensor,  # (N,)
) -> Tensor:
    """Derivative ds/d(θ, latent) of `action` at every sample, (N, P + B), by ds_{k+1} = c_k ds_k + ∂L_d/∂θ."""
    q, h = data.q, data.t.diff()

    def increment(theta: Tensor, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        P = parameters.partials(theta, q0, q1, s0, h, 1)
        return P.L, P.c.detach()

    L_theta, c = vmap(jacrev(increment, has_aux=True), (None, 0, 0, 0, 0))(theta, q[:-1], q[1:], s[:-1], h)
    ds = s.new_zeros(len(s), len(theta) + len(data))
    for k, (now, live) in enumerate(_samples(data)):
        if k == 0:
            ds[now, len(theta) + live] = 1.0
        else:
            ds[now] = c[now - 1, None] * ds[now - 1]
            ds[now, : len(theta)] += L_theta[now - 1]
    return ds


def _samples(data: Trajectories) -> Iterator[tuple[Tensor, Tensor]]:
    """For k = 0, 1, …: rows of the k-th samples, and indices of the trajectories with more than k samples."""
    lengths = torch.tensor(data.lengths, device=data.t.device)
    offsets = lengths.cumsum(0) - lengths
    for k in range(int(lengths.max())):
        live = (lengths > k).nonzero()[:, 0]
        yield offsets[live] + k, live
