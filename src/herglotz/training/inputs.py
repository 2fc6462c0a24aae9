"""Recorded inputs u (a motor's torque): which step each belongs to, and whether data and model agree about them.

`Stepper.rollout` and the exported steppers take one input a step. Between samples inputs do what the `hold` of the data
says (`herglotz.data.holds`), by default nothing: the input recorded at a sample acts from that sample to the next. The
last one of a trajectory acts on no step.
"""

from __future__ import annotations

from torch import Tensor

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.training.problems.grid import SegmentGrid


def step_inputs(model: ContactLagrangian, data: Trajectories) -> Tensor | None:
    """Inputs of the steps that start at each sample, (N, m); None for a model that takes none.

    Raises
    ------
    InputError
        If the model takes inputs and the data hold none, or another number of them.
    """
    if not model.inputs:
        return None
    where = data.source or "data"
    if data.u is None:
        raise InputError(
            f"{where}: the model is driven by {model.inputs} input(s), and none of these columns is one; name them: "
            "--inputs NAMES (inputs= in Python)"
        )
    if data.u.shape[1] != model.inputs:
        raise InputError(f"{where}: {data.u.shape[1]} input(s) u are recorded, the model takes {model.inputs}")
    return data.inputs_of_steps()


def grid_inputs(model: ContactLagrangian, data: Trajectories, grid: SegmentGrid) -> Tensor | None:
    """Inputs of the model steps of a grid, (S, K, m); None for a model that takes none. Raises as `step_inputs`."""
    return None if step_inputs(model, data) is None else data.inputs_of_steps(grid.row, grid.part)
