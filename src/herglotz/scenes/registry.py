"""Scenes by name."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable

from herglotz.errors import InputError, did_you_mean
from herglotz.scenes.cart_pole import cart_pole
from herglotz.scenes.chain import chain
from herglotz.scenes.double_pendulum import double_pendulum
from herglotz.scenes.duffing import driven_duffing, duffing
from herglotz.scenes.kepler import kepler
from herglotz.scenes.linear_drag import linear_drag
from herglotz.scenes.nonlinear_action import nonlinear_action
from herglotz.scenes.oscillator import damped_oscillator
from herglotz.scenes.parachute import parachute, quadratic_drag
from herglotz.scenes.pendulum import damped_pendulum, driven_pendulum
from herglotz.scenes.rigid_body import rigid_body
from herglotz.scenes.scene import Scene
from herglotz.scenes.servo_axis import servo_axis
from herglotz.scenes.van_der_pol import van_der_pol

SCENES: dict[str, Callable[..., Scene]] = {
    make.__name__: make
    for make in (
        cart_pole, chain, damped_oscillator, damped_pendulum, double_pendulum, driven_duffing, driven_pendulum, duffing,
        kepler, linear_drag, nonlinear_action, parachute, quadratic_drag, rigid_body, servo_axis, van_der_pol,
    )
}  # fmt: skip


def scene_names() -> tuple[str, ...]:
    """The names that `scene` knows, sorted."""
    return tuple(sorted(SCENES))


def scene(name: str, **parameters: float) -> Scene:
    """The scene called `name`, with its default parameters overridden by `parameters`.

    Parameters
    ----------
    name
        One of `scene_names()`.
    **parameters
        Numbers in the scene's units, such as gamma=0.2; `help(herglotz.scenes.NAME)` lists them.

    Returns
    -------
    Scene
        L(q, v, s), H = v·L_v − L, the flow and the exact or reference L_d as functions of batched tensors (sections 1
        and 3 of `docs/mathematics.md`), in the scene's units.

    Raises
    ------
    InputError
        If there is no such scene or parameter, or a value is not a finite number.
    """
    if name not in SCENES:
        known = scene_names()
        raise InputError(f"unknown scene {name!r}; choose one of {', '.join(known)}{did_you_mean(name, known)}")
    known = tuple(inspect.signature(SCENES[name]).parameters)
    for key, value in parameters.items():
        if key not in known:
            raise InputError(f"scene {name!r} has no parameter {key!r}; it takes {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"parameter {key!r} of scene {name!r} must be a finite number, got {value!r}")
    return SCENES[name](**parameters)
