"""A resumed fit is bit for bit the uninterrupted one, wherever it was interrupted."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import simulate
from herglotz.data.files import write_atomically
from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, stages

SMALL = FitConfig(level="linear", objective="trajectory", iterations=6, potential_width=0)
CASES = {
    "one step": replace(SMALL, objective="residual", iterations=20, correction_width=3),
    "trajectories": replace(SMALL, iterations=12, potential_width=2, departures=(0.1, 1.0)),
    "smoothing": replace(SMALL, objective="smoothing", iterations=8),
    "adam": replace(SMALL, objective="residual", optimiser="adamw", iterations=3, batch=16, correction_width=2),
}


class Interrupted(BaseException):
    """In the place of Ctrl-C."""


@pytest.fixture(scope="module")
def data():
    return simulate(scene("damped_pendulum"), trajectories=1, steps=30, h=0.1, noise=1e-3, seed=1)


def numbers(run):
    """All numbers of a run."""
    values = [*run.model.state_dict().values(), *run.states, torch.tensor([x["cost"] for x in run.history])]
    return [x.detach().clone() for x in values]


@pytest.mark.parametrize("shares", [(0.5,), pytest.param((0.0, 0.2, 0.35, 0.65, 0.8, 1.0), marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", CASES)
def test_the_same_numbers(case, shares, data, tmp_path, monkeypatch):
    # fails if a checkpoint lacks the damping, the scaling, the count of quiet steps, Adam's moments, the order of its
    # batches, or the path that a shooting problem starts its next solve from
    monkeypatch.setattr(stages, "ITERATIONS_PER_CHECKPOINT", 3)
    written, stop = 0, 10**9

    def counted(path, content):
        nonlocal written
        write_atomically(path, content)
        written += 1
        if written == stop:
            raise Interrupted

    monkeypatch.setattr(stages, "write_atomically", counted)
    whole = numbers(fit(data, CASES[case], out=tmp_path / "whole", progress=False))
    total = written
    assert total >= 4
    for k in sorted({1 + int(share * (total - 2)) for share in shares}):
        written, stop = 0, k
        with pytest.raises(Interrupted):
            fit(data, CASES[case], out=tmp_path / f"{k}", progress=False)
        stop = 10**9
        again = fit(data, CASES[case], out=tmp_path / f"{k}", progress=False, resume=True)
        assert all(torch.equal(x, y) for x, y in zip(numbers(again), whole, strict=True))


def test_a_damaged_checkpoint(data, tmp_path):
    # fails if a flipped bit of a checkpoint is fitted on from
    config = CASES["one step"]
    fit(data, config, out=tmp_path, progress=False)
    path = tmp_path / "checkpoint.pt"
    content = path.read_bytes()
    for at in range(0, len(content), len(content) // 40):
        path.write_bytes(content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :])
        with pytest.raises(InputError, match=r"checkpoint\.pt: .*; delete it and fit from the start"):
            fit(data, config, out=tmp_path, progress=False, resume=True)
