"""The step of `benchmarks/control_model.py` in torch, as L4CasADi brings it into CasADi.

L4CasADi traces a function of torch without loops or branches, and calls it by TorchScript in float32: the step equation
is differentiated by hand and Newton's iterations stand one after the other, with elementwise operations alone, which
takes 0.6 of the time of the same by `torch.func`. An interval of 8 steps in one trace took 17 ms with its Jacobian, 8
calls of one step 1 ms each.

Install it beside this project's torch: `pip install scikit-build cmake ninja` and `pip install l4casadi
--no-build-isolation` (2.0.0 builds with torch 2.13 in a minute; with pip's build isolation it finds no torch).
"""

from __future__ import annotations

import math
from pathlib import Path

import casadi as ca
import torch
from torch import Tensor

from benchmarks.control_model import COUPLING, DRAG, FACTOR, INPUTS, ITERATIONS, RATE, STIFFNESS, VISCOUS, H

M11, M12 = FACTOR[0][0] ** 2, FACTOR[0][0] * FACTOR[1][0]
M22 = FACTOR[1][0] ** 2 + FACTOR[1][1] ** 2
C = math.exp(-RATE * H)
ROOT = math.sqrt(C)


def step(
    x: Tensor,  # (B, 6) position, angle, their momenta, s, force
) -> Tensor:
    """(B, 5) the state after a step: D1 L_d + F⁻ + c p0 = 0 by Newton from q1 = q0."""
    a0, b0, p1, p2, s0, u = (x[:, i] for i in range(6))

    def at(a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
        """Velocities, middle, coupling and its slope, momenta without V, the share of the slope, and forces."""
        v1, v2, middle, angle = (a - a0) / H, (b - b0) / H, (a0 + a) / 2, (b0 + b) / 2
        k, slope = COUPLING * torch.cos(angle), COUPLING * torch.sin(angle)
        forces = INPUTS[0] * u - VISCOUS[0] * v1 - DRAG * middle * v1, INPUTS[1] * u - VISCOUS[1] * v2
        return v1, v2, middle, k, slope, M11 * v1 + (M12 + k) * v2, (M12 + k) * v1 + M22 * v2, *forces

    a, b = a0, b0
    for _ in range(ITERATIONS):
        v1, v2, middle, k, slope, g1, g2, f1, f2 = at(a, b)
        r1 = C * (p1 + H / 2 * f1) - ROOT * g1
        r2 = C * (p2 + H / 2 * (f2 - STIFFNESS * torch.sin(b0))) - ROOT * (g2 + H / 2 * slope * v1 * v2)
        j11 = -ROOT * M11 / H - C / 2 * (VISCOUS[0] + DRAG * (H / 2 * v1 + middle))
        j12 = ROOT * (slope / 2 * v2 - (M12 + k) / H)
        j21 = -ROOT * (slope / 2 * v2 + (M12 + k) / H)
        j22 = -ROOT * (M22 / H + H / 4 * k * v1 * v2) - C / 2 * VISCOUS[1]
        determinant = j11 * j22 - j12 * j21
        a, b = a - (j22 * r1 - j12 * r2) / determinant, b - (j11 * r2 - j21 * r1) / determinant
    v1, v2, _, k, slope, g1, g2, f1, f2 = at(a, b)
    last = g2 - H / 2 * slope * v1 * v2
    ends = ROOT * g1 + H / 2 * f1, ROOT * last + H / 2 * (f2 - STIFFNESS * torch.sin(b))
    V0, V1 = STIFFNESS * (1 - torch.cos(b0)), STIFFNESS * (1 - torch.cos(b))
    K = H * ((M11 * v1 * v1 + 2 * M12 * v1 * v2 + M22 * v2 * v2) / 2 + k * v1 * v2)
    s = s0 + (C - 1) * (s0 - H / 2 * V0) + ROOT * K - H / 2 * (V0 + V1)
    return torch.stack([a, b, *ends, s], 1)


def interval(count: int, steps: int, folder: Path) -> ca.Function:
    """(X (5, N), U (1, N)) → the states after an interval: a call for each step, of all N columns.

    L4CasADi is told that columns do not depend on one another, and makes no second derivatives.
    """
    from l4casadi import L4CasADi  # pyright: ignore[reportMissingImports]

    called = L4CasADi(
        step, batched=True, generate_adj1=False, generate_jac_adj1=False, name="l4_step", build_dir=str(folder)
    )
    X, U = ca.MX.sym("X", 5, count), ca.MX.sym("U", 1, count)
    end = X.T
    for _ in range(steps):
        end = called(ca.horzcat(end, U.T))
    return ca.Function("ahead", [X, U], [end.T])
