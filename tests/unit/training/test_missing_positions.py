"""Positions that were not read have no weight: in the equations of a fit, and in its errors."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training import FitConfig
from herglotz.training.baseline import estimate_baseline
from herglotz.training.choose import choose_objective
from herglotz.training.fit import fit, weighed
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.smoothing import SmoothingProblem


def rocking(blank, noise=0.002, runs=4, steps=20, h=0.35):
    """Two masses with springs, x'' = -2x + y and y'' = x - 2y, with these shares of blank cells; coarsely sampled."""
    make, lengths = torch.Generator().manual_seed(3), (steps,) * runs
    t = torch.arange(steps, dtype=torch.float64) * h
    a = 1.0 + torch.rand(2, runs, 1, generator=make, dtype=torch.float64)
    together, against = a[0] * t.cos(), a[1] * (3**0.5 * t).cos()  # the normal modes
    q = torch.stack([together + against, together - against], -1).flatten(0, 1)
    q = q + noise * torch.randn(q.shape, generator=make, dtype=torch.float64)
    known = torch.rand(q.shape, generator=make) >= torch.tensor(blank)
    known[[k for b in range(runs) for k in (b * steps, b * steps + 1, b * steps + steps - 1)]] = True
    data = Trajectories.of(t.repeat(runs), q, lengths, names=["x", "y"], units=["m", "m"])
    return data, known


def linear():
    """Two masses with springs and one damping rate."""
    ones = dict.fromkeys(("scale", "speed", "stiffness"), (1.0, 1.0))
    return ContactLagrangian(ModelConfig(angles=(False, False), level="linear", tilt=(0.0, 0.0), **ones))


def missed(data, known, by):
    """The set whose values are off by this much where none was read."""
    return replace(data, q=torch.where(known, data.q, data.q + by), observed=known.to(data.q))


@pytest.mark.parametrize("freedom", [None, 4.0])
def test_equations_do_not_depend_on_what_was_not_read(freedom):  # fails if a cell without a reading pulls the fit
    data, known = rocking((0.3, 0.2))
    base = estimate_baseline(data)
    found = []
    for by in (0.0, 0.5):
        own = missed(data, known, by)
        grid = segment_grid(own, own.samples, base.model_step)
        problem = ShootingProblem(linear(), own, grid, sigma=0.01, freedom=freedom)
        start = problem.grid.start_sample
        x = problem.pack(problem.parameters.get(), problem.states(data.q[start], 0.1 * data.q[start]))
        cost, A, b = problem.normal_equations(x)
        found.append((problem.cost(x), cost, A.corner, b))
    for one, two in zip(*found, strict=True):
        assert torch.equal(one, two)


def test_a_fourth_of_blank_cells_leaves_the_fit_at_the_noise():
    # fails if rows with a blank are left out (unseen samples are then missed by 17 mm), or blanks count in the errors
    data, known = rocking((0.25, 0.25))
    run = fit(missed(data, known, 0.3))
    assert run.metrics["verdict"].startswith("fits")
    assert run.metrics["train_rms"] < 0.002
    assert run.metrics["extrapolation_rms"] < 0.004


def test_smoothing_does_not_depend_on_what_was_not_read():
    # fails if a warm-up or a filter's noise takes an interpolated value for a reading
    data, known = rocking((0.3, 0.2))
    found, x = [], None
    for by in (0.0, 0.5):
        own = missed(data, known, by)
        problem = SmoothingProblem(linear(), own, segment_grid(own, own.samples, 1.0), sigma=0.01, process=0.1)
        x = problem.start() if x is None else x
        cost, _, b = problem.normal_equations(x)
        found.append((problem.cost(x), cost, b))
    for one, two in zip(*found, strict=True):
        assert torch.equal(one, two)


def test_single_steps_are_fitted_to_readings_alone():
    # fails if a value that was not read counts in a one-step error
    data, known = rocking((0.1, 0.0))
    own = missed(data, known, 0.3)
    assert weighed(own, "residual", "q").samples == weighed(own, "auto", "qs").samples == int(known.all(1).sum())
    assert weighed(own, "auto", "q") is own
    seen: Any = SimpleNamespace(kept=own, settings=FitConfig(), found=None, structure="the data need none",
                                probe=None, baseline_motion=None, base=estimate_baseline(data))  # fmt: skip
    assert choose_objective(seen, FitConfig())[0] == "trajectory"
