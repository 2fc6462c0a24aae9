"""Named stages of a fit: progress bars, history, and a checkpoint from which an interrupted fit goes on."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, TypedDict

import torch
from torch import Tensor

from herglotz.data.files import read_bytes, write_atomically
from herglotz.data.seal import check_seal, sealed_zip
from herglotz.errors import InputError
from herglotz.progress import FINDING, LOOKING, STAGES, FitBar
from herglotz.schema import check_entries
from herglotz.telling import tell
from herglotz.training.distributed import is_first
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, remind

FORMAT = 2  # 2 holds all that a search goes on from
REMEDY = "delete it and fit from the start"
Progress = bool | Literal["lines", "iterations"] | None
EVERY = 25  # iterations between two checkpoints inside a stage


class _Stored(TypedDict):
    """What a checkpoint holds."""

    format: Literal[2]
    key: str
    stages: dict[str, dict[str, Any]]
    kept: dict[str, dict[str, Any]]


@dataclass
class Callback:
    """What a stage's optimiser reports to; it shows progress and stores the search."""

    bar: Any
    store: Callable[[dict[str, Any]], None]
    resumed: dict[str, Any] | None
    named: str = ""  # begins a line on stderr for every iteration; "": no lines
    log: Callable[[int, float], None] | None = None  # is told every iteration and its cost
    start: float | None = None  # the first cost

    def __call__(self, iteration: int, cost: float, x: Tensor, search: Callable[[], dict[str, Any]]) -> None:  # noqa: ARG002
        """See `levenberg_marquardt.Progress`."""
        self.bar.iterate()
        self.start = cost if self.start is None else self.start
        share = f"cost {cost / self.start:.3g} of its start" if self.start else ""
        self.bar.set_postfix_str(share, refresh=False)
        if self.named:
            tell(f"{self.named}, iteration {iteration}: {share}")
        if self.log is not None:
            self.log(iteration, cost)
        if iteration % EVERY == 0:
            self.store(search())


class Stages:
    """Run optimisations one after the other, and record them.

    A fit is deterministic, so resuming is replaying: a stage that the checkpoint holds as finished is not run again,
    and an unfinished one goes on from all that its optimiser and its problem remembered. A resumed fit gives the same
    bits as one that was not interrupted. One bar over all stages and searches shows their progress.
    """

    def __init__(
        self,
        progress: Progress = False,  # None: on a terminal only; "lines", "iterations": a line on stderr after each
        checkpoint: Path | None = None,  # file to write
        key: str = "",  # identifies data and settings; a checkpoint of another fit is refused
        resume: bool = False,  # read the checkpoint if there is one
        log: Any = None,  # TensorBoard's writer, which is told the cost of every iteration as it is reached
    ):
        self.log = log if is_first() else None
        self.lines = progress in ("lines", "iterations") and is_first()
        self.verbose = progress == "iterations" and is_first()
        disable = (None if progress is None else self.lines or not progress) if is_first() else True
        self.bar = FitBar(disable=disable)
        self.bar.part(LOOKING, "looking at the data")
        self.checkpoint, self.key = checkpoint, key
        self.label = ""
        self.begun: set[str] = set()
        self.history: list[dict[str, Any]] = []
        self.done: dict[str, dict[str, Any]] = {}
        self.kept: dict[str, dict[str, Any]] = {}
        if resume and checkpoint is not None and checkpoint.exists():
            stored = _read(checkpoint)
            if stored["key"] != key:
                raise InputError(
                    f"{checkpoint}: belongs to other data or settings, or to another version of herglotz; leave out "
                    "--resume or choose another folder"
                )
            self.done, self.kept = stored["stages"], stored["kept"]

    def labelled(self, label: str) -> Stages:
        """The same record; what is kept and run from here on has names that end with this label."""
        other = copy(self)
        other.label = label
        return other

    def keep(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Plain values that something else than an optimisation finds; those of the checkpoint where it has them."""
        name += self.label
        if name not in self.kept:
            began, told = time.monotonic(), f"search for {name}"
            self.bar.part(FINDING, told)
            self.kept[name] = make()
            if self.lines:
                tell(f"{told}: {time.monotonic() - began:.1f} s")
            self._write()
        return self.kept[name]

    def run(
        self,
        name: str,
        x: Tensor,
        total: int,
        optimise: Callable[[Tensor, Callback], OptimiserResult],
        problem: Any = None,
    ) -> OptimiserResult:
        """Run one stage from x (or from where the checkpoint left it) and record its history.

        `problem` is what the stage optimises, where later work goes on from what it remembers.
        """
        name += self.label
        while name in self.begun:  # it starts elsewhere: the result of the first is not its own
            name += ", again"
        self.begun.add(name)
        stored = self.done.get(name)
        if stored is not None and stored["done"]:
            result = OptimiserResult(**{k: v for k, v in stored.items() if k != "done"})
            result.x = result.x.to(x)
            remind(problem, result.memory)
        else:
            self.bar.part(STAGES, name, total)
            resumed = None if stored is None else stored["search"]

            def store(search: dict[str, Any]) -> None:
                self.done[name] = {"done": False, "search": search}
                self._write()

            start, log = len(self.history), self.log
            told = None if log is None else lambda k, cost: log.add_scalar(f"cost/{name}", cost, start + k)
            began = time.monotonic()
            result = optimise(x, Callback(self.bar, store, resumed, name if self.verbose else "", told))
            if self.lines:
                count, seconds = result.iterations, time.monotonic() - began
                took = f"{count} iteration{'' if count == 1 else 's'}, {seconds:.1f} s"
                tell(f"{name}: {took}")
            self.done[name] = {**vars(result), "x": result.x.detach().cpu(), "done": True}
            self._write()
        start = len(self.history)
        self.history += [{"stage": name, "iteration": start + i, "cost": cost} for i, cost in enumerate(result.history)]
        return result

    def _write(self) -> None:
        if self.checkpoint is not None and is_first():
            buffer = BytesIO()
            torch.save({"format": FORMAT, "key": self.key, "stages": self.done, "kept": self.kept}, buffer)
            write_atomically(self.checkpoint, sealed_zip(buffer.getvalue()))


def _read(checkpoint: Path) -> dict[str, Any]:
    content = read_bytes(checkpoint)
    check_seal(content, checkpoint, REMEDY)
    try:
        stored = torch.load(BytesIO(content), weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises many kinds for a damaged file
        raise InputError(f"{checkpoint}: cannot be read ({type(error).__name__}); {REMEDY}") from None
    check_entries(_Stored, stored, str(checkpoint), REMEDY)
    return stored
