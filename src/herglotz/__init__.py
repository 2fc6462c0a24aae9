"""herglotz: learned discrete contact Lagrangians. Positions in, a verified stepper out.

>>> import herglotz as hz
>>> run = hz.fit("motion.csv")
>>> print(run.equation())
>>> future = run.rollout(100)
>>> print(run.verify().table())
"""

from __future__ import annotations

from importlib import import_module

# `typing` takes 20 ms to import; an interrupt of the command in that time would print a traceback.
TYPE_CHECKING = False

__version__ = "0.1.0"

if TYPE_CHECKING:
    from typing import Any

    from herglotz.data import Trajectories, load, save, simulate
    from herglotz.environment import VectorEnv as VectorEnv
    from herglotz.errors import InputError
    from herglotz.export import compile, export_pt2, filter, load_pt2
    from herglotz.mechanics import partials
    from herglotz.models import ContactLagrangian, ModelConfig
    from herglotz.scenes import scene, scene_names
    from herglotz.stepping import State, Status, Stepper
    from herglotz.training import FitConfig, Run, fit, load_run, save_run

# Names are loaded at first use, so that `herglotz --help` does not import torch. `verify` is the package of that name:
# `from herglotz.verify import verify` has the function.
_ROOMS = {
    "data": ("Trajectories", "load", "save", "simulate"),
    "errors": ("InputError",),
    "export": ("compile", "export_pt2", "filter", "load_pt2"),
    "mechanics": ("partials",),
    "models": ("ContactLagrangian", "ModelConfig"),
    "scenes": ("scene", "scene_names"),
    "stepping": ("State", "Status", "Stepper"),
    "training": ("FitConfig", "Run", "fit", "load_run", "save_run"),
}
_MODULES = {"losses": "herglotz.training.losses", "theory": "herglotz.theory"}
_HOME = {name: room for room, names in _ROOMS.items() for name in names} | {"VectorEnv": "environment"}
__all__ = [
    "ContactLagrangian",
    "FitConfig",
    "InputError",
    "ModelConfig",
    "Run",
    "State",
    "Status",
    "Stepper",
    "Trajectories",
    "compile",
    "export_pt2",
    "filter",
    "fit",
    "load",
    "load_pt2",
    "load_run",
    "partials",
    "save",
    "save_run",
    "scene",
    "scene_names",
    "simulate",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__} - {"TYPE_CHECKING", "annotations", "import_module"})


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(_MODULES[name])
    if name not in _HOME:
        raise AttributeError(f"module 'herglotz' has no attribute {name!r}")
    return getattr(import_module(f"herglotz.{_HOME[name]}"), name)
