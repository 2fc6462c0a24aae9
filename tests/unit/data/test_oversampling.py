"""How sparsely a recording tells its motion."""

import math

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.data.roughness import SMOOTH, _missed, sparsest


def sines(samples, a_period, noise=0.0, lengths=None):
    """A sine with so many samples a period; times jitter by a tenth of a step."""
    make = torch.Generator().manual_seed(0)
    draw = lambda: torch.rand(samples, generator=make, dtype=torch.float64)  # noqa: E731
    t = torch.arange(samples, dtype=torch.float64) + 0.1 * draw()
    return Trajectories.of(t, (2 * math.pi / a_period * t).sin() + noise * (draw() - 0.5), lengths)


def test_smooth_recordings_are_thinned_to_what_their_motion_asks_for():
    # fails if the cubic's weights or its middle are wrong: on a sine it misses by 3/128 (2π every/period)⁴ / √2
    for period in (150, 600):
        every = sparsest(sines(10_000, period))
        missed = lambda m, period=period: 3 / 128 * (2 * math.pi * m / period) ** 4  # noqa: E731  over the RMS
        assert missed(every) < 1.2 * SMOOTH
        assert missed(1.5 * every) > 0.8 * SMOOTH or 1.5 * every * 500 > 10_000


@pytest.mark.parametrize("given", [(10_000, 20), (900, 600), (10_000, 600, 0.01)])
def test_what_has_to_stay_stays(given):  # fails if coarse, short or noisy recordings lose samples
    assert sparsest(sines(*given)) == 1


def test_no_cubic_crosses_from_one_trajectory_to_the_next():  # fails if windows run over the ends of trajectories
    one = sines(2000, 200)
    jump = torch.where(torch.arange(2000)[:, None] < 1000, one.q, one.q + 5)
    plain, broken = (_missed(Trajectories.of(one.t, q, (1000, 1000)), 4) for q in (one.q, jump))
    assert broken == pytest.approx(plain)
