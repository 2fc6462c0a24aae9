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


class Absent(Exception):
    """Data that a row needs are not here."""


@dataclass(frozen=True)
class Trial:
    """A recording from an unseen start, or windows of one."""

    data: str  # path, relative to the job's folder or absolute
    warmup: int = 20  # samples that the state is read from: the default of `herglotz predict`
    windows: int | None = None
    horizon: float | None = None
    scale: float | None = None  # what an error of 1 is, where it differs between the trials of a job

    @property
    def settings(self) -> dict[str, Any]:
        """What `Run.predict` is told."""
        windows = {} if self.windows is None else {"windows": self.windows, "horizon": self.horizon}
        return {"warmup": self.warmup, **windows}


@dataclass(frozen=True)
class Job:
    """A fit by the command line, and how its result is scored."""

    train: str  # path, relative to the job's folder or absolute
    trials: Sequence[Trial] = ()
    command: str = "fit"
    flags: Sequence[str] = ()
    later: bool = True  # whether the unseen part of the training recordings is scored, where there is one
    scale: Sequence[float] | float | None = None  # of each coordinate: what an error of 1 is; None: 1 in the unit
    unit: str = ""  # of the error
    size: Sequence[float] | None = None  # of each coordinate: the spread of its motion; None: that of the data read
    # A perfect model's error; None where it is not known, and no verdict can be called too strict.
    attainable: float | None = None
    coordinates: Sequence[str] | None = None  # what is to be predicted: other coordinates are a wrong reading
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
