"""`tune`: an error or a budget in; out come the setting that meets the demand, and the front it was chosen from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from herglotz.data.splits import leading_rows
from herglotz.errors import InputError, refuse
from herglotz.export import compile_c
from herglotz.models import ContactLagrangian
from herglotz.progress import ProgressBar
from herglotz.stepping import State, Stepper
from herglotz.threads import one_thread
from herglotz.training import Run
from herglotz.tune.cost import Cost, measure_costs, timed_stepping
from herglotz.tune.distil import distil, pairs_of, widened
from herglotz.tune.kick_composition import CompiledKicks, KickStepper, can_kick, fit_kicks
from herglotz.tune.result import Candidate, Setting, TuneConfig, Tuning, allowed_failures

# Share of the box by which a start is moved away from a recorded state, at most.
JITTER = 0.05


@dataclass(frozen=True)
class Motions:
    """B motions of the run's own model at its own step `base`, in float64."""

    base: float
    states: State  # (B, K+1, n), (B, K+1, n), (B, K+1)

    def at(self, h: float) -> State:
        """Return the states a time h apart, a multiple of `base`."""
        return State(*(x[:, :: round(h / self.base)] for x in self.states))

    def steps(self, h: float) -> int:
        """Return how many steps of h a motion has."""
        return (self.states.s.shape[1] - 1) // round(h / self.base)

    def starts(self) -> State:
        """Return the states at time 0, (B, n), (B, n), (B,)."""
        return State(*(x[:, 0] for x in self.states))


def draw_starts(run: Run, count: int, seed: int) -> State:
    """Draw random recorded states of the run, each moved by up to `JITTER` of the box, and kept inside the box.

    A uniform draw would fill the corners of the box too, where the model has seen no data.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = leading_rows(run.data.lengths, run.train_lengths)
    rows = rows[run.states.finite.cpu()[rows]]
    if not len(rows):
        raise InputError("the run has no finite state to start from; fit it again")
    rows = rows[torch.randint(len(rows), (count,), generator=generator)]
    moved = []
    for name, x in zip("qps", run.states, strict=True):
        low, high = (torch.tensor(run.box[f"{name}_{end}"], dtype=torch.float64) for end in ("low", "high"))
        x = x.detach().cpu().double()[rows].reshape(count, -1)
        kick = 2 * torch.rand(x.shape, generator=generator, dtype=torch.float64) - 1
        moved.append((x + JITTER * (high - low) * kick).clamp(low, high))
    return State(moved[0], moved[1], moved[2][:, 0])


def record(run: Run, starts: State, horizon: float) -> Motions:
    """Return motions over `horizon` from these starts; motions that fail are left out.

    The reference is the run's model at the run's own step: the error of this flow against the data has been measured.
    Raise InputError if more than half of the motions fail.
    """
    with torch.no_grad():
        out = Stepper(frozen_double(run)).rollout(*starts, h=run.h, steps=round(horizon / run.h))
    good = out.states.finite.all(1)
    if int(good.sum()) * 2 < len(good):
        raise InputError(
            f"the run's own stepper fails on {int((~good).sum())} of {len(good)} starts over {horizon:g}; "
            "take a shorter --horizon"
        )
    return Motions(run.h, State(out.q[good], out.p[good], out.s[good]))


def frozen_double(run: Run) -> ContactLagrangian:
    """Return a copy of the run's model in float64, without gradients."""
    return deepcopy(run.model).cpu().double().requires_grad_(False)


# If the error of a distilled model is above this many limits, larger steps of its width are not tried.
HOPELESS = 10.0
# Number of steps of the run in the default horizon, at most.
MAX_HORIZON_STEPS = 200
UNTIMED = Cost(math.nan, math.nan)


@one_thread()
def tune(
    run: Run,
    *,
    max_error: float | None = None,
    budget_us: float | None = None,
    horizon: float | None = None,
    config: TuneConfig | None = None,
    progress: bool | None = None,
) -> Tuning:
    """Search step, correction, precision and form of a run's stepper.

    The error of a setting is the error of its *stepping*: the largest |q − q_ref| over the horizon, for each start. The
    reference is the run's own model at its own step. `Tuning.model_error` has the error of that model against
    the data, which adds to the error of stepping. Costs are wall time, one motion at a time.

    Parameters
    ----------
    run
        The run to tune; it is not changed.
    max_error
        Take the cheapest setting whose bound is at most this, in units of q.
    budget_us
        Take the most accurate setting that costs at most this, in microseconds per unit of simulated time.
    horizon
        Length of the motions, in the data's unit of time; default: a typical trajectory, at most 200 steps.
    progress
        Show a progress bar; None: on a terminal only.

    Raise InputError if not exactly one of the two demands is made, no setting meets it, or the run cannot be tuned.
    """
    config = config or TuneConfig()
    asked = _demand(max_error, budget_us)
    if run.model.inputs:
        raise InputError("tune cannot steer a model with inputs: the reference motions would need them")
    horizon = _horizon(run, config, horizon)
    # Three disjoint sets of starts: the first trains, the second chooses, the third judges.
    training, choosing, judging = (
        record(run, draw_starts(run, config.starts, 3 * config.seed + k), horizon) for k in range(3)
    )
    total = len(config.multiples) * (1 + len(config.widths))
    with ProgressBar(
        total=total, desc="settings", disable=None if progress is None else not progress, leave=False
    ) as bar:
        search = _Search(run, frozen_double(run), config, max_error, training, choosing, [], bar)
        tried = [*search.forms(), *search.kicks()]
    timed = [timed_stepping(c.stepper, choosing.starts(), c.setting.h, choosing.steps(c.setting.h)) for c in tried]
    costs = measure_costs(timed, config.rounds)
    candidates = [replace(c, cost=cost) for c, cost in zip(tried, costs, strict=True)]
    chosen = choose(candidates, asked)
    errors = _errors(chosen.stepper, chosen.setting.h, judging)
    held_out = _held_out(errors, chosen.bound if max_error is None else max_error, config)
    motions, notes = training.at(chosen.setting.h), list(dict.fromkeys(search.notes))
    return Tuning(run, config, horizon, asked, candidates, chosen, held_out, motions, notes)


def _demand(max_error: float | None, budget_us: float | None) -> dict[str, float]:
    asked = {k: v for k, v in (("max_error", max_error), ("budget_us", budget_us)) if v is not None}
    refuse({
        "give either --max-error or --budget-us": len(asked) != 1,
        **{f"{name} must be a finite number > 0, got {value:g}": not 0 < value < math.inf
           for name, value in asked.items()},
    })  # fmt: skip
    return asked


def _horizon(run: Run, config: TuneConfig, horizon: float | None) -> float:
    """Return the demanded horizon, or that of a typical trajectory; either holds two of the largest steps."""
    least = 2 * max(config.multiples)
    if horizon is None:
        length = float(torch.tensor(run.data.lengths).double().median()) - 1
        horizon = run.h * max(min(length, MAX_HORIZON_STEPS), least)
    if not (math.isfinite(horizon) and horizon >= least * run.h * (1 - 1e-9)):
        raise InputError(
            f"a horizon of {horizon:g} is shorter than two of the largest steps, {least * run.h:g}; take longer"
        )
    return horizon


@dataclass(frozen=True)
class _Search:
    """The search over all settings; `own` is the run's model in float64."""

    run: Run
    own: ContactLagrangian
    config: TuneConfig
    max_error: float | None
    training: Motions
    choosing: Motions
    notes: list[str]
    bar: ProgressBar

    def _models(self) -> Iterator[tuple[int, int | None, ContactLagrangian]]:
        """Yield (multiple, width, model): the run's own model at every step, then the distilled models."""
        config, own = self.config, self.own
        multiples = sorted(config.multiples)
        # The unchanged run is first, as `Tuning.own` relies on.
        for m in sorted({1, *multiples}):
            yield m, None, own
        for width in config.widths:
            for m in multiples:
                start = widened(own, width, max(own.config.correction_depth, 2))
                # At the step of the run, the run's own model is exact.
                if m == 1 and _size(start) >= _size(own):
                    continue
                h = m * self.run.h
                self.bar.set_postfix_str(f"distilling to h {h:.3g}, width {width}")
                model, _ = distil(start, *self._pairs(h), h, iterations=config.iterations)
                model.requires_grad_(False)
                yield m, width, model
                bound = bound_of(_errors(Stepper(model), h, self.choosing), config)
                if not math.isfinite(bound) or (self.max_error is not None and bound > HOPELESS * self.max_error):
                    self.notes.append(f"width {width}: no step beyond h = {h:.4g}, where the bound is {bound:.2g}")
                    break

    def _pairs(self, h: float) -> tuple[State, State]:
        return pairs_of(self.training.states, round(h / self.training.base), self.config.pairs, self.config.seed)

    def forms(self) -> Iterator[Candidate]:
        """Yield every model in every demanded form; the first is the run's own in eager float64."""
        for multiple, width, model in self._models():
            h = multiple * self.run.h
            if (multiple, width) == (1, None) or "eager" in self.config.artefacts:
                # A step in closed form has no tolerance.
                for tol in dict.fromkeys((None, *(() if model.capabilities.linear_in_q1 else self.config.tolerances))):
                    setting = Setting(multiple, h, width, "eager", "float64", tol)
                    yield self._tried(setting, Stepper(model, tol=tol), model)
            if "c" in self.config.artefacts:
                yield from self._in_c(Setting(multiple, h, width, "c", "float64", None), model)
            self.bar.update(1)

    def kicks(self) -> Iterator[Candidate]:
        """Yield steps of a few kicks and drifts in C, fitted to motions of the reference."""
        config = self.config
        if not config.kicks or "c" not in config.artefacts or not can_kick(self.own):
            return
        for m in sorted(config.multiples):
            h = m * self.run.h
            for count in config.kicks:
                self.bar.set_postfix_str(f"{count} kicks, h {h:.3g}")
                found = fit_kicks(self.own, *self._pairs(h), h, kicks=count, iterations=2 * config.iterations)
                compiled = list(self._in_c(Setting(m, h, None, "c", "float64", None, count), self.own, found))
                if not compiled:
                    return
                yield from compiled

    def _in_c(
        self, setting: Setting, model: ContactLagrangian, kicks: KickStepper | None = None
    ) -> Iterator[Candidate]:
        try:
            for dtype in ("float64", "float32"):
                form = CompiledKicks(kicks, dtype) if kicks else compile_c(model, h=setting.h, dtype=dtype)
                yield self._tried(replace(setting, dtype=dtype), form, model, kicks)
        except InputError as error:
            self.notes.append(f"no C: {error}")

    def _tried(
        self, setting: Setting, stepper: Any, model: ContactLagrangian, kicks: KickStepper | None = None
    ) -> Candidate:
        e = _errors(stepper, setting.h, self.choosing)
        bounds = float(e.median()), bound_of(e, self.config), float(e.max())
        return Candidate(setting, *bounds, UNTIMED, model, kicks, stepper)


def _size(model: ContactLagrangian) -> int:
    return sum(p.numel() for p in model.parameters())


def _errors(stepper: Any, h: float, motions: Motions) -> Tensor:
    """Return the largest |q − reference| of each motion, (B,), in float64; infinite where a step fails."""
    reference, dtype = motions.at(h), getattr(stepper, "dtype", torch.float64)
    with torch.no_grad():
        start = (x.to(dtype).contiguous() for x in motions.starts())
        out = stepper.rollout(*start, h=h, steps=motions.steps(h))
    error = (out.q.double() - reference.q).abs().flatten(1)
    return error.nan_to_num(nan=math.inf, posinf=math.inf).amax(1)


def bound_of(errors: Tensor, config: TuneConfig) -> float:
    """Return the error that `quantile` of all starts keep, with `confidence`: an order statistic of `errors`."""
    allowed = allowed_failures(len(errors), config.quantile, config.confidence)
    return float(errors.sort(descending=True).values[allowed])


def choose(candidates: list[Candidate], asked: dict[str, float]) -> Candidate:
    """Return the cheapest candidate within max_error, or the most accurate one within budget_us.

    Raise InputError if there is none; the message names the nearest demand that can be met.
    """
    ((demand, limit),) = asked.items()
    limited, wanted = ("bound", "us") if demand == "max_error" else ("us", "bound")
    good = [c for c in candidates if getattr(c, limited) <= limit and c.bound < math.inf]
    if good:
        return min(good, key=lambda c: (getattr(c, wanted), getattr(c, limited)))
    nearest = min(candidates, key=lambda c: getattr(c, limited))
    found = f"{getattr(nearest, limited):.3g} ({nearest.setting.name}); ask for that, or try"
    raise InputError({
        "max_error": f"no setting keeps --max-error {limit:g}: the smallest bound found is {found} smaller --multiples "
                     "or a shorter --horizon",
        "budget_us": f"no setting costs {limit:g} µs per unit of time or less: the cheapest found takes {found} larger "
                     "--multiples or smaller --widths",
    }[demand])  # fmt: skip


def _held_out(errors: Tensor, limit: float, config: TuneConfig) -> dict[str, Any]:
    """Return the errors of the choice on starts that had no part in the choice; `limit` is the promised bound.

    An error is infinite where a step failed.
    """
    return {
        "starts": len(errors),
        "limit": limit,
        "share_within": float((errors <= limit).double().mean()),
        "median": float(errors.median()),
        "quantile": float(errors.quantile(config.quantile, interpolation="higher")),
        "worst": float(errors.max()),
    }
