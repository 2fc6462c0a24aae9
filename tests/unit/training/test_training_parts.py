"""Small decisions of a fit, each alone: units of parameters, what starts it, which features are tried."""

import math
from types import SimpleNamespace

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.training import FitConfig
from herglotz.training.baseline import estimate_baseline
from herglotz.training.equation_words import own_term
from herglotz.training.quantities import DIMENSIONS, _unit, rounded
from herglotz.training.structure import dictionaries, start_of_features
from herglotz.training.task import drag_starts_the_fit

T = torch.arange(60, dtype=torch.float64) * 0.1


def test_units_of_parameters():  # fails if a power of time or length is another: mass 1, forces are accelerations
    run = SimpleNamespace(data=SimpleNamespace(units=("m", "rad"), dof=2, time_unit="s"))
    run.data.input_labels, run.model = (("torque", "N m"), ("gate", "")), SimpleNamespace(inputs=2)
    found = {name: _unit(name, run, 0) for name in (*DIMENSIONS, "kinetic.log_mass")}  # type: ignore[arg-type]
    assert found == {
        "potential.stiffness": "1/s²",
        "potential.tilt": "m/s²",
        "damping.rate": "1/s",
        "friction.viscous": "1/s",
        "friction.coulomb": "m/s²",
        "friction.breakaway": "m/s²",
        "friction.log_smooth": "m/s",
        "friction.log_stribeck": "m/s",
        "friction.input_map": "m/s² per N m",
        "kinetic.log_mass": "",
    }
    assert _unit("potential.tilt", run, 1) == "rad/s²"  # type: ignore[arg-type]
    entries = [_unit("friction.input_map", run, i) for i in (1, 2, 3)]  # type: ignore[arg-type]
    assert entries == ["m/s² per gate", "rad/s² per N m", "rad/s² per gate"]  # fails if rows and columns are swapped
    assert _unit("friction.input_zero", run, 0) == "N m"  # type: ignore[arg-type]


@pytest.mark.parametrize(("value", "std", "shown"), [
    (0.30096, 0.4, "0.3"), (1.00131, 0.0013, "1.0013"), (-0.000289, 0.00022, "−0.00029"), (5.0, float("nan"), "5"),
    (float("nan"), 1.0, "nan"),
])  # fmt: skip
def test_no_digits_beyond_the_deviation(value, std, shown):  # fails if 0.30096 ± 0.4 claims five digits
    assert rounded(value, std) == shown


@pytest.mark.parametrize(("settings", "starts"), [
    ({}, True), ({"level": "linear"}, False), ({"features": ("cos(q1)",)}, False), ({"known": ("cos(q1)",)}, False),
    ({"objective": "raw"}, False),
])  # fmt: skip
def test_drag_starts_the_fit_of_an_affine_model_alone(settings, starts):
    # fails if drag is added to what the user names, or to a level whose s has no d·q̇
    assert bool(drag_starts_the_fit(FitConfig(**{"level": "affine", **settings}))) is starts


@pytest.mark.parametrize(("smallest", "unit", "tried"), [(1.0, "m", True), (0.0, "m", False), (1.0, "s", False)])
def test_powers_of_the_distance(smallest, unit, tried):
    # fails if r^-1 is tried where r passes 0, or where r is a sum of metres and seconds
    q = torch.stack([smallest + T.sin().square(), 0 * T], 1)
    data = Trajectories.of(T, q, units=("m", unit))
    assert any(name.startswith("r^") for name in dictionaries(data)[0]) is tried
    assert any(not name.startswith("r^") for name in dictionaries(data)[0])


@pytest.mark.parametrize("settings", [{"mass_width": 2}, {"known": ("q1^5",)}, {"coulomb": True, "level": "forced"}])
def test_features_beside_other_settings_do_not_start_the_fit(settings):
    # fails if one linear problem starts a model that is another
    data = Trajectories.of(T, 2 * T.cos())
    base = estimate_baseline(data)
    free = start_of_features(data, base, FitConfig(level="linear", features=("q1^4",)))
    assert free is not base
    assert start_of_features(data, base, FitConfig(**{"level": "linear", "features": ("q1^4",), **settings})) is base


@pytest.mark.parametrize(
    ("angle", "power", "in_L", "in_force"),
    [
        (True, 2, ("cos x", 3.0), ("sin x", -3.0)),  # V = k (1 − cos x), k = 3
        (True, 1, ("sin x", -3.0), ("cos x", -3.0)),  # V = b sin x
        (False, 2, ("x²", -1.5), ("x", -3.0)),  # V = k x² / 2
        (False, 1, ("x", -3.0), ("", -3.0)),  # V = b x
    ],
)
def test_the_baseline_in_words(angle, power, in_L, in_force):
    # fails if L has +V, or the force +V′, or a factor 2 is lost between them
    for newton, wanted in ((False, in_L), (True, in_force)):
        what, factor = own_term("x", angle, power, newton)
        assert (what, 3.0 * factor) == wanted


@pytest.mark.parametrize("angle", [True, False])
def test_a_baseline_finds_the_spring_the_tilt_and_the_damping_of_a_swing(angle):
    # fails if the sine of an angle is its cosine, or an angle is taken for a length: each number is then another one
    k, b, gamma, h, steps = 4.0, 1.0, 0.2, 0.01, 800
    q, v, found = 1.5, 0.0, []
    for _ in range(steps):  # symplectic Euler, with errors of h
        found.append(q)
        v -= h * (k * (math.sin(q) if angle else q) + b * (math.cos(q) if angle else 1.0) + gamma * v)
        q += h * v
    t, position = h * torch.arange(steps, dtype=torch.float64), torch.tensor(found, dtype=torch.float64)[:, None]
    data = Trajectories(t, position, (steps,), ("x",), ("rad" if angle else "m",), (angle,))
    base = estimate_baseline(data)
    # Measured: each 0.1 % too large, the error of the step.
    assert (base.stiffness[0], base.tilt[0], base.rate) == pytest.approx((k, b, gamma), rel=2e-3)
