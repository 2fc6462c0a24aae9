"""Smoothed angles, velocities and accelerations of noisy angles, as in Menda et al. 2021 (arXiv:2105.01811).

R. E. Kalman's filter and the smoother of Rauch, Tung and Striebel (AIAA Journal 3:1445, 1965) of (q, q̇, q̈) with white
noise diag(1e-3, 1e-3, 1) a step. Mean and covariance of the first state and the variance of the measurement are set by
ten rounds of expectation maximisation (Shumway and Stoffer, Journal of Time Series Analysis 3:253, 1982).
"""

from __future__ import annotations

import torch
from torch import Tensor

ROUNDS = 10


def smoothed(y: Tensor, h: float) -> tuple[Tensor, Tensor, Tensor]:
    """(q, q̇, q̈), each (B, T, n), of noisy positions y (B, T, n) with step h."""
    B, T, n = y.shape
    z = y.transpose(1, 2).reshape(B * n, T)
    A = torch.tensor([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]], dtype=y.dtype)
    Q = torch.diag(torch.tensor([1e-3, 1e-3, 1.0], dtype=y.dtype))
    m, P, R = z.new_zeros(len(z), 3), torch.eye(3, dtype=y.dtype).expand(len(z), 3, 3), z.new_ones(len(z))
    for k in range(ROUNDS + 1):
        x, S = _smoother(z, A, Q, m, P, R)
        if k < ROUNDS:
            m, P = x[:, 0], S[:, 0]
            R = ((z - x[..., 0]).square() + S[..., 0, 0]).mean(1)
    return tuple(x[..., i].reshape(B, n, T).transpose(1, 2) for i in range(3))  # type: ignore[return-value]


def _smoother(z: Tensor, A: Tensor, Q: Tensor, m: Tensor, P: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
    """Means (B, T, 3) and covariances (B, T, 3, 3) given all of z (B, T)."""
    ahead, after = [], []  # (mean, covariance) of each step before and after its measurement
    for t in range(z.shape[1]):
        if t:
            m, P = m @ A.T, A @ P @ A.T + Q
        ahead.append((m, P))
        gain = P[:, :, 0] / (P[:, 0, 0] + R)[:, None]
        m, P = m + gain * (z[:, t] - m[:, 0])[:, None], P - gain[:, :, None] * P[:, :1, :]
        after.append((m, P))
    means, covariances = [m], [P]
    for t in range(z.shape[1] - 2, -1, -1):
        (m, P), (m_ahead, P_ahead) = after[t], ahead[t + 1]
        J = torch.linalg.solve(P_ahead, A @ P).mT
        means.append(m + (J @ (means[-1] - m_ahead)[..., None])[..., 0])
        covariances.append(P + J @ (covariances[-1] - P_ahead) @ J.mT)
    return torch.stack(means[::-1], 1), torch.stack(covariances[::-1], 1)
