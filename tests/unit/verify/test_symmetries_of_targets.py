"""Symmetries of scenes and runs: their states, names and precision."""

from dataclasses import replace
from importlib import import_module

import pytest
import torch

import herglotz as hz
from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.stepping import State
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


def test_angles_of_a_scene_are_angles():
    # fails if the units of a scene are forgotten: an angle is not scaled
    free = scene("linear_drag")
    found, brief = (of_target(free, samples=24, steps=k) for k in (20, 2))
    assert len(found) == 2
    assert abs(float(brief.spectrum[-1] / found.spectrum[-1]) - 1) > 0.01  # fails if `steps` is not handed on
    assert of_target(replace(free, units=("rad",)), samples=24, steps=20).names == ("translation along q",)


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
    rounded = replace(run, metrics={**run.metrics, "extrapolation_rms": 1e-16})
    assert rounded.symmetries().precision == 1e-9  # fails if a fit of exact data is held to less than rounding
    assert len(run.symmetries(steps=5, precision=1e9)) == len(found.spectrum)
    unseen = run.data.lengths[0] - run.train_lengths[0]
    assert unseen < 30
    assert run.symmetries(steps=unseen).spectrum.tolist() == found.spectrum.tolist()


def test_what_is_imposed_is_kept_to_rounding(run):
    # fails if `translations` of a fit do not reach its model
    again = hz.fit(run.data, replace(run.config, translations=("q1 + q2",)))
    found = of_target(again, precision=1e-10)
    assert found.names[0] == "translation of x and y together"
    assert again.metrics["extrapolation_rms"] < 2 * run.metrics["extrapolation_rms"]


def test_terms_are_searched_among_those_that_do_not_see_it(run):
    # fails if a translation leaves the fit to networks: of three masses it missed the free run by 8e-3, not 1e-3
    fitted = hz.fit(run.data, translations=("q1 + q2",))
    assert fitted.model.config.features == ("(q1 - q2)^2",)
    assert fitted.model.config.level == "linear"
    assert fitted.metrics["extrapolation_rms"] < 1.1 * run.metrics["extrapolation_rms"]
    assert float(fitted.symmetries().drift[0]) < 1e-12
    assert str(fitted.equation()).split("y″ = ")[1].startswith("−0.2")  # y is damped as x is


def test_the_mass_of_what_moves_apart_is_not_left_open(run):
    # fails if the relative motion has no spring to start from: a network that makes its whole force is held small by
    # its prior, with it the relative mass, and det M goes to 0 (2e-5 of a mass; measured now: masses 1, 1.0004, −3e-4)
    fitted = hz.fit(run.data, level="linear", objective="trajectory", departures=(1e-3,), translations=("q1 + q2",))
    mass = fitted.model.kinetic.mass().detach()  # pyright: ignore
    assert float((mass - torch.eye(2)).abs().max()) < 0.02
    assert fitted.metrics["extrapolation_rms"] < 2 * run.metrics["extrapolation_rms"]
    assert "(x − y)²" in str(fitted.equation())
    assert fitted.metrics["rate"] == pytest.approx(0.2, abs=0.005)  # fails if drift is taken for a spring's motion


def test_what_cannot_be_searched_is_refused(run):
    # fails if a stepper, whose L_d is unknown, is searched, or a run without numbers about itself gets a precision
    bare = replace(run, metrics={})
    with pytest.raises(InputError, match="does not say how precise it is; give precision="):
        of_target(bare)
    assert of_target(bare, precision=1e-2).names[0] == "translation of x and y together"
    with pytest.raises(InputError, match="has no L_d to look into"):
        of_target((_Map(), (torch.ones(3, 2), torch.ones(3, 2), torch.ones(3))), h=0.1)


def test_motions_start_beside_the_recorded_ones():
    # fails if p is not spread, so that J is one number on one undamped motion, or spread far beyond what was recorded
    q, make = torch.zeros(4000, 2).double(), torch.Generator().manual_seed(0)
    p = torch.tensor([2.0, 0.1]).double() * torch.randn(4000, 2, generator=make, dtype=torch.float64)
    opened = import_module("herglotz.verify.verifier")._opened(State(q, p, q[:, 0]), make)
    ratio = (opened.p - p).std(0) / p.std(0)
    assert bool(((ratio > 0.27) & (ratio < 0.33)).all())
    assert bool((opened.q == q).all())


class _Map:
    """A stepper without an L_d."""

    def step(self, state, h):
        return state, h
