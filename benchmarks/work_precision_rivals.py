"""What learned steppers stand beside, in C: the classical methods on the true equations, and neural ODEs."""

from __future__ import annotations

import time

import torch
from torch import Tensor
from work_precision_cases import TIMED, Case, Timed, repeated
from work_precision_native import FLOPS, SEPARABLE, Native, Weights
from work_precision_neural import train_neural_ode
from work_precision_scenes import CHECKS, Setup, judged

from herglotz.data import simulate


def classical(case: Case) -> list[Timed]:
    """RK4, DOP853, implicit midpoint and leapfrog on the true equations."""
    setup, name = case.setup, case.setup.name
    v = setup.scene.velocity(*case.start)
    if name == "rigid_body":
        v = body_velocity(case.start.q, v)
    y = torch.cat([case.start.q, v], -1)
    found = []
    for dtype in ("float64", "float32"):
        library = Native(name, dtype, dof=setup.scene.dof)
        methods = [
            m
            for m in ("RK4", "DOP853", "DOP853 fixed", "implicit midpoint", "leapfrog")
            if m != "leapfrog" or name in SEPARABLE
        ]
        for method in methods:
            for x in _settings(method, dtype):
                point = {
                    "kind": f"{method}, true equations",
                    "setting": _label(method, x, setup, dtype),
                    "dtype": dtype,
                }
                found.append(_classic(point, library, case, y, method, x, FLOPS[name]))
    return found


def _settings(method: str, dtype: str) -> list[float]:
    double = dtype == "float64"
    if method == "DOP853":
        return [10.0**-k for k in range(1, 11 if double else 6)]
    if method == "DOP853 fixed":
        return [1, 2, 3, 4, 6, *([8, 12] if double else [])]
    if method == "implicit midpoint":
        return [8, 32, 128]
    if method == "leapfrog":
        return [8, 16, 32, 128, *([512] if double else [])]
    return [4, 6, 8, 12, 16, 24, 32, *([64, 128] if double else [])]


def _label(method: str, x: float, setup: Setup, dtype: str) -> str:
    return (
        f"{method}, tol {x:.0e}, {dtype}" if method == "DOP853" else f"{method}, h {setup.T / CHECKS / x:.3g}, {dtype}"
    )


def _classic(point: dict, library: Native, case: Case, y: Tensor, method: str, x: float, flops: float) -> Timed:
    """One setting; where an input is held, a segment is one step of the data, and x counts for a quarter of T."""
    setup, u = case.setup, case.setup.inputs()
    segments = CHECKS if u is None else len(u)
    if u is not None and method != "DOP853":
        x = max(1, round(x * CHECKS / segments))
    q, count = library.motions(y, setup.T, segments, method, x, u)
    few = y[:TIMED]
    call, times = repeated(library.call(few, setup.T, segments, method, x, u))
    each = count / len(y) / setup.T
    more = {"evaluations_per_time": each, "flops_per_time": each * flops, "artefact": "C"}
    errors = judged(q[:, segments // CHECKS - 1 :: segments // CHECKS], case.truth)
    return Timed({**point, **errors, **more}, call, times * len(few) * setup.T)


def neural(case: Case, quick: bool) -> list[Timed]:
    """Neural ODEs of several sizes, by RK4 and DOP853."""
    setup = case.setup
    if not setup.neural:
        return []
    size = {"trajectories": setup.trajectories, "steps": setup.steps, "h": setup.h, "seed": case.seed}
    data = simulate(setup.scene, **size, keep_state=True)
    sizes, iterations = setup.neural, setup.neural_iterations
    y = torch.cat([case.start.q, setup.scene.velocity(*case.start)], -1)
    found, began = [], time.process_time()
    for width, layers in sizes[:1] if quick else sizes:
        weights: Weights = train_neural_ode(data, setup, width, layers, 10 if quick else iterations, case.seed)
        for dtype in ("float64", "float32"):
            library = Native(setup.name, dtype, weights, setup.scene.dof)
            for method in ("RK4", "DOP853"):
                for x in _settings(method, dtype)[:7]:
                    label = f"{width} × {layers}, {_label(method, x, setup, dtype)}"
                    point = {
                        "kind": f"neural ODE, {method}",
                        "setting": label,
                        "dtype": dtype,
                        "width": width,
                        "depth": layers,
                    }
                    found.append(_classic(point, library, case, y, method, x, weights.flops))
    case.seconds["neural ODE"] = time.process_time() - began
    return found


def body_velocity(q: Tensor, v: Tensor) -> Tensor:
    """The angular velocity in the body, from roll, pitch, yaw and their rates."""
    (sr, sp, _), (cr, cp, _), (roll, pitch, yaw) = q.sin().unbind(-1), q.cos().unbind(-1), v.unbind(-1)
    return torch.stack([roll - yaw * sp, pitch * cr + yaw * cp * sr, yaw * cp * cr - pitch * sr], -1)
