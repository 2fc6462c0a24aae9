"""Named stages of a fit: progress bars, history, and a checkpoint from which an interrupted fit goes on."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from tqdm import tqdm

from herglotz.data.files import write_atomically
from herglotz.errors import InputError
from herglotz.training.distributed import is_first
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult

Callback = Callable[[int, float, Tensor], None]
EVERY = 25  # iterations between two checkpoints inside a stage


class Stages:
    """Run optimisations one after the other, and record them.

    A fit is deterministic, so resuming is replaying: a stage that the checkpoint holds as finished is not run again,
    and an unfinished one goes on from its best point.

    Parameters
    ----------
    progress
        Show progress bars; None shows them on a terminal only; "lines" prints one line on stderr after every stage.
    checkpoint
        File to write, or None.
    key
        Identifies data and settings; a checkpoint of another fit is refused.
    resume
        Read the checkpoint if there is one.
    """

    def __init__(self, progress: bool | Literal["lines"] | None, checkpoint: Path | None, key: str, resume: bool):
        self.lines = progress == "lines" and is_first()
        self.disable = (None if progress is None else self.lines or not progress) if is_first() else True
        self.checkpoint, self.key = checkpoint, key
        self.history: list[dict[str, Any]] = []
        self.done: dict[str, dict[str, Any]] = {}
        self.kept: dict[str, dict[str, Any]] = {}
        if resume and checkpoint is not None and checkpoint.exists():
            stored = _read(checkpoint)
            if stored["key"] != key:
                raise InputError(
                    f"{checkpoint}: belongs to other data or settings; leave out --resume or choose another folder"
                )
            self.done, self.kept = stored["stages"], stored["kept"]

    def keep(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Plain values that something else than an optimisation finds; those of the checkpoint where it has them."""
        if name not in self.kept:
            self.kept[name] = make()
            self._write()
        return self.kept[name]

    def run(
        self, name: str, x: Tensor, total: int, optimise: Callable[[Tensor, Callback], OptimiserResult]
    ) -> OptimiserResult:
        """Run one stage from x (or from where the checkpoint left it) and record its history."""
        stored = self.done.get(name)
        if stored is not None:
            x = stored["x"].to(x)
        if stored is not None and stored["done"]:
            result = OptimiserResult(x, stored["cost"], stored["reason"], stored["iterations"], stored["history"])
        else:
            with tqdm(total=total, desc=name, disable=self.disable, leave=False) as bar:
                start: float | None = None

                def callback(iteration: int, cost: float, best: Tensor) -> None:
                    nonlocal start
                    bar.update(1)
                    start = cost if start is None else start
                    bar.set_postfix_str(f"cost {cost / start:.3g} of its start" if start else "", refresh=False)
                    if iteration % EVERY == 0:
                        self._store(name, OptimiserResult(best, cost, "interrupted", iteration), done=False)

                began = time.monotonic()
                result = optimise(x, callback)
            if self.lines:
                took = f"{result.iterations} iterations, {time.monotonic() - began:.1f} s"
                print(f"{name}: {took}", file=sys.stderr, flush=True)
            self._store(name, result, done=True)
        start = len(self.history)
        self.history += [{"stage": name, "iteration": start + i, "cost": cost} for i, cost in enumerate(result.history)]
        return result

    def _store(self, name: str, r: OptimiserResult, done: bool) -> None:
        self.done[name] = {
            "x": r.x.detach().cpu(),
            "cost": r.cost,
            "reason": r.reason,
            "iterations": r.iterations,
            "history": r.history,
            "done": done,
        }
        self._write()

    def _write(self) -> None:
        if self.checkpoint is not None and is_first():
            buffer = BytesIO()
            torch.save({"key": self.key, "stages": self.done, "kept": self.kept}, buffer)
            write_atomically(self.checkpoint, buffer.getvalue())


def _read(checkpoint: Path) -> dict[str, Any]:
    try:
        stored = torch.load(checkpoint, weights_only=True)
        return {"key": stored["key"], "stages": stored["stages"], "kept": stored.get("kept", {})}
    except Exception as error:  # torch raises many kinds for a damaged file
        raise InputError(
            f"{checkpoint}: cannot be read ({type(error).__name__}); delete it and fit from the start"
        ) from None
