"""Gauss–Newton by products: the dense step where both can be had, and a model that is too large for a matrix."""

import sys

import pytest
import torch

from herglotz.data import simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.systems import scene
from herglotz.training import FitConfig, ResidualProblem, fit, levenberg_marquardt
from herglotz.training.baseline import estimate_baseline
from herglotz.training.levenberg_marquardt import _damped_step
from herglotz.training.matrix_free import DENSE, Curvature, MatrixFree
from herglotz.training.trajectory_fit import make_prior


def problem_of(width, freedom=None, chunk=4096):
    data = simulate(scene("damped_pendulum"), trajectories=6, steps=20, h=0.5, seed=0)
    base = estimate_baseline(data)
    sizes = {k: getattr(base, k) for k in ("angles", "scale", "speed", "stiffness", "tilt", "rate")}
    model = ContactLagrangian(ModelConfig(**sizes, potential_width=0, correction_width=width))
    prior = make_prior(model, base, 6e-3)
    return ResidualProblem(model, data, sigma=1e-3, prior=prior, freedom=freedom, chunk=chunk)


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


def test_a_model_too_large_for_a_matrix_is_fitted():
    # fails if the search by products does not descend
    problem = problem_of(70)
    x = problem.start()
    assert len(x) > DENSE
    result = levenberg_marquardt(MatrixFree(problem), x, max_iterations=1)
    assert result.cost < 0.5 * float(problem.cost(x))


def test_fit_takes_products_beyond_a_size(monkeypatch):
    # fails if a large model is given to the dense solver, or a small one to the other
    made = []

    def watched(problem):
        made.append(len(problem.start()))
        return MatrixFree(problem)

    module = sys.modules["herglotz.training.fit"]
    monkeypatch.setattr(module, "MatrixFree", watched)
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=20, h=0.5, seed=0)
    settings = FitConfig(objective="residual", correction_width=4, iterations=2, train_fraction=1.0)
    fit(data, settings, progress=False)
    assert not made
    monkeypatch.setattr(module, "DENSE", 20)
    fit(data, settings, progress=False)
    assert made[0] > 20
