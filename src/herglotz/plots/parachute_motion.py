"""The numbers behind the paper's two figures: the map as printed, and a parachute that falls (erratum E9).

The printed map (H⁺ without the near-identity part, λ = −0.01) is iterated from (q, p, s) = (100, 1, 1) as the paper
does. Beside it the parachute q̈ = λq̇² − g, λ = +0.01, from the same start, with its exact discrete Lagrangian.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from herglotz.plots.parachute import Fall, PrintedOrbit
from herglotz.scenes import scene
from herglotz.scenes.printed_parachute import MAP_START, PrintedParachute
from herglotz.stepping import State, Stepper
from herglotz.theory import GeneratingFunction, generating_function, hamilton_jacobi_residual

SHOWN = 6  # points of the printed map in the figures; the next is ten times larger, the one after it 1e22
G, LAM, H = 10.0, 0.01, 0.2


def start() -> State:
    """Return the start of both motions, (100, 1, 1)."""
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in MAP_START)
    return State(q[None], p[None], s)


def printed_slopes(step: PrintedParachute, k: int) -> GeneratingFunction:
    """Return S^k of k iterations of the printed map, differentiated along its orbit."""

    def flow(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        for _ in range(k):
            q, p, s = step(q, p, s)
        return q, p, s

    return generating_function(flow, *start())


def printed_map() -> tuple[dict, PrintedOrbit]:
    """Return the orbit as printed and with s², as far as floats go, and D2S^k of both."""
    found, momenta, slopes = {}, {}, {}
    for name, step in (("printed", PrintedParachute()), ("squared", PrintedParachute(squared=True))):
        (q, p, s), last = step.orbit(*start(), steps=SHOWN + 6)
        slopes[name] = [float(printed_slopes(step, k).D2) for k in range(1, SHOWN + 1)]
        momenta[name] = p[: SHOWN + 1, 0].numpy()
        rows = range(min(last, 9) + 1)
        points = [{"k": k, "q": float(q[k, 0]), "p": float(p[k, 0]), "s": float(s[k])} for k in rows]
        found[name] = {"points": points, "dS": slopes[name], "last_finite_k": last}
    heights = np.array([x["q"] for x in found["printed"]["points"][: SHOWN + 1]])
    printed, squared = ((momenta[name], np.array(slopes[name])) for name in ("printed", "squared"))
    return found, PrintedOrbit(heights, *printed, *squared, last=found["printed"]["last_finite_k"])


def landing(q0: float, v0: float) -> tuple[float, float]:
    """Return time and velocity at q = 0 in closed form.

    cosh ωt − a sinh ωt = e^{λq0} with ω = √(λg), a = λv0/ω, and v² = g/λ − (g/λ − v0²) e^{−2λq0}.
    """
    omega = math.sqrt(LAM * G)
    a, K = LAM * v0 / omega, math.exp(LAM * q0)
    time = math.log((K + math.sqrt(K * K - (1 - a * a))) / (1 - a)) / omega
    return time, -math.sqrt(G / LAM - (G / LAM - v0 * v0) * math.exp(-2 * LAM * q0))


def physical_fall() -> tuple[dict, Fall]:
    """Return landing, twice; p_k of the stepper, D2S^k(q_k), and the discrete Hamilton–Jacobi equation between them."""
    fall, x = scene("parachute", g=G, lam=LAM), start()
    v0 = float(fall.velocity(*x))
    time, speed = landing(float(x.q), v0)
    steps = int(time / H)
    stepper = Stepper(fall.L_d)
    solution = stepper.rollout(*x, h=H, steps=steps)
    event = stepper.rollout(*x, h=H, steps=steps + 1, events=[lambda state: state.q[..., 0]]).events[0]

    def flow(k: int):
        return lambda q, p, s: stepper.rollout(q, p, s, h=H, steps=k).final

    S = [generating_function(flow(k), *x) for k in range(1, steps + 1)]
    assert fall.H_plus is not None
    residuals = []
    for S0, S1 in pairwise(S):
        H_plus = fall.H_plus(S0.q, S1.D2, S0.s, H)
        residual = hamilton_jacobi_residual(S1.s, S0.s, S1.D2, S1.q, H_plus)
        residuals.append(float(residual.abs() / (S1.s.abs() + S0.s.abs() + H_plus.abs())))
    p, dS = solution.p[:, 0], torch.stack([x.D2[0] for x in S])
    numbers = {
        "landing_time": {"closed_form": time, "event_of_the_stepper": float(event.t[0])},
        "landing_velocity": {"closed_form": speed, "event_of_the_stepper": float(fall.velocity(*event.state))},
        "terminal_velocity": -math.sqrt(G / LAM),
        "h": H,
        "steps": steps,
        "worst_dS_minus_p_relative": float(((dS - p[1:]) / p[1:]).abs().max()),
        "worst_hamilton_jacobi_residual_relative": max(residuals),
    }
    v = fall.velocity(solution.q, solution.p, solution.s)[:, 0]
    t = H * np.arange(steps + 1)
    q, v, p, dS = (x.numpy() for x in (solution.q[:, 0], v, p, dS))
    return numbers, Fall(t, q, v, p, dS, np.array(residuals), time, speed, -math.sqrt(G / LAM))
