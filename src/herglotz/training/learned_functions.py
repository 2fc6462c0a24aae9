"""The functions that a model has learned, along one coordinate or speed, with the bands of their posterior.

Positions identify a model only up to a gauge (trap 3 of `docs/mathematics.md`). Functions are given in this gauge:

* the first entry of the mass has the mean 1 over the data, so that forces are accelerations of the first coordinate;
* the potential V has the mean 0 over the recorded range;
* friction is 0 at rest: a constant force, which waves of a speed can contain, is a tilt of V.

The variance of a function f in this gauge is std² = ∇f · Σ ∇f, with the covariance Σ of `function_posterior`.

A fit keeps only the waves (Fourier terms) that improve its score. A posterior of these waves alone treats all others as
known to be 0, and its bands are far too narrow. In `function_posterior` every function has all its waves, which also
replace the powers and other named terms of the function. The model of the posterior is

* a prior N(0, α_f τ_k²) of the waves, with τ_k of `prior_spreads` and a strength α_f for each function. α_f maximises
  the marginal likelihood times a prior of √α_f, ∝ √α exp(−α/2), that keeps α_f from 0 (Chung et al. 2013, A
  nondegenerate penalized likelihood estimator for variance parameters). At the maximum
  α_f = α_f (Σ θ_k²/(α_f τ_k²) + 1) / (γ_f + α_f), with γ_f = Σ (1 − C_kk/(α_f τ_k²)) the effective number of
  parameters of the function (MacKay 1992);
* the σ of the noise that maximises the likelihood of the residuals;
* the mean of the first mass over the data fixed, because positions do not determine it (trap 3 of
  `docs/mathematics.md`).

The motion is linearised once, at the fit. The functions are those of continuous motion: a rule of order p differs by
h^p, and Jᵀr of model steps h and h/2 is extrapolated (Richardson). Held-out errors widen the bands, as in
`herglotz.training.uncertainty`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.func import jacrev

from herglotz.data.splits import leading
from herglotz.errors import InputError, refuse
from herglotz.models import ContactLagrangian, refuse_own
from herglotz.models.terms import LinearDamping, Phase
from herglotz.stepping.explicit import FieldOf
from herglotz.threads import one_thread
from herglotz.training.cross_validation import foretold_errors
from herglotz.training.dictionary import keys_of
from herglotz.training.functions import Band, bands, prior_spreads, replaced
from herglotz.training.kernel import MAX_PARAMETERS
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.pruning import inverse_of, of_unit_diagonal
from herglotz.training.run import Run
from herglotz.training.uncertainty import Laplace, Starts, inflation_of, quantile

# Relative variation below which a function is constant: rounding of float32.
MAX_VARIATION_OF_CONSTANT = 1e-6
# Points x (K,), and the ends of the recorded range.
Line = tuple[Tensor, float, float]
# Kind, coordinates and line of a function.
Part = tuple[str, tuple[int, ...], Line]
# Matérn processes of ν = 3/2, 5/2, 7/2: the prior deviation of wave k falls by these further powers of k.
FALLS = (0, 1, 2)
# Iterations of the strengths, and the relative change that ends the iteration.
MAX_ITERATIONS, TOLERANCE = 200, 0.01
# Relative prior deviation of the mean of the first mass.
MASS_DEVIATION = 1e-4
# Most samples of the data for the mean of the mass.
SAMPLES = 200
# Prior deviation, over its value, of the coefficient of a term that the waves replace.
REPLACED = 1e-6


@dataclass(frozen=True)
class LearnedFunction:
    """A function of a model along one coordinate or speed, with the other coordinates at their medians.

    Its posterior at x is 𝒩(mean, std²): section 7 of `docs/trajectory.md`.

    Parameters
    ----------
    kind
        "potential" V, "force" −∂V/∂q_i, "friction" f_i(v_i), "damping" −f_i/v_i by position at the RMS speed, or
        "mass" m_jk.
    of
        (i,), the coordinate from 0. For a mass (j, k, i), the entry m_jk and the coordinate i that m_jk depends on.
    x
        (K,) positions or speeds, in the data's units; −π to π for an angle whose range exceeds one turn.
    value
        (K,) of the model, in units where the mass of the first coordinate is 1.
    low, high
        The range of x in the training data, in the data's units.
    mean, std
        (K,) of the posterior, in the units of `value`; None without a posterior. The mean differs from `value` if the
        data need more than the model has, or if the model's steps are not short. `std` is infinite beyond the recorded
        range, and everywhere if left-out blocks of time cannot be predicted.
    """

    kind: str
    of: tuple[int, ...]
    x: Tensor  # (K,)
    value: Tensor  # (K,)
    low: float
    high: float
    mean: Tensor | None = None  # (K,)
    std: Tensor | None = None  # (K,)

    def interval(self, level: float = 0.9) -> tuple[Tensor, Tensor]:
        """Lower and upper ends of the central interval of the posterior, (K,) each; `level` is its probability."""
        width = quantile(level)
        if self.mean is None or self.std is None:
            raise InputError("a function without a posterior has no band; give one: learned_functions(laplace(run))")
        width = width * self.std
        return self.mean - width, self.mean + width


@one_thread()
def learned_functions(of: Run | Laplace, *, points: int = 101, beyond: float = 0.0) -> list[LearnedFunction]:
    """The functions that a run has learned, along each coordinate; with bands if its posterior is given.

    Each coordinate has a potential and a force, and a friction if the model has friction. Damping and the entries of
    the mass are listed if they depend on the position. The gauge is described in section 7 of `docs/trajectory.md`.

    Parameters
    ----------
    of
        A fitted run, or its posterior, `laplace(run)`.
    points
        K, number of points, evenly spaced over the recorded range.
    beyond
        Share of the recorded range by which x continues on both sides, where the model extrapolates; dimensionless.

    Returns
    -------
    list of LearnedFunction
        Potential, force, friction, damping and mass of the first coordinate, and so on.

    Raises
    ------
    InputError
        If the model is the user's own module, there are fewer than two points, or `beyond` is negative.

    Examples
    --------
    >>> potential, force, *others = learned_functions(laplace(run))
    >>> low, high = force.interval(0.9)
    """
    run = of.run if isinstance(of, Laplace) else of
    refuse_own(run.model, "figure or table of functions", "evaluate parts of the module, such as net.V(q)")
    refuse({f"points must be 2 or more, got {points}": points < 2, f"beyond must be >= 0, got {beyond:g}": beyond < 0})
    lines = _Lines(run, points, beyond)
    with torch.no_grad():
        value = lines.values(run.model).split(points)
        if not isinstance(of, Laplace):
            mean = std = [None] * len(value)
        else:
            posterior = function_posterior(of)
            std = [posterior.std(J) for J in lines.by_numbers(posterior.model, posterior.theta)]
            mean = lines.values(posterior.model).split(points)
    found = []
    for (kind, i, (x, low, high)), y, m, s in zip(lines.parts, value, mean, std, strict=True):
        # Waves vanish beyond the recorded range by their form, not by the data.
        s = None if s is None else torch.where((x >= low) & (x <= high), s, torch.inf)
        found.append(LearnedFunction(kind, i, x, y, low, high, m, s))
    return found


class _Lines:
    """The lines along which the functions of a run are evaluated."""

    @torch.no_grad()
    def __init__(self, run: Run, points: int, beyond: float):
        self.h, q, steps = run.h, run.states.q.detach(), run.data.steps()
        trained = leading(run.data.lengths, run.train_lengths).to(q.device)
        v = (q[steps.index + 1] - q[steps.index]) / steps.h[:, None]
        q, v = q[trained & q.isfinite().all(-1)], v[trained[steps.index + 1] & v.isfinite().all(-1)]
        self.some = q[:: -(-len(q) // SAMPLES)]
        self.middle, self.speed = q.median(0).values, v.square().mean(0).sqrt()
        self.parts = [
            part
            for i, turns in enumerate(run.data.angles)
            for part in self._of(run.model, i, _range(q[:, i], points, beyond, turns), _range(v[:, i], points, beyond))
        ]

    def _of(self, model: ContactLagrangian, i: int, at: Line, speeds: Line) -> list[Part]:
        """Kinds and lines of the functions of coordinate i: positions `at`, and `speeds`."""
        found: list[Part] = [("potential", (i,), at), ("force", (i,), at)]
        friction = isinstance(model.damping, LinearDamping)
        found += [("friction", (i,), speeds)] if friction else []
        found += [("damping", (i,), at)] if friction and _varies(self._damping(model, i, at[0])) else []
        m = mass_at(model, self._line(i, at[0]), self.h)
        pairs = ((j, k) for j in range(len(m)) for k in range(j, len(m)))
        return [*found, *(("mass", (j, k, i), at) for j, k in pairs if _varies(m[j, k], m))]

    def values(self, model: ContactLagrangian, parts: Sequence[Part] | None = None) -> Tensor:
        """Functions of a model in the gauge of this module, by default all, concatenated, float64."""
        unit = mass_at(model, self.some, self.h)[0, 0].double().cpu().mean()
        every = self.parts if parts is None else parts
        return torch.cat([self._value(model, kind, of, *line) / unit for kind, of, line in every])

    def by_numbers(self, model: ContactLagrangian, theta: Tensor) -> Iterator[Tensor]:
        """The derivatives (K, P) of each function by the numbers of a model at θ.

        One function at a time: backwards through all of them, each value would cost as much as all values.
        """
        for part in self.parts:
            yield by_numbers(model, lambda m, part=part: self.values(m, [part]), theta)

    def _value(
        self, model: ContactLagrangian, kind: str, of: tuple[int, ...], x: Tensor, low: float, high: float
    ) -> Tensor:
        """A function on its line before the division by the mean mass, (K,)."""
        i = of[-1]
        if kind == "friction":
            v = self.middle.new_zeros(len(x), len(self.middle))
            v[:, i] = x.to(v)
            q = self.middle.expand_as(v)
            return (self._friction(model, q, v) - self._friction(model, q, 0 * v))[:, i].double().cpu()
        if kind == "damping":
            return self._damping(model, i, x)
        q = self._line(i, x)
        if kind == "mass":
            return mass_at(model, q, self.h)[of[0], of[1]].double().cpu()
        field, rest = FieldOf(model.potential)(q), self._friction(model, q, 0 * q)[:, i].double().cpu()
        if kind == "force":
            return rest - field.slope[:, i].double().cpu()
        V = field.V.double().cpu() - torch.cat([rest[:1] * 0, torch.cumulative_trapezoid(rest, x)])
        return V - V[(x >= low) & (x <= high)].mean()

    def _damping(self, model: ContactLagrangian, i: int, x: Tensor) -> Tensor:
        """−f_i/v_i at the RMS speed, the mean of both directions, (K,)."""
        q = self._line(i, x)
        v = torch.zeros_like(q)
        v[:, i] = self.speed[i]
        both = (self._friction(model, q, -v) - self._friction(model, q, v))[:, i]
        return both.double().cpu() / float(2 * self.speed[i])

    def _line(self, i: int, x: Tensor) -> Tensor:
        """Positions (K, n): coordinate i along x, the others at their medians."""
        q = self.middle.expand(len(x), -1).clone()
        q[:, i] = x.to(q)
        return q

    def _friction(self, model: ContactLagrangian, q: Tensor, v: Tensor) -> Tensor:
        """Dissipative force −γ m v of the contact term at s = 0 plus the forces beside L without inputs, (K, n)."""
        if not isinstance(model.damping, LinearDamping):
            return 0.0 * v
        h, rate = torch.full_like(q[:, 0], self.h), model.damping.rate
        force = -rate * (mass_at(model, q, self.h).movedim(-1, 0) @ v[..., None])[..., 0]
        parts = model.forces(q - h[:, None] * v / 2, q + h[:, None] * v / 2, torch.zeros_like(h), h)
        if parts is None:
            return force
        c = 1.0 if model.action is not None else (-rate * h).exp()[:, None]
        return force + (parts[0] / c + parts[1]) / h[:, None]


def _range(values: Tensor, points: int, beyond: float, turns: bool = False) -> Line:
    """Evenly spaced points over the range of the values and beyond, and the range.

    For an angle (`turns`) whose range exceeds one turn, one turn: functions of an angle are periodic, and the points
    would be too few for each of many turns.
    """
    low, high = float(values.min()), float(values.max())
    if turns and high - low > 2 * math.pi:
        return torch.linspace(-math.pi, math.pi, points, dtype=torch.float64), -math.pi, math.pi
    room = beyond * ((high - low) or 1.0)
    return torch.linspace(low - room, high + room, points, dtype=torch.float64), low, high


def _varies(values: Tensor, among: Tensor | None = None) -> bool:
    """True if a function varies by more than rounding, relative to the largest of the values `among`."""
    size = (values if among is None else among).abs().amax()
    return bool(values.amax() - values.amin() > MAX_VARIATION_OF_CONSTANT * size)


@dataclass(frozen=True)
class FunctionPosterior:
    """𝒩(θ, f² covariance) of the numbers of a model with all waves; `factor` is f, inf if held-out blocks fail."""

    model: ContactLagrangian
    theta: Tensor  # (P,)
    covariance: Tensor  # (P, P) float64, on the CPU
    factor: float

    def std(self, J: Tensor) -> Tensor:
        """Standard deviations (K,) of values with derivatives J (K, P) by θ."""
        found = ((J.double().cpu() @ self.covariance) * J.double().cpu()).sum(-1).clamp_min(0).sqrt()
        return found * self.factor if self.factor < math.inf else torch.full_like(found, math.inf)


def function_posterior(posterior: Laplace) -> FunctionPosterior:
    """The posterior of a run's functions; for a model without waves (networks, symmetries) of its numbers alone."""
    every = bands(posterior.problem.data, posterior.base, fine=True)
    model = _with_waves(posterior.run.model, every)
    found = None if model is None else _linear(posterior, model, every)
    own = inverse_of(posterior.information.cpu())
    return found or FunctionPosterior(posterior.run.model, posterior.theta, own, posterior.inflation)


def mass_at(model: ContactLagrangian, q: Tensor, h: float) -> Tensor:
    """m(q) = −h ∂²K/∂q₀∂q₁ at rest, (n, n, K), at positions q (K, n)."""
    n = q.shape[-1]
    if not model.config.baseline:
        return q.new_zeros(n, n, len(q))
    K = model.kinetic(Phase(q, q, torch.full_like(q[:, 0], h), 2, model.config))
    return -h * K.hessian()[:n, n:].movedim(-1, 2)


def by_numbers(model: ContactLagrangian, function: Callable[[ContactLagrangian], Tensor], theta: Tensor) -> Tensor:
    """∂f/∂θ, (..., P), of a function f of a model at the numbers θ (P,), which are written into the model."""
    numbers = ParameterVector(model)
    numbers.set(theta)
    J = jacrev(lambda theta: numbers.evaluated(theta, function))(numbers.get())
    assert isinstance(J, Tensor)
    return J


def _with_waves(model: ContactLagrangian, every: list[Band]) -> ContactLagrangian | None:
    """The model with all waves, 0 for those it lacks; None if this kind of model has no waves."""
    c, own = model.config, ParameterVector(model)
    if c.networks or c.translations or c.terms or c.level in ("affine", "full"):
        return None
    still, moving = ([x for b in every if b.brakes == brakes for x in b.texts] for brakes in (False, True))
    moving = [] if c.level == "conservative" else moving
    features, drag = (tuple(dict.fromkeys((*a, *b))) for a, b in ((c.features, still), (c.drag, moving)))
    whole = replace(c, level="forced" if drag else c.level, features=features, drag=drag, absent=())
    names = ParameterVector(ContactLagrangian(whole)).numbers
    value = dict(zip(keys_of(own.numbers, c), own.get().tolist(), strict=True))
    learned = {*value, *still, *moving}
    absent = tuple(name for name, key in zip(names, keys_of(names, whole), strict=True) if key not in learned)
    if len(names) - len(absent) > MAX_PARAMETERS:
        return None
    whole = ContactLagrangian(replace(whole, absent=absent)).to(own.get())
    numbers = ParameterVector(whole)
    keys = keys_of(numbers.numbers, whole.config)
    numbers.set(own.get().new_tensor([value.get(key, 0.0) for key in keys]))
    return whole


@dataclass(frozen=True)
class _Linear:
    """The misfit over σ², ½ (c + 2 bᵀδ + δᵀAδ) at θ + δ, minimal over the start states, and the prior of δ.

    `count` is the number of residuals minus the number of start states, `mass` the derivatives of the logarithm of the
    first mass; a `robust` loss fixes its own scale. The prior is 𝒩(mean, 1/weight), for waves with a variance times the
    strength of their function. `of` is the index of the function, F = `functions` for other numbers; `rate` is the
    frequency of a wave over the lowest one of its function, 1 for other numbers.
    """

    A: Tensor  # (P, P)
    b: Tensor  # (P,)
    c: float
    count: int
    mass: Tensor  # (P,)
    robust: bool
    mean: Tensor  # (P,)
    weight: Tensor  # (P,)
    of: Tensor  # (P,)
    rate: Tensor  # (P,)
    functions: int

    def likeliest(self, fall: int) -> tuple[float, Tensor, Tensor, float]:
        """The strengths of highest marginal likelihood if the deviation of wave k falls by `fall` more powers of k.

        Returns the logarithm of that likelihood up to a constant, the posterior's mean minus θ, the inverse covariance
        (P, P) of the prior, and the variance of the residuals.
        """
        F, own = self.functions, self.weight * self.rate ** (2 * fall)
        fixed = self.mass.outer(self.mass) / MASS_DEVIATION**2
        strength, variance, rest = torch.ones(F + 1, dtype=torch.float64), 1.0, self.c
        step, weight, spent = self.mean, own, torch.zeros_like(own)
        for _ in range(MAX_ITERATIONS):
            weight = own / strength[self.of]
            C = inverse_of(self.A / variance + weight.diag() + fixed)
            step = C @ (weight * self.mean - self.b / variance)
            spent = weight * (step - self.mean).square()
            rows = torch.stack([spent, (1 - weight * C.diagonal()).clamp_min(0.0)])
            size, told = torch.zeros(2, F + 1, dtype=torch.float64).index_add_(1, self.of, rows)
            factor = (size + 1) / (told + strength)
            # Numbers that are no waves keep their prior.
            factor[F] = 1.0
            strength = strength * factor
            rest = self.c + float(2 * self.b @ step + step @ self.A @ step)
            variance = variance if self.robust else rest / (self.count - float(told.sum()))
            if float((factor - 1).abs().max()) < TOLERANCE:
                break
        H, size = of_unit_diagonal(self.A / variance + weight.diag() + fixed)
        waves = self.of < F
        terms = torch.linalg.eigvalsh(H).clamp_min(1e-300).log().sum() + 2 * size.log().sum()
        terms = terms - weight[waves].log().sum() + spent.sum() + rest / variance + self.count * math.log(variance)
        likelihood = -float(terms - (strength[:F].log() - strength[:F]).sum()) / 2
        return likelihood, step, weight.diag() + fixed, variance


def _linear(posterior: Laplace, model: ContactLagrangian, every: list[Band]) -> FunctionPosterior | None:
    """The posterior of a model with all waves, linearised at the fit; None if a step fails there."""
    theta, problem = ParameterVector(model).get(), _problem(posterior, model, 2)
    P, d, start = problem.P, problem.d, posterior.path.x[:, 0, : problem.d]
    x = problem.pack(theta, start)
    coarse, _, its_b = _problem(posterior, model, 1).normal_equations(x)
    cost, A, b = problem.normal_equations(x)
    if not bool(coarse.isfinite() & cost.isfinite()):
        return None
    more = 1 / (2**model.config.order - 1)
    cost, b = cost + more * (cost - coarse), (b + more * (b - its_b)).double()
    by_theta, by_start = b[:P], b[P:].reshape(-1, d)
    starts = Starts.of(A)
    own = (starts.inverse @ by_start[..., None])[..., 0]
    q, h = posterior.problem.data.q, posterior.run.h
    some = q[:: -(-len(q) // SAMPLES)]
    mass = by_numbers(model, lambda m: mass_at(m, some, h)[0, 0].mean().log(), theta)
    c, count = float(2 * cost - (by_start * own).sum()), q.numel() - by_start.numel()
    information = starts.information(A).cpu()
    linear = _Linear(
        information, (by_theta + torch.einsum("sdp,sd->p", starts.follow, by_start)).cpu(), c, count,
        mass.double().cpu(), posterior.problem.freedom is not None, *_prior(posterior, model, every),
    )  # fmt: skip
    _, moved, weight, variance = max(map(linear.likeliest, FALLS), key=lambda found: found[0])
    moved_start = start - (own - starts.follow @ moved.to(own)).to(start)
    theta, weight = theta + moved.to(theta), variance * weight
    cost, A, _ = problem.normal_equations(problem.pack(theta, moved_start))
    if (path := problem.path) is None or not bool(cost.isfinite()):
        return None
    A = replace(A, corner=A.corner + weight.to(A.corner))
    factor = inflation_of(foretold_errors(problem, path, theta, A), variance**0.5)
    return FunctionPosterior(model, theta, inverse_of(information + weight) * variance, factor)


def _problem(posterior: Laplace, model: ContactLagrangian, parts: int) -> ShootingProblem:
    """Each trajectory as one segment, without a prior, with the model steps of the fit divided into `parts`."""
    of = posterior.problem
    grid = segment_grid(of.data, max(of.data.lengths), posterior.base.model_step / parts)
    problem = ShootingProblem(model, of.data, grid, sigma=of.sigma, freedom=of.freedom, used=of.used)
    problem.guess_from(of, posterior.path)
    return problem


def _prior(
    posterior: Laplace, model: ContactLagrangian, every: list[Band]
) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """The last fields of `_Linear`: the prior of the fit and of all waves, with terms that the waves replace near 0."""
    numbers, data = ParameterVector(model), posterior.problem.data
    spreads = {**posterior.base.spreads, **prior_spreads(every, posterior.base, data.balance, [])}
    keys, known = keys_of(numbers.numbers, model.config), {*numbers.numbers}
    spreads = {key: spread for key, spread in spreads.items() if key in keys or key in known}
    gone = replaced(model.config.features, model.config.drag, model.config.angles)
    theta = numbers.get().tolist()
    spreads |= {key: REPLACED * abs(x) for key, x in zip(keys, theta, strict=True) if key in gone and x}
    prior = prior_of(model, replace(posterior.base, spreads=spreads), None)
    names = list(dict.fromkeys(band.name.rsplit(" ", 1)[0] for band in every))
    place = {text: names.index(band.name.rsplit(" ", 1)[0]) for band in every for text in band.texts}
    of = torch.tensor([place.get(key, len(names)) for key in keys])
    weight = prior.normal_equations(prior.start)[1].diagonal()
    rate = {text: k / band.longest for band in every for text, k in zip(band.texts, band.rates, strict=True)}
    rates = weight.new_tensor([rate.get(key, 1.0) for key in keys]).double().cpu()
    mean = (prior.start - numbers.get()).double().cpu()
    return mean, weight.double().cpu(), of, rates, len(names)
