"""Fits of many coordinates wait for smaller gains only where strengths of the prior are compared."""

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.training import FitConfig, trajectory_fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.stages import Stages
from herglotz.training.task import Task


@pytest.mark.parametrize(("n", "grown", "compared"), [(4, 1e-4, 1e-4), (5, 1e-2, 1e-3)])
def test_stages_of_many_coordinates_end_early(monkeypatch, n, grown, compared):
    # fails if noisy motion of many coordinates waits for gains of 1e-4 in every stage (twenty: 180 s),
    # if strengths are compared by fits that have not ended, or if few coordinates are hurried
    search, ends = trajectory_fit.levenberg_marquardt, []

    def shortened(problem, x, **how):
        ends.append(how["rtol"])
        return search(problem, x, **how | {"max_iterations": 1})

    monkeypatch.setattr(trajectory_fit, "levenberg_marquardt", shortened)
    t = 0.1 * torch.arange(31, dtype=torch.float64)
    q = torch.cos(t[:, None] * torch.linspace(1, 2, n, dtype=torch.float64))
    data = Trajectories.of(t, q, (31,), angles=(False,) * n)
    config = FitConfig(level="linear", robust="off", departures=(6e-3, 2e-3))
    task = Task(data, estimate_baseline(data), config, Stages(False, None, "", resume=False))
    assert trajectory_fit.fit_trajectories(task, task.build("potential"), 1.0) is not None
    assert ends == [grown] * (len(ends) - 3) + [compared] * 3  # the noise, and two strengths
    assert len(ends) > 4
