"""Among terms that make nearly the same force over the recorded range, the likeliest subset is found."""

import math
from itertools import combinations

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.training import FitConfig
from herglotz.training.baseline import estimate_baseline
from herglotz.training.dictionary_search import DictionarySearch
from herglotz.training.pruning import prune
from herglotz.training.subsets import best_of_each_size, subsets


def linear_problem(seed: int):
    """x − x³ with noise over 0.2 to 1.4, powers up to x⁵ and one unknown beside them."""
    make = torch.Generator().manual_seed(seed)
    x = torch.linspace(0.2, 1.4, 100, dtype=torch.float64)
    columns = torch.stack([torch.ones_like(x), *(x**k for k in range(1, 6))], -1)
    y = 0.3 + x - x**3 + 0.05 * torch.randn(len(x), generator=make, dtype=torch.float64)
    J = columns / 0.05
    return J.T @ J, -J.T @ (y / 0.05), torch.zeros(6, dtype=torch.float64)


def test_every_subset_has_the_cost_of_its_own_fit():
    # fails if the other unknowns do not follow, the sign of the gradient is wrong, or a term has another worth
    A, b, x = linear_problem(0)
    x = x + 0.1
    b = b + A @ x  # the gradient there
    best = -torch.linalg.solve(A, b - A @ x)
    value = lambda z: float((z - best) @ A @ (z - best)) / 2  # noqa: E731
    groups = [[1], [2, 3], [4], [5]]
    found = {subset.kept: subset for subset in subsets(A, b, x, groups, worth=4.6)}
    assert len(found) == 16
    for size in range(5):
        for kept in combinations(range(4), size):
            free = [0, *(i for k in kept for i in groups[k])]
            z = torch.zeros(6, dtype=torch.float64)
            z[free] = torch.linalg.solve(A[free][:, free], (A @ best)[free])
            assert found[kept].criterion == pytest.approx(
                value(z) + 2.3 * size + math.log(math.comb(4, size)), rel=1e-6
            )
            torch.testing.assert_close(found[kept].x, z, rtol=1e-5, atol=1e-5)


def test_the_likeliest_subset_of_each_size():
    # fails if sizes are missing or out of order, or another subset of that size costs less
    A, b, _ = linear_problem(0)
    best = -torch.linalg.solve(A, b)
    every = subsets(A, torch.zeros_like(b), best, [[i] for i in (1, 2, 4)], worth=0.0)
    found = best_of_each_size(A, best, [1, 2, 4])
    assert [len(subset.kept) for subset in found] == [0, 1, 2, 3]
    for size, subset in enumerate(found):
        assert subset.criterion == min(other.criterion for other in every if len(other.kept) == size)


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_elimination_can_end_where_no_term_can_go_alone(seed):
    # fails if the likeliest subset is not sought among all: one by one, x and x³ go where their neighbours do as well
    A, b, x = linear_problem(seed)
    best, terms, worth = -torch.linalg.solve(A, b), torch.arange(1, 6), math.log(100)
    eliminated, _ = prune(A, best, terms, worth)
    assert subsets(A, b, x, [[i] for i in terms.tolist()], worth)[0].kept == (0, 2)
    assert set(eliminated.tolist()) != {1, 3}


def half_of_a_double_well(seed: int) -> Trajectories:
    """x″ = x − x³ − 0.05 x′ from rest at 0.25: it stays where x > 0; 201 samples 0.1 apart, noise 0.01."""
    x, v, h = torch.tensor([0.25], dtype=torch.float64), torch.zeros(1, dtype=torch.float64), 0.005
    force, q = (lambda x, v: x - x**3 - 0.05 * v), [x]
    for step in range(1, 4001):  # Heun's rule errs by 1e-5
        a = force(x, v)
        x, v = x + h * v + h * h / 2 * a, v + h / 2 * (a + force(x + h * v, v + h * a))
        q += [x] if step % 20 == 0 else []
    clean = torch.stack(q)
    make = torch.Generator().manual_seed(seed)
    return Trajectories.of(
        0.1 * torch.arange(201, dtype=torch.float64),
        clean + 0.01 * torch.randn(clean.shape, generator=make, dtype=torch.float64),
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_half_of_a_double_well_tells_the_other_half(seed):
    # fails if backward elimination alone decides: it kept x², x⁴ in place of x³, which follows the data at the noise
    # and runs away where nothing was recorded
    data = half_of_a_double_well(seed)
    found = DictionarySearch(data, estimate_baseline(data), FitConfig()).run()
    assert found is not None
    assert set(found.terms.names) == {"q1^2", "q1^4"}
