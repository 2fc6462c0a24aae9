"""Gauss–Newton by products: the dense step where both can be had, and where a fit takes it."""

import sys
from dataclasses import replace

import pytest
import torch

from herglotz.data import simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.training import FitConfig, ResidualProblem, fit, levenberg_marquardt
from herglotz.training.baseline import estimate_baseline
from herglotz.training.problems.prior import prior_of
from herglotz.training.solvers.levenberg_marquardt import _damped_step
from herglotz.training.solvers.matrix_free import Curvature, MatrixFree


def problem_of(width, freedom=None, chunk=4096, sigma=1e-3, trajectories=6):
    data = simulate(scene("damped_pendulum"), trajectories=trajectories, steps=20, h=0.5, seed=0)
    base = estimate_baseline(data)
    sizes = {k: getattr(base, k) for k in ("angles", "scale", "speed", "stiffness", "tilt", "rate")}
    model = ContactLagrangian(ModelConfig(**sizes, potential_width=0, correction_width=width))
    prior = prior_of(model, base, 6e-3)
    return ResidualProblem(model, data, sigma=sigma, prior=prior, freedom=freedom, chunk=chunk)


@pytest.mark.parametrize("freedom", [None, 3.0])
def test_the_step_is_the_dense_one(freedom):
    # fails if a product, a weight of the robust loss, the prior or a chunk is missing from JᵀJ or Jᵀr
    problem = problem_of(3, freedom, chunk=60)
    x = problem.start() + 0.1 * torch.randn(len(problem.start()), generator=torch.Generator().manual_seed(1)).double()
    cost, A, b = problem.normal_equations(x)
    found, curvature, gradient = MatrixFree(problem).normal_equations(x)
    assert isinstance(curvature, Curvature)
    torch.testing.assert_close(found, cost, rtol=1e-12, atol=0)
    torch.testing.assert_close(gradient, b, rtol=1e-10, atol=1e-10 * float(b.abs().max()))
    damping = 0.3 * A.diagonal()
    dense, step = _damped_step(A, b, damping), curvature.solve(-b, damping, tol=1e-13, iterations=2000)
    assert dense is not None
    assert step is not None
    assert float((step - dense).norm()) < 1e-8 * float(dense.norm())


def test_the_diagonal_is_estimated():
    # fails if the probes are not of the residuals' space: the estimate is then no diagonal
    problem = problem_of(6)
    _, A, _ = problem.normal_equations(problem.start())
    _, curvature, _ = MatrixFree(problem).normal_equations(problem.start())
    ratio = curvature.diagonal().sum() / A.diagonal().sum()
    assert 0.5 < float(ratio) < 2.0


def test_the_search_is_the_dense_one():
    # fails if a rejected step, the damping or the scaling is treated another way than with a matrix
    class ExactDiagonal(MatrixFree):
        def normal_equations(self, x):
            cost, curvature, gradient = super().normal_equations(x)
            return cost, replace(curvature, estimate=self.problem.normal_equations(x)[1].diagonal()), gradient

    problem = problem_of(6)
    x = problem.start()
    dense = levenberg_marquardt(problem, x, max_iterations=12)
    found = levenberg_marquardt(ExactDiagonal(problem), x, max_iterations=12)
    assert len(dense.history) > 3
    assert found.history == pytest.approx(dense.history, rel=1e-2)


def test_the_step_lowers_the_cost_as_the_dense_one_does():
    # fails if the conjugate gradients stop early: exact data then need many times the steps
    problem = problem_of(10, sigma=1e-8)
    _, A, b = problem.normal_equations(problem.start())
    _, curvature, _ = MatrixFree(problem).normal_equations(problem.start())
    damping = 1e-6 * A.diagonal().clamp_min(1e-10 * float(A.diagonal().max()))
    dense, step = _damped_step(A, b, damping), curvature.solve(-b, damping)
    assert dense is not None
    assert step is not None

    def gap(y):  # what the damped model leaves above its minimum
        return float((y - dense) @ (A @ (y - dense) + damping * (y - dense)))

    assert gap(step) < 1e-4 * gap(torch.zeros_like(step))


def test_the_search_does_not_hang_on_rounding():
    # fails if the conjugate gradients lose their orthogonality: another order of the sums then moves x by 1e-6
    one, other = (problem_of(6, chunk=chunk) for chunk in (4096, 60))
    x, y = (levenberg_marquardt(MatrixFree(p), p.start(), max_iterations=6).x for p in (one, other))
    assert float((x - one.start()).norm()) > 0.1
    torch.testing.assert_close(y, x, rtol=0, atol=1e-10)


def test_a_search_by_products_goes_on():
    # fails if it stalls after its first step
    problem = problem_of(24, trajectories=2)
    x = problem.start()
    result = levenberg_marquardt(MatrixFree(problem), x, max_iterations=18)
    assert len(result.history) > 6
    assert result.cost < 0.1 * float(problem.cost(x))


@pytest.mark.slow
def test_a_large_model_becomes_a_good_one():
    # fails if the steps are so rough that exact data are never reached: 1e-2 in place of 1e-4 ends at 2e-5
    problem = problem_of(70, sigma=1e-8)
    result = levenberg_marquardt(MatrixFree(problem), problem.start(), max_iterations=125)
    assert float(problem.residuals(result.x).square().mean().sqrt()) < 4e-6


def test_fit_takes_products_beyond_a_size(monkeypatch):
    # fails if a large model is given to the dense solver, or a small one to the other
    made = []

    def watched(problem):
        made.append(len(problem.start()))
        return MatrixFree(problem)

    module = sys.modules["herglotz.training.one_step_fit"]
    monkeypatch.setattr(module, "MatrixFree", watched)
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=20, h=0.5, seed=0)
    settings = FitConfig(objective="residual", correction_width=4, iterations=2, train_fraction=1.0)
    fit(data, settings, progress=False)
    assert not made
    monkeypatch.setattr(module, "DENSE", 20)
    fit(data, settings, progress=False)
    assert made[0] > 20
