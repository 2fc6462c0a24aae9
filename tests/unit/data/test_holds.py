"""What inputs do between samples: values, thinning and files."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories, load
from herglotz.errors import InputError


def recorded(hold="", count=40) -> Any:
    """Two trajectories at uneven times whose input is a cubic of time."""
    make = torch.Generator().manual_seed(0)
    t = torch.rand(2, count, generator=make, dtype=torch.float64).add_(0.2).cumsum(1).flatten() / 5
    u = torch.stack([t**3 - t, 2 * t], -1)
    return Trajectories.of(t, torch.sin(t), (count, count), u=u, hold=hold)


@pytest.mark.parametrize(("hold", "powers"), [("zero", 1), ("first", 2), ("smooth", 8)])
def test_a_hold_is_exact_on_its_polynomials(hold, powers):
    # fails if steps are taken for equal, a stencil reaches into the next trajectory, or a row is off by one
    data = recorded(hold)
    inside = torch.arange(80) % 40 != 39
    row, part = torch.arange(80)[inside], torch.full((78,), 0.3, dtype=torch.float64)
    time = data.t[row] + 0.3 * (data.t[row + 1] - data.t[row])
    for k in range(powers):
        own = data.trajectory * 3.0  # each trajectory has a polynomial of its own
        found: Any = replace(data, u=(data.t**k + own)[:, None]).inputs_of_steps(row, part)
        torch.testing.assert_close(found[:, 0], time**k + own[row], rtol=1e-9, atol=1e-12)
    assert torch.equal(data.inputs_of_steps()[39], data.u[39])


def test_thinned_inputs_are_those_of_steps():
    # fails if the mean over a longer step takes samples for steps, or is held again afterwards
    data = recorded("first")
    h = data.t[1:5] - data.t[:4]
    mean = ((data.u[:4] + data.u[1:5]) / 2 * h[:, None]).sum(0) / h.sum()
    thinned = data.thinned(4)
    assert thinned.hold == "zero"
    torch.testing.assert_close(thinned.inputs_of_steps()[0], mean)
    assert data.thinned(1).hold == "first"


def test_an_unknown_hold_is_refused(tmp_path):
    # fails if a typing error in a file is taken for "not said"
    (tmp_path / "a.csv").write_text("# hold: frist\nt,x,u\n0,0,1\n1,1,1\n2,2,1\n")
    with pytest.raises(InputError, match="unknown hold 'frist' of the inputs; choose one of zero, first, smooth"):
        load(tmp_path / "a.csv")
