"""`Errors`: the errors of free runs behind a verdict, and the words for them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from herglotz.data.noise import AT_THE_NOISE, SAMPLES
from herglotz.data.units import size
from herglotz.training.problems.grid import FIRST_SEGMENT

# Share of the spread. Smaller errors count as none, since exact data have no noise to compare with.
EXACT_ENOUGH = 1e-4
# Pairs (share of the spread, multiple of the noise). An error above both numbers of a pair loses the motion. A tenth of
# the spread in windows of 20 steps is the limit of `herglotz verify`; noise larger than the motion is missed by a good
# model as well. For precise data a smaller share is no effect of noise: of six laws with 10 to 19 times the noise in
# their own recording, five had more than 20 times the noise from other starts, the worst 125 times
# (`benchmarks/judge.py --only "open 5417" "law 3"`).
LOST = ((0.1, 3.0), (0.05, 10.0))
# Two errors in one sentence that differ by this ratio need an explanation.
APART = 20.0
EACH = "all over the spread of each coordinate"


@dataclass(frozen=True)
class Errors:
    """The RMS errors and sizes behind a verdict, in one unit, or divided by the spread of each coordinate.

    `windows`, `unseen` and `free` are the three errors in the head of `herglotz.training.verdict`, None if nothing was
    held out; `free` is inf if the free run fails or diverges. `noise` is the precision of the data, inf if unknown.
    With `unit` None all numbers are over the spread; with `degrees` numbers in rad are printed in deg. `out` training
    samples with gross errors are left out of the errors. The precision of the coordinates `rough`, not of all, exceeds
    half their spread. `bound`: the precision is an upper bound, because samples are far apart (`noise.coarse`).
    """

    windows: float
    unseen: float | None
    free: float | None
    noise: float
    spread: float
    unit: str | None = ""
    degrees: bool = False
    out: int = 0
    rough: tuple[str, ...] = ()
    bound: bool = False

    @property
    def limit(self) -> float:
        """The smallest error that the data can show."""
        noise = self.noise if math.isfinite(self.noise) else min(self.windows, self.lost)
        return max(noise, EXACT_ENOUGH * self.spread)

    @property
    def lost(self) -> float:
        """The error above which a model does not follow the motion; without known noise a share of the spread."""
        if not math.isfinite(self.noise):
            return LOST[0][0] * self.spread
        return min(max(share * self.spread, times * self.limit) for share, times in LOST)

    @property
    def missed(self) -> bool:
        """Whether the error of the training data exceeds the noise."""
        return not self.windows <= AT_THE_NOISE * self.limit

    @property
    def worst(self) -> float:
        """The largest error."""
        return max(self.windows, self.unseen or 0.0, self.free or 0.0)

    def __str__(self) -> str:
        told = [f"free runs over {FIRST_SEGMENT} steps {self._missed(self.windows, 'the training data')}"]
        if self.unseen is not None:
            told.append(self._missed(self.unseen, "unseen data", missed=math.isfinite(self.windows)))
            told[-1] += self._why(self.unseen, self.windows, "where the fit has not been")
        if self.free is not None and math.isfinite(self.free):
            told.append(f"all unseen time in one run by {self._size(self.free)}")
            told[-1] += self._why(
                self.free, max(self.windows, self.unseen or 0.0), "as errors of one run grow with its time"
            )
        elif self.free is not None:
            told.append("and one run over all unseen time breaks off or leaves the world")
        spread = f"their spread is {self._size(self.spread)}" if self.unit is not None else EACH
        spread += f"; {self.out} training samples are far from the model, and are left out" if self.out else ""
        return f"{', '.join(told)}; {self._precision()}, {spread}"

    def _missed(self, error: float, what: str, missed: bool = False) -> str:
        if not math.isfinite(error):
            return f"fail on {what}"
        return f"{what} by {self._size(error)}" if missed else f"miss {what} by {self._size(error)}"

    def _why(self, error: float, other: float, why: str) -> str:
        """The reason why an error is far from the `other` in the sentence; "" if the two are close."""
        if not (math.isfinite(error) and 0 < other < math.inf) or 1 / APART < error / other < APART:
            return ""
        return (
            f" ({error / other:.2g} times as much, {why})"
            if error > other
            else " (less: that part asks less of the model)"
        )

    def _precision(self) -> str:
        if not math.isfinite(self.noise):
            return f"the data's precision is unknown, for no training part has {SAMPLES} samples"
        least = f" (errors below {self._size(self.limit)} count as none)" if self.limit > self.noise else ""
        told = " or better, for samples are too far apart to tell" if self.bound and not least else ""
        return f"the data's precision is {self._size(self.noise)}{least}{told}"

    def _size(self, x: float) -> str:
        unit, factor = ("deg", math.degrees(1)) if self.degrees else (self.unit or "", 1.0)
        return size(factor * x, unit, digits=2)
