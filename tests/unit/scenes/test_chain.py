"""The chain against its normal modes, and its size."""

import math

import torch

from herglotz.scenes import damped_oscillator, scene
from herglotz.stepping import Stepper


def start(n, seed=0):
    make = torch.Generator().manual_seed(seed)
    q, p = torch.rand(2, 4, n, generator=make, dtype=torch.float64) - 0.5
    return q, p, torch.zeros(4, dtype=torch.float64)


def test_without_hardening_it_is_its_normal_modes():
    # fails if a spring or a wall is missing, or if the damping is not the same in every mode
    m, k, gamma, n, t = 1.7, 0.6, 0.3, 10, 0.9
    system = scene("chain", m=m, k=k, beta=0.0, gamma=gamma)
    q, p, s = start(n)
    j = torch.arange(1, n + 1, dtype=torch.float64)
    modes = math.sqrt(2 / (n + 1)) * torch.sin(math.pi * j[:, None] * j / (n + 1))  # orthonormal, symmetric
    q1, p1, s1 = torch.zeros_like(q), torch.zeros_like(p), s
    for number, mode in enumerate(modes, 1):
        omega = 2 * math.sqrt(k / m) * math.sin(number * math.pi / (2 * n + 2))
        own = damped_oscillator(m=m, omega0=omega, gamma=gamma)
        a, b, c = own.flow((q @ mode)[:, None], (p @ mode)[:, None], s, t)
        q1, p1, s1 = q1 + a * mode, p1 + b * mode, s1 + c
    for value, expected in zip(system.flow(q, p, s, t), (q1, p1, s1), strict=True):
        torch.testing.assert_close(value, expected, rtol=0, atol=2e-13)


def test_hardening_stiffens():
    # fails if β d⁴/4 has another sign or power: one mass between two springs feels 2kq + 2βq³
    system = scene("chain", masses=1, m=1.0, k=0.8, beta=1.1, gamma=0.0)
    q = torch.tensor([[0.3]], dtype=torch.float64).requires_grad_()
    H = system.hamiltonian(q, torch.zeros_like(q), torch.zeros(1, dtype=torch.float64))
    (force,) = torch.autograd.grad(H.sum(), q)
    assert abs(force.item() - (2 * 0.8 * 0.3 + 2 * 1.1 * 0.3**3)) < 1e-15


def test_thirty_two_masses_are_stepped_at_order_two():
    # fails if the size is fixed anywhere, or if c is not the same number for every size
    system, errors = scene("chain", masses=32), []
    assert system.dof == len(system.coordinates) == 32
    exact = system.flow(*start(32, seed=1), 1.0)[0]
    for steps in (5, 10):  # the slope is 2.02
        out = Stepper(system.L_d_rules["strang"]).rollout(*start(32, seed=1), h=1 / steps, steps=steps)
        assert bool(out.ok.all())
        torch.testing.assert_close(out.sigma[:, -1], torch.full((4,), math.exp(-0.1), dtype=torch.float64))
        errors.append(float((out.q[:, -1] - exact).abs().max()))
    assert 1.9 < math.log2(errors[0] / errors[1]) < 2.1
