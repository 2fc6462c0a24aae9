"""What a model of a search is beside its parameters (`Variant`), and the record of a scored model (`Compared`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from herglotz.training.functions import Band


@dataclass(frozen=True)
class Variant:
    """Order and steps of the rule, kind of dry friction, and the dictionary of a model.

    `functions` are bands of learned functions beside the named terms. `dissipation` are powers of s in L. `kept` are
    named terms that stay offers although functions can replace them.
    """

    order: int
    substeps: int = 1
    sticking: bool = False
    functions: tuple[Band, ...] = ()
    dissipation: tuple[str, ...] = ()
    kept: frozenset[str] = frozenset()

    def crossing(self, ratio: float) -> Variant:
        """The variant with model steps of about the same length for recorded steps that are `ratio` times as long."""
        return replace(self, substeps=max(1, round(ratio * self.substeps)))


class Compared(NamedTuple):
    """A scored model: segments of `length` recorded steps, number of parameters, RMS error, and offers.

    `held_out` is the error over held-out blocks, in units of q over the balance.
    """

    length: int
    numbers: int
    held_out: float
    taken: frozenset[str]
