"""A motion that leaves what was recorded is said to: which quantity, how far, since when."""

import math
from dataclasses import replace

import torch

from herglotz.data import Trajectories
from herglotz.data.units import span
from herglotz.training.recorded_range import farthest, near_recorded, quantities_outside, range_in_words, warning

BOX = {"q_low": [-1.0, 2.0], "q_high": [1.0, 4.0], "p_low": [-3.0, -1.0], "p_high": [3.0, 1.0]}
LIKE = Trajectories.of(
    torch.arange(4.0, dtype=torch.float64), torch.zeros(4, 2, dtype=torch.float64), names=("x", "phi"),
    units=("m", "rad"), angles=(False, True),
)  # fmt: skip
INSIDE = torch.tensor([[0.0, 3.0]], dtype=torch.float64).repeat(4, 1)


def test_a_motion_inside_is_not_noted():
    # fails if an angle is not counted modulo 2π, the ends of a range do not belong to it, or NaN counts as outside
    q = INSIDE.clone()
    q[1], q[2, 1] = torch.tensor([1.0, 4.0]), 3.0 + 6 * math.pi
    q[3] = torch.nan
    assert quantities_outside(BOX, LIKE, LIKE.t, q, 0 * INSIDE) == []
    assert quantities_outside({}, LIKE, LIKE.t, 100 + q, q) == []


def test_what_leaves_how_far_and_since_when():
    # fails if q and p, the low and the high end, the width, or the first time outside are mixed up
    q, p = INSIDE.clone(), 0 * INSIDE
    q[2:, 0] = torch.tensor([-1.5, -2.0])
    p[1, 1] = 5.0
    found = quantities_outside(BOX, LIKE, 10 + LIKE.t, q, p)
    assert [(x.coordinate, x.quantity, x.by, x.since) for x in found] == [
        ("x", "position", 0.5, 12.0), ("phi", "momentum", 2.0, 11.0),
    ]  # fmt: skip
    text = warning(found, "s")
    assert "the position of x (-1 to 1 m) by 50 % of its width, since t = 12 s" in text
    assert "the momentum of phi (-1 to 1) by 2e+02 % of its width, since t = 11 s" in text
    assert warning([], "s") == ""


def test_a_hair_beyond_is_not_told():
    # fails if a recording that is predicted again is said to leave its own range, or the margin is of no width
    q = INSIDE.clone()
    q[2, 0], q[3, 0] = 1.019, 1.021
    (found,) = quantities_outside(BOX, LIKE, LIKE.t, q, 0 * INSIDE)
    assert (found.since, round(found.by, 4)) == (3.0, 0.0105)
    q[3, 0] = 1.019
    assert quantities_outside(BOX, LIKE, LIKE.t, q, 0 * INSIDE) == []


def test_of_several_motions_the_farthest_is_told():
    # fails if the nearest one, or another trajectory's number, is told
    q = INSIDE.clone()
    q[3, 0] = 2.0
    p = torch.zeros_like(q)
    near, far = (
        quantities_outside(BOX, LIKE, LIKE.t, q, p),
        quantities_outside(BOX, LIKE, LIKE.t, q * torch.tensor([2.0, 1.0]), p + 2),
    )
    x, phi = farthest([[], near, far, near])
    assert (x.coordinate, x.quantity, x.by, x.trajectory) == ("x", "position", 1.5, 2)
    assert (phi.coordinate, phi.quantity, phi.by, phi.trajectory) == ("phi", "momentum", 0.5, 2)
    # a batch of the same times in one go
    several = torch.stack([INSIDE, q, q * torch.tensor([2.0, 1.0]), q]), torch.stack([p, p, p + 2, p])
    assert {x, phi} == set(quantities_outside(BOX, LIKE, LIKE.t, *several))


def test_the_recorded_range_in_words():  # fails if low and high, or the unit, are lost
    assert range_in_words(BOX, LIKE) == "x -1 to 1 m, its momentum -3 to 3; phi 2 to 4 rad, its momentum -1 to 1"


def test_a_range_without_width_is_one_number():  # fails if steps are "0.05 to 0.05 s"
    assert (span((0.05, 0.05 + 1e-9), "s"), span((-1.0, 2.0), "m"), span((0.1, 0.2))) == (
        "0.05 s",
        "-1 to 2 m",
        "0.1 to 0.2",
    )


def test_what_was_recorded_in_degrees_is_told_in_degrees():
    # fails if a reader whose file has degrees is told of radians alone, or a momentum is turned
    like = replace(LIKE, columns=(("phi", "coordinate", "deg"),))
    assert range_in_words(BOX, like).endswith("; phi 2 to 4 rad = 115 to 229 deg, its momentum -1 to 1")
    q = INSIDE.clone()
    q[2:, 1] = 1.0
    found = quantities_outside(BOX, like, LIKE.t, q, q)
    text = warning(found, "s")
    assert "the position of phi (2 to 4 rad = 115 to 229 deg) by 50 % of its width" in text
    assert "the momentum of phi (-1 to 1) by" in text


def test_zero_width_is_no_division_by_zero():  # fails if a coordinate that never moved leaves by inf % of no width
    box = {"q_low": [0.0, 0.0], "q_high": [0.0, 0.0], "p_low": [0.0, 0.0], "p_high": [0.0, 0.0]}
    (found,) = quantities_outside(box, LIKE, LIKE.t, torch.tensor([[0.0, 0.0]] * 3 + [[1.0, 0.0]]), torch.zeros(4, 2))
    assert found.by == math.inf
    assert warning([found], "s").endswith(": the position of x (0 m throughout), since t = 3 s")


def test_states_that_leave_the_recording_are_no_recorded_range():
    # fails if a pole within 4 degrees is said to be recorded up to 246, where its model falls over, if a reading that
    # was not recorded counts, or the noise of the ends takes states away
    q = torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0]).double()
    observed = torch.ones(5, 2, dtype=torch.float64)
    observed[4, 1] = 0.0
    data = Trajectories.of(torch.arange(5.0).double(), q, observed=observed)
    states = torch.cat([q, 0 * q, 0 * q[:, :1]], 1)
    states[0, 1], states[2, 1] = -2.01, 70.0
    assert near_recorded(states, data)[:, 1].tolist() == [-2.01, -1.0, 1.0]
    assert near_recorded(states, replace(data, observed=None))[:, 1].tolist() == [-2.01, -1.0, 1.0, 2.0]
    # A model that is lost everywhere has its own range.
    assert len(near_recorded(states + 100, data)) == 5
