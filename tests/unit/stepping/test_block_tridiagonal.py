"""Block-tridiagonal systems against the dense solver of the same numbers."""

import torch

from herglotz.stepping.block_tridiagonal import diagonal_of_inverse, eliminate, multiply, solve_blocks


def blocks(samples=3, count=4, m=2):
    make = torch.Generator().manual_seed(0)
    diagonal, upper, lower = torch.randn(3, samples, count, m, m, generator=make, dtype=torch.float64)
    return diagonal + 4 * torch.eye(m, dtype=torch.float64), upper, lower


def dense(diagonal, upper, lower):
    samples, count, m = diagonal.shape[:3]
    A = torch.zeros(samples, count * m, count * m, dtype=torch.float64)
    for k in range(count):
        here = slice(k * m, (k + 1) * m)
        A[:, here, here] = diagonal[:, k]
        if k + 1 < count:
            A[:, here, (k + 1) * m : (k + 2) * m] = upper[:, k]
            A[:, (k + 1) * m : (k + 2) * m, here] = lower[:, k + 1]
    return A


def test_elimination_is_the_dense_solution():
    # fails if the elimination or the substitution back has a sign or an index wrong
    system = blocks()
    rhs = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = torch.linalg.solve(dense(*system), rhs.flatten(1)).unflatten(1, (4, 2))
    torch.testing.assert_close(eliminate(system, rhs[..., None])[..., 0], expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(multiply(system, expected), rhs, rtol=1e-12, atol=1e-12)


def test_a_singular_leading_block_is_solved_densely_and_alone():
    # fails if the sample whose first block is singular is not solved densely, only a batch of such samples is, or a
    # system without batch axes is refused
    diagonal, upper, lower = blocks()
    diagonal[1, 0] = 0.0
    rhs = torch.ones(3, 4, 2, dtype=torch.float64)
    expected = torch.linalg.solve(dense(diagonal, upper, lower), rhs.flatten(1)).unflatten(1, (4, 2))
    torch.testing.assert_close(solve_blocks((diagonal, upper, lower), rhs), expected, rtol=1e-10, atol=1e-10)
    alone = solve_blocks((diagonal[1], upper[1], lower[1]), rhs[1])
    torch.testing.assert_close(alone, expected[1], rtol=1e-10, atol=1e-10)


def test_the_diagonal_of_the_inverse():
    # fails if the elimination from either end is wrong, or the diagonal is subtracted twice
    system = blocks()
    expected = torch.linalg.inv(dense(*system)).diagonal(dim1=-2, dim2=-1).unflatten(1, (4, 2))
    torch.testing.assert_close(diagonal_of_inverse(system), expected, rtol=1e-11, atol=1e-11)
