"""Settings of a search, and its result: every setting with error and cost, the front, and the choice as a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from herglotz.data import Trajectories
from herglotz.errors import InputError, refuse
from herglotz.models import ContactLagrangian
from herglotz.stepping import State
from herglotz.training import Run
from herglotz.tune.cost import Cost
from herglotz.tune.kick_composition import KickStepper

ARTEFACTS = ("eager", "c")


@dataclass(frozen=True)
class TuneConfig:
    """Settings of `tune`.

    Parameters
    ----------
    multiples
        Step sizes to try, in steps of the run: whole numbers.
    widths
        Hidden units of the distilled corrections; an empty tuple re-trains nothing.
    kicks
        Numbers of kicks of explicit large steps (`KickStepper`), tried in C at every whole multiple where the model has
        one coordinate and a constant c; an empty tuple tries none.
    artefacts
        "eager" (PyTorch), "c" (compiled C, in float64 and float32).
    tolerances
        Newton tolerances of the eager stepper, relative to the size of the positions; None is its default.
    starts
        Number of motions that choose a setting; the same number of other motions judges the choice.
    quantile, confidence
        The bound of a setting is an error that, with this confidence, this share of all starts keeps.
    seed
        Seed of the starts; training, choosing and judging starts are drawn separately.
    iterations, pairs
        Largest number of iterations, and number of pairs of states, of a distillation.
    rounds
        Number of timings of each setting; all settings take turns.
    """

    multiples: tuple[int, ...] = (1, 2, 4, 8)
    widths: tuple[int, ...] = (8, 16)
    kicks: tuple[int, ...] = ()
    artefacts: tuple[str, ...] = ARTEFACTS
    tolerances: tuple[float | None, ...] = (None, 1e-7)
    starts: int = 128
    quantile: float = 0.95
    confidence: float = 0.95
    seed: int = 0
    iterations: int = 80
    pairs: int = 1000
    rounds: int = 7

    def __post_init__(self):
        unknown = [x for x in self.artefacts if x not in ARTEFACTS]
        whole = all(m >= 1 and float(m).is_integer() for m in self.multiples)
        refuse({
            f"artefacts must be some of {', '.join(ARTEFACTS)}, got {self.artefacts}": unknown or not self.artefacts,
            "multiples is empty; give at least one, such as 1": not self.multiples,
            f"multiples must be whole numbers >= 1, got {self.multiples}": not whole,
            f"widths must be >= 1, got {self.widths}; give an empty tuple for no distillation":
                min(self.widths, default=1) < 1,
            f"kicks must be >= 1, got {self.kicks}; give an empty tuple for none": min(self.kicks, default=1) < 1,
            **{f"{name} must be in (0, 1), got {x:g}": not 0 < x < 1
               for name, x in (("quantile", self.quantile), ("confidence", self.confidence))},
            **{f"{name} must be >= 1, got {getattr(self, name)}": getattr(self, name) < 1
               for name in ("iterations", "pairs", "rounds")},
        })  # fmt: skip
        allowed_failures(self.starts, self.quantile, self.confidence)


def allowed_failures(count: int, quantile: float, confidence: float) -> int:
    """Return how many of `count` starts may exceed a bound that `quantile` of all starts keep, with this confidence.

    The result is the largest k with P(at most k of `count` exceed | each exceeds with probability 1 − quantile) ≤ 1 −
    confidence. This tolerance limit holds for every distribution of the errors. Raise InputError if `count` starts are
    too few for the claim.  Source: S. S. Wilks, Ann. Math. Stat. 12 (1941) 91.
    """
    p, total, k = 1 - quantile, 0.0, 0
    while k <= count:
        total += math.comb(count, k) * p**k * quantile ** (count - k)
        if total > 1 - confidence:
            break
        k += 1
    if k == 0:
        least = math.ceil(math.log(1 - confidence) / math.log(quantile))
        raise InputError(
            f"{count} starts cannot show that {quantile:g} of all keep a bound, with confidence {confidence:g}; "
            f"take {least} or more"
        )
    return k - 1


@dataclass(frozen=True)
class Setting:
    """A way to step: a model, a step size and a form.

    `multiple` is the step h in steps of the run. `width` is the number of hidden units of the distilled correction,
    None for the run's own model. `tol` is the tolerance of the eager Newton iteration, None for the default. `kicks` is
    the number of kicks if a `KickStepper` replaces the model.
    """

    multiple: float
    h: float
    width: int | None
    artefact: str
    dtype: str
    tol: float | None
    kicks: int | None = None

    @property
    def name(self) -> str:
        """Return the name for tables."""
        if self.kicks is not None:
            return f"h {self.h:.4g}, {self.kicks} kicks, C {self.dtype}"
        net = "own model" if self.width is None else f"distilled {self.width}"
        tol = "" if self.tol is None else f", tol {self.tol:g}"
        return f"h {self.h:.4g}, {net}, {'C' if self.artefact == 'c' else self.artefact} {self.dtype}{tol}"


@dataclass(frozen=True)
class Candidate:
    """A setting with the measured error and cost.

    The error of a start is the largest |q − reference| over the horizon, in units of q; `bound` is the error that the
    demanded share of all starts keeps. `kicks` replaces the model; `stepper` is the form that was measured.
    """

    setting: Setting
    median: float
    bound: float
    worst: float
    cost: Cost
    model: ContactLagrangian = field(repr=False)
    kicks: KickStepper | None = field(default=None, repr=False)
    stepper: Any = field(default=None, repr=False)

    @property
    def us(self) -> float:
        """Return microseconds for a unit of simulated time."""
        return self.cost.step_us / self.setting.h

    @property
    def spread(self) -> float:
        """Return how far the median round lies above the best, in the unit of `us`."""
        return self.cost.spread_us / self.setting.h

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        errors = {f"error_{k}": getattr(self, k) for k in ("median", "bound", "worst")}
        parameters = sum(p.numel() for p in self.model.parameters())
        return {
            **asdict(self.setting),
            # An error is infinite where a step failed, and JSON has no infinity.
            **{k: x if math.isfinite(x) else None for k, x in errors.items()},
            "step_us": self.cost.step_us, "us_per_time": self.us, "us_per_time_spread": self.spread,
            "parameters": parameters if self.kicks is None else self.kicks.parameters,
        }  # fmt: skip


def pareto(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that no other beats in both error bound and cost, cheapest first."""
    front: list[Candidate] = []
    for c in sorted(candidates, key=lambda c: (c.us, c.bound)):
        if c.bound < float("inf") and (not front or c.bound < front[-1].bound):
            front.append(c)
    return front


@dataclass(frozen=True)
class Tuning:
    """All settings tried, the choice, and the errors of the choice on starts that had no part in choosing.

    `asked` is max_error or budget_us with its value. `motions` are the training motions of the reference at the chosen
    step. `notes` has the settings that could not be tried, each with the reason.
    """

    run: Run
    config: TuneConfig
    horizon: float
    asked: dict[str, float]
    candidates: list[Candidate]
    chosen: Candidate
    held_out: dict[str, Any]
    motions: State  # (B, K+1, …)
    notes: list[str]

    @property
    def front(self) -> list[Candidate]:
        """Return the Pareto front, cheapest first."""
        return pareto(self.candidates)

    @property
    def own(self) -> Candidate:
        """Return the run unchanged: the model at the step of the data, eager."""
        return self.candidates[0]

    @property
    def own_in_c(self) -> Candidate | None:
        """Return the unchanged run in C, in the faster precision; None without C."""
        found = [
            c for c in self.candidates
            if c.setting.artefact == "c" and c.setting.multiple == 1 and c.model is self.own.model
        ]  # fmt: skip
        return min(found, key=lambda c: c.us, default=None)

    @property
    def model_error(self) -> dict[str, float | None]:
        """Return the RMS errors of the run against its data, in units of q; errors of stepping come on top."""
        names = ("extrapolation_rms", "train_rms", "one_step_rms")
        return {name: self.run.metrics.get(name) for name in names}

    def tuned_run(self) -> Run:
        """Return the chosen model as a run at the chosen step, on motions of the reference, for `save_run` and export.

        States (q, p, s) of the old run are states of the new run. If kicks were chosen, which are no model, the old run
        is returned: `export_kicks_c(tuning.chosen.kicks, …)` writes the kicks.
        """
        if self.chosen.kicks is not None:
            return self.run
        s = self.chosen.setting
        dtype = getattr(torch, s.dtype)
        states = State(*(x.flatten(0, 1).to(dtype) for x in self.motions))
        count, length = self.motions.s.shape
        old = self.run.data
        data = Trajectories(
            (s.h * torch.arange(length, dtype=dtype)).repeat(count),
            states.q,
            (length,) * count,
            names=old.names, units=old.units, angles=old.angles, time_unit=old.time_unit,
            source=f"motions of the run on {old.source or 'data'} at h={s.h:g}",
        )  # fmt: skip
        metrics = {**self.run.metrics, "tuned": self.summary()}
        config = replace(self.run.config, dtype=s.dtype)
        return replace(
            self.run, model=self.chosen.model.to(dtype), config=config, metrics=metrics, data=data,
            train_lengths=data.lengths, states=states, h=s.h,
        )  # fmt: skip

    def summary(self) -> dict[str, Any]:
        """The choice and the measurements, for JSON."""
        return {
            "asked": self.asked, "chosen": self.chosen.to_dict(), "held_out": self.held_out,
            "horizon": self.horizon, "model_error": self.model_error,
        }  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Everything, for JSON."""
        front = self.front
        return {
            **self.summary(),
            "time_unit": self.run.data.time_unit,
            "own": self.own.to_dict(),
            "candidates": [{**c.to_dict(), "front": c in front} for c in self.candidates],
            "config": asdict(self.config),
            "notes": self.notes,
        }

    def table(self) -> str:
        """The front, the unchanged run and the choice (*), for people, in 80 columns."""
        per, share = time_label(self.run), f"{100 * self.config.quantile:g} %"
        shown = self.front
        shown += [c for c in (self.own, self.chosen) if c not in shown]
        width = max(len(c.setting.name) for c in shown)
        lines = [f"  {'setting':<{width}}{'median':>9}{share:>9}{'worst':>9}{per:>9}{'±':>9}"]
        for c in sorted(shown, key=lambda c: c.us):
            mark = "*" if c is self.chosen else " "
            lines.append(
                f"{mark} {c.setting.name:<{width}}{c.median:>9.2g}{c.bound:>9.2g}{c.worst:>9.2g}"
                f"{c.us:>9.3g}{c.spread:>9.2g}"
            )
        return "\n".join(lines)


def time_label(run: Run) -> str:
    """µs per unit of simulated time, in words."""
    return "µs/time" if run.data.time_unit == "1" else f"µs/{run.data.time_unit}"
