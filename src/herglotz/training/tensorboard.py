"""The log of a fit for TensorBoard. Extra: `herglotz[tensorboard]`; history.csv holds the same costs without it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from herglotz.errors import InputError

# Seconds after which TensorBoard can read what was logged.
SECONDS = 5


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
