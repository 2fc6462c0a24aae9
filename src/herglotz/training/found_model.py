"""The model found by a search, as settings and starting values of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from herglotz.errors import InputError
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.dictionary import keys_of
from herglotz.training.named_terms import NamedTerms, settings_of, started, values_of
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.task import build_model
from herglotz.training.trials import ALIKE, FINER, Fitter, Trial, is_precise, moved


def settings(trial: Trial, config: FitConfig) -> tuple[FitConfig, Baseline]:
    """The settings of a model with exactly the numbers of a trial, and the baseline with their values."""
    fitter, data, variant = trial.fitter, trial.problem.data, trial.fitter.variant
    base = replace(fitter.base, spreads=_spreads(trial))
    numbers = set(trial.problem.parameters.numbers)
    keys = [fitter.keys[name] for name in fitter.start if name in numbers]
    terms = _terms_of(fitter, keys)
    config = settings_of(terms, data, replace(config, drag=()), variant.order, variant.substeps)
    config = replace(config, sticking=variant.sticking and terms.dry)
    # The model has exactly the numbers of the trial: all others are absent.
    bare = replace(base, start={})
    possible = ParameterVector(build_model(bare, config, "none"))
    absent = [
        name for name, key in zip(possible.numbers, keys_of(possible.numbers, possible.model.config), strict=True)
        if key not in keys and not key.startswith("friction.log_smooth")
    ]  # fmt: skip
    config = replace(config, absent=tuple(absent))
    parameters = ParameterVector(build_model(bare, config, "none"))
    fitted = {fitter.keys[name]: x for name, x in trial.values.items()}
    keys, start = keys_of(parameters.numbers, parameters.model.config), parameters.get().tolist()
    # The trial lacks the widths of friction without a force; these keep their default.
    theta = data.q.new_tensor([fitted.get(key, x) for key, x in zip(keys, start, strict=True)])
    values = values_of(parameters, theta)
    # A search has no kernel of order 4, and uses short steps of order 2 instead.
    if is_precise(data) and data.dof > 1 and data.u is None and variant.substeps > 1 and not terms.dry:
        fourth = replace(config, order=4, substeps=1)
        if (start_of_order_4 := _start_of_order_4(trial, fourth, base, values)) is not None:
            return fourth, start_of_order_4
    return config, started(base, data, values, config)


def _terms_of(fitter: Fitter, keys: Sequence[str]) -> NamedTerms:
    """The named terms of a model whose numbers have these keys (`dictionary.keys_of`)."""
    offered = replace(fitter.terms, drag=fitter.settings.drag)
    dry = any(key.startswith(("friction.coulomb", "friction.breakaway")) for key in keys)
    forces = any(key.startswith(("friction.", "coupling.")) for key in keys)
    # These keys have an index if there are three coordinates or more.
    between = any(key.startswith(("kinetic.off_diagonal", "coupling.viscous")) for key in keys)
    return replace(offered.only(keys), dry=dry, apart=not between, one_rate=offered.one_rate or not forces)


def _start_of_order_4(trial: Trial, fourth: FitConfig, base: Baseline, values: dict) -> Baseline | None:
    """The baseline of a model of order 4; None if its motion is not that of the trial, or a term has no such rule."""
    data, base = trial.problem.data, started(base, trial.problem.data, values, fourth)
    try:
        model = build_model(base, fourth, "none")
    # Some terms have no rule of order 4, among them products of three velocities.
    except InputError:
        return None
    grid = segment_grid(data, trial.length, base.model_step)
    problem = ShootingProblem(model, data, grid, sigma=trial.problem.sigma)
    change = moved(trial, problem, problem.parameters.get())
    return base if change <= FINER * max(trial.rms, trial.fitter.rounding / ALIKE) else None


def _spreads(trial: Trial) -> dict[str, float]:
    """Prior deviations, by their text, of the waves of a trial and of the terms that waves could replace."""
    numbers, fitter, prior = trial.problem.parameters.numbers, trial.fitter, trial.prior
    return {
        fitter.keys[name]: weight**-0.5
        for name, weight in zip(numbers, prior.weight.tolist(), strict=True)
        if name in fitter.centred
    }
