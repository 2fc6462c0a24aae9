"""Friction that gives the motion energy: none does, unless a force is missing, or the motion drives itself."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data.splits import leading
from herglotz.models import ContactLagrangian
from herglotz.models.terms import LinearDamping
from herglotz.training.equation_words import Joint, Numbers
from herglotz.training.fitted_run import FittedRun

# Standard deviations by which the work of friction exceeds 0.
CLEARLY = 2.0
PUSHES = (
    "Friction pushes: over the training part it gives the motion more energy than it takes, as where motion drives "
    "itself; else another force is missing"
)


def pushes(run: FittedRun, joint: Joint | None) -> str:
    """What is to be said of friction that clearly gives energy to the training part; nothing of any other."""
    if joint is None or not isinstance(run.model.damping, LinearDamping):
        return ""
    work, deviation, _ = Numbers(run.model, joint).known(work_of_friction(run), "work")
    return PUSHES if deviation is not None and work > CLEARLY * deviation else ""


def work_of_friction(run: FittedRun) -> Tensor:
    """The energy that friction gives to the training part, (), by the fitted motion from sample to sample.

    Σ (F⁻/c + F⁺)·Δ − γ h p·v without inputs and constant loads, which are no friction; < 0 where it brakes.
    """
    model, data = run.model, run.data.unwrapped()
    assert isinstance(model.damping, LinearDamping)
    trained = leading(data.lengths, run.train_lengths).to(data.t.device)
    steps = data.steps()
    row = steps.index[trained[steps.index] & trained[steps.index + 1]]
    q0, q1, p = run.states.q[row].detach(), run.states.q[row + 1].detach(), run.states.p.detach()
    h, move = data.t[row + 1] - data.t[row], q1 - q0
    work = -model.damping.rate * ((p[row] + p[row + 1]) / 2 * move).sum()
    forces = model.forces(q0, q1, torch.zeros_like(h), h)
    if forces is not None:
        work = work + ((forces[0] / (-model.damping.rate * h).exp()[:, None] + forces[1]) * move).sum()
    return work + _loads(model, move)


def _loads(model: ContactLagrangian, move: Tensor) -> Tensor:
    """What constant loads have in that work, to be taken off."""
    total = move.new_zeros(())
    for g, text in enumerate(model.config.drag):
        if text.startswith("load"):
            assert model.drag is not None
            total = total + model.drag.coefficient[g] * move[:, int(text.split()[1]) - 1].sum()
    return total
