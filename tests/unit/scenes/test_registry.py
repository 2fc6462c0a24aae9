"""Scenes by name, and what a user's mistake says."""

import pytest

import herglotz.scenes
from herglotz.errors import InputError
from herglotz.scenes import Scene, scene, scene_names


def test_names_and_overrides():
    # fails if a parameter is dropped on the way to the scene
    assert scene_names() == tuple(sorted(scene_names()))
    assert {"damped_oscillator", "damped_pendulum", "parachute", "kepler"} <= set(scene_names())
    system = scene("damped_oscillator", gamma=0.7)
    assert isinstance(system, Scene)
    assert system.parameters == {"m": 1.0, "omega0": 1.0, "gamma": 0.7}


def test_scene_is_the_function():
    # fails if the submodule herglotz.scenes.scene shadows the function of the same name
    assert herglotz.scenes.scene is scene
    assert callable(scene)


def test_unknown_scene():
    # fails if the message does not list the names to choose from
    with pytest.raises(InputError, match="unknown scene 'pendulum'; choose one of cart_pole, chain, damped_o"):
        scene("pendulum")


def test_unknown_parameter():
    # fails if an unknown parameter is a bare TypeError
    with pytest.raises(InputError, match="scene 'parachute' has no parameter 'lambda_'; it takes m, g, lam"):
        scene("parachute", lambda_=0.1)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "0.1", None, True])
def test_value_that_is_no_number(value):
    # fails if a value that cannot be a parameter reaches the formulas
    with pytest.raises(InputError, match="parameter 'gamma' of scene 'damped_pendulum' must be a finite number, got"):
        scene("damped_pendulum", gamma=value)


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("damped_oscillator", {"m": 0.0}, "mass m must be > 0, got 0.0"),
        ("parachute", {"m": -1.0}, "mass m must be > 0, got -1.0"),
        ("parachute", {"lam": 0.0}, "drag lam must not be 0, got 0.0"),
        ("linear_drag", {"m": 0.0}, "linear_drag: mass m must be > 0, got 0.0"),
        ("quadratic_drag", {"m": -2.0}, "quadratic_drag: mass m must be > 0, got -2.0"),
        ("quadratic_drag", {"lam": 0.0}, "quadratic_drag: drag lam must not be 0, got 0.0"),
        ("kepler", {"m": 0.0}, "kepler: mass m must be > 0, got 0.0"),
        ("cart_pole", {"length": 0.0}, "cart_pole: length must be > 0, got 0.0"),
        ("driven_duffing", {"beta": 0.0}, "driven_duffing: cubic stiffness beta must be > 0, got 0.0"),
        ("duffing", {"beta": -1.0}, "duffing: cubic stiffness beta must be > 0, got -1.0"),
        ("servo_axis", {"m": 0.0}, "servo_axis: mass m must be > 0, got 0.0"),
        ("servo_axis", {"dry": -1.0}, "servo_axis: dry friction must be >= 0, got -1.0"),
        ("van_der_pol", {"mu": 0.0}, "van_der_pol: mu must be > 0, got 0.0"),
        ("chain", {"masses": 2.5}, "chain: masses must be a whole number >= 1, got 2.5"),
        ("chain", {"masses": 0}, "chain: masses must be a whole number >= 1, got 0"),
        ("chain", {"m": -1.0}, "chain: mass m must be > 0, got -1.0"),
        ("chain", {"k": 0.0}, "chain: stiffness k must be > 0, got 0.0"),
        ("chain", {"beta": -0.1}, "chain: hardening beta must be >= 0, got -0.1"),
        ("rigid_body", {"J3": 0.0}, "moments must be > 0, none larger than the sum of the others, got 3.0, 2.0, 0.0"),
        ("rigid_body", {"J1": 3.1}, "none larger than the sum of the others, got 3.1, 2.0, 1.0"),
    ],
)
def test_value_out_of_range(name, parameters, message):
    # fails if a degenerate parameter becomes a NaN trajectory instead of a message
    with pytest.raises(InputError, match=message):
        scene(name, **parameters)
