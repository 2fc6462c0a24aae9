"""`benchmarks/function_bands.py`: its laws are what their parts say, and its table counts every function."""

import numpy as np
import pytest

from benchmarks import function_bands
from benchmarks.function_bands import KINDS, law


@pytest.mark.parametrize("kind", KINDS)
def test_a_law_moves_as_its_parts_say(kind):
    # fails if the truth that bands are measured against is not that of the motion: M q̈ = −½ M′ q̇² − V′ − f
    of, e = law(kind, np.random.default_rng(3)), 1e-5
    q, v = np.linspace(-0.9, 0.8, 7), np.linspace(-0.5, 0.6, 7)
    a, _ = of.mechanism.slope(q[:, None], v[:, None], np.zeros((7, 0)), np.zeros(7))
    bend = (of.mass(q + e) - of.mass(q - e)) / (2 * e)
    wanted = (-bend * v * v / 2 - of.slope(q) - of.friction(q, v)) / of.mass(q)
    np.testing.assert_allclose(a[:, 0], wanted, atol=1e-7)


def test_the_table_has_the_mean_of_all_functions():
    # fails if a function is left out of the mean, or a law without a function has a cell of zeros
    force = {"inside": 1.0, "error": 0.02, "mean_error": 0.01}
    seeds = [{"functions": {"force": force}}, {"functions": {"force": {**force, "inside": 0.7}, "mass": force}}]
    rows = {"well": {"commit": "abc", "seeds": seeds}}
    assert function_bands.shares(rows) == {"force": [1.0, 0.7], "mass": [1.0]}
    text = function_bands.table(rows)
    assert "| well |  | 85 %, 2.0e-02, 1.0e-02 (2) |  |  | 100 %, 2.0e-02, 1.0e-02 (1) | abc |" in text
    assert "90.0 % of all points" in text
