"""The states of a fit at every sample: fitted ones on the training part, a free run over the rest."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper, state_of
from herglotz.training.first_states import states_of_pairs
from herglotz.training.objectives import Fitted
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import SegmentGrid, segment_grid, step_inputs, substeps
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.lifted_newton import solve_path


def states_everywhere(
    fitted: Fitted, data: Trajectories, train_lengths: tuple[int, ...], max_step: float
) -> tuple[State, str]:
    """States at every sample, those of the training part and a free run from the last of them; and "ok", or why not.

    A model that follows the data has its free run near them: all steps are then solved at once, from the data. Else one
    after the other.
    """
    ends = torch.tensor(data.offsets) + torch.tensor(train_lengths)
    out = data.q.new_full((data.samples, 2 * data.dof + 1), torch.nan)
    trained = torch.arange(data.samples) < ends[data.trajectory.cpu()]
    out[trained] = fitted.states
    if bool(trained.all()):
        return state_of(out), "ok"
    found, status = _at_once(fitted, data, out, ends, max_step), "ok"
    if found is None:
        found, status = _stepped(fitted, data, out, ends, max_step)
    return state_of(found), status


def _at_once(fitted: Fitted, data: Trajectories, out: Tensor, ends: Tensor, max_step: float) -> Tensor | None:
    """`out` with the free runs, solved together from the recorded positions; None where that does not converge."""
    index = torch.arange(data.samples)
    rows = index[index >= ends[data.trajectory.cpu()] - 1]
    lengths = tuple((torch.tensor(data.offsets) + torch.tensor(data.lengths) - ends + 1).tolist())
    if min(lengths) < 2:
        return None
    rest = data.rows(rows, lengths)
    grid = segment_grid(rest, rest.samples, max_step)
    inputs = None if step_inputs(fitted.model, rest) is None else data.inputs_of_steps(rows[grid.row], grid.part)
    nodes = near_data(fitted.model, rest, grid, out[rows[grid.start_sample]], inputs)
    if nodes is None:
        return None
    out = out.clone()
    out[rows[grid.sample]] = nodes.flatten(0, 1)[grid.node]
    return out


def near_data(
    model: ContactLagrangian, data: Trajectories, grid: SegmentGrid, start: Tensor, u: Tensor | None
) -> Tensor | None:
    """Free runs from `start`, (S, 2n+1), over whole trajectories, (S, K+1, 2n+1), all steps solved at once.

    Newton's iteration starts from the recorded positions; None where that does not converge: the runs are elsewhere.
    """
    problem = ShootingProblem(model, data, grid, sigma=1.0)
    with torch.no_grad():
        problem.guess_from_states(states_of_pairs(model, data))
        assert problem.path is not None
        tol = 64 * torch.finfo(start.dtype).eps
        L_d = problem.parameters.at(problem.parameters.get(), u)
        path = solve_path(L_d, start, grid.h, problem.path.x, tol)
    return None if path is None or not bool(torch.isfinite(path.x).all()) else path.x


def continued(model: ContactLagrangian, start: Tensor, h: Tensor, u: Tensor | None) -> Tensor:
    """The free runs from `start`, (S, 2n+1), (S, K+1, 2n+1); NaN from a failed step of a run on.

    Blocks of steps are solved at once from straight lines: a block that converges doubles the next one, and after one
    that does not a single step is taken. A few batched evaluations stand for each step's own.
    """
    parameters, n, tol = ParameterVector(model), (start.shape[-1] - 1) // 2, 64 * torch.finfo(start.dtype).eps
    theta, x, k, block = parameters.get(), start[:, None], 0, 1

    def at_once(part: slice) -> Tensor | None:
        guess = x[:, -1:].repeat(1, h[:, part].shape[1] + 1, 1)
        v = (x[:, -1, :n] - x[:, -2, :n]) / h[:, k - 1 : k]
        guess[:, 1:, :n] += v[:, None] * h[:, part].cumsum(1)[..., None]
        L_d = parameters.at(theta, None if u is None else u[:, part])
        path = solve_path(L_d, x[:, -1], h[:, part], guess, tol)
        return None if path is None else path.x

    def stepped(part: slice) -> Tensor:
        inputs = None if u is None else u[:, part]
        return Stepper(model).rollout(*state_of(x[:, -1]), h=h[:, part], inputs=inputs).states.joined

    with torch.no_grad():
        while k < h.shape[1]:
            new = at_once(slice(k, k + block)) if block > 1 else None
            block = max(2, block // 4) if new is None else 2 * block
            new = stepped(slice(k, k + 1)) if new is None else new
            x, k = torch.cat([x, new[:, 1:]], 1), k + new.shape[1] - 1
    return x


def _stepped(fitted: Fitted, data: Trajectories, out: Tensor, ends: Tensor, max_step: float) -> tuple[Tensor, str]:
    """`out` with the free runs, one step after the other, and "ok" or why it ends; NaN from a failed step on."""
    stepper, status, driven = Stepper(fitted.model), "ok", step_inputs(fitted.model, data) is not None
    for first, length, end in zip(data.offsets, data.lengths, ends.tolist(), strict=True):
        if end == first + length:
            continue
        h, stops, row, part = _fine_steps(data.t[end - 1 : first + length], max_step)
        inputs = data.inputs_of_steps(end - 1 + row, part) if driven else None
        with torch.no_grad():
            run = stepper.rollout(*state_of(out[end - 1]), h=h, inputs=inputs)
        out[end : first + length] = run.states.joined[stops]
        if not bool(run.ok.all()):
            status = f"a step failed after t = {float(data.t[end - 1]):g}; nothing is predicted beyond it"
    return out, status


def _fine_steps(t: Tensor, max_step: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Model steps that cover the recorded times; the node that reaches each of them; each step's row, and its middle.

    The middle is a number from 0 to 1, of the recorded step that starts at the row.
    """
    counts = torch.tensor([substeps(h, max_step) for h in t.diff().tolist()], device=t.device)
    row = torch.arange(len(counts), device=t.device).repeat_interleave(counts)
    ends = counts.cumsum(0)
    part = (torch.arange(len(row), device=t.device) - (ends - counts)[row] + 0.5) / counts[row]
    return (t.diff() / counts).repeat_interleave(counts), ends, row, part.to(t.dtype)
