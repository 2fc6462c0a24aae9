"""Free runs solved block by block, and paths that start from the last one's derivatives."""

from typing import Any, cast

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig, OwnLagrangian
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import free_run
from herglotz.training.free_run import continued, free_runs, near_data
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers import lifted_newton


@pytest.mark.parametrize("name", ["damped_pendulum", "servo_axis"])
def test_runs_continued_in_blocks_are_those_of_single_steps(name):
    # fails if a block starts from the wrong state, takes the wrong inputs, or is taken where it did not converge
    held = name == "servo_axis"
    config = ModelConfig(
        (name == "damped_pendulum",), "forced", (1.0,), (1.0,), (1.0,), (0.1,), potential_width=0, rate=0.1,
        coulomb=held, sticking=held, inputs=1 if held else 0, order=2,
    )  # fmt: skip
    model, start = ContactLagrangian(config), torch.tensor([[0.8, 0.3, 0.0]], dtype=torch.float64)
    h = torch.full((1, 120), 0.05, dtype=torch.float64)
    u = 0.5 * torch.sin(torch.arange(120, dtype=torch.float64) / 9)[None, :, None] if held else None
    with torch.no_grad():
        if held:
            model.get_parameter("friction.coulomb").fill_(0.3)
            model.get_parameter("friction.input_map").fill_(1.0)
        x = continued(model, start, h, u)
        out = Stepper(model).rollout(start[:, :1], start[:, 1:2], start[:, 2], h=h, inputs=u)
    still = (out.q[:, 1:] == out.q[:, :-1]).any()
    assert bool(still) == held  # friction holds for a while
    torch.testing.assert_close(x[..., :1], out.q, rtol=0, atol=1e-11)
    torch.testing.assert_close(x[..., 1:2], out.p, rtol=0, atol=1e-11)


def test_a_run_near_the_data_is_that_of_the_stepper():
    # fails if a step that has two solutions is taken to the one near the data: the printed error of a free run was that
    # of a motion that no stepper makes
    bent = lambda q0, q1, s0, h: ((q1 - q0) ** 2 / 2 - (q1 - q0) ** 3 / 3).sum(-1) / h + 0 * s0  # noqa: E731
    model, h, t = cast(Any, OwnLagrangian(bent, 1)), 0.1, 0.1 * torch.arange(9, dtype=torch.float64)
    start = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
    for sign in (-1, 1):
        # Both solutions Δ of Δ − Δ² = h p, with p = 1 throughout.
        data = Trajectories.of(t, torch.arange(9.0).double() * (1 + sign * (1 - 4 * h) ** 0.5) / 2)
        grid = segment_grid(data, 8, h)
        run = free_runs(Stepper(model), data, grid, start, None)
        rolled = Stepper(model).rollout(start[:, :1], start[:, 1:2], start[:, 2], h=grid.h)
        torch.testing.assert_close(run[..., :1], rolled.q, rtol=0, atol=1e-9)
        assert (near_data(model, data, grid, start, None) is None) is (sign == 1)


def test_a_run_that_fails_leaves_the_others_alone():
    # fails if a run that breaks off takes the ones beside it with it, or goes on as if nothing had been
    model = ContactLagrangian(ModelConfig(potential_width=0, rate=0.1))
    good = torch.tensor([0.8, 0.3, 0.0], dtype=torch.float64)
    start, h = torch.stack([good, torch.full_like(good, 1e200)]), torch.full((2, 9), 0.05, dtype=torch.float64)
    h[1] = 1e200
    x = continued(model, start, h, None)
    assert bool(x[1, -1].isnan().all())
    torch.testing.assert_close(x[0], continued(model, start[:1], h[:1], None)[0], rtol=0, atol=1e-11)


def test_a_lost_run_is_not_solved_again(monkeypatch):
    # fails if blocks of steps hold a run that is lost: none of them converges, and the others go on step by step
    model, sizes = ContactLagrangian(ModelConfig(potential_width=0, rate=0.1)), []
    start, h = torch.tensor([[0.8, 0.3, 0.0]] * 2, dtype=torch.float64), torch.full((2, 20), 0.05, dtype=torch.float64)
    h[1, 5:] = 1e200
    own = free_run.solve_path
    monkeypatch.setattr(free_run, "solve_path", lambda L, x, *rest: sizes.append(len(x)) or own(L, x, *rest))
    x = continued(model, start, h, None)
    assert sizes[0] == 2
    assert sizes[-1] == 1
    assert bool(x[1, -1].isnan().all())
    assert bool(x[0].isfinite().all())


@pytest.fixture
def pendulum():
    """A pendulum's problem over whole trajectories, solved at the model's parameters, and its unknowns."""
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=60, h=0.1, noise=0.0, seed=0)
    model = ContactLagrangian(ModelConfig(rate=0.2, potential_width=0, scale=(2.5,), speed=(2.0,)))
    problem = ShootingProblem(model, data, segment_grid(data, 60, 0.2), sigma=0.01)
    problem.compiled = None  # a kernel steps, and needs no path to start from
    start = problem.grid.start_sample
    v = (data.q[start + 1] - data.q[start]) / 0.1
    x = problem.pack(problem.parameters.get(), problem.states(data.q[start], v))
    problem.normal_equations(x)
    return problem, x


def test_the_next_path_starts_from_derivatives(pendulum):
    # fails if a column of the derivatives goes with another unknown: the error of the start falls as the step's square
    problem, x = pendulum
    errors = []
    for size in (1e-2, 1e-3):
        moved = x + size * torch.linspace(-1, 1, len(x), dtype=x.dtype)
        guess, path = problem._guess(moved, problem.path), problem.solve(moved)
        errors.append(float((guess - path.x)[..., : problem.d].abs().max()))
    assert 50 < errors[0] / errors[1] < 200


def test_a_path_that_is_not_looked_at_again_is_solved(pendulum):
    # fails if sweeps end where the next defect would not be rounding
    problem, x = pendulum
    tol = 1e3 * torch.finfo(x.dtype).eps
    for size in (1e-1, 1e-3, 1e-6, 1e-9):
        moved = x + size * torch.linspace(-1, 1, len(x), dtype=x.dtype)
        path, theta = problem.solve(moved), moved[: problem.P]
        stepped = lifted_newton.all_steps(problem.parameters.at(theta), path.x, problem.grid.h)
        assert stepped is not None
        y = stepped[0]
        assert float((y - path.x[:, 1:]).abs().max()) < 2 * tol * float(path.x.abs().max())
