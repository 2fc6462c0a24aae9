"""What a row asks: a recording, a command, and recordings that the result is to predict. Written as job.json.

Neither this module nor those that run rows import torch, so that the memory of the judge does not count for a fit.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

NAME = "job.json"


@dataclass(frozen=True)
class Trial:
    """A recording from an unseen start, or windows of one."""

    # Path, relative to the folder of the job or absolute.
    data: str
    # Samples that the state is estimated from: the default of `herglotz predict`.
    warmup: int = 20
    windows: int | None = None
    horizon: float | None = None
    # Unit of the error, if the trials of a job have different units.
    scale: float | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """What `Run.predict` is told."""
        windows = {} if self.windows is None else {"windows": self.windows, "horizon": self.horizon}
        return {"warmup": self.warmup, **windows}


@dataclass(frozen=True)
class Job:
    """A fit by the command line, and how its result is scored."""

    # Path, relative to the folder of the job or absolute.
    train: str
    trials: Sequence[Trial] = ()
    command: str = "fit"
    flags: Sequence[str] = ()
    # True if the held-out part of the training recordings is scored.
    later: bool = True
    # Unit of the error of each coordinate; None: 1, in `unit`.
    scale: Sequence[float] | float | None = None
    # Name of the unit of the error.
    unit: str = ""
    # Spread of the motion of each coordinate; None: the spread of the data.
    size: Sequence[float] | None = None
    # A perfect model's error; None where it is not known, and no verdict can be called too strict.
    attainable: float | None = None
    # Coordinates to predict: a run of other coordinates has read the data in a wrong way.
    coordinates: Sequence[str] | None = None
    in_degrees: bool = False  # `scale` is in degrees; a run that reads radians is scored in radians
    facts: dict[str, Any] = field(default_factory=dict)


def write(folder: Path, job: Job) -> None:
    """Write the job beside its data; its presence says that they are complete."""
    part = folder / f"{NAME}.part"
    part.write_text(json.dumps(asdict(job), indent=1), encoding="utf-8")
    part.replace(folder / NAME)


def read(folder: Path) -> Job:
    """Read a job, its paths made absolute."""
    values = json.loads((folder / NAME).read_text(encoding="utf-8"))
    trials = [Trial(**{**one, "data": str(folder / one["data"])}) for one in values["trials"]]
    return Job(**{**values, "train": str(folder / values["train"]), "trials": trials})
