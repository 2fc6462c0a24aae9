"""Waves of known frequency as inputs."""

import math

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.data.input_terms import waves, with_waves
from herglotz.errors import InputError

F64 = torch.float64


def test_waves():
    # fails if the columns are in another order, or a recording with inputs loses them
    t = torch.tensor([0.0, 0.5, 1.0], dtype=F64)
    assert waves(t, (2.0, 3.0))[1].tolist() == [math.cos(1.0), math.sin(1.0), math.cos(1.5), math.sin(1.5)]
    data = Trajectories.of(t, t)
    assert with_waves(data, ()) is data
    twice = with_waves(with_waves(data, (2.0,)), (2.0,))
    assert twice.hold == "smooth"
    assert twice.u is not None
    assert twice.u.shape == (3, 2)
    assert twice.input_labels == (("cos(2 t)", ""), ("sin(2 t)", ""))
    with pytest.raises(InputError, match=r"samples 0.5 apart show no angular frequency above 6.283, got 7"):
        with_waves(data, (1.0, 7.0))
    with pytest.raises(InputError, match="holds inputs u, and frequencies would be inputs, too"):
        with_waves(Trajectories.of(t, t, u=t), (2.0,))
    with pytest.raises(InputError, match="holds inputs u"):  # as many columns, of other numbers
        with_waves(Trajectories.of(t, t, u=torch.ones(3, 2, dtype=F64)), (2.0,))
    with pytest.raises(InputError, match=r"must be positive numbers, got \(-1.0,\)"):
        with_waves(data, (-1.0,))
