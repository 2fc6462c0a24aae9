"""The models that a search compared, as plain values for `metrics.json` and the figure of sizes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from herglotz.training.trials import Compared, Fitter, Trial


def compared_models(fitters: Iterable[Fitter], trial: Trial) -> list[dict[str, Any]]:
    """The models that were scored over segments of the length of a trial, and the trial itself, by their size."""
    rows: dict[frozenset[str], Compared] = {}
    for fitter in fitters:
        for row in fitter.compared:
            before = rows.get(row.taken)
            better = math.isfinite(row.held_out) and (before is None or row.held_out < before.held_out)
            if row.length == trial.length and better:
                rows[row.taken] = row
    rows[trial.taken] = Compared(trial.length, trial.problem.P, trial.score.rms, trial.taken)
    order = [offer.name for offer in (*trial.fitter.offers, *trial.fitter.loads)]
    return [
        {
            "numbers": row.numbers,
            "held_out": row.held_out,
            "offers": [name for name in order if name in row.taken],
            "taken": row.taken == trial.taken,
        }
        for row in sorted(rows.values(), key=lambda row: (row.numbers, row.held_out))
    ]
