"""The one Newton iteration: samples apart, bad starts, singular Jacobians, and one sample in plain numbers."""

import math

import pytest
import torch

from herglotz.mechanics.newton import Point, Rules, _eliminate_numbers, attached, find_root, largest, newton

EPS = torch.finfo(torch.float64).eps


def arctangent(x):
    """Its full Newton steps overshoot from |x| > 1.39: without backtracking they diverge."""
    return x.atan() - 0.3, torch.diag_embed(1 / (1 + x * x))


def test_backtracking_and_samples_apart():
    # fails if a step is taken that makes things worse, or one sample's fraction of a step is another's
    start = torch.tensor([[20.0], [0.1], [-400.0]], dtype=torch.float64)
    root = find_root(arctangent, start)
    assert root.converged.tolist() == [True] * 3
    torch.testing.assert_close(root.x[:, 0], torch.full((3,), 0.3, dtype=torch.float64).tan(), rtol=0, atol=4 * EPS)
    for i in range(3):
        assert torch.equal(find_root(arctangent, start[i : i + 1]).x[0], root.x[i])


def test_what_cannot_be_solved_is_given_up():
    # fails if a singular Jacobian is an exception, or a sample without a solution is called converged
    def equations(x):
        return x * x + torch.tensor([[1.0], [-4.0], [0.0]], dtype=torch.float64), torch.diag_embed(2 * x)

    root = find_root(equations, torch.tensor([[0.7], [3.0], [0.0]], dtype=torch.float64))
    assert root.converged.tolist() == [False, True, False]
    assert root.solved[:, 0].isnan().tolist() == [True, False, True]


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_one_sample_takes_the_same_iterations_in_plain_numbers(n, keep):
    # fails if a rule of one of the two is not that of the other
    A = torch.eye(n, dtype=torch.float64) + 0.3 * torch.ones(n, n, dtype=torch.float64).tril(-1)
    scale = torch.arange(1.0, n + 1, dtype=torch.float64)

    def equation(x, second):
        y = x @ A.T
        return Point((y * scale).atan() - 0.3, (scale / (1 + (y * scale) ** 2))[..., None] * A if second else None)

    x = torch.full((1, n), 9.0, dtype=torch.float64)
    rules = Rules(4 * EPS, 60, keep=keep)
    one = newton(equation, x, rules, lambda *_: (1.0, 1e3 * EPS), alone=True)
    many = newton(
        equation, x, rules, lambda x, *_: (torch.ones_like(x[..., 0]), 1e3 * EPS * torch.ones_like(x[..., 0]))
    )
    assert one.iterations == many.iterations > 3
    assert bool(one.done.all() & many.done.all())
    torch.testing.assert_close(one.x, many.x, rtol=0, atol=4 * EPS)
    assert float(largest(equation(one.x, False).F)) < 1e-15


@pytest.mark.parametrize("batch", [(), (1,), (1, 1)])
def test_one_sample_under_any_axes(batch):
    # fails if what is known of a sample without a batch, or with two axes of one, is of another shape
    x = torch.full((*batch, 2), 0.4, dtype=torch.float64)
    sizes = lambda *_: (1.0, 1e3 * EPS)  # noqa: E731
    one = newton(lambda x, _: Point(*arctangent(x)), x, Rules(4 * EPS, 60), sizes, alone=True)
    assert one.merit.shape == one.residual.shape == one.done.shape == batch


def test_a_solution_gets_its_derivative():
    # fails if the slope that is attached has the wrong sign, or the value moves
    a = torch.tensor([2.0], dtype=torch.float64, requires_grad=True)
    root = find_root(lambda x: (x * x - a.detach(), torch.diag_embed(2 * x)), torch.ones(1, dtype=torch.float64))
    x = attached(root.x, root.J, root.x * root.x - a)
    torch.testing.assert_close(x, torch.tensor([2.0**0.5], dtype=torch.float64), rtol=0, atol=EPS)
    (slope,) = torch.autograd.grad(x.sum(), a)
    torch.testing.assert_close(slope, 0.5 / x.detach(), rtol=0, atol=EPS)


@pytest.mark.parametrize("matrix", [[2.0, 1.0, -3.0, 0.5], [0.0, 1.0, 2.0, 5.0], [1.0, 2.0, 4.0, 9.0]])
def test_two_equations_are_solved_by_hand(matrix):
    # fails if a row is not exchanged with its right side, or a factor has another sign; small whole numbers are exact
    J = torch.tensor(matrix, dtype=torch.float64).reshape(2, 2)
    move = torch.tensor(_eliminate_numbers(*[*matrix, 3.0, -1.0]), dtype=torch.float64)
    torch.testing.assert_close(J @ move, torch.tensor([-3.0, 1.0], dtype=torch.float64), rtol=0, atol=1e-14)


@pytest.mark.parametrize("matrix", [[0.0, 1.0, 0.0, 2.0], [1.0, 2.0, 2.0, 4.0]])
def test_two_singular_equations_move_nowhere(matrix):  # fails if a division by zero is raised
    assert all(math.isnan(x) for x in _eliminate_numbers(*[*matrix, 3.0, -1.0]))


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize(("steep", "third"), [(30.0, -4.5e-5), (1.5, -5e-5)])
def test_an_old_jacobian_that_misleads(steep, third, alone):
    # fails if a move by an old Jacobian that raises |F| thirtyfold is taken, as where sharp friction turns joints back,
    # or one that lowers it slowly is not: the third trial is at half of the first move, or one move on
    tried = []

    def equation(x, second):
        tried.append(float(x))
        slope = torch.where(x < 0, steep, 1.0)
        return Point(slope * x + 1e-4, slope[..., None] if second else None)

    def sizes(*_):
        return (1.0, 1e3 * EPS) if alone else (torch.ones(1).double(), 1e3 * EPS * torch.ones(1).double())

    found = newton(equation, torch.full((1, 1), 1e-5).double(), Rules(4 * EPS, 60, keep=True), sizes, alone=alone)
    assert bool(found.done.all())
    assert tried[:3] == pytest.approx([1e-5, -1e-4, third], rel=1e-6)
