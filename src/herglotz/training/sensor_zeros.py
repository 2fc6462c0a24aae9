"""Sensors whose zeros differ from recording to recording: y = q + z. The recording of most samples is the reference.

A model cannot follow such recordings together, though each of them alone: friction makes up for some of the difference,
and nothing then asks for the zeros any more. The reference is therefore fitted alone. With that model held, z starts
where the other recordings' steps are missed least; then parameters, states and z are fitted together (`WithZeros`),
last with a z of the reference too, in place of all terms that q → −q turns round, such as a tilt. The steps, with
numbers, stand in `docs/measured.md`. Free runs over held-out time decide whether the zeros are used (`rivals`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.roughness import AT_THE_NOISE, precision
from herglotz.data.sensors import measured
from herglotz.data.smoothing import smoothed
from herglotz.data.units import common_unit, size
from herglotz.models import ContactLagrangian
from herglotz.models.drag import DragFeature, parse_drag
from herglotz.models.features import Product, parse
from herglotz.training.arrowhead import dense
from herglotz.training.config import FitConfig
from herglotz.training.cross_validation import MARGIN
from herglotz.training.first_states import first_states, states_of_pairs
from herglotz.training.look import Look, look
from herglotz.training.named_terms import places
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.one_step import ResidualProblem
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.zeros import WithZeros, reference_of
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt
from herglotz.training.stages import Stages
from herglotz.training.task import build_model
from herglotz.training.trajectory_fit import FIRST_SEGMENT, FLOOR, STAGE, SegmentStages, TrajectoryFit

ALONE = 0.8  # times the misfit together: a recording that misses no more where it is fitted alone differs from others
ROUND = 12  # zeros of an angle that are tried, all around
SPREADS = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)  # zeros of a length that are tried, in its spreads
AS_GOOD = 1.01  # times the least mean square: no force may depend on a coordinate, and its zero is not determined
NUDGE = 1e-3  # of the spread: differences for the derivatives by the zeros
FLAT = 1e-3  # of the largest singular value: directions of the zeros that no force depends on
ROUNDS = 10  # of Gauss–Newton
CLEARLY = 5.0  # standard deviations by which a zero differs from 0
THINNED = (1, 2, 4, 8)  # parts of a recording that tell its zeros: all, or every m-th where some cannot be followed
SETTLED = 0.1  # of the misfit: zeros that move by less have no say in the terms


@dataclass(frozen=True)
class Apart:
    """Recordings that named terms do not follow together, or only with terms that zeros of the sensors replace."""

    reference: int  # the recording of most samples; its zeros are 0 unless symmetry says where they are
    together: float  # misfit of the reference by the fit to all recordings, in units of q
    alone: float  # by the fit of the same terms to itself
    zeros: tuple[float, ...] = ()  # (B · n) recording after recording; empty where they do not explain the difference
    deviations: tuple[float, ...] = ()  # (B · n), standard deviations
    unit: str = ""  # of all coordinates, where they have one

    def of(self, found: FoundZeros) -> Apart:
        """With these zeros."""
        z, deviations = (tuple(x.flatten().tolist()) for x in (found.z, found.deviations))
        return replace(self, zeros=z, deviations=deviations)

    @property
    def differs(self) -> str:
        """What is wrong, in words; empty where the reference is followed with the others about as well as alone."""
        if self.alone > ALONE * self.together:
            return ""
        own, others = (size(x, self.unit, digits=2) for x in (self.alone, self.together))
        return f"recording {self.reference} is missed by {own} fitted alone, by {others} with the others"

    def __str__(self) -> str:
        sure = (f"{z:.4g} ± {d:.2g}" for z, d in zip(self.zeros, self.deviations, strict=True) if d)
        some = 0.0 in self.deviations
        which = f"zeros that differ from those of recording {self.reference}" if some else "zeros of all recordings"
        words = f"{which}: {', '.join(sure)}"
        return "; ".join(filter(None, (self.differs, words)))


def sensor_zeros(data: Trajectories, config: FitConfig, seen: Look) -> Apart | None:
    """What keeps recordings from being followed together; None where nothing does, or there is one alone.

    `seen` is the look at all of them, with the named terms that follow them best.
    """
    if len(data) == 1 or seen.found is None or seen.found.sigma is None:
        return None
    of = ZerosOf(seen)
    together, alone = of.fit(seen.kept), of.fit(seen.kept[of.reference])
    if together is None or alone is None:
        return None
    own = together.problem.data.trajectory == of.reference
    before = _rms(together.problem.misfit(together.path)[own])
    apart = Apart(of.reference, before, alone.noise, unit=common_unit(seen.kept.units))
    if config.find_zeros is None and not apart.differs:
        return None  # zeros that keep nothing apart are looked for where the user asks alone
    first = look(data[of.reference], config, Stages())
    found = of.best(first, alone)
    if found.z.any() and found.rms <= MARGIN * together.noise:
        return apart.of(found)
    return apart if apart.differs else None


def refined(apart: Apart, seen: Look) -> Apart | None:
    """The zeros by the terms of a look at the recordings without the last ones; None where they are about the same."""
    if seen.found is None or seen.found.sigma is None:
        return None
    of, start = ZerosOf(seen), seen.kept.q.new_zeros(len(seen.kept), seen.kept.dof)
    model = build_model(seen.base, seen.settings, "none")
    found = of.symmetric(model, of.moved(model, start))
    if float((found.z / seen.kept.balance).abs().max()) < SETTLED * of.sigma:
        return None
    zeros, before = (found.z.new_tensor(x).reshape(found.z.shape) for x in (apart.zeros, apart.deviations))
    deviations = torch.where(found.deviations > 0, found.deviations, before)  # of the reference, where it stayed put
    return apart.of(clearly(FoundZeros(found.z + zeros, deviations, found.rms)))


class FoundZeros(NamedTuple):
    """Zeros of the sensors, their standard deviations, and the misfit with them."""

    z: Tensor  # (B, n), or as many as there are unknowns
    deviations: Tensor  # as z
    rms: float


def clearly(found: FoundZeros) -> FoundZeros:
    """With 0 for the zeros that are not clearly there."""
    return found._replace(z=torch.where(found.z.abs() > CLEARLY * found.deviations, found.z, 0.0))


def zeros_of_one(model: ContactLagrangian, data: Trajectories, sigma: float, max_step: float) -> tuple[float, ...]:
    """The zeros (n,) of the sensors of one recording, of which these are parts, by a model that is held.

    By multiple shooting, with the states where the parts start; 0 for zeros that are not clearly there. Where the model
    cannot follow some part, every second one is taken, or fewer; zeros are 0 where it follows none of these either.
    """
    found = (
        _of_parts(model, data.select(range(0, len(data), by)), sigma, max_step) for by in THINNED if by <= len(data)
    )
    return next((zeros for zeros in found if zeros is not None), (0.0,) * data.dof)


def _of_parts(model: ContactLagrangian, data: Trajectories, sigma: float, max_step: float) -> tuple[float, ...] | None:
    """By all of these parts; None where the model cannot follow one."""
    problem = ShootingProblem(model, data, segment_grid(data, data.samples, max_step), sigma=sigma, freedom=FREEDOM)
    target = WithZeros(problem, torch.arange(problem.P), shared=True)
    found = _fitted(target, problem.parameters.get(), data)
    return None if found is None else tuple(clearly(found).z.tolist())


def _fitted(target: WithZeros, theta: Tensor, begin: Trajectories) -> FoundZeros | None:
    """The zeros as a vector, from 0 with these parameters, and states read off `begin`; None where nothing follows."""
    problem = target.problem
    problem.guess_from_states(states_of_pairs(problem.parameters.model, begin))
    x = torch.cat([problem.pack(theta, first_states(problem, theta, begin)), theta.new_zeros(target.count)])
    result = levenberg_marquardt(target, x, max_iterations=STAGE, rtol=1e-4, patience=3)
    if not math.isfinite(result.cost):
        return None
    _, A, _ = target.normal_equations(result.x)
    A = dense(A)
    assert problem.path is not None
    rms = _rms(problem.misfit(problem.path))
    variance = torch.linalg.pinv(A, hermitian=True).diagonal()[-target.count :] * (rms / problem.sigma) ** 2
    return FoundZeros(result.x[-target.count :], variance.clamp_min(0).sqrt(), rms)


class ZerosOf:
    """The zeros of the recordings that a look at them kept, by the named terms that it found."""

    def __init__(self, seen: Look):
        assert seen.found is not None
        assert seen.found.sigma is not None
        self.data, self.freedom = seen.kept, FREEDOM if seen.outliers else None
        self.every = seen.found.every
        self.task = seen.task(Stages())
        self.sigma = max(seen.found.sigma, FLOOR * self.task.size)
        self.reference = reference_of(self.data)

    def fit(self, data: Trajectories) -> TrajectoryFit | None:
        """The shortest segments of these recordings; None where the model cannot follow them."""
        task = replace(self.task, data=data, stages=Stages()).thinned(self.every)
        stages = SegmentStages(task, build_model(task.base, task.config, "none"))
        return stages.fit(stages.lengths[0], self.sigma, self.freedom, None, begin=smoothed(task.data))

    def best(self, first: Look, alone: TrajectoryFit) -> FoundZeros:
        """By the terms of the reference alone, at a look at it, or by those of all recordings, fitted to it alone."""
        tried = []
        if first.found is not None and first.found.sigma is not None:
            own = build_model(first.base, first.settings, "none")
            tried.append(ZerosOf(replace(first, kept=self.data)).zeros(own))
        if not tried or tried[0].rms > AT_THE_NOISE * precision(self.data):
            alone.problem.parameters.set(alone.theta)
            tried.append(self.zeros(alone.problem.parameters.model))
        return next(one for one in tried if one.rms <= MARGIN * min(other.rms for other in tried))

    def zeros(self, model: ContactLagrangian) -> FoundZeros:
        """By a model that follows the reference alone."""
        z = self.data.q.new_zeros(len(self.data), self.data.dof)
        for b, one in enumerate(self.data):
            if b != self.reference:
                z[b] = _by_steps(model, one, self.task.base.max_step)
        return self.symmetric(model, clearly(self.moved(model, z)))

    def symmetric(self, model: ContactLagrangian, found: FoundZeros) -> FoundZeros:
        """With zeros of all recordings in place of terms that q → −q turns round, where these miss no more."""
        other = clearly(self.moved(model, found.z, odd(model)))
        if not other.rms <= MARGIN * found.rms:
            return found
        if not other.z[self.reference].any():
            other.deviations[self.reference] = 0.0
        return other

    def moved(self, model: ContactLagrangian, start: Tensor, held: Tensor | None = None) -> FoundZeros:
        """By multiple shooting over all recordings, from these zeros (B, n) and the parameters of the model.

        Parameters that are `held` are 0, and the reference has zeros too. The misfit is infinite where the model cannot
        follow the recordings.
        """
        data, base = measured(self.data, start.flatten().tolist()), self.task.base
        rows = [b for b in range(len(data)) if b != self.reference or held is not None]
        problem = ShootingProblem(
            model, data, segment_grid(data, FIRST_SEGMENT, base.model_step), sigma=self.sigma,
            prior=prior_of(model, base, None), freedom=self.freedom,
        )  # fmt: skip
        theta = problem.parameters.get()
        theta[[] if held is None else held] = 0.0
        found = _fitted(WithZeros(problem, held), theta, smoothed(data))
        if found is None:
            return FoundZeros(start, torch.zeros_like(start), math.inf)
        z, deviations = start.clone(), torch.zeros_like(start)
        z[rows] += found.z.reshape(-1, data.dof)
        deviations[rows] = found.deviations.reshape(-1, data.dof)
        return FoundZeros(z, deviations, found.rms)


def odd(model: ContactLagrangian) -> Tensor:
    """Places of the parameters of terms that q → −q, v → −v turns round: tilts, loads, sin(q1), q1^3, friction q v."""
    parameters, config, angles = ParameterVector(model), model.config, model.config.angles
    at = places(parameters)
    turned = [name for name in config.features if any(_turned(f) for f in parse(name, angles))]
    turned += [name for name in config.drag if _pushes_on(parse_drag(name, angles))]
    tilt = parameters.index("potential.tilt").tolist()
    return torch.tensor([*tilt, *(i for name in turned for i in at[name])], dtype=torch.long)


def _turned(f: Product) -> bool:
    """Whether a product of L changes its sign with q and v."""
    even = {"sin": False, "power": f.power % 2 == 0, "signed": f.power % 2 == 1}
    changes = not even.get(f.function, True)
    return changes != (len(f.velocities) % 2 == 1)


def _pushes_on(f: DragFeature) -> bool:
    """Whether a force q^a |v|^b v^c keeps its direction where q and v change their signs: it is no mirror image."""
    odd = f.a + (f.wave == "sin")
    return (odd + (1 if f.dry else f.c)) % 2 == 0


def _rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


def _by_steps(model: ContactLagrangian, data: Trajectories, max_step: float) -> Tensor:
    """The zeros (n,) of one recording with which the model misses its steps least, the nearest to 0 of good ones."""
    smooth = smoothed(data)

    def errors(z: Tensor) -> Tensor:
        problem = ResidualProblem(model, replace(smooth, q=smooth.q - z), max_step=max_step)
        return problem.residuals(problem.start()).flatten()

    spread = smooth.q.std(0).tolist()
    axes = [
        [2 * math.pi * k / ROUND for k in range(-ROUND // 2, ROUND // 2)] if angle else [x * size for x in SPREADS]
        for angle, size in zip(data.angles, spread, strict=True)
    ]
    points = sorted((data.q.new_tensor(point) for point in product(*axes)), key=lambda z: float(z.norm()))
    costs = torch.stack([errors(z).square().mean() for z in points])
    z = points[int((costs <= AS_GOOD * costs.min()).nonzero()[0])]
    best, small = errors(z), NUDGE * smooth.q.std(0)
    for _ in range(ROUNDS):
        J = torch.stack([(errors(z + dz) - errors(z - dz)) / (2 * dz.sum()) for dz in small.diag()], -1)
        new = z - torch.linalg.pinv(J, rtol=FLAT) @ best
        r = errors(new)
        if not _rms(r) < _rms(best):
            break
        z, best = new, r
    return z
