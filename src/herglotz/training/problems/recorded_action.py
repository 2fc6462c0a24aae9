"""The action s along recorded positions, s_{k+1} = s_k + L_d(q_k, q_{k+1}, s_k), and its derivative."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.data import Trajectories
from herglotz.training.parameter_vector import ParameterVector

# Multiple of the rounding of the largest s, below which a change of s is rounding.
ROUNDING = 16


def action(
    parameters: ParameterVector,
    theta: Tensor,  # (P,)
    data: Trajectories,
    latent: Tensor,  # (B,)
) -> Tensor:
    """The action s at every sample, (N,), from its start values `latent` of every trajectory.

    Newton's method on all steps at once: with s near s*, s_{k+1} = c_k s_k + L_d(s*_k) − (c_k − 1) s*_k. For L_d affine
    in s the first iteration gives s. Each iteration makes at least one further step exact.
    """
    q, h, s = data.q, data.t.diff(), torch.zeros_like(data.t)
    samples = list(_samples(data))
    for _ in samples:
        P = parameters.partials(theta, q[:-1], q[1:], s[:-1], h, 1)
        c, gained = P.c.detach(), (P.L - (P.c - 1) * s[:-1]).detach()
        near, s = s, torch.zeros_like(s)
        s[samples[0][0]] = latent[samples[0][1]]
        for now, _ in samples[1:]:
            s[now] = c[now - 1] * s[now - 1] + gained[now - 1]
        if not float((s - near).abs().max()) > ROUNDING * torch.finfo(s.dtype).eps * float(s.abs().max()):
            break
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
