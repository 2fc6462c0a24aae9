"""A model learned at one step, stepped at others, and its energy: backward error analysis of what was learned.

    python benchmarks/other_steps.py --system pendulum --seeds 0 1 2 3 4

A damped pendulum (h = 0.2) or a damped Hénon–Heiles system (h = 0.2) is recorded without noise: positions alone, fitted
with the defaults. The model then makes samples, and those between them, from the fitted states by `run.at_step` at h,
h/2, 2h and h/7. Printed are RMS errors of the position over 4 recorded steps, the energy law |dH̃/dt + RH̃| over the
largest |dH̃/dt|, and the processor time of the fit. `lost` is the largest share of samples that a part of a step did not
reach, as the iterates before the start run away (Hénon–Heiles gains energy backwards).
"""

from __future__ import annotations

import argparse
import time

import torch
from torch import Tensor

import herglotz as hz
from herglotz.data import Trajectories, simulate
from herglotz.scenes import Scene, scene
from herglotz.scenes.natural import natural_scene
from herglotz.stepping import State
from herglotz.theory import ContinuousEquation

FINE, STEPS = 14, 4  # samples of the truth in a recorded step; recorded steps that are made
PARTS = {"h": 14, "h/2": 7, "2h": 28, "h/7": 2}  # of the fine samples


def henon_heiles(gamma: float = 0.05) -> Scene:
    """L = |v|²/2 − |q|²/2 − x²y + y³/3 − γs."""

    def potential(q: Tensor) -> Tensor:
        x, y = q.unbind(-1)
        return 0.5 * (q * q).sum(-1) + x * x * y - y**3 / 3

    def slope(q: Tensor) -> Tensor:
        x, y = q.unbind(-1)
        return q + torch.stack([2 * x * y, x * x - y * y], -1)

    return natural_scene(
        potential, slope, gamma, name="henon_heiles", description="", coordinates=("x", "y"), units=("m", "m"),
        parameters={"gamma": gamma}, q_range=(-0.35, 0.35), v_range=(-0.25, 0.25), h=0.2,
    )  # fmt: skip


# Scene, h, trajectories and steps of each: 31 samples a period of small motions, over two and three periods.
SYSTEMS = {"pendulum": (lambda: scene("damped_pendulum"), 0.2, 8, 60), "henon_heiles": (henon_heiles, 0.2, 8, 90)}


def other_steps(run: hz.Run, fine: Trajectories, h: float) -> dict[str, float]:
    """RMS error of the position at each step, started at the fitted states of the recording."""
    errors, lost = {}, 0.0
    for name, part in PARTS.items():
        count, apart = STEPS * FINE // part, []
        for first, length in zip(run.data.offsets, run.data.lengths, strict=True):
            rows = torch.arange(0, length - STEPS, 5)
            start = State(*(x[first + rows] for x in run.states))
            with torch.no_grad():
                out = run.at_step(h * part / FINE).rollout(*start, h=h * part / FINE, steps=count)
            begin = fine.offsets[list(run.data.offsets).index(first)] + FINE * rows
            truth = fine.q[begin[:, None] + part * torch.arange(count + 1)]
            apart.append((out.q - truth).flatten())
        x = torch.cat(apart)
        errors[name] = float(x[x.isfinite()].square().mean().sqrt())
        lost = max(lost, float((~x.isfinite()).double().mean()))
    return {**errors, "lost": lost}


def energy_law(E: ContinuousEquation, states: State) -> tuple[float, float]:
    """Median and largest |dH̃/dt + RH̃| over the largest |dH̃/dt|."""
    x = [y.detach().clone().requires_grad_() for y in states]
    H = E.hamiltonian(*x)
    H_q, H_p, H_s = torch.autograd.grad(H.sum(), x)
    q_dot, p_dot, s_dot = (y.detach() for y in E.field(*(y.detach() for y in x)))
    power = (H_q * q_dot).sum(-1) + (H_p * p_dot).sum(-1) + H_s * s_dot
    left = (power + H_s * H.detach()).abs() / power.abs().max()
    return float(left.median()), float(left.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--system", choices=SYSTEMS, default="pendulum")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    arguments = parser.parse_args()
    make, h, trajectories, steps = SYSTEMS[arguments.system]
    print("seed  " + "".join(f"{name:>9}" for name in (*PARTS, "lost")) + "   law, median  largest  fit, s")
    for seed in arguments.seeds:
        fine = simulate(make(), trajectories=trajectories, steps=steps * FINE, h=h / FINE, seed=seed)
        start = time.process_time()
        run = hz.fit(fine.thinned(FINE), seed=seed)
        spent = time.process_time() - start
        errors = other_steps(run, fine, h)
        states = State(*(x[:: max(1, len(x) // 64)] for x in run.states))
        median, largest = energy_law(run.continuous, states)
        numbers = "".join(f"{x:9.1e}" for x in errors.values())
        print(f"{seed:4}  {numbers}   {median:11.1e}  {largest:7.1e}  {spent:6.1f}", flush=True)


if __name__ == "__main__":
    main()
