"""Free runs of a model along recordings, and the states of a fit at every sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.splits import leading
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper, state_of
from herglotz.training.first_states import states_of_pairs
from herglotz.training.flow import motion
from herglotz.training.objectives import Fitted
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import SegmentGrid, segment_grid, step_inputs
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.lifted_newton import solve_path


def states_everywhere(
    fitted: Fitted, data: Trajectories, train_lengths: tuple[int, ...], max_step: float
) -> tuple[State, str]:
    """States at every sample: fitted ones, then a free run from the last fitted state; and "ok" or the failure."""
    out = data.q.new_full((data.samples, 2 * data.dof + 1), torch.nan)
    trained = leading(data.lengths, train_lengths).to(out.device)
    out[trained] = fitted.states
    run_on(Stepper(fitted.model), data, out, train_lengths, max_step)
    lost = data.trajectory[~trained & ~torch.isfinite(out).all(-1)]
    if not len(lost):
        return state_of(out), "ok"
    b = int(lost[-1])
    start = float(data.t[data.offsets[b] + train_lengths[b] - 1])
    return state_of(out), f"a step failed after t = {start:g}; nothing is predicted beyond it"


def run_on(
    stepper: Stepper,
    data: Trajectories,
    states: Tensor,
    known: Sequence[int],
    max_step: float,
    *,
    one_by_one: bool = True,
) -> SegmentGrid | None:
    """Fill in `states` (N, 2n+1) by a free run from the last of the `known` leading samples of each trajectory.

    NaN from a failed step on. Return the grid of the model steps; None if all samples are known. `one_by_one`: as for
    `free_runs`.
    """
    before = [k - 1 if k < length else length for k, length in zip(known, data.lengths, strict=True)]
    rows = (~leading(data.lengths, before)).nonzero()[:, 0].to(states.device)
    if not len(rows):
        return None
    rest = data.rows(rows, tuple(length - k for k, length in zip(before, data.lengths, strict=True) if k < length))
    grid = segment_grid(rest, rest.samples, max_step)
    # A hold may take the inputs of earlier samples into account.
    u = step_inputs(cast(ContactLagrangian, stepper.L_d), data, replace(grid, row=rows[grid.row]))
    runs = free_runs(stepper, rest, grid, states[rows[grid.start_sample]], u, one_by_one=one_by_one)
    states[rows] = grid.at_samples(runs)
    return grid


def free_runs(
    stepper: Stepper,
    data: Trajectories,
    grid: SegmentGrid,
    start: Tensor,
    u: Tensor | None,
    *,
    one_by_one: bool = True,
) -> Tensor:
    """Free runs from `start`, (S, 2n+1), over whole trajectories, (S, K+1, 2n+1); NaN from a failed step on.

    Near the data all steps are solved at once, with the data as initial guess; else one by one, which takes minutes for
    1e5 steps, or with `one_by_one` false not at all: all runs are NaN then. If a start is NaN, its run is NaN.
    """
    known, model = torch.isfinite(start).all(-1), cast(ContactLagrangian, stepper.L_d)
    nodes = near_data(model, data, grid, start, u) if bool(known.all()) else None
    if nodes is not None:
        return nodes
    nodes = start.new_full((len(start), grid.longest + 1, start.shape[-1]), torch.nan)
    if one_by_one and bool(known.any()):
        with torch.no_grad():
            inputs = None if u is None else u[known]
            out = stepper.rollout(*state_of(start[known]), h=grid.h[known], inputs=inputs)
        nodes[known] = out.states.joined
    return nodes


def near_data(
    model: ContactLagrangian, data: Trajectories, grid: SegmentGrid, start: Tensor, u: Tensor | None
) -> Tensor | None:
    """Free runs from `start`, (S, 2n+1), over whole trajectories, (S, K+1, 2n+1), all steps solved at once.

    Newton's method starts from the recorded positions; None if it does not converge, when the runs are not near them,
    and if the stepper goes elsewhere.
    """
    found = motion(model, start, grid.h, u)
    if found is not None:
        return found
    problem = ShootingProblem(model, data, grid, sigma=1.0, compiled=False)
    with torch.no_grad():
        problem.guess_from_states(states_of_pairs(model, data))
        assert problem.path is not None
        tol = 64 * torch.finfo(start.dtype).eps
        L_d = problem.parameters.at(problem.parameters.get(), u)
        path = solve_path(L_d, start, grid.h, problem.path.x, tol)
    return path.x if path is not None and _are_steps(model, path.x, grid, u) else None


def _are_steps(model: ContactLagrangian, nodes: Tensor, grid: SegmentGrid, u: Tensor | None) -> bool:
    """Whether the stepper takes every step of these runs (S, K+1, 2n+1) from where it begins.

    A step may have several solutions, of which the one near the data need not be that of the stepper.
    """
    there = torch.arange(grid.h.shape[1], device=nodes.device) < grid.end[:, None]
    start, q = state_of(nodes[:, :-1][there]), nodes[:, 1:, : model.dof][there]
    with torch.no_grad():
        taken = Stepper(model).step(start, grid.h[there], u=None if u is None else u[there]).state.q
    return bool((taken - q).abs().amax() <= torch.finfo(q.dtype).eps ** 0.5 * q.abs().amax())


def continued(model: ContactLagrangian, start: Tensor, h: Tensor, u: Tensor | None) -> Tensor:
    """The free runs from `start`, (S, 2n+1), as (S, K+1, 2n+1); NaN after a failed step of a run.

    Blocks of steps are solved at once, with straight lines as initial guess. After a block that converges the next is
    twice as long; after a failure one single step is taken. Batched evaluations are faster than single steps.
    """
    found = motion(model, start, h, u)
    if found is not None:
        return found
    parameters, n, tol = ParameterVector(model), (start.shape[-1] - 1) // 2, 64 * torch.finfo(start.dtype).eps
    x = start.new_full((h.shape[0], h.shape[1] + 1, start.shape[-1]), torch.nan)
    x[:, 0], theta, k, block, alive = start, parameters.get(), 0, 1, torch.arange(len(start), device=start.device)

    def at_once(before: Tensor, now: Tensor, h_before: Tensor, h: Tensor, u: Tensor | None) -> Tensor | None:
        guess = now[:, None].repeat(1, h.shape[1] + 1, 1)
        guess[:, 1:, :n] += ((now - before)[:, :n] / h_before)[:, None] * h.cumsum(1)[..., None]
        path = solve_path(parameters.at(theta, u), now, h, guess, tol)
        return None if path is None else path.x

    with torch.no_grad():
        while k < h.shape[1] and len(alive):
            now, steps, inputs = x[alive, k], h[alive, k : k + block], None if u is None else u[alive, k : k + block]
            new = at_once(x[alive, k - 1], now, h[alive, k - 1 : k], steps, inputs) if k else None
            block = max(2, block // 4) if new is None else 2 * block
            if new is None:
                inputs = None if inputs is None else inputs[:, :1]
                new = Stepper(model).rollout(*state_of(now), h=steps[:, :1], inputs=inputs).states.joined
            x[alive, k + 1 : k + new.shape[1]] = new[:, 1:]
            k += new.shape[1] - 1
            alive = alive[torch.isfinite(x[alive, k]).all(-1)]
    return x
