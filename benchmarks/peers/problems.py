"""The data sets and how a trained model is judged on each: simulated ones, and measured ones where they are there.

Only the training data depend on the seed; the tests are the same for all. Exact velocities exist for simulated data,
whose truth has no noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import DATA, there
from benchmarks.ibm_double_pendulum import read_ibm_double_pendulum
from herglotz.data import load, simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit

from .known_equation import Equation
from .rollouts import Predictor, fitted_start, rk4
from .samples import Motion, Samples

LOST = 50.0  # an error beyond which a rollout counts as failed, in units of q
STEPS = 100  # of a rollout of the pendulum
GAMMA = 0.2  # the pendulum's damping
IBM_EVERY, IBM_PIECE, IBM_HISTORY = 4, 50, 12  # frames a sample, samples a trajectory, samples that fix a start
Metrics = dict[str, Any]


@dataclass(frozen=True)
class Problem:
    """One data set."""

    title: str  # what it is and what is measured
    samples: Callable[[int, bool], Samples]  # (seed, exact) → what a peer is given
    judge: Callable[[Predictor, bool], Metrics]  # (predictor, exact) → `rms`, `median`, `failures`, …
    simulated: bool = True  # whether exact velocities exist
    # Seed → metrics and parameters of ours, where it is judged by the free run from its own fitted states.
    own: Callable[[int], tuple[Metrics, int]] | None = None


def errors(
    found: Tensor,  # (B, K, n); the first two positions are given, not predicted
    truth: Tensor,  # (B, K, n)
    energy: Callable[[Tensor], Tensor] | None,  # positions (B, K, n) → (B, K−2), by central differences
) -> Metrics:
    """RMS over the rollouts that end, median over all, and the error of the energy relative to its start."""
    e = (found - truth)[:, 2:]
    size = e.abs().flatten(1).amax(1)
    good = torch.isfinite(size) & (size < LOST)
    out: Metrics = {"rollouts": len(e), "failures": int((~good).sum()), "rms": None, "median": None, "decay": None}
    if bool(good.any()):
        out["rms"] = float(e[good].square().mean().sqrt())
        median = float(torch.where(good[:, None, None], e.abs(), torch.inf).median())
        out["median"] = median if math.isfinite(median) else None
        if energy is not None:
            E = energy(truth)
            out["decay"] = float(((energy(found)[good] - E[good]) / E[:, 0].mean()).square().mean().sqrt())
    return out


def free_run(out: Tensor, truth: Tensor) -> Metrics:
    """Errors of one free run; `decay` is the relative error of the amplitude over its last third."""
    found = errors(torch.cat([truth[:2], out])[None], torch.cat([truth[:2], truth])[None], None)
    last = len(truth) // 3
    if found["failures"] == 0:
        found["decay"] = abs(float(out[-last:].std() / truth[-last:].std()) - 1)
    return found


def _middle(q: Tensor, h: float) -> tuple[Tensor, Tensor]:
    return q[:, 1:-1], (q[:, 2:] - q[:, :-2]) / (2 * h)


def _pendulum_motion(q: Tensor, clean: Tensor, v: Tensor) -> tuple[Motion, ...]:
    """The positions given, with the rates at the positions without noise."""
    a = -clean.sin() - GAMMA * v
    return tuple(Motion(q_i, v_i, v_i, a_i, a_i) for q_i, v_i, a_i in zip(q, v, a, strict=True))


def pendulum(h: float, noise: float = 0.0, trajectories: int = 40) -> Problem:
    """The damped pendulum: 40 × 41 positions; 5 × 20 unseen starts, 100 steps."""
    system = scene("damped_pendulum")

    def samples(seed: int, exact: bool) -> Samples:
        options = {"trajectories": trajectories, "steps": 40, "h": h, "seed": seed, "keep_state": True}
        data = simulate(system, noise=noise, **options)
        q = data.q.reshape(trajectories, 41, 1)
        if not exact:
            return Samples(tuple(q), h, (True,), noise > 0)
        clean = simulate(system, **options)  # the noise is drawn last: these are the same motions
        assert clean.p is not None
        motion = _pendulum_motion(q, clean.q.reshape(q.shape), clean.p.reshape(q.shape))
        return Samples(tuple(q), h, (True,), noise > 0, motion)

    def tests() -> tuple[Tensor, Tensor]:
        options = {"trajectories": 20, "steps": STEPS + 1, "h": h, "keep_state": True}
        sets = [simulate(system, seed=k, **options) for k in range(1000, 1005)]
        q, p = (torch.cat([getattr(one, name) for one in sets]) for name in "qp")
        return q.reshape(-1, STEPS + 2, 1), p.reshape(-1, STEPS + 2, 1)

    what = f"{trajectories} × 41 positions, h = {h:g}" + (f", noise {noise:g} rad" if noise else "")
    return _pendulum_problem(h, samples, tests, what)


def one_pendulum(h: float = 0.5) -> Problem:
    """One trajectory of 41 positions from v = 0; unseen starts are those with less energy than it begins with."""
    system = scene("damped_pendulum")

    def run(seed: int) -> tuple[Tensor, Tensor]:
        angle = 2.0 + 0.1 * seed  # released from rest
        data = simulate(system, trajectories=1, steps=40, h=h, seed=seed, q_range=(angle, angle), v_range=(0.0, 0.0),
                        keep_state=True)  # fmt: skip
        assert data.p is not None
        return data.q[None], data.p[None]

    def samples(seed: int, exact: bool) -> Samples:
        q, v = run(seed)
        return Samples(tuple(q), h, (True,), False, _pendulum_motion(q, q, v) if exact else None)

    def tests() -> tuple[Tensor, Tensor]:
        # Inside every seed's range: energy below that of the release at 2 rad.
        data = simulate(system, trajectories=200, steps=STEPS + 1, h=h, seed=1000, q_range=(-2.0, 2.0),
                        v_range=(-1.68, 1.68), keep_state=True)  # fmt: skip
        assert data.p is not None
        q, p = (x.reshape(200, STEPS + 2, 1) for x in (data.q, data.p))
        inside = (p[:, 0, 0].square() / 2 + 1 - q[:, 0, 0].cos() < 1 - math.cos(2.0)).nonzero()[:100, 0]
        return q[inside], p[inside]

    return _pendulum_problem(h, samples, tests, f"one trajectory of 41 positions, h = {h:g}")


def _pendulum_problem(h: float, samples: Any, tests: Any, what: str) -> Problem:
    def energy(q: Tensor) -> Tensor:
        q, v = _middle(q, h)
        return (v.square() / 2 + 1 - q.cos())[..., 0]

    def judge(model: Predictor, exact: bool) -> Metrics:
        q, v = tests()
        state = torch.cat([q[:, 1], v[:, 1]], -1) if exact else None
        return errors(model.rollout(q[:, 0], q[:, 1], STEPS, state), q, energy)

    return Problem(f"damped pendulum, {what}; {STEPS} steps from 100 unseen starts", samples, judge)


LINKS = scene("double_pendulum", gamma=0.0)  # in absolute angles, without friction
# m = ℓ = 1, g = 9.81, viscous 0.1 at both joints, over the first arm's inertia 2: see `known_equation`.
DOUBLE = torch.tensor([[0.5, 0.5, 9.81, 4.905, 0.05, 0.05]], dtype=torch.float64)


def double_motion(q: Tensor, v: Tensor, h: float, samples: int) -> tuple[Tensor, Tensor]:
    """Positions and velocities (B, samples, 2) in the joint angles (θ1, θ2 − θ1), by short Runge–Kutta steps."""
    equation, y = Equation(relative=True), torch.cat([q, v], -1)
    out = [y]
    for _ in range(samples - 1):
        y = rk4(lambda y: equation.field(y, DOUBLE), y, h, 24)
        out.append(y)
    both = torch.stack(out, 1)
    return both[..., :2], both[..., 2:]


def double_momentum(q: Tensor, v: Tensor) -> Tensor:
    """Momentum ∂L/∂v of the joint angles, (..., 2)."""
    p = LINKS.momentum(q.cumsum(-1), v.cumsum(-1), q[..., 0])
    return torch.stack([p.sum(-1), p[..., 1]], -1)


def double_pendulum(h: float = 0.02, steps: int = 50) -> Problem:
    """100 × 100 positions of both joint angles, released from rest within ±1 rad; 50 steps from 100 unseen releases."""

    def runs(seed: int, samples: int) -> tuple[Tensor, Tensor]:
        make = torch.Generator().manual_seed(seed)
        q = 2.0 * torch.rand(100, 2, generator=make, dtype=torch.float64) - 1.0
        return double_motion(q, torch.zeros_like(q), h, samples)

    def samples(seed: int, exact: bool) -> Samples:
        q, v = runs(seed, 100)
        if not exact:
            return Samples(tuple(q), h, (True, True), relative=True)
        flat_q, flat_v = (x.reshape(-1, 2).requires_grad_() for x in (q, v))
        p = double_momentum(flat_q, flat_v)
        with torch.no_grad():
            a = Equation(relative=True).acceleration(flat_q, flat_v, DOUBLE.expand(len(flat_q), -1))
        slopes = [torch.autograd.grad(p[:, i].sum(), (flat_q, flat_v), retain_graph=True) for i in (0, 1)]
        f = torch.stack([(p_q * flat_v + p_v * a).sum(-1) for p_q, p_v in slopes], -1)  # ṗ by the chain rule
        parts = (x.detach().reshape(q.shape) for x in (flat_q, flat_v, p, a, f))
        motion = tuple(Motion(*x) for x in zip(*parts, strict=True))
        return Samples(tuple(q), h, (True, True), False, motion, relative=True)

    def energy(q: Tensor) -> Tensor:
        (q, v), s = (x.cumsum(-1) for x in _middle(q, h)), torch.zeros((), dtype=q.dtype)
        return LINKS.hamiltonian(q, LINKS.momentum(q, v, s), s)

    def judge(model: Predictor, exact: bool) -> Metrics:
        q, v = runs(1000, steps + 2)
        second = double_momentum(q[:, 1], v[:, 1]) if getattr(model, "momentum", False) else v[:, 1]
        state = torch.cat([q[:, 1], second], -1) if exact else None
        return errors(model.rollout(q[:, 0], q[:, 1], steps, state), q, energy)

    title = f"double pendulum, friction at both joints, 100 × 100 positions, h = {h:g}; {steps} steps from 100 releases"
    return Problem(title, samples, judge)


def on_grid(index: Tensor, q: Tensor) -> Tensor:
    """Samples (K, n) at whole numbers of steps, NaN between them."""
    out = q.new_full((int(index[-1] - index[0]) + 1, q.shape[1]), torch.nan)
    out[index - index[0]] = q
    return out


def real_pendulum(history: int = 40) -> Problem:
    """real_pend_h_1 (Schmidt & Lipson 2009): the first 2/3 train, the last 1/3 is one free run."""
    path, h = DATA / "schmidt_lipson_2009" / "real_pend_h_1.txt", 1 / 6

    def parts() -> tuple[Tensor, Tensor, int]:
        data = load(there(path)).unwrapped()
        index = ((data.t - data.t[0]) / h).round().long()
        return index, data.q, round(0.667 * len(index))

    def samples(seed: int, exact: bool) -> Samples:  # noqa: ARG001
        index, q, cut = parts()
        breaks = (index[:cut].diff() > 1).nonzero()[:, 0] + 1
        pieces = q[:cut].tensor_split(breaks.tolist())
        pieces = tuple(x for x in pieces if len(x) > 2)
        return Samples(pieces, h, (True,), True, gaps=on_grid(index[:cut], q[:cut]))

    def judge(model: Predictor, exact: bool) -> Metrics:  # noqa: ARG001
        index, q, cut = parts()
        first = next(k for k in range(cut - history, 0, -1) if index[k + 1] == index[k] + 1)
        grid = index - index[first]
        q0, q1 = fitted_start(model, on_grid(grid[first:cut], q[first:cut])[None])
        out = model.rollout(q0, q1, int(grid[-1]) - 1)[0, grid[cut:]]
        return free_run(out, q[cut:])

    title = "measured pendulum (Schmidt & Lipson), first 2/3 → last 1/3; one free run"

    def own(seed: int) -> tuple[Metrics, int]:
        run = fit(load(path), FitConfig(seed=seed), progress=False)
        cut = run.train_lengths[0]
        return free_run(run.prediction[cut:], run.data.q[cut:]), run.metrics["parameters"]

    return Problem(title, samples, judge, simulated=False, own=own)


def ibm() -> Problem:
    """A measured chaotic double pendulum (Asseman et al. 2018): runs 2 and 3 train, windows of run 4 test."""
    h, checks = IBM_EVERY / 400, {"0.1 s": 10, "0.25 s": 25, "0.5 s": 50}

    def run(number: int) -> Tensor:
        q = read_ibm_double_pendulum(there(DATA / "ibm_double_pendulum" / f"{number}.csv")).q
        # The known equation needs 0 to hang down. Where the first arm comes to rest says which quarter turn that is.
        late = q[-800:, 0]
        rest = torch.atan2(late.sin().mean(), late.cos().mean())
        return (q - (rest / (math.pi / 2)).round() * (math.pi / 2))[::IBM_EVERY]

    def near_zero(x: Tensor) -> Tensor:
        """The same motions (B, K, 2) with their first angles within ±π: a network may take the angle itself."""
        turn = 2 * math.pi
        return x - turn * (x[:, :1] / turn).round()

    def samples(seed: int, exact: bool) -> Samples:  # noqa: ARG001
        pieces = [x for number in (2, 3) for x in run(number).split(IBM_PIECE) if len(x) == IBM_PIECE]
        return Samples(tuple(near_zero(torch.stack(pieces))), h, (True, True), True)

    def judge(model: Predictor, exact: bool) -> Metrics:  # noqa: ARG001
        length = IBM_HISTORY + checks["0.5 s"]
        windows = near_zero(run(4).unfold(0, length, 34).transpose(1, 2))
        q0, q1 = fitted_start(model, windows[:, :IBM_HISTORY])
        out = model.rollout(q0, q1, length - 2)
        ahead, truth = (torch.cat([x[:, :2], x[:, IBM_HISTORY:]], 1) for x in (out, windows))
        found = errors(ahead, truth, None)
        e = (out - windows)[:, IBM_HISTORY:]
        good = torch.isfinite(e).flatten(1).all(1)
        after = {
            name: (e[good, k - 1].square().mean(0).sqrt().tolist() if bool(good.any()) else None)
            for name, k in checks.items()
        }
        return found | {"after": after}

    title = "measured chaotic double pendulum (IBM), runs 2 and 3 → windows of run 4; 0.5 s ahead"
    return Problem(title, samples, judge, simulated=False)


# Steps h of the pendulum: 31, 13 and 6 samples a period.
PROBLEMS: dict[str, Callable[[], Problem]] = {
    "pendulum_02": lambda: pendulum(0.2),
    "pendulum_05": lambda: pendulum(0.5),
    "pendulum_10": lambda: pendulum(1.0),
    "pendulum_noise": lambda: pendulum(0.2, noise=0.01),
    "pendulum_one": one_pendulum,
    "real_pendulum": real_pendulum,
    "double_pendulum": double_pendulum,
    "ibm": ibm,
}
