"""The Gauss–Newton (Laplace) posterior of a fit, and the bands of its predictions.

Around the fit, −log posterior ≈ ½ (x − x̂)ᵀ A (x − x̂) with A = JᵀJ of the trajectory problem, prior included, so the
unknowns x (parameters and start states) have covariance A⁻¹. A⁻¹ assumes white residuals, but the error of a
deterministic model is not white: the covariance is multiplied by (held-out RMS / σ)². The RMS is that of the median
block of held-out time, because a block that alone determines some number has a large error, which A⁻¹ accounts for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.noise import spikes
from herglotz.data.splits import leading_rows
from herglotz.errors import InputError, refuse
from herglotz.models import refuse_own
from herglotz.threads import one_thread
from herglotz.training.arrowhead import Arrowhead
from herglotz.training.baseline import estimate_baseline
from herglotz.training.cross_validation import held_out_errors
from herglotz.training.equation import HALVED
from herglotz.training.equation_words import Joint
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.pruning import inverse_of
from herglotz.training.run import Run
from herglotz.training.solvers.lifted_newton import Path
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.trades import Trade, combinations
from herglotz.training.trajectory_fit import fit_states

# Parameters with a name in mechanics, by the start of their names.
PHYSICAL = ("kinetic.log", "kinetic.off", "potential.stiffness", "potential.tilt", "damping.rate", "damping.drag",
            "friction.")  # fmt: skip


@dataclass(frozen=True)
class Bands:
    """A prediction with its uncertainty, at every sample of the data; all in the units of q.

    Parameters
    ----------
    q
        (N, n) free run, in the units of the data.
    std
        (N, n) standard deviation of the model's position, in the units of q.
    sigma
        (n,) standard deviation of the measurement noise, in the units of q.
    """

    q: Tensor
    std: Tensor
    sigma: Tensor

    def interval(self, level: float = 0.9, *, measured: bool = True) -> tuple[Tensor, Tensor]:
        """Lower and upper end of the central interval of a measured value, or of the true position, (N, n) each."""
        width = quantile(level) * ((self.std.square() + self.sigma**2).sqrt() if measured else self.std)
        return self.q - width, self.q + width

    def inside(self, q: Tensor, level: float = 0.9) -> Tensor:
        """Which measured positions q, (N, n), lie inside their interval; bool (N, n)."""
        low, high = self.interval(level)
        return (q >= low) & (q <= high)


def quantile(level: float) -> float:
    """Half the width of the central interval of this probability, in standard deviations of a normal distribution."""
    refuse({f"level must be between 0 and 1, got {level:g}; 0.9 is usual": not 0 < level < 1})
    return NormalDist().inv_cdf(0.5 + level / 2)


@dataclass(frozen=True)
class Starts:
    """The start x of each trajectory in JᵀJ = A of a fit: its covariance at fixed θ, and its derivative by θ."""

    inverse: Tensor  # (B, d, d) A_xx⁻¹
    follow: Tensor  # (B, d, P) −A_xx⁻¹ A_xθ

    @classmethod
    def of(cls, A: Arrowhead) -> Starts:
        """Those of a fit whose segments are whole trajectories."""
        inverse = inverse_of(A.blocks.double())
        return cls(inverse, -inverse @ A.border.double())

    def information(self, A: Arrowhead) -> Tensor:
        """The Schur complement A_θθ − A_θx A_xx⁻¹ A_xθ of the parameters, (P, P)."""
        found = A.corner.double() + A.border.double().flatten(0, 1).T @ self.follow.flatten(0, 1)
        return (found + found.T) / 2


class Laplace:
    """Posterior of a run's parameters and start states; made by `laplace`.

    `covariance` (P, P) is that of the parameters, and `information` (P, P) is JᵀJ with the starts eliminated.
    """

    def __init__(self, run: Run):
        self.run = run
        data = run.data.unwrapped()
        rows = leading_rows(data.lengths, run.train_lengths)
        out = torch.zeros(data.samples, dtype=torch.bool, device=data.q.device)
        out[run.metrics.get("outlier_samples", [])] = True
        states, train, out = run.states.joined[rows], data.rows(rows, run.train_lengths), out[rows]
        if run.config.robust != "off":
            lone = spikes(train)
            train, out, states = train.keep(~lone), out[~lone], states[~lone]
        self.freedom = FREEDOM if run.metrics.get("robust") else None
        found = run.config.robust == "on" or bool(run.metrics.get("outliers"))
        base = estimate_baseline(train, outliers=found, substeps=run.decided.substeps)
        self.base = replace(base, spreads=run.metrics.get("plan", {}).get("spreads", {}))
        self.sigma = run.metrics.get("sigma") or 0.0
        if not 0 < self.sigma * self.sigma < float("inf"):
            raise InputError(f"the run's metrics have sigma {self.sigma:g}, and it must be a size > 0; fit again")
        departure = run.metrics.get("departure") or run.decided.departures[-1]
        self.prior = prior_of(run.model, self.base, departure)
        self.problem, self.path = self._solved(train, run.states.joined[list(data.offsets)], ~out, guess=states)
        self.theta = self.problem.parameters.get()
        x = self.problem.unknowns(self.theta, self.path)
        cost, self.matrix, self._slope = self.problem.normal_equations(x)
        if not all(bool(torch.isfinite(x).all()) for x in (cost, self.matrix.corner, self.matrix.blocks)):
            raise InputError("the motion is so unstable that its derivatives overflow, so the run has no posterior")
        errors = held_out_errors(self.problem, self.path, self.theta, self.matrix)
        self.inflation = inflation_of(errors, self.sigma)
        self.starts = Starts.of(self.matrix)
        self.information = self.starts.information(self.matrix)
        self.covariance = inverse_of(self.information) * self.inflation**2

    @one_thread()
    def bands(self) -> Bands:
        """The run's prediction at every sample with its standard deviation, held-out part included.

        First order in the unknowns: dq_k = Z_k d(θ, start), with Z through every implicit step.
        """
        return self._bands(self.run.data.unwrapped(), self.path.x[:, 0], self.joint(self.starts))

    def predict(self, data: Trajectories, seen: int) -> Bands:
        """Bands of new trajectories: their first `seen` samples give the start states, a free run the rest.

        The start of each is fitted to those samples, θ being fixed; its covariance with θ is that of `joint`.

        The data have the coordinates, units and inputs of the run, and more than `seen` ≥ 3 samples per trajectory; in
        the first `seen` samples the bands are those of a fit. Raise InputError if a trajectory is shorter, or the model
        does not follow its beginning.
        """
        data, where = data.unwrapped(), data.source or "data"
        if data.angles != self.run.data.angles:
            raise InputError(f"{where}: angles {data.angles}, but the run's are {self.run.data.angles}")
        if not 3 <= seen < min(data.lengths):
            raise InputError(f"{where}: seen must be from 3 to {min(data.lengths) - 1} samples, got {seen}")
        lengths = (seen,) * len(data)
        head = data.rows(leading_rows(data.lengths, lengths), lengths)
        task = Task(head, self.base, replace(self.run.decided, iterations=1), Stages())
        found = fit_states(task, self.run.model, self.sigma)
        if found is None or found.problem.grid.segments > len(data):
            raise InputError(f"{where}: the model cannot follow the first {seen} samples; fit it to such motions too")
        _, A, _ = found.problem.normal_equations(found.problem.unknowns(self.theta, found.path))
        return self._bands(data, found.path.x[:, 0], self.joint(Starts.of(A)))

    def joint(self, starts: Starts) -> Iterator[Tensor]:
        """The covariance (P + d, P + d) of the parameters and of the start of each trajectory.

        With the covariance C of θ and the derivative G of a start x by θ, (θ, x) has the covariance
        [[C, C Gᵀ], [G C, G C Gᵀ + A_xx⁻¹]].
        """
        C, P = self.covariance, len(self.theta)
        for inverse, follow in zip(starts.inverse, starts.follow, strict=True):
            G = torch.cat([torch.eye(P).to(C), follow])
            S = G @ C @ G.T
            S[P:, P:] += inverse * self.inflation**2
            yield S

    def _bands(self, data: Trajectories, start: Tensor, joint: Iterable[Tensor]) -> Bands:
        """Runs from `start`, (B, 2n+1), with a covariance of (θ, start) for each, (P + d, P + d)."""
        whole, path = self._solved(data, start)
        with torch.no_grad():
            Z = whole.slopes_at_samples(self.theta, path).double().split(data.lengths)  # (N_b, n, P + d) each
            variance = torch.cat([((z @ C) * z).sum(-1) for z, C in zip(Z, joint, strict=True)])
        q, std = whole.grid.at_samples(path.x[..., : whole.n]), variance.clamp_min(0).sqrt().to(data.q)
        return Bands(q, std, self.problem.deviations)

    def of_short_steps(self) -> tuple[Tensor, Tensor] | None:
        """Parameters (P,) and start states (B, d) to which those of the fit tend as its steps get shorter.

        One Gauss–Newton step with halved steps, x ← x − A⁻¹ (b₂ − b), removes the change of the fit; by Richardson's
        rule the limit is `HALVED` times as far. None if the model cannot be run with halved steps.
        """
        problem, x, d = self.problem, self.problem.unknowns(self.theta, self.path), self.problem.d
        grid = segment_grid(problem.data, max(problem.data.lengths), self.base.model_step / 2)
        other = ShootingProblem(
            self.run.model, problem.data, grid, sigma=self.sigma, prior=self.prior, freedom=self.freedom,
            used=problem.used,
        )  # fmt: skip
        other.guess_from(problem, self.path)
        cost, _, slope = other.normal_equations(x)
        if not bool(torch.isfinite(cost)):
            return None
        moved, P = (slope - self._slope).double() * -HALVED, len(self.theta)
        by_theta, by_start = moved[:P], moved[P:].reshape(-1, d)
        step = inverse_of(self.information) @ (by_theta + torch.einsum("sdp,sd->p", self.starts.follow, by_start))
        steps = self.starts.follow @ step + (self.starts.inverse @ by_start[..., None])[..., 0]
        theta, start = self.theta.double() + step, x[P:].reshape(-1, d).double() + steps
        return (theta.to(x), start.to(x)) if bool(theta.isfinite().all() & start.isfinite().all()) else None

    def standard_deviations(self) -> dict[str, Tensor]:
        """Standard deviation of every parameter, by name, in its own units."""
        return self.problem.parameters.unflatten(self.covariance.diagonal().clamp_min(0).sqrt())

    def effective_parameters(self) -> float:
        """The effective number of parameters, P − tr(C A_prior), which the data determine (MacKay 1992)."""
        _, prior, _ = self.prior.normal_equations(self.theta)
        return len(self.theta) - float((self.covariance / self.inflation**2 * prior.double()).sum())

    def _solved(
        self, data: Trajectories, start: Tensor, used: Tensor | None = None, guess: Tensor | None = None
    ) -> tuple[ShootingProblem, Path]:
        """Each trajectory as one segment, solved from its start state (B, 2n+1), near the states `guess` (N, 2n+1)."""
        grid = segment_grid(data, max(data.lengths), self.base.model_step)
        problem = ShootingProblem(
            self.run.model, data, grid, sigma=self.sigma, prior=self.prior, freedom=self.freedom, used=used
        )
        theta = problem.parameters.get()
        if guess is not None:
            problem.guess_from_states(guess)
        path = problem.solve(problem.pack(theta, start[:, : problem.d]))
        if path is None:
            raise InputError("the model cannot be run over its own data, so it has no bands; fit it again")
        return problem, path


def inflation_of(errors: Tensor, sigma: float) -> float:
    """The factor f of deviations, at least 1: median of the RMS `errors` of held-out blocks, over σ."""
    return float("inf") if int(errors.isinf().sum()) > 1 else max(1.0, float(errors.median()) / sigma)


@one_thread()
def laplace(run: Run) -> Laplace:
    """The Gauss–Newton posterior of a run: 𝒩(θ̂, f² (JᵀJ)⁻¹), J the derivatives of residuals over their σ.

    f is the error over held-out blocks of time over σ (section 7 of `docs/trajectory.md`; head of this module).

    Parameters
    ----------
    run
        A fit whose model follows its data (`metrics["follows_data"]`).

    Returns
    -------
    Laplace
        `bands()` on the data of the run, `predict(data, seen)` on others, `standard_deviations()` of the parameters.

    Raises
    ------
    InputError
        If the trajectories cannot be solved from the run's states.
    """
    refuse_own(run.model, "posterior", "fit several starting weights for a spread")
    return Laplace(run)


@one_thread()
def ensemble_bands(runs: Sequence[Run], data: Trajectories | None = None, seen: int = 20) -> Bands:
    """The mean prediction of fits from several seeds to the same data, with their spread.

    By the law of total variance the variance of the position is the mean of the fits' Laplace variances plus the
    variance of their predictions: the uncertainty around each minimum, and the distance of the minima.
    With `data`: bands of other trajectories, each started from its first `seen` samples (`Laplace.predict`). Raise
    InputError if there are fewer than two runs, or the runs were fitted to different data.
    """
    if len(runs) < 2:
        raise InputError(f"an ensemble needs two runs or more, got {len(runs)}; fit other seeds")
    if len({(run.data.digest(), run.train_lengths) for run in runs}) > 1:
        raise InputError("the runs of an ensemble must be fits to the same data; only their seeds may differ")
    bands = [laplace(run).bands() if data is None else laplace(run).predict(data, seen) for run in runs]
    q, std = torch.stack([b.q for b in bands]), torch.stack([b.std for b in bands])
    sigma = torch.stack([b.sigma for b in bands]).square().mean(0).sqrt()
    return Bands(q.mean(0), (std.square().mean(0) + q.var(0)).sqrt(), sigma)


def traded(posterior: Laplace) -> list[Trade]:
    """The combinations of physical parameters that the data of a fit do not determine, the worst first; [] if none."""
    names = posterior.problem.parameters.numbers
    rows = torch.tensor([i for i, name in enumerate(names) if name.startswith(PHYSICAL)], dtype=torch.long)
    M = information_of(posterior, rows)
    return combinations(M, posterior.matrix.corner.diagonal().double()[rows], [names[i] for i in rows.tolist()])


def information_of(posterior: Laplace, rows: Tensor) -> Tensor:
    """The information M (K, K) of the data on the parameters at the places `rows` (K,).

    With A = JᵀJ of the fit, prior included and starts eliminated, φ these parameters and r the others, M is the Schur
    complement A_φφ − A_φr A_rr⁻¹ A_rφ minus the prior of φ.
    """
    A = posterior.information
    rest = torch.ones(len(A), dtype=torch.bool)
    rest[rows] = False
    order = torch.cat([rest.nonzero()[:, 0], rows])
    _, prior, _ = posterior.prior.normal_equations(posterior.theta)
    return schur(A[order[:, None], order], len(rows)) - prior.double()[rows[:, None], rows]


def schur(A: Tensor, count: int) -> Tensor:
    """The Schur complement A_φφ − A_φr A_rr⁻¹ A_rφ of the last `count` unknowns φ.

    It is L_φφ L_φφᵀ of the Cholesky factor L, which no rounding error makes negative. In chaotic motion the start tells
    all but 1e-13 of the information on a number, and the difference itself is rounding. A singular A has no L.
    """
    size = torch.where(A.diagonal() > 0, A.diagonal(), 1.0).sqrt()
    L, singular = torch.linalg.cholesky_ex(A / size[:, None] / size)
    if not bool(singular):
        L = size[-count:, None] * L[-count:, -count:]
        return L @ L.T
    inverse = torch.linalg.pinv(A[:-count, :-count], hermitian=True)
    return A[-count:, -count:] - A[-count:, :-count] @ inverse @ A[:-count, -count:]


def joint_of(posterior: Laplace, least: float) -> Joint:
    """The joint posterior of all numbers, on the CPU, if positions are precise only to `least`, in units of q.

    Raise InputError if a change of some number by its rounding error in float64 moves the motion by more than the
    misfit: the motion is too unstable for the first-order posterior.
    """
    P, sigma = len(posterior.theta), posterior.sigma
    rounding = max(1.0, least / (sigma * posterior.inflation)) ** 2
    alone = posterior.matrix.corner.diagonal().double().clamp_min(1e-300).rsqrt() * max(1.0, least / sigma)
    lost = alone < torch.finfo(torch.float64).eps * posterior.theta.abs().to(alone)
    refuse({"rounding errors of the model's numbers change its motion by more than the misfit": bool(lost.any())})
    every = posterior.covariance * rounding, alone, information_of(posterior, torch.arange(P))
    return Joint(*(x.cpu() for x in every))


def determined(effective: float, every: int) -> str:
    """The number of parameters that the data determine, in words."""
    # Closer than 0.05 both numbers print alike.
    free = "" if effective > every - 0.05 else "; the others stay where the prior holds them"
    return f"{effective:.1f} of {every}{free}"
