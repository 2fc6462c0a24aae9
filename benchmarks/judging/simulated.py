"""Jobs of simulated recordings: noise and outliers, many coordinates, the data of `peers`, `select`, twenty masses."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import there
from benchmarks.judging.job import Job, Trial
from herglotz.data import Trajectories, save, simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig

WARMUP, EVERYTHING = 20, ("--train-fraction", "1")
# Standard deviation, in rad or relative to the size of a motion.
NOISE = 0.01
# Errors of exact data are judged as if the data had this noise, relative to their spread; the zoo does the same.
EXACT = 1e-4


def _job(folder: Path, train: Trajectories, test: Trajectories, noise: float = 0.0) -> Job:
    """Fit all of the training data; predict exact recordings from unseen starts, over the noise of the former."""
    save(folder / "train.csv", train)
    save(folder / "test.csv", test)
    size = train.unwrapped().q.double().std(0)
    scale = torch.full_like(size, noise) if noise else EXACT * size
    trials = [Trial("test.csv", WARMUP)]
    named = {"scale": scale.tolist(), "unit": "over noise", "size": size.tolist(), "attainable": 1.0}
    return Job("train.csv", trials, flags=EVERYTHING, **named)


def _unseen(seed: int, steps: int = 100, h: float = 0.2, trajectories: int = 20, **starts: Any) -> Trajectories:
    """Exact recordings of the damped pendulum."""
    return simulate(
        scene("damped_pendulum"), trajectories=trajectories, steps=steps + WARMUP - 1, h=h, seed=seed + 500, **starts
    )


def noise(folder: Path, trajectories: int, seed: int) -> Job:
    """The damped pendulum with 0.01 rad of noise; of one recording, from starts that it surrounds."""
    data = simulate(scene("damped_pendulum"), trajectories=trajectories, steps=40, h=0.2, noise=NOISE, seed=seed)
    starts: dict[str, Any] = {}
    if trajectories == 1:
        reach = float(data.q.abs().max())
        starts = {"q_range": (-0.7 * reach, 0.7 * reach), "v_range": (-0.3 * reach, 0.3 * reach)}
    return _job(folder, data, _unseen(seed, **starts), NOISE)


def with_outliers(seed: int) -> tuple[Trajectories, Trajectories]:
    """Six noisy recordings of the damped pendulum; the same with 2 % of the samples off by 0.5 to 1.5 rad."""
    data = simulate(scene("damped_pendulum"), trajectories=6, steps=60, h=0.2, noise=NOISE, seed=seed)
    make = torch.Generator().manual_seed(seed + 100)
    bad = torch.rand(data.samples, generator=make) < 0.02
    size = 0.5 + torch.rand(data.samples, generator=make, dtype=data.q.dtype)
    sign = torch.where(torch.rand(data.samples, generator=make) < 0.5, -1.0, 1.0)
    return data, replace(data, q=data.q + (bad * sign * size)[:, None])


def outliers(folder: Path, seed: int) -> Job:
    """The recordings with outliers."""
    return _job(folder, with_outliers(seed)[1], _unseen(seed, 60), NOISE)


def disturbed(folder: Path, seed: int) -> Job:
    """The pendulum under random kicks of 0.02 at every sample, with 0.01 rad of noise; predicted without kicks."""
    count, steps, h, parts = 10, 100, 0.2, 20
    make = torch.Generator().manual_seed(seed + 7)
    q, v = (2 * torch.rand(2, count, generator=make, dtype=torch.float64) - 1) * torch.tensor([[2.0], [1.0]])
    out, k = [q], h / parts
    for _ in range(steps):
        # Velocity Verlet with damping: the error is 1e-5 of the kicks.
        for _ in range(parts):
            v = v + k / 2 * (-q.sin() - 0.2 * v)
            q = q + k * v
            v = (v - k / 2 * q.sin()) / (1 + k / 2 * 0.2)
        v = v + 0.02 * torch.randn(count, generator=make, dtype=torch.float64)
        out.append(q)
    noisy = torch.stack(out, 1) + NOISE * torch.randn(count, steps + 1, generator=make, dtype=torch.float64)
    t = (h * torch.arange(steps + 1, dtype=torch.float64)).repeat(count)
    data = Trajectories.of(
        t, noisy.reshape(-1, 1), (steps + 1,) * count, names=("theta",), units=("rad",), angles=(True,)
    )
    return _job(folder, data, _unseen(seed), NOISE)


def many_dof(folder: Path, name: str, seed: int) -> Job:
    """A row of many_dof.py: what its fit is told stands in config.json; ten exact recordings are predicted."""
    from benchmarks import many_dof as rows

    row = next(row for row in rows.ROWS if row.name == name)
    of = row.make()
    settings = {"h": row.h, "seed": seed}
    data = simulate(of, trajectories=row.trajectories, steps=row.steps, **settings)
    test = simulate(of, trajectories=10, steps=row.test_steps + WARMUP, h=row.h, seed=1000 + seed)
    return replace(_job(folder, data, test), flags=_told(folder, replace(row.told, seed=seed)))


def one_rate(folder: Path, name: str, seed: int) -> Job:
    """The parachute and quadratic drag, at the affine level."""
    features = ("1",) if name == "parachute" else ()
    told = FitConfig(level="affine", features=features, alike=True, damping_width=0, correction_width=0, seed=seed,
                     train_fraction=1.0, objective="residual")  # fmt: skip
    data, test = (
        simulate(scene(name), trajectories=10, steps=steps, h=0.05, seed=s) for steps, s in ((120, seed), (220, 1000))
    )
    return replace(_job(folder, data, test), flags=_told(folder, told))


def _told(folder: Path, config: FitConfig) -> tuple[str, str]:
    """Settings that differ from their defaults, as a file for --config."""
    usual = FitConfig().to_dict()
    own = {f.name: value for f in fields(FitConfig) if (value := config.to_dict()[f.name]) != usual[f.name]}
    path = folder / "config.json"
    path.write_text(json.dumps(own), encoding="utf-8")
    return "--config", str(path)


def pendulum(folder: Path, h: float, noise: float, seed: int) -> Job:
    """The pendulums of peers: 40 × 41 positions; 100 steps from 100 unseen starts."""
    data = simulate(scene("damped_pendulum"), trajectories=40, steps=40, h=h, noise=noise, seed=seed)
    return _job(folder, data, _unseen(500, 100, h, 100), noise)


def one_pendulum(folder: Path, seed: int) -> Job:
    """One recording from rest; unseen starts have less energy than it begins with."""
    of, h = scene("damped_pendulum"), 0.5
    data = simulate(of, trajectories=1, steps=40, h=h, seed=seed, q_range=(2.0, 2.0), v_range=(0.0, 0.0))
    made = {"q_range": (-2.0, 2.0), "v_range": (-1.68, 1.68), "keep_state": True}
    test = _unseen(500, 100, h, 200, **made)
    assert test.p is not None
    first = list(test.offsets)
    inside = test.p[first, 0].square() / 2 + 1 - test.q[first, 0].cos() < 1 - math.cos(2.0)
    test = replace(test.select(inside.nonzero()[:100, 0]), p=None, s=None)
    return _job(folder, data, test)


def double_pendulum(folder: Path, seed: int) -> Job:
    """100 × 100 positions of two joints with friction, released from rest; 50 steps from 100 unseen releases."""
    from benchmarks.peers.problems import double_motion

    h, made = 0.02, []
    for s, samples in ((seed, 100), (1000, 50 + WARMUP)):
        make = torch.Generator().manual_seed(s)
        q = 2.0 * torch.rand(100, 2, generator=make, dtype=torch.float64) - 1.0
        q = double_motion(q, torch.zeros_like(q), h, samples)[0]
        t = (h * torch.arange(samples, dtype=torch.float64)).repeat(100)
        names = {"names": ("theta1", "theta2"), "units": ("rad", "rad"), "angles": (True, True)}
        made.append(Trajectories.of(t, q.reshape(-1, 2), (samples,) * 100, **names))
    return _job(folder, *made)


def ibm(folder: Path) -> Job:
    """The measured chaotic double pendulum at 100 Hz: runs 2 and 3 train, windows of run 4 are predicted for 0.5 s."""
    from benchmarks.ibm_double_pendulum import read_ibm_double_pendulum
    from benchmarks.judging.recorded import DATA

    files = (there(DATA / "ibm_double_pendulum" / f"{k}.csv") for k in (2, 3, 4))
    runs = [read_ibm_double_pendulum(file).thinned(4) for file in files]
    save(folder / "train.csv", Trajectories.cat(runs[:2]))
    save(folder / "test.csv", runs[2])
    trials = [Trial("test.csv", windows=60, horizon=0.5)]
    return Job("train.csv", trials, flags=EVERYTHING, unit="rad", later=False)


def selected(folder: Path) -> Job:
    """`herglotz select` of 400 samples with 1 % of noise."""
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=99, h=0.1, noise=NOISE, seed=0)
    return replace(_job(folder, data, _unseen(0, 100, 0.1), NOISE), command="select", flags=())


def drive_motion(ratio: float, u: Tensor, h: float) -> Tensor:
    """Positions (N, 2) in rad of a motor and of its load, from rest, under a torque (N,) that is held over each step.

    J₁ φ₁″ = g u − b₁ φ₁′ − ρ F and J₂ φ₂″ = F − b₂ φ₂′, with F = k (ρ φ₁ − φ₂) + d (ρ φ₁′ − φ₂′) and the ratio ρ of the
    gear, by the exponential of the matrix of this linear motion.
    """
    J, k, d, b, g = (1.0, 4.0 / ratio**2), 15_000.0 / ratio**2, 10.0 / ratio**2, (2.0, 1.5 / ratio**2), 500.0
    spring = torch.tensor([[-ratio * ratio, ratio], [ratio, -1.0]], dtype=torch.float64)
    A = torch.zeros(5, 5, dtype=torch.float64)
    A[0, 2] = A[1, 3] = 1.0
    A[2:4, :2], A[2:4, 2:4], A[2, 4] = k * spring, d * spring - torch.diag(torch.tensor(b).double()), g
    A[2:4] /= torch.tensor(J).double()[:, None]
    step, x, path = torch.linalg.matrix_exp(h * A)[:4], torch.zeros(4, dtype=torch.float64), []
    for torque in u:
        path.append(x[:2])
        x = step @ torch.cat([x, torque[None]])
    return torch.stack(path)


def drive(folder: Path, ratio: float, seed: int) -> Job:
    """A motor and a load with encoders, 20 s at 1 kHz under a torque that jumps; two other torques are predicted."""
    h, lines, made = 1e-3, (0.0005, 0.0005 * ratio), []
    make = torch.Generator().manual_seed(seed)
    for samples in (20_000, 3000, 3000):
        levels = 4 * torch.rand(samples // 20, generator=make, dtype=torch.float64) - 2
        held = torch.randint(20, 300, (samples // 20,), generator=make)
        u = levels.repeat_interleave(held)[:samples]
        t = h * torch.arange(samples, dtype=torch.float64)
        named = {"names": ("motor", "load"), "units": ("rad", "rad"), "angles": (True, True)}
        made.append(Trajectories.of(t, drive_motion(ratio, u, h), u=u, **named))
    line = torch.tensor(lines, dtype=torch.float64)
    train, *tests = made
    job = _job(folder, replace(train, q=(train.q / line).round() * line), Trajectories.cat(tests))
    # The error of an encoder is even over a line.
    return replace(job, flags=(), scale=(line / 12**0.5).tolist())


def spring_pendulum(folder: Path, seed: int) -> Job:
    """A weight on a spring that swings, its length in mm, with 0.5 mm and 0.003 rad of noise: three recordings."""
    from benchmarks.peers.rollouts import rk4

    h, parts, g, k, rest, braked = 0.02, 20, 9.81, 40.0, 0.6, (0.15, 0.1)

    def motion(x: Tensor) -> Tensor:  # (B, 4) r in m, φ, and their rates
        r, phi, v, w = x.unbind(1)
        a = r * w * w + g * phi.cos() - k * (r - rest) - braked[0] * v
        return torch.stack([v, w, a, (-2 * v * w - g * phi.sin()) / r - braked[1] * w / r**2], 1)

    make, made = torch.Generator().manual_seed(seed), []
    for count, samples in ((3, 500), (10, 150)):
        start = torch.rand(count, 2, generator=make, dtype=torch.float64) * torch.tensor([0.3, 1.6])
        x = torch.cat([start + torch.tensor([0.7, -0.8]), torch.zeros(count, 2, dtype=torch.float64)], 1)
        path = []
        for _ in range(samples):
            path.append(x[:, :2] * torch.tensor([1000.0, 1.0], dtype=torch.float64))
            x = rk4(motion, x, h, parts)
        t = (h * torch.arange(samples, dtype=torch.float64)).repeat(count)
        named = {"names": ("r", "phi"), "units": ("mm", "rad"), "angles": (False, True)}
        made.append(Trajectories.of(t, torch.stack(path, 1).reshape(-1, 2), (samples,) * count, **named))
    train, test = made
    noise = torch.tensor([0.5, 0.003], dtype=torch.float64)
    noisy = train.q + noise * torch.randn(train.q.shape, generator=make, dtype=torch.float64)
    return replace(_job(folder, replace(train, q=noisy), test), flags=(), scale=noise.tolist())


def twenty(folder: Path) -> Job:
    """A chain of twenty masses, 1 % of noise: ten recordings of 41 samples."""
    of = scene("chain", masses=20)
    clean = simulate(of, trajectories=10, steps=40, h=0.1, seed=0)
    size = float(clean.q.std())
    data = simulate(of, trajectories=10, steps=40, h=0.1, noise=0.01 * size, seed=0)
    test = simulate(of, trajectories=10, steps=100 + WARMUP, h=0.1, seed=1000)
    return _job(folder, data, test, 0.01 * size)
