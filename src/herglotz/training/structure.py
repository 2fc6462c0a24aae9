"""The terms of several coordinates, found from the data.

`search` finds named terms of one to three coordinates, which whole trajectories ask for, and `search_of_many` those of
more coordinates. Where no search is made, or it finds none, `structured` takes a dictionary of features. Every planar
chain of revolute joints, in absolute or relative angles, has its mass and its weight in the dictionary `revolute`
(`herglotz.models.features`); coordinates without an angle among them have constant masses of their own, and springs,
powers and distances in the dictionary `lengths`. Either starts as a linear problem (`linear_start`). For joints the
problem with a constant mass is solved too, without a fifth of the data at a time; the mass that depends on the angles
is taken where it predicts that fifth better, beyond the spread of the fifths. A short one-step fit then leaves out the
features that the data do not need, and tells noise from the error of the rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.noise import precision, roughness
from herglotz.data.sensors import measured
from herglotz.data.units import common_unit, size
from herglotz.models.drag import input_columns
from herglotz.models.feature_potential import baseline_features
from herglotz.models.features import expand, lengths, revolute
from herglotz.training.acting_inputs import asked_terms
from herglotz.training.baseline import Baseline, estimate_baseline
from herglotz.training.config import FitConfig
from herglotz.training.coupled_pairs import coupled_pairs, sizes, terms_between
from herglotz.training.cross_validation import FOLDS, simplest_not_beaten
from herglotz.training.dictionary import in_proportion
from herglotz.training.distributed import of_first
from herglotz.training.found_model import settings as settings_of_trial
from herglotz.training.kernel import MAX_PARAMETERS
from herglotz.training.linear_start import SHARED, LinearFit
from herglotz.training.named_terms import MOVING, by_term, distances, holders, places, started, values_of
from herglotz.training.one_step_fit import NOISE_OF_R, ROWS
from herglotz.training.problems.one_step import ResidualProblem
from herglotz.training.problems.prior import prior_of
from herglotz.training.pruning import prune
from herglotz.training.questions import Questions
from herglotz.training.search import Search
from herglotz.training.sensor_zeros import drifts, in_words, reference_of, sure
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt
from herglotz.training.stages import Stages
from herglotz.training.task import EXACT, NOISY, build_model
from herglotz.training.trades import listed
from herglotz.training.trials import Trial, Variant, compared_models, is_precise

# Most coordinates with an angle among them: the dictionary of joints grows as 3ⁿ n².
MOST = 3
# Most triples in the linear problem, and least number of residuals for each coefficient.
TRIPLES, ENOUGH = 4000, 5
# Most numbers in the derivatives of the linear problem: 240 MB.
MAX_NUMBERS = 3e7
# Strides of the samples that are tried: noise asks for long steps, the rule of order 2 for short ones.
STRIDES = (1, 2, 4)
# A residual above this multiple of the noise: a force is missing from the dictionary.
MISSED = 2.0
# Order 4 is kept where it lowers the one-step error below this share.
MAX_ERROR_RATIO = 0.5
# A one-step error below this share of the motion's size needs no rule of order 4.
EXPLAINED = 1e-7
# Settings that name a term of the model.
NAMED = ("features", "known", "terms", "alike", "diagonal", "mass_width", "coulomb", "sticking", "drag", "translations",
         "coupled", "absent", "dissipation")  # fmt: skip
VISCOUS = "friction.viscous"
WHY_INPUT_TERMS = "held-out blocks of time are missed by less with them"
# What a search may find about the recording beside its terms; `look` reads the data so.
READING = ("hold", "input_terms", "zeros", "drifts", "turning")


class Structure(NamedTuple):
    """The terms and starting values that were found, and how the recording is to be read for them.

    `config` are the settings with the features, the order and the objective that the data call for, `base` has starting
    values, and `reason` says so in words and numbers. `sigma` is the misfit of whole trajectories, or of segments of
    `length` recorded steps if that is not 0; None: these were not fitted. For these terms inputs have another `hold`
    ("": the same) and further `input_terms`, sensors have `zeros` that differ between recordings, and `drifts`, and
    angles are `turning` or positions on a line; `why` has pairs of a name of these five and its reason. `compared` are
    the models that a search compared (`compared_models`).
    """

    config: FitConfig
    base: Baseline
    reason: str
    sigma: float | None = None
    length: int = 0
    hold: str = ""
    input_terms: tuple[str, ...] = ()
    zeros: tuple[float, ...] = ()  # (B · n)
    drifts: tuple[float, ...] = ()  # (n,) rates of the zeros
    turning: bool = True
    why: tuple[tuple[str, str], ...] = ()
    compared: Sequence[dict[str, Any]] = ()

    @property
    def reading(self) -> dict[str, Any]:
        """What was found about the recording: those of `READING` that are not as they were."""
        own = self._asdict()
        return {name: own[name] for name in READING if own[name] != self._field_defaults[name]}

    def read(self) -> Structure:
        """The same terms for data that are read so."""
        return self._replace(**{name: self._field_defaults[name] for name in (*READING, "why")})


def structure_is_free(data: Trajectories, user_settings: FitConfig) -> bool:
    """Whether `structured` may choose: several coordinates, no inputs, and the user names no term."""
    c = user_settings
    driven = data.u is not None and c.use_inputs
    several = data.dof > 1 and (data.dof <= MOST or not any(data.angles))
    return _nothing_named(c) and not driven and several


def terms_are_free(data: Trajectories, user_settings: FitConfig) -> bool:
    """Whether `search` may choose: one to three coordinates, and the user names no term but translations."""
    c = user_settings
    few = (2 if c.translations else 1) <= data.dof <= MOST
    alone = c.objective == "auto" and c.substeps == 1 and not c.input_map
    return few and alone and _nothing_named(replace(c, translations=()))


def many_are_free(data: Trajectories, user_settings: FitConfig) -> bool:
    """Whether `search_of_many` may choose: more coordinates than `search` takes, and nothing named.

    Exact positions on lines without inputs are not searched: one-step errors of order 4 tell their dictionary.
    """
    c, driven = user_settings, data.u is not None and user_settings.use_inputs
    noisy = driven or any(data.angles) or not is_precise(data)
    alone = c.objective == "auto" and not c.input_map
    return _nothing_named(c) and data.dof > MOST and alone and noisy


def _nothing_named(c: FitConfig) -> bool:
    plain = (c.level, c.order, c.supervision, c.optimiser) == ("auto", 2, "q", "lm") and c.objective != "raw"
    return plain and not any(getattr(c, name) for name in NAMED)


def dictionaries(data: Trajectories) -> list[tuple[str, ...]]:
    """The whole dictionary and, for coordinates without an angle, two smaller ones.

    These are the dictionary of coupled pairs, if the samples tell the pairs, and the springs between all coordinates
    alone. A dictionary takes part where the samples suffice for its coefficients and where the derivatives take no more
    than `MAX_NUMBERS`: at 200 samples the whole dictionary up to 14 coordinates, springs up to 22.
    """
    if any(data.angles):
        return [tuple(revolute(data.angles))]
    away = distances(data)
    names = tuple(name for name in lengths(data.angles) if name in away or not name.startswith("r^"))
    springs = tuple(name for name in names if name.startswith("(") and name.endswith(")^2"))
    coupled = coupled_pairs(data) if data.dof > MOST else None
    return [names, *([] if coupled is None else [terms_between(coupled, data.angles)]), springs]


def kept_structure(
    name: str, find: Callable[[], Structure], base: Baseline, config: FitConfig, stages: Stages
) -> Structure:
    """What `find` finds, or what the checkpoint remembers of it under this name."""
    numbers = ("stiffness", "tilt", "rate", "start", "spreads", "model_step")

    def plain() -> dict[str, Any]:
        found = find()
        start = {name: getattr(found.base, name) for name in numbers}
        return found._asdict() | {"config": found.config.to_dict(), "base": start}

    kept = stages.keep(name, plain)
    settings = replace(FitConfig.from_dict(kept["config"]), device=config.device)
    return Structure(**kept | {"config": settings, "base": replace(base, **kept["base"])})


def search(
    data: Trajectories, base: Baseline, config: FitConfig, *, outliers: bool, holds: Sequence[str] = ()
) -> Structure:
    """The named terms that whole trajectories ask for (`training.search`); unchanged where they follow no data.

    Where they miss the data, inputs are tried with these other `holds`.
    """
    # A kernel has float64 on the CPU alone.
    data = data.to(torch.float64, "cpu")
    own = replace(base, low=base.low.double().cpu(), high=base.high.double().cpu())
    wanted = Search(data, own, replace(config, dtype="float64", device="cpu"), outliers=outliers)
    asked, rates, why = Questions(wanted, holds), (), {}
    best = asked.best
    met = best is not None and asked.differ is None and best.at_the_noise
    suffices = best is None or (met and best.taken <= best.fitter.simple)
    drift = None if suffices else drifts(wanted.part, met=met)
    if best is not None and drift is not None:
        found = tuple(drift[0].tolist())
        again = Questions(wanted.of(measured(data, drifts=found)), holds)
        if again.best is not None and again.best.at_the_noise and _is_worth(again.best, best, len(found)):
            asked, rates, why["drifts"] = again, found, f"rates {sure(*drift)}"
    asked.how_inputs_act()
    # With positions on a line, whose inputs and sizes differ, `look` searches again.
    if asked.better_on_a_line():
        return Structure(config, base, "terms of positions on a line miss the data by less", turning=False)
    if asked.best is None:
        return Structure(config, base, "no dictionary of terms: its model cannot follow the shortest segments")
    for question in (asked.functions, asked.all_data):
        question()
    found, differ, zeros = asked.best, asked.differ, ()
    if found is None:
        return Structure(config, base, "no dictionary of terms: what follows a part of the data does not follow all")
    if asked.hold:
        why["hold"] = _why_hold(asked.hold, data.hold)
    if asked.input_terms:
        why["input_terms"] = WHY_INPUT_TERMS
    if differ is not None:
        zeros, why["zeros"] = tuple(differ[0].flatten().tolist()), in_words(*differ, reference_of(data))
    plain = _of_trial(found, data, asked.wanted.config, config, base, asked.read)
    return plain._replace(
        hold=asked.hold, input_terms=asked.input_terms, zeros=zeros, drifts=rates, why=tuple(why.items())
    )


def _why_hold(found: str, other: str) -> str:
    """The reason of a hold that was found in the place of another."""
    return f"with hold {found} the data are missed by less, or met with fewer terms than with {other}"


def _is_worth(drifting: Trial, best: Trial, rates: int) -> bool:
    """True if a model with so many rates of drifts is better than one without; that of more numbers has to replace."""
    if drifting.problem.P + rates < best.problem.P:
        return not best.fits_better(drifting, -rates)
    return drifting.fits_better(best, rates)


def search_of_many(
    data: Trajectories, base: Baseline, config: FitConfig, *, outliers: bool, holds: Sequence[str] = ()
) -> Structure:
    """The named terms of many coordinates that meet whole trajectories; unchanged if no terms do.

    Offers leave the model of all offers of `search_between_coupled`. Where that misses the data, inputs are tried with
    these other `holds`, then their terms are offered. Angles are taken for positions on a line: no dictionary has the
    terms of so many joints.
    """

    def without(reason: str) -> Structure:
        return Structure(config, base, f"no dictionary of terms: {reason}")

    data = data.to(torch.float64, "cpu")
    own, turning = replace(base, low=base.low.double().cpu(), high=base.high.double().cpu()), any(data.angles)
    if turning:
        data = replace(data, angles=(False,) * data.dof)
        own = estimate_baseline(data, outliers=outliers)
    wanted = search_between_coupled(data, own, config, outliers=outliers)
    if isinstance(wanted, str):
        return without(wanted)
    found, hold, terms, why = _pared_down(wanted), "", (), {}
    if found is not None and (hold := wanted.part.better_hold(found, holds)):
        why["hold"] = _why_hold(hold, wanted.hold)
        wanted = wanted.held(hold)
        found = _pared_down(wanted)
    # A building on a shaken ground is met to about the noise without the force by the rate of the ground.
    if found is not None and data.u is not None:
        terms = asked_terms(wanted.part, found)
    if terms:
        why["input_terms"] = WHY_INPUT_TERMS
        wanted = wanted.driven_by(terms)
        found = _pared_down(wanted)
    if wanted.part is not wanted:
        found = wanted.of_part(found, None)[1]
    if found is None or not (found.at_the_noise or found.misses_next_to_nothing):
        return without("the terms of one coordinate and of two miss the data by more than the noise")
    if turning:
        # `look` searches again, with positions on a line, whose inputs and sizes differ.
        met = "terms of positions on a line meet the data"
        return Structure(config, base, met, turning=False, why=(("turning", met),))
    plain = _of_trial(found, data, wanted.config, config, base, wanted.part)
    return plain._replace(hold=hold, input_terms=input_columns(terms), why=tuple(why.items()))


def _pared_down(search: Search) -> Trial | None:
    """The model of a part that is left of all offers; None if no path is found."""
    every = search.part.full
    return every and search.part.settled(every)


def search_between_coupled(data: Trajectories, base: Baseline, config: FitConfig, *, outliers: bool) -> Search | str:
    """The search of many coordinates, or the reason that there is none.

    Offers are the dictionary `lengths` and a damper of those pairs of coordinates between which a force acts
    (`coupled_pairs`), the latter if a kernel can have so many numbers. `data` have float64 on the CPU.
    """
    if (coupled := coupled_pairs(data)) is None:
        return "too few samples to find which coordinates are coupled"
    ratios = sizes(data)
    dampers = in_proportion((f"(v{i + 1} - v{j + 1})" for i, j in coupled), ratios)
    terms = in_proportion(terms_between(coupled, data.angles), ratios)
    offered = replace(config, dtype="float64", device="cpu", level="forced", features=terms)
    tried = (
        Search(data, base, replace(offered, drag=drag), outliers=outliers, ratios=ratios) for drag in (dampers, ())
    )
    found = next((x for x in tried if len(x.fitter(Variant(x.order)).start) <= MAX_PARAMETERS), None)
    return "too many forces act between coordinates" if found is None else found


def _of_trial(
    found: Trial, data: Trajectories, offered: FitConfig, config: FitConfig, base: Baseline, of: Search
) -> Structure:
    """The terms and starting values of a model that the search `of` found among the offers of these settings."""
    settings, found_base = settings_of_trial(found, offered)
    return Structure(
        replace(settings, dtype=config.dtype, device=config.device),
        replace(found_base, low=base.low, high=base.high),
        _told(found, data),
        found.rms,
        0 if found.whole else found.length,
        compared=compared_models(of.fitters.values(), found),
    )


def _told(found: Trial, data: Trajectories) -> str:
    """The terms of a model, and by how much they miss the data."""
    noise = precision(data)
    named = listed(("mass", "damping", *found.names))
    miss, least = (size(x, common_unit(data.units), digits=2) for x in (found.rms, noise))
    least = least if math.isfinite(noise) else "unknown"
    words = f"{named} miss the data by {miss}, whose precision is {least}"
    return words if found.whole else f"{words}; whole trajectories are not followed"


def structured(data: Trajectories, base: Baseline, config: FitConfig) -> Structure:
    """Settings and starting values with the dictionary that the data show; unchanged where the data show none."""
    joints, size = any(data.angles), max(base.scale)

    def without(reason: str) -> Structure:
        return Structure(config, base, f"no dictionary of features: {reason}")

    names, linear = _largest(data, base)
    if linear is None:
        return without("too few samples for its coefficients")
    every, fit, x = linear
    start = fit.start(x)
    if start is None:
        return without("it gives no positive mass")
    if joints and not _mass_turns(fit):
        return without("a mass that depends on the angles predicts held-out steps no better")
    rich = replace(config, level="forced", coupled=joints, diagonal=not joints, features=names, order=4)
    first = started(base, data, by_term(start, holders(names)), rich)
    values, kept, rms = _short_fit(data.thinned(every), first, rich, every * base.max_step)
    if not (holders(kept)[MOVING] if joints else kept):
        return without("the data need none of its features" + (" of the mass" if joints else ""))
    rich = replace(rich, features=kept)
    found = started(base, data, values, rich)
    words = f"{len(kept)} of {len(names)} features explain the steps to {rms / size:.1e} of the motion's size"
    if rms > NOISY * size:
        noise = NOISE_OF_R * roughness(data)
        if not joints and rms > MISSED * noise:
            return without(f"it misses steps by {rms:.2g}, noise by {noise:.2g}: a force is missing from it")
        return Structure(replace(rich, order=2, objective="trajectory"), found, f"{words}: noise")
    if not explains_steps(rms, float(fit.errors(x).square().mean().sqrt()), size):
        return Structure(replace(rich, order=2), found, f"{words}; order 4 is not what the rest lacks")
    objective = "residual" if config.objective == "auto" else config.objective
    return Structure(replace(rich, objective=objective), found, f"{words}: exact")


def _largest(data: Trajectories, base: Baseline) -> tuple[tuple[str, ...], tuple[int, LinearFit, Tensor] | None]:
    """The largest dictionary that the samples suffice for, and its linear problem; (), None where none does."""
    tried = ((names, _linear(data, base, names)) for names in dictionaries(data))
    return next(((names, found) for names, found in tried if found), ((), None))


def explains_steps(order4: float, order2: float, size: float) -> bool:
    """Whether the rule of order 4 lowers the one-step errors enough, or leaves next to none."""
    return order4 <= max(MAX_ERROR_RATIO * order2, EXPLAINED * size)


def start_of_features(data: Trajectories, base: Baseline, config: FitConfig) -> Baseline:
    """The baseline with starting values for the features that a user names, from one linear problem.

    From a constant mass some fits end in another minimum. The baseline stays as it is where the linear problem is not
    the model's: shared or known coefficients, a mass network, inputs, s in L, features that the baseline has too.
    """
    names = tuple(expand(config.features, data.angles))
    other = any(getattr(config, name) for name in ("known", "terms", "alike", "mass_width", "coulomb", "translations"))
    other = other or data.u is not None or config.objective == "raw"
    own = set(baseline_features(data.angles, base.stiffness, base.tilt)[0])
    if other or config.level not in ("conservative", "linear", "forced") or own & set(names):
        return base
    linear = _linear(data, base, names)
    start = None if linear is None else linear[1].start(linear[2])
    if start is None:
        return base
    # The linear problem has no mass between coordinates without an angle.
    if not any(data.angles):
        start.pop("kinetic.base.off_diagonal")
    found = started(base, data, by_term(start, holders(names)), replace(config, features=names))
    viscous = {VISCOUS: tuple(start[VISCOUS].tolist())} if config.level == "forced" else {}
    return replace(found, rate=base.rate, start={**found.start, **viscous})


def _linear(data: Trajectories, base: Baseline, names: tuple[str, ...]) -> tuple[int, LinearFit, Tensor] | None:
    """The stride with the least ratio of one-step errors to the motion's curvature, its linear problem, the solution.

    None where the samples do not suffice at any stride.
    """
    best: tuple[float, int, LinearFit, Tensor] | None = None
    n = data.dof
    # Each coordinate that is no angle has a mass, a spring, a tilt and a friction.
    coefficients = len(names) + (n * n if any(data.angles) else 4 * n)
    for every in STRIDES:
        if min(data.lengths) <= 2 * every and every > 1:
            break
        most = min(TRIPLES, int(MAX_NUMBERS / (n * n * (len(names) + n * (n + 4)))))
        t = data.thinned(every).triples(every * base.max_step).spread_out(most)
        if len(t) * n < ENOUGH * coefficients:
            break
        fit = LinearFit.of(data.angles, names, t, data.balance)
        # A linear system of n coordinates has n independent Lagrangians. One of these has masses between all
        # coordinates and no springs; without masses between coordinates the Lagrangian is unique.
        columns = [any(data.angles) or name != SHARED for name in fit.names]
        (x,) = of_first(fit.solve(torch.tensor(columns)))
        moved = (t.q2 - t.q1 - (t.h1 / t.h0)[:, None] * (t.q1 - t.q0)) / data.balance
        score = float(of_first(fit.errors(x).square().mean() / moved.square().mean())[0])
        if best is None or score < best[0]:
            best = score, every, fit, x
    return None if best is None else best[1:]


def _mass_turns(fit: LinearFit) -> bool:
    """Whether the data show that the mass depends on the angles."""
    constant = torch.tensor([name != MOVING for name in fit.names])
    poor, good = of_first(_held_out(fit, constant), _held_out(fit, torch.ones_like(constant)))
    return simplest_not_beaten({0.0: poor, 1.0: good}) == 1.0


def _held_out(fit: LinearFit, columns: Tensor) -> Tensor:
    """RMS of each fold's one-step errors at the coefficients that the others give, (FOLDS,)."""
    fold = torch.arange(len(fit.R), device=fit.R.device) * FOLDS // len(fit.R)
    rest = [(fit.rows(fold == k), fit.rows(fold != k).solve(columns)) for k in range(FOLDS)]
    return torch.stack([own.errors(x).square().mean().sqrt() for own, x in rest]).cpu()


def _short_fit(
    data: Trajectories, base: Baseline, config: FitConfig, max_step: float
) -> tuple[dict, tuple[str, ...], float]:
    """A short fit of order 4: values by term or parameter, the features that stay, and the one-step error."""
    model = build_model(base, config, "potential")
    prior = prior_of(model, base, None)
    most = ROWS * prior.start.numel() // data.dof
    problem = ResidualProblem(model, data, max_step=max_step, sigma=1e-6 * max(base.scale), prior=prior, most=most)
    result = levenberg_marquardt(problem, problem.start(), max_iterations=40, rtol=1e-3, patience=3)
    r = problem.residuals(result.x)
    _, A, _ = problem.normal_equations(result.x)
    named = {i: name for name, (i,) in places(problem.parameters).items()}
    relative = A * problem.sigma**2 / r.square().mean().clamp_min((EXACT["float64"] * max(base.scale)) ** 2)
    kept, x = prune(relative, result.x, torch.tensor(list(named)), math.log(r.numel()))
    values = values_of(problem.parameters, x)
    return values, tuple(named[i] for i in kept.tolist()), float(r.square().mean().sqrt())
