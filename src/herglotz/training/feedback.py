"""Motion that a controller holds, or that drives itself: what a free run of its model, and its numbers, cannot tell.

Names of inputs tell the set points of a controller, which act through the controller alone. Two facts are measured on
the training part:

* The motion is unstable and its inputs hold it. An error of a start of the size of the noise, carried on by the
  linearised steps along the recorded motion with the inputs as recorded, grows to the spread of the motion; and with
  the mean of the inputs in their place the model leaves the recorded range by its spread. A free run then tells no
  longer whether its start or its forces are wrong.
* The inputs follow from the state: a linear function of positions and velocities leaves less than half of their spread.
  The map of the inputs and the other forces then make up for each other. Where the inputs are recorded with noise,
  the noise alone is no function of the state, and moves nothing: a fit finds inputs without effect, and the law of the
  machine with its controller.

Friction gives a motion energy only if the motion drives itself, or if another force is missing (`pushes`).
"""

from __future__ import annotations

import re
import shlex
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.column_roles import is_recorded_effort, is_set_point
from herglotz.data.input_terms import saturation
from herglotz.data.noise import precisions
from herglotz.data.splits import leading
from herglotz.data.units import size
from herglotz.models import ContactLagrangian
from herglotz.models.drag import input_forces
from herglotz.models.terms import LinearDamping
from herglotz.training.equation_words import Joint, Numbers
from herglotz.training.fitted_run import FittedRun
from herglotz.training.following import HALF, constant, unexplained
from herglotz.training.free_run import continued
from herglotz.training.problems.grid import segment_grid, step_inputs
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.lifted_newton import linear_recurrence, linear_steps

# Inputs that do not follow from the state.
SIGNALS = ("a small random signal on the inputs", "set points that jump")
# Standard deviations by which the work of friction exceeds 0.
CLEARLY = 2.0
PUSHES = (
    "Friction pushes: over the training part it gives the motion more energy than it takes, as where motion drives "
    "itself; else another force is missing"
)


def reason_of_inputs(
    model: ContactLagrangian,
    data: Trajectories,
    states: Tensor,  # (N, 2n+1) of the fit at the samples
    max_step: float,
    longer: str = "",
    fits: bool = True,
) -> str:
    """The fact in the head of this module that the training part shows, and what to try, in sentences; "" for none.

    `longer` is a recording, in words, that would tell as well what inputs do that follow. A model that does not fit
    (`fits`) says nothing about the motion.
    """
    if data.u is None or not model.inputs or not bool(torch.isfinite(states).all()):
        return ""
    if unstable := held_by_inputs(model, data, states, max_step, fits):
        how = "Try" if fits else "If the motion is unstable, try"
        return f"{unstable}. {how} several recordings, each no longer than that"
    if (left := unexplained(data, states)) < HALF:
        ways = filter(None, (*SIGNALS, longer))
        return f"{_following(left)}: what they do and other forces make up for each other. Try {', or '.join(ways)}"
    return ""


def held_by_inputs(
    model: ContactLagrangian, data: Trajectories, states: Tensor, max_step: float, fits: bool = True
) -> str:
    """That the motion of a model that `fits` is unstable and its inputs hold it, in a sentence; "" if it is not so."""
    if data.u is None or not model.inputs or not bool(torch.isfinite(states).all()):
        return ""
    lost = growth_of_noise(model, data, states, max_step) >= 1
    if not (bool(lost.any()) and leaves_without_inputs(model, data, states, max_step)):
        return ""
    since, unit = data.t - data.t[list(data.offsets)][data.trajectory], "" if data.time_unit == "1" else data.time_unit
    what = "The motion is unstable and its inputs hold it" if fits else "The model, and maybe the motion, is unstable"
    return (
        f"{what}: with the inputs as recorded an error of the start as small as the noise grows to the spread of "
        f"the motion within {size(float(since[lost].min()), unit, digits=2)}, and longer runs tell a wrong start "
        "from a wrong force no more"
    )


def reason_of_idle_inputs(
    model: ContactLagrangian,
    data: Trajectories,
    states: Tensor,  # (N, 2n+1) of the fit at the samples
) -> str:
    """That no input acts in the model, and all follow from the state, with a remedy; "" if that is not so."""
    known = data.u is not None and model.friction is not None and bool(torch.isfinite(states).all())
    if not known or acting_inputs(model):
        return ""
    if (left := unexplained(data, states)) >= HALF:
        return ""
    law = "its equation is that of the machine with the controller"
    return f"{_following(left)}, and the model has no effect of theirs: {law}. Try {', or '.join(SIGNALS)}"


def reason_of_set_points(model: ContactLagrangian, data: Trajectories) -> str:
    """That a set point acts in a model that misses data with a recorded force, with a remedy; "" if that is not so."""
    names = acting_set_points(model, data)
    if not names or not _has_recorded_effort(data):
        return ""
    place = "in the equation, in the place of the machine's"
    return f"{_through(names)} {place}. Try {_without(names)}, which leaves the forces that were recorded"


def _has_recorded_effort(data: Trajectories) -> bool:
    """Whether an input is a force that was recorded, by its name and unit."""
    return any(is_recorded_effort(*label) for label in data.input_labels)


def _without(names: list[str]) -> str:
    """The flag that leaves columns of these names out."""
    return f"--drop {shlex.quote(','.join(names))}"


def caveat_of_inputs(model: ContactLagrangian, data: Trajectories, states: Tensor) -> str:
    """What the data do not tell of the effects of inputs, in sentences; "" if they tell all."""
    return ". ".join(filter(None, (_caveat_of_changing_inputs(model, data, states), _caveat_of_constants(model, data))))


def _caveat_of_constants(model: ContactLagrangian, data: Trajectories) -> str:
    """That the data do not tell the effect of inputs that never change from a constant force; "" for no such input."""
    if data.u is None:
        return ""
    still = constant(data.u).tolist()
    names = [data.input_labels[k][0] for k in acting_inputs(model) if still[k]]
    never, own = ("never changes", "its effect") if len(names) == 1 else ("never change", "their effect")
    told = f"which do not tell {own} from a constant force. Where that matters, record other values"
    return f"{', '.join(names)} {never} in these data, {told}" if names else ""


def _caveat_of_changing_inputs(model: ContactLagrangian, data: Trajectories, states: Tensor) -> str:
    """What the effect of set points, or of inputs that follow from the state, rests on, in a sentence; "" for others.

    Set points follow from nothing; the motion follows them.
    """
    if names := acting_set_points(model, data):
        alone = f"; for the law of the machine alone, by the forces that were recorded, try {_without(names)}"
        return f"{_through(names)} a part of the equation{alone if _has_recorded_effort(data) else ''}"
    if data.u is None or not bool(torch.isfinite(states).all()) or (left := unexplained(data, states)) >= HALF:
        return ""
    return (
        f"{_following(left)}: such motion is met, and what the inputs do by themselves rests on "
        "the rest of their spread and on how they are held between samples"
    )


def acting_set_points(model: ContactLagrangian, data: Trajectories) -> list[str]:
    """Names of set points of a controller on which a force of the model depends."""
    labels, units = list(data.input_labels), dict(data.input_labels)
    # A saturation has no unit: that of its input tells a commanded voltage from a set point.
    of = {name: found[2] for name, _ in labels if (found := saturation(name))}
    acting = (labels[k][0] for k in acting_inputs(model))
    return [name for name in acting if is_set_point(name, units.get(of.get(name, name), ""))]


def _through(names: list[str]) -> str:
    """That set points of these names act in the model, as the start of a sentence."""
    act, points = ("acts", "a set point acts") if len(names) == 1 else ("act", "set points act")
    return f"{', '.join(names)} {act} in the model, and {points} through a controller alone: its law is"


def acting_inputs(model: ContactLagrangian) -> list[int]:
    """Indices of the inputs that a force of the model depends on: by the map from inputs to forces, or by its drag.

    None of a model without inputs, and none of a model of the user's own, which has no map that could be asked.
    """
    if model.friction is None or not model.inputs:
        return []
    by_map = model.friction.input_map.detach().abs().sum(0).tolist()
    forces = " ".join(input_forces(model.config.drag))
    return [k for k, gain in enumerate(by_map) if gain or re.search(rf"\bu{k + 1}\b", forces)]


def _following(left: float) -> str:
    """That all but this share of the inputs' spread follows from the state, in words.

    A controller's inputs follow from the state; the state of a machine follows from inputs that are slow beside it.
    """
    share = f"all but {100 * left:.2g} % of their spread"
    return (
        f"Positions and velocities give the inputs, {share}, as under a controller or where motion follows slow inputs"
    )


def growth_of_noise(model: ContactLagrangian, data: Trajectories, states: Tensor, max_step: float) -> Tensor:
    """RMS of δq over the spread of q, (N,), of an error of the start: δq₀ the noise of q, δp₀ = 0, δX_{k+1} = A_k δX_k.

    A_k are the derivatives of the model's steps at `states`, (N, 2n+1).
    """
    grid, n = segment_grid(data, data.samples, max_step), data.dof
    problem = ShootingProblem(model, data, grid, sigma=1.0, compiled=False)
    problem.guess_from_states(states)
    assert problem.path is not None
    x = problem.path.x
    _, A = linear_steps(problem.parameters.at(problem.parameters.get(), problem.u), x, grid.h)
    first = x.new_zeros(*x[:, 0].shape, n)
    first[:, :n] = (precisions(data).to(x) * data.balance).diag()
    moved = linear_recurrence(A.detach(), x.new_zeros(*A.shape[:-1], n), first)[..., :n, :]
    return (grid.at_samples(moved) / _spread(data)[:, None]).square().sum((1, 2)).div(n).sqrt().nan_to_num(torch.inf)


def leaves_without_inputs(model: ContactLagrangian, data: Trajectories, states: Tensor, max_step: float) -> bool:
    """Whether a run with the mean of the inputs leaves the recorded range by the spread of a coordinate, or fails."""
    assert data.u is not None
    grid, mean = segment_grid(data, data.samples, max_step), replace(data, u=data.u.mean(0).expand_as(data.u))
    run = continued(model, states[grid.start_sample], grid.h, step_inputs(model, mean, grid))
    q, low, high = grid.at_samples(run[..., : data.dof]), data.q.amin(0), data.q.amax(0)
    return not bool(((q > low - _spread(data)) & (q < high + _spread(data))).all())


def _spread(data: Trajectories) -> Tensor:
    """Standard deviation of each coordinate, (n,)."""
    return data.q.std(0, correction=0).clamp_min(1e-300)


def pushes(run: FittedRun, joint: Joint | None) -> str:
    """What is to be said of friction that clearly gives energy to the training part; nothing of any other."""
    if joint is None or not isinstance(run.model.damping, LinearDamping):
        return ""
    work, deviation, _ = Numbers(run.model, joint).known(work_of_friction(run), "work")
    return PUSHES if deviation is not None and work > CLEARLY * deviation else ""


def work_of_friction(run: FittedRun) -> Tensor:
    """The energy that friction gives to the training part, (), by the fitted motion from sample to sample.

    Σ (F⁻/c + F⁺)·Δ/h − γ p·Δ without inputs and constant loads, which are no friction; < 0 where it brakes.
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
        impulse = forces[0] / (-model.damping.rate * h).exp()[:, None] + forces[1]
        work = work + (impulse / h[:, None] * move).sum()
    for g, text in enumerate(model.config.drag):
        if text.startswith("load"):
            assert model.drag is not None
            work = work + model.drag.coefficient[g] * move[:, int(text.split()[1]) - 1].sum()
    return work
