"""States: which samples are numbers throughout."""

import math

import pytest
import torch

from herglotz import State


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("part", range(3))
def test_a_sample_is_finite_where_all_of_its_numbers_are(bad, part):
    # fails if q, p, s or a coordinate is ignored, or samples share their result
    state = State(torch.ones(2, 3, 2), torch.ones(2, 3, 2), torch.ones(2, 3))
    assert state.finite.tolist() == [[True] * 3] * 2
    state[part][1, 2] = torch.tensor([1.0, bad]) if part < 2 else bad
    assert state.finite.tolist() == [[True] * 3, [True, True, False]]
