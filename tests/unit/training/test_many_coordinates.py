"""Fits of many coordinates wait for smaller gains only where strengths of the prior are compared."""

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.training import FitConfig, trajectory_fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult
from herglotz.training.stages import Stages
from herglotz.training.task import Task


@pytest.mark.parametrize(("n", "grown", "compared"), [(4, 1e-4, 1e-4), (5, 1e-2, 1e-3)])
def test_stages_of_many_coordinates_end_early(monkeypatch, n, grown, compared):
    # fails if noisy motion of many coordinates waits for gains of 1e-4 in every stage (twenty: 180 s),
    # if strengths are compared by fits that have not ended, or if few coordinates are hurried
    search, ends = trajectory_fit.levenberg_marquardt, []

    def shortened(problem, x, **how):
        ends.append(how["rtol"])
        how["max_iterations"] = 1
        return search(problem, x, **how)

    monkeypatch.setattr(trajectory_fit, "levenberg_marquardt", shortened)
    t = 0.1 * torch.arange(31, dtype=torch.float64)
    q = torch.cos(t[:, None] * torch.linspace(1, 2, n, dtype=torch.float64))
    data = Trajectories.of(t, q, (31,), angles=(False,) * n)
    config = FitConfig(level="linear", robust="off", departures=(6e-3, 2e-3))
    task = Task(data, estimate_baseline(data), config, Stages(False, None, "", resume=False))
    assert trajectory_fit.fit_trajectories(task, task.build("potential"), 1.0) is not None
    last = 3 + (n > trajectory_fit.MANY_COORDINATES)  # the strongest of many, the noise, and two strengths
    assert ends == [grown] * (len(ends) - last) + [compared] * last
    assert len(ends) > last + 1


@pytest.mark.parametrize(("n", "samples", "told_apart"), [(4, 31, True), (5, 31, False), (5, 120, True)])
def test_strengths_that_held_out_blocks_cannot_tell_apart_are_not_fitted(n, samples, told_apart):
    # fails if every strength is fitted where blocks are missed by more than the motion's spread (twenty coordinates:
    # 80 s for 50), if the choice is left out where samples suffice, or for few coordinates
    t = 0.1 * torch.arange(samples, dtype=torch.float64)
    noise = 0.01 * torch.randn(samples, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = torch.cos(t[:, None] * torch.linspace(1, 2, n, dtype=torch.float64)) + noise
    data = Trajectories.of(t, q, (samples,), angles=(False,) * n)
    config = FitConfig(level="linear", robust="off", departures=(6e-3, 2e-3))
    task = Task(data, estimate_baseline(data), config, Stages(False, None, "", resume=False))
    found = trajectory_fit.fit_trajectories(task, task.build("potential"), 0.01)
    assert found is not None
    assert set(found.held_out) == ({2e-3, 6e-3} if told_apart else {2e-3})
    assert [name for name in task.stages.done if not name.startswith("segments")] == [
        *["strongest prior"] * (n > trajectory_fit.MANY_COORDINATES),
        *["noise", "prior 0.006", "prior 0.002"] * told_apart,
    ]


@pytest.mark.parametrize("hurried", [True, False])
def test_a_hurried_stage_steps_through_its_start_alone(monkeypatch, hurried):
    # fails if every trial without a path is stepped through, which costs more than all iterations, or if a start far
    # from a path is lost though it could be stepped through
    patient, t = [], 0.1 * torch.arange(31, dtype=torch.float64)
    monkeypatch.setattr(
        trajectory_fit, "levenberg_marquardt", lambda _problem, x, **_: OptimiserResult(x, 1.0, "done", 1, [1.0])
    )
    data = Trajectories.of(t, t.cos()[:, None], (31,))
    task = Task(data, estimate_baseline(data), FitConfig(level="linear"), Stages(False, None, "", resume=False))
    stages = trajectory_fit.SegmentStages(task, task.build("none"))
    stages.hurried = hurried
    problems = trajectory_fit.ShootingProblem
    solve = problems.solve
    monkeypatch.setattr(problems, "solve", lambda self, x: patient.append(self.patient) or solve(self, x))
    assert stages.fit(stages.lengths[0], 0.01, None, None) is not None
    assert patient[-2:] == ([True, False] if hurried else [True])
