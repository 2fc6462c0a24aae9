"""The log of a fit for TensorBoard. Extra: `herglotz[tensorboard]`; history.csv holds the same costs without it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.errors import InputError

if TYPE_CHECKING:
    from herglotz.training.run import Run


def summary_writer() -> Any:
    """PyTorch's `SummaryWriter`.

    Raises
    ------
    InputError
        If TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter  # pyright: ignore[reportPrivateImportUsage]
    except ImportError:
        raise InputError("a log for TensorBoard needs it: pip install 'herglotz[tensorboard]'") from None
    return SummaryWriter


def write_tensorboard(run: Run, folder: str | Path) -> None:
    """Write the cost of every iteration (a curve a stage), the metrics, and summary and equation as text.

    Parameters
    ----------
    run
        What `fit` returned.
    folder
        Where the event file is written; `tensorboard --logdir FOLDER` shows it.

    Raises
    ------
    InputError
        If TensorBoard is not installed.
    """
    with summary_writer()(str(folder)) as log:
        for row in run.history:
            log.add_scalar(f"cost/{row['stage']}", row["cost"], row["iteration"])
        for name, value in run.metrics.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
                log.add_scalar(f"metrics/{name}", value, 0)
        log.add_text("summary", f"```\n{run.summary()}\n```")
        log.add_text("equation", f"```\n{run.equation()}\n```")
