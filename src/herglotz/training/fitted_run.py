"""`FittedRun`: the attributes of a `Run` that equation, summary, motion and prediction use.

These modules cannot import `Run`, because `Run` imports them. `as_recorded` reads another recording in the way in which
the data of a run were read.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.anything import as_trajectories
from herglotz.data.holds import Arrival
from herglotz.errors import refuse, tell
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.training.config import FitConfig


class FittedRun(Protocol):
    """Attributes of `herglotz.training.Run`; a new one that these modules need is added here."""

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


def as_recorded(run: FittedRun, data: Any, **reading: Any) -> Trajectories:
    """Another recording, or a file of recordings, read as the data of the run were.

    Columns, units, angles, sensors, what the user read in degrees and, unless the file states its own, the hold of the
    inputs are those of the run.

    `reading` are options of `as_trajectories`, which replace those of the run. Trajectories hold positions already, so
    the zeros and scales of the run's sensors are not applied. Raise InputError if each recording of the run has a zero
    or a scale of its own, because those of another recording are then unknown.
    """
    sensors = {} if isinstance(data, Trajectories) else run.reading
    for name in {"sensor_zeros", "sensor_scales"} & sensors.keys() - reading.keys():
        numbers, what = sensors[name], name.replace("_", " ")
        remedy = f"--{name.replace('_', '-')} ({name}= in Python)"
        several = f"each recording of the run has {what} of its own; give those of this one: {remedy}"
        refuse({several: len(numbers) not in (0, run.data.dof)})
        if numbers:
            tell(f"{what} are those of the run, {', '.join(f'{x:.6g}' for x in numbers)}; for others {remedy}")
        reading[name] = numbers
    if (names := sensors.get("degrees")) and "degrees" not in reading:
        read = f"{', '.join(names)} read in degrees, as in the run"
        tell(f"{read}; for positions in rad --degrees '' (degrees=() in Python)")
        reading["degrees"] = names
    # The hold with which the file was read comes first: a fit to means of inputs over steps has the hold "zero".
    hold = run.reading.get("hold") or run.arrival.hold
    # Angles that the fit found to be positions on a line were read as angles, whose turns are counted.
    turning = (run.metrics.get("plan") or {}).get("turning", True)
    angles = run.data.angles if turning else tuple(unit == "rad" for unit in run.data.units)
    return as_trajectories(data, like=replace(run.data, hold=hold, angles=angles), **reading)
