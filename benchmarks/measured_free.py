"""Free runs after a fit to noisy data: simulated noise, one trajectory, outliers, and two measured sets.

* noise: the simulated damped pendulum, 40 × 41 positions, h = 0.2, noise 0.01 rad (1 % of 1 rad); RMS over 100-step
  rollouts from 20 exact unseen starts against the noiseless truth. `one_trajectory`: the same from one of 41 samples.
* outliers: 6 × 61 of these positions with 2 % of them off by 0.5 … 1.5 rad, beside the same fit without outliers, and
  with outliers but without the robust loss; 60-step rollouts.
* disturbed: 10 × 101 noisy positions of the pendulum under a random force (velocity kicks of 0.02 at every sample), by
  multiple shooting and by joint smoothing; 100-step rollouts without the force, and the noise found over the true one.
* real_pendulum, air_track: first two thirds → free run over the last third.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from herglotz.data import Trajectories, load, simulate
from herglotz.models import ContactLagrangian
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, fit

PENDULUM = "schmidt_lipson_2009/real_pend_h_1.txt"
AIR_TRACK = "schmidt_lipson_2009/real_linear_h_1.txt"


def rollout_rms(model: ContactLagrangian, steps: int, seed: int) -> float:
    """RMS over free runs from 20 unseen exact starts of the damped pendulum, h = 0.2."""
    test = simulate(scene("damped_pendulum"), trajectories=20, steps=steps, h=0.2, seed=seed + 500, keep_state=True)
    assert test.p is not None
    q, p = (x.reshape(20, steps + 1, 1) for x in (test.q, test.p))
    with torch.no_grad():
        out = Stepper(model).rollout(q[:, 0], p[:, 0], h=0.2, steps=steps)
    return float((out.q - q).square().mean().sqrt())


def noise(seed: int, folder: Path) -> dict[str, float]:  # noqa: ARG001  one signature for all
    data = simulate(scene("damped_pendulum"), trajectories=40, steps=40, h=0.2, noise=0.01, seed=seed)
    run = fit(data, FitConfig(train_fraction=1.0, seed=seed), progress=False)
    return {"rms_100_steps": rollout_rms(run.model, 100, seed), "train_rms": run.metrics["train_rms"]}


def one_trajectory(seed: int, folder: Path) -> dict[str, float]:  # noqa: ARG001
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=40, h=0.2, noise=0.01, seed=seed)
    run = fit(data, FitConfig(train_fraction=1.0, seed=seed), progress=False)
    reach = float(data.q.abs().max())
    test = simulate(
        scene("damped_pendulum"), trajectories=20, steps=100, h=0.2, seed=seed + 500, keep_state=True,
        q_range=(-0.7 * reach, 0.7 * reach), v_range=(-0.3 * reach, 0.3 * reach),
    )  # fmt: skip
    assert test.p is not None
    q, p = (x.reshape(20, 101, 1) for x in (test.q, test.p))
    with torch.no_grad():
        out = Stepper(run.model).rollout(q[:, 0], p[:, 0], h=0.2, steps=100)
    return {"rms_100_steps": float((out.q - q).square().mean().sqrt()), "train_rms": run.metrics["train_rms"]}


def outliers(seed: int, folder: Path) -> dict[str, float]:  # noqa: ARG001
    clean = simulate(scene("damped_pendulum"), trajectories=6, steps=60, h=0.2, noise=0.01, seed=seed)
    make = torch.Generator().manual_seed(seed + 100)
    bad = torch.rand(clean.samples, generator=make) < 0.02
    size = 0.5 + torch.rand(clean.samples, generator=make, dtype=clean.q.dtype)
    sign = torch.where(torch.rand(clean.samples, generator=make) < 0.5, -1.0, 1.0)
    dirty = replace(clean, q=clean.q + (bad * sign * size)[:, None])
    found = {}
    for name, data, robust in (("clean", clean, "auto"), ("robust", dirty, "auto"), ("plain", dirty, "off")):
        run = fit(data, FitConfig(train_fraction=1.0, seed=seed, robust=robust), progress=False)
        found[name] = rollout_rms(run.model, 60, seed)
    return {**found, "over_clean": found["robust"] / found["clean"]}


def disturbed(seed: int, folder: Path) -> dict[str, float]:  # noqa: ARG001
    count, steps, h, parts = 10, 100, 0.2, 20
    start = simulate(scene("damped_pendulum"), trajectories=count, steps=2, h=h, seed=seed, keep_state=True)
    assert start.p is not None
    x = torch.cat([start.q, start.p], -1)[::3]  # (count, 2); mass 1
    make = torch.Generator().manual_seed(seed + 7)

    def rates(x: torch.Tensor) -> torch.Tensor:
        return torch.stack([x[:, 1], -x[:, 0].sin() - 0.2 * x[:, 1]], -1)

    q = [x[:, 0]]
    for _ in range(steps):
        for _ in range(parts):
            d = h / parts
            a = rates(x)
            b = rates(x + d / 2 * a)
            c = rates(x + d / 2 * b)
            x = x + d / 6 * (a + 2 * b + 2 * c + rates(x + d * c))
        x[:, 1] += 0.02 * torch.randn(count, generator=make, dtype=x.dtype)
        q.append(x[:, 0])
    noisy = torch.stack(q, 1) + 0.01 * torch.randn(count, steps + 1, generator=make, dtype=x.dtype)
    t = (h * torch.arange(steps + 1, dtype=x.dtype)).repeat(count)
    data = Trajectories.of(t, noisy.reshape(-1, 1), (steps + 1,) * count, angles=start.angles)
    found = {}
    for objective in ("trajectory", "smoothing"):
        run = fit(data, FitConfig(train_fraction=1.0, seed=seed, objective=objective), progress=False)
        found[objective] = rollout_rms(run.model, 100, seed)
        found[f"{objective}_noise"] = run.metrics["sigma"] / 0.01
        found[f"{objective}_rate"] = run.metrics["rate"] / 0.2
    return found


def extrapolation(name: str) -> Callable[[int, Path], dict[str, float]]:
    def measure(seed: int, folder: Path) -> dict[str, float]:
        metrics = fit(load(folder / name), FitConfig(seed=seed), progress=False).metrics
        return {k: metrics[k] for k in ("extrapolation_rms", "train_rms", "rate")}

    return measure
