"""The figures of the sources that `benchmarks/peers --reproduce` measures."""

import math

import pytest
import torch

from benchmarks.peers import __main__ as peers
from benchmarks.peers import report, reproduce
from benchmarks.peers.continuous import acceleration
from benchmarks.peers.discrete import DiscreteLagrangian
from benchmarks.peers.known_equation import Equation
from benchmarks.peers.networks import Scales
from benchmarks.peers.reproduce import discrete, lagrangian
from benchmarks.peers.reproduce.figures import Figure, at_most_twice, read_off, spread
from benchmarks.peers.reproduce.smoothing import smoothed


@pytest.mark.parametrize("task", reproduce.TASKS)
def test_every_task_measures_its_figures(task):
    # fails if a name has no figure or a figure no value, or if a task ends in NaN
    found = reproduce.TASKS[task](0, 0.001)
    assert set(found) == set(reproduce.FIGURES[task])
    assert all(math.isfinite(x) and x > 0 for x in found.values()), found


def test_agreement_can_fail():
    # fails if a rule accepts whatever it is given
    table = Figure("a table", *spread(1.0, 0.1))
    assert table.agrees([0.5, 0.95])
    assert not table.agrees([0.5, 0.8])
    assert not table.agrees([1.2, 1.3])
    plot = read_off("a plot", 1.0)
    assert plot.agrees([0.1, 0.4, 9.0])
    assert not plot.agrees([0.1, 0.2, 0.5])
    error = at_most_twice("an error", 1.0)
    assert error.agrees([0.01, 0.02, 5.0])
    assert not error.agrees([0.01, 2.1, 5.0])


def test_finished_seeds_are_kept_and_the_table_says_no(monkeypatch):
    # fails if an interruption loses a seed, a finished one is measured again, or the limit of seeds is not kept
    figures = {"a": {"x": at_most_twice("somewhere", 1.0)}, "b": {"y": Figure("elsewhere", 5.0, 6.0)}}
    seen, saved, result = [], [], {}

    def task(name, value):
        def run(seed, effort):
            if (name, seed) == ("y", 1) and len(saved) == 3:
                raise KeyboardInterrupt
            seen.append((name, seed, effort))
            return {name: value}

        return run

    monkeypatch.setattr(reproduce, "FIGURES", figures)
    monkeypatch.setattr(reproduce, "TASKS", {"a": task("x", 1.5), "b": task("y", 1.5)})
    monkeypatch.setattr(reproduce, "MOST", {"a": 2})
    with pytest.raises(KeyboardInterrupt):
        reproduce.reproduce(result, 3, lambda: saved.append(1))
    saved.append(1)
    reproduce.reproduce(result, 3, lambda: saved.append(1))
    assert [(name, seed) for name, seed, _ in seen] == [("x", 0), ("y", 0), ("x", 1), ("y", 1), ("y", 2)]
    assert result["reproduced"]["b, y"]["here"] == [1.5] * 3
    machine = {"processor": "any", "cores": 1}
    text = report.table({**result, "cells": {}, "settings": peers.settings(1.0), "machine": machine, "versions": {}})
    assert "| a, x | somewhere | 1.50e+00 (1.5e+00 – 1.5e+00) | 2 | median at most 2 | yes |" in text
    assert "| b, y | elsewhere | 1.50e+00 (1.5e+00 – 1.5e+00) | 3 | range meets 5 – 6 | no |" in text


def test_the_systems_of_the_figures_are_what_they_say():
    # fails if the arm's Coriolis torque, the double pendulum's Lagrangian or its friction is wrong
    make = torch.Generator().manual_seed(0)
    q, v = (torch.rand(5, 2, generator=make, dtype=torch.float64).requires_grad_() for _ in range(2))
    A, b, c, d, e, f = lagrangian.ARM
    C = q[:, 1].cos()
    kinetic = (A + b * C) * v[:, 0] ** 2 / 2 + (c + d * C) * v[:, 0] * v[:, 1] + c * v[:, 1] ** 2 / 2
    L = kinetic - e * q[:, 0].sin() - f * q.sum(1).sin()
    free = acceleration(L, q, v).detach()
    assert torch.allclose(lagrangian.arm_torque(q.detach(), v.detach(), free), torch.zeros(5, 2).double(), atol=1e-12)
    exact = DiscreteLagrangian(Scales.unit(True, True), 0.05, discrete._Exact(), kinetic=0.0)
    theta = torch.tensor([[0.5, 0.5, 10.0, 5.0, 0.0, 0.0]], dtype=torch.float64).expand(5, -1)
    want = Equation(relative=False).acceleration(q, v, theta)
    assert torch.allclose(discrete.accelerations(exact, q, v), want, atol=1e-12)
    exact.force = discrete._Friction()
    loss = discrete.accelerations(exact, q, v) - want
    M = torch.tensor([[2.0, 0.0], [0.0, 1.0]], dtype=torch.float64).repeat(5, 1, 1)
    M[:, 0, 1] = M[:, 1, 0] = (q[:, 0] - q[:, 1]).cos()
    assert torch.allclose((M @ loss[..., None])[..., 0], -0.5 * v, atol=1e-12)


def test_smoothing_takes_the_noise_away():
    # fails if the filter's gain or the smoother's is wrong: the noise then stays, or the motion lags
    make = torch.Generator().manual_seed(0)
    t = 0.05 * torch.arange(200, dtype=torch.float64)
    q = torch.stack([(2 * t).sin(), t.cos()], -1)[None]
    noisy = q + 0.1 * torch.randn(q.shape, generator=make, dtype=torch.float64)
    found = smoothed(noisy, 0.05)
    middle = slice(20, 180)
    assert float((found[0] - q)[:, middle].square().mean().sqrt()) < 0.05
    assert float((found[1][0, :, 0] - 2 * (2 * t).cos())[middle].square().mean().sqrt()) < 0.3
