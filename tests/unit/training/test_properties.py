"""Inputs that are the same throughout each recording, as a mass is, and recordings that alone have their value."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from herglotz import fit
from herglotz.data import Trajectories
from herglotz.training.left_out import LeftOut
from herglotz.training.missed import ways_of_columns
from herglotz.training.properties import own_properties, properties
from herglotz.training.summary import outlying_of
from herglotz.training.verdict import unseen_outlier

LENGTHS = (13,) * 6


def _drops(values: tuple[float, ...], bad: int, more: Any = None) -> Trajectories:
    """Drops x = v t + 4.9 t² with 1.5 mm of noise; that of the recording `bad` in honey; an input of these values."""
    of, t = torch.Generator().manual_seed(0), 0.05 * torch.arange(13).double()
    speeds = torch.rand(6, generator=of, dtype=torch.float64)
    x = torch.stack([speeds[b] * t + (1.5 if b == bad else 4.9) * t.square() for b in range(6)])
    x += 0.0015 * torch.randn(6, 13, generator=of, dtype=torch.float64)
    u = torch.tensor(values, dtype=torch.float64).repeat_interleave(13)[:, None]
    u = u if more is None else torch.cat([u, more], 1)
    names = ["mass", "drive"][: u.shape[1]]
    columns = (("x", "coordinate", "m"), *((name, "input", "") for name in names))
    return Trajectories.of(t.repeat(6), x.flatten(), LENGTHS, units=("m",), names=("x",), u=u, columns=columns)


def test_what_is_a_property():
    # fails if an input that moves, or is the same everywhere, is one; or a value that another recording has is its own
    moving = torch.arange(78.0).double()[:, None]
    data = _drops((1, 2, 2, 3, 3, 3), -1, moving)
    assert list(properties(data)) == ["mass"]
    assert [own_properties(data, b) for b in range(6)] == [("mass",), *[()] * 5]
    assert not properties(_drops((2,) * 6, -1))
    assert not properties(replace(data, u=None, columns=()))


@pytest.mark.parametrize(("values", "found"), [((1, 2, 3, 4, 5, 6), []), ((1, 1, 2, 2, 3, 3), [4])])
def test_a_recording_with_a_mass_of_its_own_is_not_left_out(capsys, values, found):
    # fails if a recording that alone has its mass is said to be of something else, or one beside another of its mass
    # is not
    run = fit(_drops(values, bad=4), progress=False)
    assert [one["recording"] for one in run.metrics["left_out"]] == found
    text = " ".join((run.summary() + run.metrics["verdict"] + capsys.readouterr().err).split())
    assert "something else" not in text
    assert ("alone has its mass" in text) == (found == [])


def test_words_of_a_recording_with_a_mass_of_its_own():
    # fails if a recording is accused, or nothing is said of 1/mass, in the verdict or in the warning
    out = LeftOut(0, 9.0, 1.0, "trajectory 0 (m200.csv)", properties=("mass",))
    ways = "a column 1/mass in its place (--inputs), as a mass acts by its inverse, or a fit of each recording"
    why = "alone has its mass, on which the law may depend otherwise than by a force"
    assert out.reason.endswith(f"is missed 9 times as far as the others, and {why}. Try {ways}")
    (said,) = outlying_of({"outlying": [out.as_dict()]}, _drops((1, 2, 3, 4, 5, 6), -1))
    assert said.startswith(f"trajectory 0 (m200.csv), counted from 0, {why}: the model misses it by 9 m")
    assert said.endswith(f"; try {ways}")


def test_an_unseen_part_with_a_mass_of_its_own():
    # fails if the recording whose unseen part is missed is accused, though it alone has its mass
    for values, said in (((1, 2, 3, 4, 5, 6), "alone has its mass"), ((1, 1, 2, 2, 3, 3), "of something else")):
        data = _drops(values, -1)
        states = data.q + 0.0015 * torch.randn(78, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        states[5 * 13 + 9 :] += 0.1
        seen: Any = type("Seen", (), {"data": data, "train": data.keep(torch.arange(78) % 13 < 9)})
        assert said in unseen_outlier(seen, states)


@pytest.mark.parametrize(
    ("columns", "ways"),
    [
        ((("mass", "left aside", "kg"),), [
            "--inputs drive,mass, which takes mass, left aside so far",
            "where mass is a number of each recording, a column 1/mass in its place (--inputs), as a mass acts by its "
            "inverse, or a fit of each recording",
        ]),
        ((("hoop speed", "left aside", "rpm"),), [
            "--inputs 'drive,hoop speed', which takes hoop speed, left aside so far, unless hoop speed is a rate of "
            "the motion",
        ]),
        ((("x speed", "left aside", "m/s"), ("speed", "left aside", "m/s"), ("temp", "left aside", "C")), []),
    ],
)  # fmt: skip
def test_columns_that_were_left_aside_are_named(columns, ways):
    # fails if a mass is an input alone, the speed of something else is not named, or a rate of the motion is
    data = _drops((1, 1, 1, 1, 1, 1), -1)
    data = replace(data, columns=(("x", "coordinate", "m"), ("drive", "input", ""), *columns))
    assert ways_of_columns(data) == ways
