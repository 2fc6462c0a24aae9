"""The unit of length decides nothing: no constant of a search has one."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig
from herglotz.training.baseline import estimate_baseline
from herglotz.training.search import Search
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt


@cache  # the fit in its own unit stands beside both others
def _found(unit: float):
    data = simulate(scene("duffing"), trajectories=2, steps=60, h=0.1, seed=0)
    data = replace(data, q=unit * data.q, p=None, s=None)
    search = Search(data, estimate_baseline(data), FitConfig())
    search.order = 2  # as of noisy data: a kernel of order 4 takes four times as long
    return search.run()


@pytest.mark.parametrize("unit", [1e-15, 1e15])
def test_the_unit_of_length_decides_nothing(unit):
    # fails if Levenberg–Marquardt, the linear problem or its pruning hold back or round away what is small in this
    # unit: clean data of size 1e-12 were not followed.
    one, other = _found(1.0), _found(unit)
    assert one is not None
    assert other is not None
    assert other.taken == one.taken == {"q1^2", "q1^4"}
    (number,) = [name for name, key in one.fitter.keys.items() if key == "q1^4"]
    assert other.values[number] * unit**2 == pytest.approx(one.values[number], rel=1e-6)


def test_unknowns_of_any_size_are_found():  # fails if the damping of a small unknown is another's
    class Problem:
        J = torch.tensor([[1e20, 1.0], [1e20, 2.0], [-1e20, 1.0]], dtype=torch.float64)

        def residual(self, x):
            return self.J @ x - torch.tensor([2.0, 3.0, 0.0], dtype=torch.float64)

        def cost(self, x):
            return self.residual(x).square().sum() / 2

        def normal_equations(self, x):
            return self.cost(x), self.J.T @ self.J, self.J.T @ self.residual(x)

    found = levenberg_marquardt(Problem(), torch.zeros(2, dtype=torch.float64), max_iterations=20)
    assert (found.x * torch.tensor([1e20, 1.0])).tolist() == pytest.approx([1.0, 1.0])
