"""The uncertainty of free runs beyond the data: by the start, by the parameters, and by terms too small to be seen.

Held-out time says nothing about longer motion. Around the fit the cost is quadratic with A = JᵀJ: start states and
parameters have the covariance A⁻¹, and a free run with sensitivities Z changes by Z δ. A term that the fit does not
have may act all the same. The Bayesian information criterion leaves a term out if the cost would fall by less than
½ log N: the term may be as large as √(log N) of its standard deviations, and all other unknowns follow. Unseen samples
that a free run meets to the noise count in A: a force that they would show is no larger.

Free runs go on from the end of the training part for `TURNS` turns of the motion or over the whole unseen part,
whichever is longer; recorded inputs are repeated where there are no more. A chaotic motion is lost by its start alone,
whatever the law; from then on two motions know nothing of each other. All uncertainties grow there at one rate, and one
that is a few times larger loses the motion only a little earlier: samples count for half of the time until the start
alone loses it. Samples where the run has left the recorded range do not count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.noise import AT_THE_NOISE
from herglotz.models import ContactLagrangian
from herglotz.models.config import POWERS
from herglotz.models.drag import input_forces
from herglotz.progress import beat
from herglotz.training.baseline import Baseline
from herglotz.training.following import HALF, unexplained
from herglotz.training.free_run import continued
from herglotz.training.look import Look
from herglotz.training.named_terms import (
    DRY,
    NamedTerms,
    candidates,
    places,
    settings_of,
    shapes_of_dry,
    special,
    started,
    values_of,
)
from herglotz.training.objectives import Fitted
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import FIRST_SEGMENT, segment_grid, step_inputs
from herglotz.training.problems.prior import NETWORKS, prior_of
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.pruning import inverse_of
from herglotz.training.structure import MOST
from herglotz.training.task import Task, build_model, with_sticking

# Share of the spread: a free run of a larger uncertainty is useless.
UNCERTAIN = 0.1
# A turn is 2π times the ratio of the spreads of q and q̇: the period of an oscillation.
TURNS = 2.0
# Longest free run, over the recorded time.
LONGEST = 10
# A term with a smaller share of its information left is a combination of other terms, to rounding, and changes nothing.
# Under a controller, terms that do change the free motion have shares of 1e-11.
MIN_INFORMATION = 1e-12
# Most trajectories that are continued.
RUNS = 4


@dataclass(frozen=True)
class Foresight:
    """The uncertainty of free runs: RMS over samples, over the spread of each coordinate.

    `unseen` is the uncertainty by start states and parameters over the unseen part, `apart` the distance of two motions
    of this kind that know nothing of each other. `followed` is the time after which the start alone is uncertain, inf
    if it stays known. `parameters` is the uncertainty over the `horizon`, the time beyond the training part. `hidden`
    is the largest change by a term that the fit does not have, of this `name`. `reached`: all steps were solved.
    """

    unseen: float
    apart: float
    followed: float
    parameters: float
    hidden: float
    name: str
    horizon: float
    reached: bool

    @property
    def open(self) -> float:
        """The larger of the uncertainties by parameters and by hidden terms; inf where a step fails."""
        return max(self.parameters, self.hidden) if self.reached else math.inf


def foresee(task: Task, fitted: Fitted, seen: Look, states: Tensor) -> Foresight | None:
    """See the head of this module; None where the model does not follow the data.

    `states` (N, 2n+1) are those of the finished fit at all samples of `seen.data`; a free run gives the unseen ones.
    """
    if not fitted.notes.get("follows_data", True) or not bool(torch.isfinite(states).all()):
        return None
    length = fitted.notes.get("segment_steps", FIRST_SEGMENT * task.config.substeps) // task.config.substeps
    known, used = fitted.states[~seen.spikes], fitted.used
    model, base, absent = _with_absent_terms(task, fitted.model)
    problem = ShootingProblem(
        model, task.data, segment_grid(task.data, max(length, 1), base.model_step), sigma=fitted.sigma,
        prior=prior_of(model, base, fitted.notes.get("departure")), used=used,
        freedom=FREEDOM if fitted.notes.get("robust") else None,
    )  # fmt: skip
    theta, x = problem.parameters.get(), known[problem.grid.start_sample]
    problem.guess_from_states(known)
    cost, A, _ = problem.normal_equations(problem.pack(theta, x[:, : problem.d]))
    beat()
    if not math.isfinite(float(cost)):
        return None
    low, high = task.data.q.amin(0), task.data.q.amax(0)
    steps, q = task.data.steps(), known[:, : task.data.dof]
    v = (q[steps.index + 1] - q[steps.index]) / steps.h[:, None]
    # The longest turn of the coordinates' motion.
    turn = float((2 * math.pi * q.std(0) / v.square().mean(0).sqrt().clamp_min(1e-300)).max())
    runs = _Ahead.of(task.data, seen.data, problem, turn)
    guess = runs.stepped_on(fitted.model, states, base.model_step)
    runs, guess = runs.until_lost(guess, low, high)
    ahead, path = None, None
    if guess is not None:
        ahead = ShootingProblem(
            model, runs.data, segment_grid(runs.data, runs.data.samples, base.model_step), sigma=problem.sigma
        )
        ahead.guess_from_states(guess)
        path = ahead.solve(ahead.pack(theta, x[runs.segments, : ahead.d]))
    beat()
    if ahead is None or path is None or (told := A.onto(runs.segments)) is None:
        return Foresight(math.inf, math.sqrt(2), math.inf, math.inf, 0.0, "", runs.horizon, False)
    spread, Z = task.data.q.std(0, correction=0).clamp_min(1e-300), ahead.slopes_at_samples(theta, path).double()
    q = ahead.grid.at_samples(path.x[..., : problem.n])
    inside = ((q >= low) & (q <= high)).all(-1)
    # Under a controller the unseen part is more of the same: no rest of the inputs tells what they do.
    free = seen.data.u is None or unexplained(seen.data, states) >= HALF
    if free:
        told += _of_unseen(Z, q, problem, runs, seen.data)
    apart = _apart(seen.data, task.data, spread)
    starts = inverse_of(A.blocks[runs.segments].double())
    return _summary(starts, told, Z / spread[:, None], problem, runs, absent, inside, apart)


@dataclass(frozen=True)
class _Ahead:
    """Times and inputs of free runs, each from the start of the last segment of a trajectory."""

    data: Trajectories  # (N) samples, positions are 0
    rows: Tensor  # (N,) the same samples in all data; −1 beyond them
    segments: list[int]  # (runs) segments of the fit, from whose starts the runs start
    beyond: Tensor  # (N,) bool: after the training part
    horizon: float

    @property
    def unseen(self) -> Tensor:
        """Samples of the unseen part, (N,) bool."""
        return self.beyond & (self.rows >= 0)

    def known_for(self, uncertain: Tensor) -> Tensor:
        """The time beyond the training part until the first `uncertain` sample, (N,) bool, of each run; inf if none."""
        first = []
        for t, there, out in zip(
            *(x.split(list(self.data.lengths)) for x in (self.data.t, self.beyond, uncertain)), strict=True
        ):
            lost = (there & out).nonzero()[:, 0]
            first.append(float(t[lost[0]] - t[there][0]) if len(lost) else math.inf)
        return torch.tensor(first, dtype=torch.float64)

    def within(self, times: Tensor) -> Tensor:
        """Samples beyond the training part, up to these times (runs,) from its end on, (N,) bool."""
        parts = zip(
            *(x.split(list(self.data.lengths)) for x in (self.data.t, self.beyond)), times.tolist(), strict=True
        )
        return torch.cat([there & (t - t[there][0] <= most) for t, there, most in parts])

    @classmethod
    def of(cls, train: Trajectories, data: Trajectories, problem: ShootingProblem, turn: float) -> _Ahead:
        """Runs over the rest of the data, and on for two turns of the motion."""
        owner, step, horizon = train.trajectory[problem.grid.start_sample], data.typical_step, 0.0
        segments, times, rows, recorded, beyond = [], [], [], [], []
        for b in torch.linspace(0, len(data) - 1, min(RUNS, len(data))).round().long().tolist():
            segment = int((owner == b).nonzero()[-1])
            every = torch.arange(data.offsets[b], data.offsets[b] + data.lengths[b])
            t = data.t[every].cpu()
            last = float(train.t[train.offsets[b] + train.lengths[b] - 1])
            wanted = min(TURNS * turn, LONGEST * float(t[-1] - t[0]))
            more = max(0, math.ceil((last + wanted - float(t[-1])) / step))
            own = every[t >= float(train.t[problem.grid.start_sample[segment]])]
            segments.append(segment)
            times.append(torch.cat([data.t[own], data.t[own[-1]] + step * torch.arange(1, more + 1).to(data.t)]))
            rows.append(torch.cat([own, torch.full((more,), -1)]))
            recorded.append(torch.cat([own, every[torch.arange(more) % len(every)]]))
            beyond.append(times[-1] > last)
            horizon = max(horizon, float(times[-1][-1]) - last)
        t, lengths = torch.cat(times), tuple(map(len, times))
        u = None if data.u is None else data.u[torch.cat(recorded)]
        made = replace(
            data, t=t, q=data.q.new_zeros(len(t), data.dof), u=u, s=None, p=None, lengths=lengths, observed=None,
            recordings=(),
        )  # fmt: skip
        return cls(made, torch.cat(rows).to(t.device), segments, torch.cat(beyond), horizon)

    def stepped_on(self, model: ContactLagrangian, states: Tensor, max_step: float) -> Tensor:
        """States at all samples of these runs, known ones and those of the model's steps; NaN from a failed step on.

        The fitted model steps quicker than the model with all terms.
        """
        known, parts = states[self.rows], []
        for first, length in zip(self.data.offsets, self.data.lengths, strict=True):
            last = int((self.rows[first : first + length] >= 0).nonzero()[-1])
            if last < length - 1:
                # Trajectories have three samples at least.
                parts.append(torch.arange(first + min(last, length - 3), first + length))
        if not parts:
            return known
        at = torch.cat(parts).to(known.device)
        rest = self.data.rows(at, tuple(map(len, parts)))
        grid = segment_grid(rest, rest.samples, max_step)
        x = known[at[grid.start_sample]]
        known[at] = grid.at_samples(continued(model, x, grid.h, step_inputs(model, rest, grid)))
        return known

    def until_lost(self, states: Tensor, low: Tensor, high: Tensor) -> tuple[_Ahead, Tensor | None]:
        """These runs up to where a step fails, with their `states`; None where one fails inside of [low, high], (n,).

        A run that fails outside the recorded range says no more about the model than a run that only leaves the range.
        """
        found, q = torch.isfinite(states).all(-1), states[:, : len(low)]
        inside, kept, lengths = ((q >= low) & (q <= high)).all(-1), [], []
        for first, length in zip(self.data.offsets, self.data.lengths, strict=True):
            lost = (~found[first : first + length]).nonzero()[:, 0]
            end = length if not len(lost) else int(lost[0])
            if end < length and (end < MIN_SAMPLES or bool(inside[first + end - 1])):
                return self, None
            kept.append(torch.arange(first, first + end))
            lengths.append(end)
        rows = torch.cat(kept).to(states.device)
        cut = replace(
            self, data=self.data.rows(rows, tuple(lengths)), rows=self.rows[rows], beyond=self.beyond[rows.cpu()]
        )
        return cut, states[rows]


def _with_absent_terms(
    task: Task, model: ContactLagrangian
) -> tuple[ContactLagrangian, Baseline, dict[str, list[int]]]:
    """A model of named terms with all other candidates at 0, and the places of these; any other model as it is."""
    c, data, parameters = task.config, task.data, ParameterVector(model)
    own = NamedTerms(c.features, c.drag, c.dissipation, c.coulomb)
    every = _searched(task, own, parameters)
    if every is None or not set(own.names) <= set(every.names):
        return model, task.base, {}
    values = values_of(parameters, parameters.get())
    full = replace(settings_of(every, data, c, c.order, c.substeps), sticking=c.sticking)
    base = started(task.base, data, values, full)
    more = build_model(base, full, "none")
    more = with_sticking(more, excess=False) if full.sticking else more
    numbers = ParameterVector(more)
    at = {name: where for name, where in places(numbers).items() if name not in own.names}
    return more, base, at | {name: [i] for i, name in enumerate(numbers.numbers) if name in c.absent}


def _searched(task: Task, own: NamedTerms, parameters: ParameterVector) -> NamedTerms | None:
    """The candidates of the search that gives a model of these named terms; None where no search gives the model."""
    c, data = task.config, task.data
    told = any((c.known, c.terms, c.input_map, c.translations and not c.features))
    network = any(name.startswith(NETWORKS) for name in parameters.names)
    by_name = c.level in ("linear", "forced") or bool(c.dissipation)
    if network or told or c.objective != "trajectory" or not by_name or data.dof > MOST:
        return None
    every, rare = candidates(data, c.translations), set(special(data))
    every = every.joined(NamedTerms(drag=input_forces(c.drag)))
    every = replace(every, dissipation=tuple(POWERS) if c.dissipation else ())
    if not rare & set(own.features):
        every = every.only(set(every.names) - rare)
    return replace(every, one_rate=every.one_rate and c.level != "forced")


def _of_unseen(Z: Tensor, q: Tensor, problem: ShootingProblem, runs: _Ahead, data: Trajectories) -> Tensor:
    """JᵀJ, by θ and the starts of the runs, of the unseen samples of `data` at q with sensitivities Z (N, n, P + d).

    All samples count of a run that meets them to the noise. A run that misses more counts as one reading of this error:
    a force that is missing may make all of it.
    """
    found = Z.new_zeros(2 * [problem.P + len(runs.segments) * problem.d])
    every = torch.arange(len(q), device=q.device).split(list(runs.data.lengths))
    for run, rows in enumerate(every):
        rows = rows[runs.unseen[rows]]
        at = runs.rows[rows]
        there = torch.ones_like(q[rows]) if data.observed is None else data.observed[at]
        r = there * (q[rows] - data.q[at]) / problem.deviations
        J, missed = (Z[rows] * (there / problem.deviations)[..., None]).flatten(0, 1), float(r.square().sum())
        own = problem.places(run)
        found[own[:, None], own] += J.T @ J / (1.0 if missed <= AT_THE_NOISE**2 * float(there.sum()) else missed)
    return found


def _summary(
    starts: Tensor, told: Tensor, Z: Tensor, problem: ShootingProblem, runs: _Ahead, absent: dict[str, list[int]],
    inside: Tensor, apart: float,
) -> Foresight:  # fmt: skip
    """The variances of free runs from their sensitivities Z (N, n, P + d) over the spread.

    `starts` (runs, d, d) are the covariances of the starts alone, and `told` is JᵀJ by θ and all starts of runs. Only
    samples `inside` the recorded range, (N,) bool, count. `apart` is that of `Foresight`.
    """
    P = problem.P
    names = [name for name, at in absent.items() for _ in at]
    C, follow = _open(told, absent, problem)
    start, parameters, hidden = [], [], []
    for run, (state, z) in enumerate(zip(starts, Z.split(list(runs.data.lengths)), strict=True)):
        own = problem.places(run)
        start.append(((z[..., P:] @ state) * z[..., P:]).sum(-1).mean(-1))
        parameters.append(((z @ C[own][:, own]) * z).sum(-1).mean(-1))
        hidden.append((z @ follow[own]).square().mean(1))
    of_start, of_all, by_term = torch.cat(start), torch.cat(parameters), torch.cat(hidden)
    followed = runs.known_for(of_start.sqrt() >= UNCERTAIN)
    counts = runs.within(followed / 2) & inside
    by_term = by_term[counts].sum(0) / max(1, int(counts.sum()))
    worst = int(by_term.argmax()) if names else -1
    lost = runs.beyond & ~runs.within(followed)
    of_unseen = torch.where(lost, of_all.new_tensor(apart**2).maximum(of_all), of_all)[runs.unseen]
    return Foresight(
        unseen=_root(of_unseen), apart=apart, followed=float(followed.min()),
        parameters=_root(of_all[counts]), horizon=runs.horizon, reached=True,
        hidden=float(by_term[worst].sqrt()) if names else 0.0, name=names[worst] if names else "",
    )  # fmt: skip


def _apart(data: Trajectories, train: Trajectories, spread: Tensor) -> float:
    """The RMS distance of two motions of this kind that know nothing of each other, over the spread of each coordinate.

    √2 where motions stay about a place. Where they wander, as of a pendulum that turns over, positions that lie as far
    apart in time as the unseen part is long tell more.
    """
    moved = []
    for one, seen in zip(data, train.lengths, strict=True):
        ahead = one.samples - seen
        if ahead:
            both = one.complete[ahead:] & one.complete[:-ahead]
            moved.append(((one.q[ahead:] - one.q[:-ahead]) / spread)[both])
    far = torch.cat(moved).square().mean().sqrt() if any(map(len, moved)) else spread.new_zeros(())
    return max(math.sqrt(2), float(far))


def _open(A: Tensor, absent: dict[str, list[int]], problem: ShootingProblem) -> tuple[Tensor, Tensor]:
    """Covariance of the fit's unknowns, and the change of all unknowns with each absent term at its limit."""
    others = torch.tensor([i for at in absent.values() for i in at], dtype=torch.long)
    held = torch.zeros(len(A), dtype=torch.bool)
    held[others] = True
    # The numbers that shape a force of 0 have no effect.
    if DRY in absent:
        held[shapes_of_dry(problem.parameters)] = True
    free = (~held).nonzero()[:, 0]
    C = torch.zeros_like(A)
    C[free[:, None], free] = inverse_of(A[free][:, free])
    follow = -C @ A[:, others]
    left = A[others, others] + (A[:, others] * follow).sum(0)
    follow[others, torch.arange(len(others))] = 1.0
    most, apart = math.log(problem.data.q.numel()), left > MIN_INFORMATION * A[others, others]
    return C, follow * torch.where(apart, most / left, 0.0).sqrt()


def _root(variances: Tensor) -> float:
    return float(variances.mean().sqrt()) if len(variances) else 0.0
