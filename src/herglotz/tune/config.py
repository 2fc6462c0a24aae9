"""Settings of a search, stored beside its result."""

from __future__ import annotations

import math
from dataclasses import dataclass

from herglotz.errors import InputError, refuse

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
