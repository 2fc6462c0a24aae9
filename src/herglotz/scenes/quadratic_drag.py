"""Quadratic drag alone, q̈ = λq̇²: the parachute without gravity.

L = mv²/2 + 2λvs, H = (p − 2λs)²/2m, L_d = (e^{2λΔ}−1)s0 + (m/2λ²h)(e^{λΔ}−1)². It brakes where λq̇ < 0 and speeds up
without bound where λq̇ > 0: q1 = q0 − ln(1 − λv0h)/λ exists until λv0h = 1.
"""

from __future__ import annotations

from dataclasses import replace

from herglotz.errors import InputError
from herglotz.scenes.parachute import parachute
from herglotz.scenes.scene import Scene, require_positive


def quadratic_drag(m: float = 1.0, lam: float = 0.01) -> Scene:
    """Motion with quadratic drag and no gravity, q̈ = λq̇².

    Parameters
    ----------
    m
        Mass, kg.
    lam
        Drag λ, 1/m, not 0; positive brakes motion to negative q.

    Raises
    ------
    InputError
        If m ≤ 0 or lam = 0.

    Source: section 3 of `docs/mathematics.md`; the parachute's formulas, which are analytic in λg, at g = 0.
    """
    require_positive("quadratic_drag", mass_m=m)
    if lam == 0:
        raise InputError(f"quadratic_drag: drag lam must not be 0, got {lam}; without drag use a value such as 1e-6")
    return replace(
        parachute(m, 0.0, lam),
        name="quadratic_drag",
        description="quadratic drag without gravity, q̈ = λq̇², in closed form",
        parameters={"m": m, "lam": lam},
        q_range=(-50.0, 50.0),
        v_range=(-20.0, -1.0) if lam > 0 else (1.0, 20.0),
        examples=({"m": 1.4, "lam": 0.03}, {"m": 0.7, "lam": -0.02}),
    )
