"""`FittedRun`: the part of a `Run` that equation, summary, motion and prediction use, which `Run` imports."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.holds import Arrival
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.training.config import FitConfig


class FittedRun(Protocol):
    """Attributes of `herglotz.training.Run`, as a protocol against a circle of imports."""

    @property
    def model(self) -> ContactLagrangian: ...  # noqa: D102
    @property
    def config(self) -> FitConfig: ...  # noqa: D102
    @property
    def decided(self) -> FitConfig: ...  # noqa: D102
    @property
    def metrics(self) -> dict[str, Any]: ...  # noqa: D102
    @property
    def data(self) -> Trajectories: ...  # noqa: D102
    @property
    def states(self) -> State: ...  # noqa: D102
    @property
    def prediction(self) -> Tensor: ...  # noqa: D102
    @property
    def reading(self) -> dict[str, Any]: ...  # noqa: D102
    @property
    def train_lengths(self) -> tuple[int, ...]: ...  # noqa: D102
    @property
    def h(self) -> float: ...  # noqa: D102
    @property
    def h_range(self) -> tuple[float, float]: ...  # noqa: D102
    @property
    def box(self) -> dict[str, list[float]]: ...  # noqa: D102
    @property
    def arrival(self) -> Arrival: ...  # noqa: D102
    @property
    def stepper(self) -> Stepper: ...  # noqa: D102
    def last_fitted(self, trajectory: int = 0) -> tuple[State, float]: ...  # noqa: D102
