"""The prior's normal equations."""

import pytest
import torch
from torch.func import grad, jacrev

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training.problems.prior import Prior


def prior_of(n, level, rate=0.1, **options):
    """Of a model of n lengths, and parameters away from its start."""
    one, zero = (1.0,) * n, (0.0,) * n
    config = ModelConfig(
        angles=(False,) * n, level=level, stiffness=one, tilt=zero, scale=one, speed=one, rate=rate, potential_width=4
    )
    ends = torch.ones(n, dtype=torch.float64)
    prior = Prior(ContactLagrangian(config).double(), -ends, ends, departure=0.5, **options)
    make = torch.Generator().manual_seed(0)
    return prior, prior.start + 0.1 * torch.randn(len(prior.start), generator=make, dtype=torch.float64)


@pytest.mark.parametrize(("n", "level"), [(1, "affine"), (2, "affine"), (5, "linear")])
def test_equations_are_those_of_the_residuals(n, level):
    # fails if forces and rates are weighed as each other, or a part of the grid (64 n points, at most 256) is left out
    prior, theta = prior_of(n, level)
    r, J = prior.residuals(theta), jacrev(prior.residuals)(theta)
    cost, A, b = prior.normal_equations(theta)
    assert len(r) == len(prior.index) + min(64 * n, 256) * (n + (level == "affine"))
    for found, told in ((cost, r.square().sum() / 2), (A, J.T @ J), (b, J.T @ r)):
        torch.testing.assert_close(found, told, rtol=1e-12, atol=1e-12 * float(told.abs().max()))  # 5e-16 to 3e-15


def test_twenty_coordinates_fit_into_memory():
    # fails if every output at every point is differentiated by every point: 44 GB, of which a fit to noisy data died
    prior, theta = prior_of(20, "linear")
    cost, _, b = prior.normal_equations(theta)
    torch.testing.assert_close(cost, prior.cost(theta))
    torch.testing.assert_close(b, grad(prior.cost)(theta), rtol=1e-9, atol=1e-12 * float(b.abs().max()))


@pytest.mark.parametrize(("rate", "spread"), [(0.1, 1.0), (-10.0, 10.0)])
def test_a_large_rate_is_as_free_as_it_is_large(rate, spread):
    # fails if a rate of ten is held to within the rate of the motion, 1, at the value where a fit began, in which drag
    # and weight of a falling body made up for the rest; or if a search lets the rate go
    prior, _ = prior_of(1, "linear", rate)
    (at,) = prior.parameters.index("damping.rate").tolist()
    assert float(prior.spread[prior.index == at]) == pytest.approx(spread)
    narrow, _ = prior_of(1, "linear", rate, wide_rates=False)
    assert float(narrow.spread[narrow.index == at]) == 1.0
    others = prior.spread[prior.index != at]
    torch.testing.assert_close(others, prior_of(1, "linear")[0].spread[prior.index != at])


def test_friction_is_narrow_by_the_mass_of_its_coordinate():
    # fails if the friction of an angle, whose mass is in mm² beside a length in mm, is held below 1e-5 of what it is
    # (waves of the speed made up for it), or if that of one coordinate stands for another where others are frozen
    speed = (1.0, 0.1, 10.0)
    config = ModelConfig(angles=(False,) * 3, level="forced", stiffness=(1.0,) * 3, tilt=(0.0,) * 3, scale=(1.0,) * 3,
                         speed=speed, rate=0.1, coulomb=True, potential_width=0)  # fmt: skip
    model, ends = ContactLagrangian(config).double(), torch.ones(3, dtype=torch.float64)
    prior = Prior(model, -ends, ends, departure=None, rate_spread=0.5)
    spread = dict(zip(prior.index.tolist(), prior.spread.tolist(), strict=True))
    viscous, coulomb = (prior.parameters.index(f"friction.{name}") for name in ("viscous", "coulomb"))
    assert [spread[i] for i in viscous.tolist()] == pytest.approx([0.5 * mass for mass in (1.0, 100.0, 0.01)])
    assert [spread[i] for i in coulomb.tolist()] == pytest.approx([0.5 * momentum for momentum in (1.0, 10.0, 0.1)])
    assert prior._coordinates(viscous[1:2]) == [1]
