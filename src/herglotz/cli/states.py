"""Start states of a rollout."""

from __future__ import annotations

from typing import TYPE_CHECKING

from herglotz.errors import InputError
from herglotz.stepping import State

if TYPE_CHECKING:
    from herglotz.training import Run


def last_fitted(run: Run, trajectory: int) -> State:
    """Return the state at the last training sample of a trajectory, with shapes (n,), (n,), ().

    Raises
    ------
    InputError
        If there is no such trajectory.
    """
    data = run.data
    if not 0 <= trajectory < len(data):
        raise InputError(f"there is no trajectory {trajectory}; choose one from 0 to {len(data) - 1}")
    return State(*(x[_row(run, trajectory)].detach() for x in run.states))


def time_of_last_fitted(run: Run, trajectory: int) -> float:
    """Return the time of that sample."""
    return float(run.data.t[_row(run, trajectory)])


def _row(run: Run, trajectory: int) -> int:
    return run.data.offsets[trajectory] + max(run.train_lengths[trajectory], 1) - 1
