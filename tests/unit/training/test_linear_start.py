"""The linear problem that a search starts from: masses of coordinates that hardly act on one another."""

import math

import pytest
import torch

from herglotz.data.windows import Triples
from herglotz.training import linear_start
from herglotz.training.linear_start import LinearFit

NAMES = ("mass", "mass", "potential.stiffness", "potential.stiffness", "potential.features.sum.coefficient")


def weakly_coupled(seed: int, noise: tuple[float, float], samples: int = 500) -> LinearFit:
    """q₁″ = −3 q₁ − 0.5 (q₁ − q₂), 2 q₂″ = −8 q₂ + 0.5 (q₁ − q₂), with noise of these sizes in the accelerations."""
    make = torch.Generator().manual_seed(seed)
    q, e = torch.randn(2, 2, samples, generator=make, dtype=torch.float64)
    between = 0.5 * (q[0] - q[1])
    a = -3 * q[0] - between + noise[0] * e[0], (-8 * q[1] + between) / 2 + noise[1] * e[1]
    R, J = torch.zeros(samples, 2, 5, dtype=torch.float64), torch.zeros(samples, 2, 2, 5, dtype=torch.float64)
    for i in range(2):
        R[:, i, i], R[:, i, 2 + i], J[:, i, i, i] = -a[i], -q[i], -1.0
    R[:, 0, 4], R[:, 1, 4] = -(q[0] - q[1]), q[0] - q[1]
    return LinearFit(R, J, NAMES)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("noise", [(0.5, 0.1), (0.1, 0.5)])
def test_a_mass_is_not_made_large_by_small_errors_of_its_coordinate(seed, noise):
    # fails if the eigenvector is the start: the coordinate that errs least counts ever more, and its mass came out 500
    # to 1900 times as large, or 0.04 to 0.17 times. Over 40 seeds its logarithm has a standard deviation of 0.05 and
    # 0.10, which noise gives it
    fit = weakly_coupled(seed, noise)
    x = fit.solve(torch.ones(5, dtype=torch.bool))
    assert math.log(float(x[1] / x[0]) / 2) == pytest.approx(0, abs=0.4)
    assert (x[2:3] / x[0]).tolist() == pytest.approx([3], rel=0.1)


def test_exact_accelerations_give_the_exact_coefficients():
    # fails if the search after the eigenproblem leaves a minimum at 0
    x = weakly_coupled(0, (0.0, 0.0)).solve(torch.ones(5, dtype=torch.bool))
    assert (x / x[0]).tolist() == pytest.approx([1, 2, 3, 8, 0.5], rel=1e-9)


def test_coefficients_that_no_mass_matrix_has_are_left_alone():
    # fails if the search starts where a mass is negative, and ends in an error of the linear algebra
    fit = weakly_coupled(0, (0.1, 0.1))
    x = torch.tensor([1.0, -2.0, 3.0, 8.0, 0.5], dtype=torch.float64)
    assert fit._misfit(x) == math.inf
    assert torch.equal(fit._polished(x), x)


def test_single_precision_gives_numbers():
    # fails if an error of 0 is divided by a size that float32 has not: 1e-300
    fit = weakly_coupled(0, (0.0, 0.0))
    x = torch.tensor([1.0, 2.0, 3.0, 8.0, 0.5])
    single = LinearFit(torch.zeros_like(fit.R).float(), fit.J.float(), NAMES)
    assert math.isfinite(single._misfit(x))
    assert torch.equal(single._polished(x), x)


@pytest.mark.parametrize("large", [2.0**10, 2.0**40])
@pytest.mark.parametrize(
    ("angles", "names"), [((False, False), ("q1^4", "(q1 - q2)^2")), ((True, True), ("cos(q1)", "cos(q1 - q2) v1 v2"))]
)
def test_columns_are_derivatives(monkeypatch, angles, names, large):
    # fails if a column is not linear in its coefficient (a difference then changes with its size), or loses digits
    make = torch.Generator().manual_seed(0)
    q0, q1, q2, u = torch.randn(4, 7, 2, generator=make, dtype=torch.float64)
    h0, h1 = 0.1 + torch.rand(2, 7, generator=make, dtype=torch.float64)
    t, rows = Triples(q0, q1, q2, h0, h1, torch.arange(7)), []
    drag = ("|v1| v1" if all(angles) else "q1^2 v1",)
    for size in (linear_start.LARGE, large):
        monkeypatch.setattr(linear_start, "LARGE", size)
        balance = torch.ones(2, dtype=torch.float64)
        rows.append(LinearFit.of(angles, names, t, balance, drag=drag, dry=(1.0, 1.0), u=u))
    assert set(rows[0].names) >= {"drag.coefficient", "friction.coulomb", "friction.input_map", "friction.viscous"}
    torch.testing.assert_close(rows[0].R, rows[1].R, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(rows[0].J, rows[1].J, rtol=1e-10, atol=1e-10)
