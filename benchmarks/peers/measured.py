"""Measured data sets, read from where data/README.md says they are put."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from herglotz.data import load
from herglotz.errors import InputError

from .judging import Metrics, Problem, errors, free_run
from .rollouts import Predictor, fitted_start
from .samples import Samples

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data"
IBM_EVERY, IBM_PIECE, IBM_HISTORY = 4, 50, 12  # frames a sample, samples a trajectory, samples that fix a start


def on_grid(index: Tensor, q: Tensor) -> Tensor:
    """Samples (K, n) at whole numbers of steps, NaN between them."""
    out = q.new_full((int(index[-1] - index[0]) + 1, q.shape[1]), torch.nan)
    out[index - index[0]] = q
    return out


def real_pendulum(history: int = 40) -> Problem:
    """real_pend_h_1 (Schmidt & Lipson 2009): the first 2/3 train, the last 1/3 is one free run."""
    path, h = MEASURED / "schmidt_lipson_2009" / "real_pend_h_1.txt", 1 / 6

    def parts() -> tuple[Tensor, Tensor, int]:
        if not path.is_file():
            raise InputError(f"{path}: not here; data/README.md says where to get it, or leave real_pendulum out")
        data = load(path).unwrapped()
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
    return Problem(title, samples, judge, simulated=False, whole=lambda: load(path))


def ibm() -> Problem:
    """A measured chaotic double pendulum (Asseman et al. 2018): runs 2 and 3 train, windows of run 4 test."""
    h, checks = IBM_EVERY / 400, {"0.1 s": 10, "0.25 s": 25, "0.5 s": 50}

    def run(number: int) -> Tensor:
        path = MEASURED / "ibm_double_pendulum" / f"{number}.csv"
        if not path.is_file():
            raise InputError(f"{path}: not here; data/README.md says where to get it, or leave ibm out")
        q = load(path).unwrapped().q
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
    return Problem(title, samples, judge, simulated=False, dof=2)
