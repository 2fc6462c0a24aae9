"""The posterior of learned functions: of a run's numbers together with all waves (Fourier terms) of its functions.

A fit keeps only the waves that improve its score. A posterior of these waves alone treats all others as known to be 0,
and its bands are far too narrow. Here every function (potential, damping, mass, friction) has all its waves, which also
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
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, jacrev

from herglotz.models import ContactLagrangian
from herglotz.models.terms import Phase
from herglotz.training.arrowhead import dense
from herglotz.training.cross_validation import foretold_errors
from herglotz.training.dictionary import keys_of
from herglotz.training.functions import Band, bands, prior_spreads, replaced
from herglotz.training.kernel import MAX_PARAMETERS
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.pruning import inverse_of
from herglotz.training.uncertainty import Laplace, inflation_of

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
    P, own = len(posterior.theta), inverse_of(posterior.information.cpu())
    return found or FunctionPosterior(posterior.run.model, posterior.theta, own[:P, :P], posterior.inflation)


def mass_at(model: ContactLagrangian, q: Tensor, h: float) -> Tensor:
    """m(q) = −h ∂²K/∂q₀∂q₁ at rest, (n, n, K), at positions q (K, n)."""
    n = q.shape[-1]
    K = model.terms(Phase(q, q, torch.full_like(q[:, 0], h), 2, model.config)).K
    return q.new_zeros(n, n, len(q)) if K is None else -h * K.hessian()[:n, n:].movedim(-1, 2)


def by_numbers(model: ContactLagrangian, function: Callable[[ContactLagrangian], Tensor], theta: Tensor) -> Tensor:
    """∂f/∂θ, (..., P), of a function f of a model at the numbers θ (P,), which are written into the model."""
    numbers, of = ParameterVector(model), _Of(model, function)
    numbers.set(theta)

    def at(theta: Tensor) -> Tensor:
        return functional_call(of, {f"model.{name}": x for name, x in numbers.unflatten(theta).items()}, ())

    J = jacrev(at)(numbers.get())
    assert isinstance(J, Tensor)
    return J


class _Of(nn.Module):
    """A function of a model as a module, whose parameters `functional_call` reaches."""

    def __init__(self, model: ContactLagrangian, function: Callable[[Any], Tensor]):
        super().__init__()
        self.model, self.function = model, function

    def forward(self) -> Tensor:
        return self.function(self.model)


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
class _Known:
    """The misfit over σ², minimal over the start states: ½ (c + 2 bᵀδ + δᵀAδ) at θ + δ.

    `count` is the number of residuals minus the number of start states, `scale` the derivatives of the logarithm of the
    first mass; a `robust` loss fixes its own scale.
    """

    A: Tensor  # (P, P)
    b: Tensor  # (P,)
    c: float
    count: int
    scale: Tensor  # (P,)
    robust: bool


@dataclass(frozen=True)
class _Waves:
    """The prior 𝒩(mean, 1/weight) of numbers minus θ; the variance of a wave is times the strength of its function.

    `of` is the index of the function, F = `functions` for other numbers; `rate` is the frequency of a wave over the
    lowest one of its function, 1 for other numbers.
    """

    mean: Tensor  # (P,)
    weight: Tensor  # (P,)
    of: Tensor  # (P,)
    rate: Tensor  # (P,)
    functions: int


@dataclass(frozen=True)
class _Likeliest:
    """The strengths of one prior with the highest marginal likelihood.

    `likelihood` is its logarithm up to a constant, `step` the posterior's mean minus θ, `weight` the inverse covariance
    of the prior, `variance` that of the residuals.
    """

    likelihood: float
    step: Tensor  # (P,)
    weight: Tensor  # (P, P)
    variance: float


def _linear(posterior: Laplace, model: ContactLagrangian, every: list[Band]) -> FunctionPosterior | None:
    """The posterior of a model with all waves, linearised at the fit; None if a step fails there."""
    theta, problem = ParameterVector(model).get(), _problem(posterior, model, 2)
    P, d, start = problem.P, problem.d, posterior.path.x[:, 0, : problem.d]
    coarse, fine = (_sums(x, problem.pack(theta, start)) for x in (_problem(posterior, model, 1), problem))
    if not bool(coarse[0].isfinite() & fine[0].isfinite()):
        return None
    more = 1 / (2**model.config.order - 1)
    cost, b = (x + more * (x - y) for x, y in ((fine[0], coarse[0]), (fine[2], coarse[2])))
    A = fine[1]
    states = inverse_of(A[P:, P:])
    onto = A[:P, P:] @ states
    q, h = posterior.problem.data.q, posterior.run.h
    some = q[:: -(-len(q) // SAMPLES)]
    mass = by_numbers(model, lambda m: mass_at(m, some, h)[0, 0].mean().log(), theta)
    c, count = float(2 * cost - b[P:] @ states @ b[P:]), q.numel() - len(states)
    robust = posterior.problem.freedom is not None
    known = _Known(A[:P, :P] - onto @ A[P:, :P], b[:P] - onto @ b[P:], c, count, mass.double().cpu(), robust)
    prior = _prior(posterior, model, every)
    best = max((_likeliest(known, prior, fall) for fall in FALLS), key=lambda found: found.likelihood)
    moved, variance = best.step, best.variance
    starts = start - (states @ (b[P:] + A[P:, :P] @ moved)).reshape(-1, d).to(start)
    theta = theta + moved.to(theta)
    path = problem.solve(problem.pack(theta, starts))
    if path is None:
        return None
    A[:P, :P] += variance * best.weight
    errors = foretold_errors(problem, path, theta, A.to(theta.device))
    factor = inflation_of(errors, variance**0.5)
    return FunctionPosterior(model, theta, inverse_of(A)[:P, :P] * variance, factor)


def _problem(posterior: Laplace, model: ContactLagrangian, parts: int) -> ShootingProblem:
    """Each trajectory as one segment, without a prior, with the model steps of the fit divided into `parts`."""
    of = posterior.problem
    grid = segment_grid(of.data, max(of.data.lengths), posterior.base.model_step / parts)
    settings = {"sigma": of.sigma, "freedom": of.freedom, "used": of.used, "compiled": False}
    problem = ShootingProblem(model, of.data, grid, **settings)
    problem.guess_from(of, posterior.path)
    return problem


def _sums(problem: ShootingProblem, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """½|r|², JᵀJ and Jᵀr, float64 on the CPU."""
    cost, A, b = problem.normal_equations(x)
    return cost.double().cpu(), dense(A).double().cpu(), b.double().cpu()


def _prior(posterior: Laplace, model: ContactLagrangian, every: list[Band]) -> _Waves:
    """The prior of the fit and of all waves, with terms that the waves replace near 0."""
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
    return _Waves(mean, weight.double().cpu(), of, rates, len(names))


def _likeliest(known: _Known, prior: _Waves, fall: int) -> _Likeliest:
    """The posterior with a prior deviation of wave k that falls by `fall` more powers of k."""
    F, own = prior.functions, prior.weight * prior.rate ** (2 * fall)
    fixed = known.scale.outer(known.scale) / MASS_DEVIATION**2
    strength, variance, rest = torch.ones(F + 1, dtype=torch.float64), 1.0, known.c
    step, weight, spent = prior.mean, own, torch.zeros_like(own)
    for _ in range(MAX_ITERATIONS):
        weight = own / strength[prior.of]
        C = inverse_of(known.A / variance + weight.diag() + fixed)
        step = C @ (weight * prior.mean - known.b / variance)
        spent = weight * (step - prior.mean).square()
        rows = torch.stack([spent, (1 - weight * C.diagonal()).clamp_min(0.0)])
        size, told = torch.zeros(2, F + 1, dtype=torch.float64).index_add_(1, prior.of, rows)
        factor = (size + 1) / (told + strength)
        # Numbers that are no waves keep their prior.
        factor[F] = 1.0
        strength = strength * factor
        rest = known.c + float(2 * known.b @ step + step @ known.A @ step)
        variance = variance if known.robust else rest / (known.count - float(told.sum()))
        if float((factor - 1).abs().max()) < TOLERANCE:
            break
    H, waves = known.A / variance + weight.diag() + fixed, prior.of < F
    size = H.diagonal().sqrt()
    terms = torch.linalg.eigvalsh(H / size / size[:, None]).clamp_min(1e-300).log().sum() + 2 * size.log().sum()
    terms = terms - weight[waves].log().sum() + spent.sum() + rest / variance + known.count * math.log(variance)
    likelihood = -float(terms - (strength[:F].log() - strength[:F]).sum()) / 2
    return _Likeliest(likelihood, step, weight.diag() + fixed, variance)
