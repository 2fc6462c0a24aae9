"""Symmetries of scenes and runs: their states, names and precision."""

from dataclasses import replace

import pytest
import torch

import herglotz as hz
from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.verify import symmetries as of_target


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("kepler", ("rotation in the plane (x, y)",)),
        ("double_pendulum", ()),
        ("chain", ()),
        ("cart_pole", ("translation along x",)),
    ],
)
def test_scenes(name, expected):
    # fails if an angle is taken for a length, or gravity's double pendulum is given a symmetry
    found = of_target(name, samples=24, steps=20)
    assert found.names == expected
    assert found.coordinates == scene(name).coordinates


@pytest.fixture(scope="module")
def run():
    """Two bodies and a spring between them, free in space, with a little noise; named terms."""
    t, make = 0.2 * torch.arange(60).double(), torch.Generator().manual_seed(0)
    drift = lambda a, v: a + v / 0.2 * (1 - torch.exp(-0.2 * t))  # noqa: E731  q̈ = −0.2 q̇
    w = (2 * 1.1 - 0.01) ** 0.5
    swing = torch.exp(-0.1 * t) * (0.6 * torch.cos(w * t) + 0.3 * torch.sin(w * t))
    q = torch.cat([torch.stack([drift(a, v) + x * swing, drift(a, v) - x * swing], -1) for a, v, x in
                   ((0.0, 0.4, 1.0), (0.5, -0.3, 0.5), (-0.5, 0.1, -0.8))])  # fmt: skip
    q = q + 1e-3 * torch.randn(q.shape, generator=make, dtype=torch.float64)
    data = Trajectories.of(t.repeat(3), q, (60, 60, 60), names=("x", "y"))
    return hz.fit(data, level="linear", features=("(q1 - q2)^2",), objective="trajectory", potential_width=0)


def test_a_learned_translation_is_found_within_the_error_of_the_free_run(run):
    # fails if the precision is not that of the run, or its motions are not those of the unseen part
    found = run.symmetries()
    assert found.names[0] == "translation of x and y together"
    assert found.precision == pytest.approx(3 * run.metrics["extrapolation_rms"] / run.metrics["spread"])
    assert float(found.drift[0]) < found.precision < 0.1 * float(found.spectrum[len(found)])
    assert found.gap > 10  # measured 40
    exact = run.symmetries(
        precision=1e-9
    ).names  # a quadratic L_d is scaled; weak springs to the origin are learned, too
    assert [name for name in exact if not name.startswith("scaling")] == []
    assert len(run.symmetries(steps=5, precision=1e9)) == len(found.spectrum)


def test_what_is_imposed_is_kept_to_rounding(run):
    # fails if `translations` of a fit do not reach its model
    again = hz.fit(run.data, replace(run.config, translations=("q1 + q2",)))
    found = of_target(again, precision=1e-10)
    assert found.names[0] == "translation of x and y together"
    assert again.metrics["extrapolation_rms"] < 2 * run.metrics["extrapolation_rms"]


def test_what_cannot_be_searched_is_refused(run):
    # fails if a stepper, whose L_d is unknown, is searched, or a run without numbers about itself gets a precision
    bare = replace(run, metrics={})
    with pytest.raises(InputError, match="does not say how precise it is; give precision="):
        of_target(bare)
    assert of_target(bare, precision=1e-2).names[0] == "translation of x and y together"
    with pytest.raises(InputError, match="has no L_d to look into"):
        of_target((_Map(), (torch.ones(3, 2), torch.ones(3, 2), torch.ones(3))), h=0.1)


class _Map:
    """A stepper without an L_d."""

    def step(self, state, h):
        return state, h
