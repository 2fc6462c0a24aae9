"""Named stages of a fit: progress, history, and a checkpoint from which an interrupted fit continues.

TensorBoard's log (extra: `herglotz[tensorboard]`) has the same costs as history.csv.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, TypedDict

import torch
from torch import Tensor

from herglotz.data.files import check_seal, read_bytes, sealed_zip, write_atomically
from herglotz.errors import InputError, tell
from herglotz.progress import FINDING, LOOKING, STAGES, FitBar
from herglotz.schema import check_entries
from herglotz.training.distributed import is_first
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, remind

# Format of the checkpoint. Format 2 has the whole state of an optimiser; format 1, which had less, is refused.
FORMAT = 2
REMEDY = "delete it and fit from the start"
Progress = bool | Literal["lines", "iterations"] | None
# Iterations between two checkpoints inside a stage.
ITERATIONS_PER_CHECKPOINT = 25
# Seconds after which TensorBoard can read what was logged.
SECONDS = 5


class _Stored(TypedDict):
    """The contents of a checkpoint."""

    format: Literal[2]
    key: str
    stages: dict[str, dict[str, Any]]
    kept: dict[str, dict[str, Any]]


@dataclass
class Callback:
    """The callback of an optimiser: shows progress in `bar`, and lets `store` write the state to the checkpoint.

    `resumed` is the state to continue from, or None. `named` are the first words of a line on stderr after each
    iteration; no lines if empty. `log` is called with each iteration and its cost; `start` is the first cost.
    """

    bar: Any
    store: Callable[[dict[str, Any]], None]
    resumed: dict[str, Any] | None
    named: str = ""
    log: Callable[[int, float], None] | None = None
    start: float | None = None

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
        if iteration % ITERATIONS_PER_CHECKPOINT == 0:
            self.store(search())


class Stages:
    """Run optimisations one after the other, and record them.

    A fit is deterministic, so a resumed fit repeats the fit with the results that the checkpoint has: a finished stage
    is not run again, and an unfinished stage continues from the stored state of its optimiser and problem. A resumed
    fit gives the same bits as a fit without interruption.

    `progress` is that of `fit`, `checkpoint` the file to write, which `resume` reads if it exists. `key` identifies
    data and settings: the checkpoint of another fit is an InputError. `log` is TensorBoard's writer.
    """

    def __init__(
        self,
        progress: Progress = False,
        checkpoint: Path | None = None,
        key: str = "",
        resume: bool = False,
        log: Any = None,
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
        """A view of this record in which `keep` and `run` append the label to the names of results and stages."""
        other = copy(self)
        other.label = label
        return other

    def keep(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The result of `make`, plain values that the checkpoint stores; not computed if the checkpoint has them."""
        name += self.label
        if name not in self.kept:
            began, title = time.monotonic(), f"search for {name}"
            self.bar.part(FINDING, title)
            self.kept[name] = make()
            if self.lines:
                tell(f"{title}: {time.monotonic() - began:.1f} s")
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
        """Run one stage from x, or from the state in the checkpoint, and record its history.

        `problem` is the optimised problem; if given, its memory is restored for later work when a finished stage is
        not run again.
        """
        name += self.label
        # A second stage of a name starts elsewhere, and must not get the stored result of the first.
        while name in self.begun:
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
            add = None if log is None else lambda k, cost: log.add_scalar(f"cost/{name}", cost, start + k)
            began = time.monotonic()
            result = optimise(x, Callback(self.bar, store, resumed, name if self.verbose else "", add))
            if self.lines:
                count, seconds = result.iterations, time.monotonic() - began
                tell(f"{name}: {count} iteration{'' if count == 1 else 's'}, {seconds:.1f} s")
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
    # Torch raises many kinds of exceptions for a damaged file.
    except Exception as error:
        raise InputError(f"{checkpoint}: cannot be read ({type(error).__name__}); {REMEDY}") from None
    check_entries(_Stored, stored, str(checkpoint), REMEDY)
    return stored


@contextmanager
def tensorboard_log(folder: str | Path | None) -> Iterator[Any]:
    """TensorBoard's writer into this folder, which it shows while the fit runs; None without a folder.

    Raise InputError if TensorBoard is not installed.
    """
    if folder is None:
        yield None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter  # pyright: ignore[reportPrivateImportUsage]
    except ImportError:
        raise InputError("a log for TensorBoard needs it: pip install 'herglotz[tensorboard]'") from None
    with SummaryWriter(str(folder), flush_secs=SECONDS) as writer:
        yield writer


def log_result(writer: Any, metrics: dict[str, Any], words: dict[str, str]) -> None:
    """What the fit reached: its numbers, and texts by name."""
    for name, value in metrics.items():
        if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
            writer.add_scalar(f"metrics/{name}", value, 0)
    for name, text in words.items():
        writer.add_text(name, f"```\n{text}\n```")
