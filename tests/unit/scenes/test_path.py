"""Herglotz's action of a path, and what makes motions its critical points."""

import math

import pytest
import torch

from herglotz.scenes import path_action, scene

T = 0.8
SYSTEM = scene("parachute", m=1.4, g=7.0, lam=0.03)  # L_s depends on the velocity


def start():
    q = torch.tensor([3.0], dtype=torch.float64)
    s = torch.tensor(0.4, dtype=torch.float64)
    return q, SYSTEM.momentum(q, torch.full_like(q, -5.0), s), s


def motion(t):
    """The fall from q = 3 with v0 = −5, written out: v = q̇ solves v̇ = λv² − g."""
    g, lam, omega, v0 = 7.0, 0.03, math.sqrt(7.0 * 0.03), -5.0
    C, S = torch.cosh(omega * t)[..., None], torch.sinh(omega * t)[..., None] / omega
    return 3.0 - torch.log(C - lam * v0 * S) / lam, (v0 * C - g * S) / (C - lam * v0 * S)


def bent(path, epsilon):
    """The same ends, another path between them."""

    def moved(t):
        (q, v), x = path(t), math.pi * t[..., None] / T
        bump = torch.sin(x) + 0.3 * torch.sin(2 * x)
        slope = (torch.cos(x) + 0.6 * torch.cos(2 * x)) * math.pi / T
        return q + epsilon * bump, v + epsilon * slope

    return moved


def test_the_action_of_a_motion_is_the_exact_discrete_lagrangian():
    # fails if s does not feed back into L, or the velocity is not that of the path
    q, p, s = start()
    q1, _, s1 = SYSTEM.flow(q, p, s, T)
    end = path_action(SYSTEM.lagrangian, motion, s, T)
    assert abs(float(end - s1)) < 1e-11 * abs(float(s1))
    assert abs(float(end - s - SYSTEM.L_d(q, q1, s, torch.tensor(T, dtype=torch.float64)))) < 1e-11 * abs(float(s1))


def test_motions_are_stationary_and_other_paths_are_not():
    # fails if the path that makes s(T) stationary solves Euler–Lagrange instead of Herglotz: slopes 2 and 1 in ε
    s = start()[2]

    def straight(t):
        (q0, _), (q1, _) = motion(torch.zeros_like(t)), motion(torch.full_like(t, T))
        return q0 + (q1 - q0) * (t / T)[..., None], (q1 - q0) / T

    for path, slope in ((motion, 2.0), (straight, 1.0)):
        base = path_action(SYSTEM.lagrangian, path, s, T)
        change = [abs(float(path_action(SYSTEM.lagrangian, bent(path, e), s, T) - base)) for e in (2e-3, 1e-3)]
        assert math.log2(change[0] / change[1]) == pytest.approx(slope, abs=0.02)


def test_batches():
    # fails if samples share an initial value or a final time
    s = torch.tensor([0.4, -1.0], dtype=torch.float64)
    ends = torch.tensor([0.8, 0.5], dtype=torch.float64)
    together = path_action(SYSTEM.lagrangian, motion, s, ends)
    for k in range(2):
        assert abs(float(together[k] - path_action(SYSTEM.lagrangian, motion, s[k], ends[k]))) < 1e-11
