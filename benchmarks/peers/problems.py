"""Every data set by name. Only the training data depend on the seed; the tests are the same for all."""

from __future__ import annotations

from collections.abc import Callable

from .judging import Problem
from .measured import ibm, real_pendulum
from .simulated import double_pendulum, one_pendulum, pendulum

PROBLEMS: dict[str, Callable[[], Problem]] = {
    "pendulum_02": lambda: pendulum(0.2),
    "pendulum_05": lambda: pendulum(0.5),
    "pendulum_10": lambda: pendulum(1.0),
    "pendulum_noise": lambda: pendulum(0.2, noise=0.01),
    "pendulum_one": one_pendulum,
    "real_pendulum": real_pendulum,
    "double_pendulum": double_pendulum,
    "ibm": ibm,
}
