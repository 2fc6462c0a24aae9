"""Adam: the best point, minibatches, an end by itself; and the models that only Adam takes."""

import sys
from typing import Any

import pytest
import torch

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.training import FitConfig, Prior, ResidualProblem, adam, fit
from herglotz.training.problems.one_step import SupervisedProblem


class Line:
    """½ Σ (a x − b)² over 40 rows of a line fit."""

    rows = 40

    def __init__(self):
        make = torch.Generator().manual_seed(0)
        self.a = torch.randn(40, 2, generator=make, dtype=torch.float64)
        self.b = self.a @ torch.tensor([1.0, -2.0], dtype=torch.float64)
        self.seen = []

    def cost(self, x):
        return (self.a @ x - self.b).square().sum() / 2

    def cost_and_gradient(self, x, rows=None):
        self.seen.append(rows)
        a, b = (self.a, self.b) if rows is None else (self.a[rows], self.b[rows])
        r = a @ x - b
        return r.square().sum() / 2 * 40 / len(a), a.T @ r * 40 / len(a)


def test_adam_descends():
    # fails if Adam returns its last point instead of its best, or never steps
    result = adam(Line(), torch.zeros(2, dtype=torch.float64), max_iterations=60, learning_rate=1.0)
    assert result.cost == float(Line().cost(result.x)) == min(result.history)
    assert result.cost < 0.1 * result.history[0]


def test_minibatches_take_every_row_once_a_round():
    # fails if a row is drawn twice a round, the best point is chosen by the cost of a batch, or the order has no seed
    problem, start = Line(), torch.zeros(2, dtype=torch.float64)
    result = adam(problem, start, max_iterations=400, learning_rate=0.05, batch=16)
    assert result.cost == float(problem.cost(result.x)) < 1e-6
    assert [len(rows) for rows in problem.seen[:4]] == [16, 16, 8, 16]
    assert sorted(torch.cat(problem.seen[:3]).tolist()) == list(range(40))
    assert problem.seen[0].tolist() != problem.seen[3].tolist()
    again = adam(Line(), start, max_iterations=400, learning_rate=0.05, batch=16)
    torch.testing.assert_close(again.x, result.x, rtol=0, atol=0)
    assert adam(Line(), start, max_iterations=400, batch=40).history == adam(Line(), start, max_iterations=400).history


def test_adam_stops_by_itself():
    # fails if a search that has arrived goes on to the end of its schedule
    class Flat(Line):
        def cost_and_gradient(self, x, rows=None):
            cost, gradient = super().cost_and_gradient(x, rows)
            return cost + 1.0, 0 * gradient

    result = adam(Flat(), torch.zeros(2, dtype=torch.float64), max_iterations=1000)
    assert (result.reason, result.iterations) == ("converged", 51)


def test_decay_shrinks_the_weights():
    # fails if adamw is adam: without a gradient the weights then stay
    class Flat(Line):
        def cost_and_gradient(self, x, rows=None):
            cost, gradient = super().cost_and_gradient(x, rows)
            return cost, 0 * gradient

    start = torch.ones(2, dtype=torch.float64) * torch.tensor([3.0, -3.0], dtype=torch.float64)
    kept, shrunk = (adam(Flat(), start, max_iterations=40, learning_rate=0.1, decay=d) for d in (0.0, 0.1))
    torch.testing.assert_close(kept.x, start)
    assert float(shrunk.x.norm()) < 0.95 * float(start.norm())
    assert shrunk.cost < kept.cost


@pytest.mark.parametrize("supervision", [False, True])
def test_a_batch_stands_for_all(supervision):
    # fails if a batch is not weighed to the size of all, or the prior is weighed with it
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=12, h=0.2, seed=0, keep_state=True).unwrapped()
    model = ContactLagrangian(ModelConfig(stiffness=(0.8,), rate=0.1, correction_width=3))
    prior = Prior(model, data.q.amin(0), data.q.amax(0), departure=0.1)
    with torch.no_grad():
        for p in model.parameters():
            p += 0.05
    problem: Any = SupervisedProblem(model, data, momenta=True, prior=prior) if supervision else ResidualProblem(
        model, data, prior=prior)  # fmt: skip
    x = problem.start()
    cost, gradient = problem.cost_and_gradient(x)
    assert float(cost) == pytest.approx(float(problem.cost(x)), rel=1e-12)
    torch.testing.assert_close(gradient, problem.normal_equations(x)[2], rtol=1e-9, atol=1e-12)
    parts = [problem.cost_and_gradient(x, rows) for rows in torch.arange(problem.rows).split(problem.rows // 2)]
    torch.testing.assert_close(sum(part[0] for part in parts) / 2, cost)
    torch.testing.assert_close(sum(part[1] for part in parts) / 2, gradient)


def test_a_model_too_large_for_a_matrix_is_refused_in_words(monkeypatch):
    # fails if JᵀJ of a huge network fills the memory without a word, or Adam is refused, too
    monkeypatch.setattr(sys.modules["herglotz.training.one_step_fit"], "MAX_PARAMETERS", 20)
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=20, h=0.5, seed=0)
    settings = {"objective": "residual", "correction_width": 4, "iterations": 1}
    with pytest.raises(InputError, match="more than the 20 that Levenberg–Marquardt takes; set optimiser='adam'"):
        fit(data, FitConfig(**settings), progress=False)
    assert fit(data, FitConfig(optimiser="adam", **settings), progress=False).metrics["iterations"] == 20
