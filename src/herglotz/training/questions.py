"""What a search asks of data beside their terms: one question after the other, of the model that the last one left.

Damping by s belongs to the terms. Zeros of sensors and how inputs hold come before everything else that may stand for
them. By which terms inputs act, and whether functions say what named terms do not, follows. Of long recordings a part
is asked, and all samples at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from herglotz.training.acting_inputs import columns_of, taken_terms
from herglotz.training.dissipation import with_dissipation
from herglotz.training.function_search import with_functions
from herglotz.training.search import Search
from herglotz.training.trials import Trial


class Questions:
    """The answers so far: the model, and what the data were found to be."""

    def __init__(self, wanted: Search, holds: Sequence[str]):
        # The search of all data, and the holds of inputs that may be tried, that of the data among them.
        self.wanted, self.holds = wanted, (*holds, *([wanted.data.hold] if holds else []))
        self.hold, self.input_terms = "", ()
        # The search of the part, its sensors' zeros taken off where these differ; the model; the zeros.
        self.read: Search = wanted.part
        self.best: Trial | None = wanted.part.first
        self.differ: tuple[Tensor, Tensor] | None = None
        asked = False
        if self.best is None or not self.best.at_the_noise:
            self.best = wanted.part.full  # which lacks no term that zeros, or another hold, could stand for
            asked = self.best is not None and self.best.whole
            if asked and any([self.zeros(), self.how_inputs_hold(alike=True)]):
                self.read.full = self.best
        self.best = _searched(self.read)
        if not asked and self.zeros():  # what stood for zeros has bent the terms
            self.best = self.read.better(self.best, _searched(self.read))
        if not asked and self.how_inputs_hold():
            self.best = self.read.better(self.best, _searched(self.read))

    def zeros(self) -> bool:
        """Zeros of sensors that differ between recordings, where the model asks for some."""
        self.read, self.best, self.differ = self.read.with_zeros(self.best)
        return self.differ is not None

    def how_inputs_hold(self, *, alike: bool = False) -> bool:
        """Another hold of the inputs where the model asks for one; `alike`: by the residuals of its fits themselves."""
        if self.best is None or self.wanted.part.longer > 1:
            return False
        if not (hold := self.read.held(self.best, self.holds, alike=alike)):
            return False
        self.wanted, self.read = (x.of(replace(x.data, hold=hold)) for x in (self.wanted, self.read))
        self.hold, self.best = hold, self.read.again(self.best)
        return True

    def how_inputs_act(self) -> None:
        """Terms anew with other terms of the inputs, where the model asks for some; then the hold once more.

        A hold may have stood for the term that was missing, and some of the terms for the hold.
        """
        if self.best is None or not (terms := self.read.input_terms(self.best)):
            return
        recorded = self.wanted, self.read
        read = self.read.driven_by(terms)
        found = _searched(read)
        if found is None or not found.replaces(self.best) or read.finalist(found, (self.best, found)) is not found:
            return
        self._drive(terms, self.wanted, read, found)
        if self.how_inputs_hold():
            left = taken_terms(self.read.settled(self.best, swapped=True), terms)
            wanted, read = (x.of(replace(x.data, hold=self.hold)) for x in recorded)
            found = _searched(read := read.driven_by(left)) if left != terms else None
            if found is not None and not self.best.replaces(found):
                self._drive(left, wanted, read, found)

    def _drive(self, terms: Sequence[str], wanted: Search, read: Search, found: Trial) -> None:
        """The inputs act by these terms as well, in all data and in the search of a model."""
        self.input_terms, self.wanted = columns_of(terms), wanted.driven_by(terms)
        self.read, self.best = read, found

    def functions(self) -> None:
        """A model of functions, where it is better; then holds and zeros once more.

        Functions may be what recordings seemed to differ by, and tell a hold that terms did not.
        """
        if self.best is None or (found := with_functions(self.read, self.best)) is self.best:
            return
        self.best = found
        later = "" if self.wanted.part.longer > 1 else self.read.held(found, self.holds)
        wanted = self.wanted.of(replace(self.wanted.data, hold=later)) if later else self.wanted
        if (again := wanted.part.again(found)) is None:
            return
        self.wanted, self.hold = wanted, later or self.hold
        self.read, best, self.differ = wanted.part.with_zeros(again)
        self.best = best and self.read.settled(best, swapped=True)

    def all_data(self) -> None:
        """The model of a part fitted to all data, with what more these ask for, and its zeros of sensors."""
        if self.wanted.part is self.wanted:
            if self.best is not None and self.differ is not None:
                self.read, best, self.differ = self.wanted.zeros_again(self.read, self.best, self.differ)
                self.best = best and (best if best is self.best else self.read.settled(best, swapped=True))
            return
        longer = self.wanted.part.longer > 1  # inputs are means over several samples, which say little of holds of one
        self.read, self.best, self.differ = self.wanted.of_part(self.best, self.differ is not None)
        if longer and self.best is not None and (hold := self.read.held(self.best, self.holds)):
            self.hold, self.wanted = hold, self.wanted.of(replace(self.wanted.data, hold=hold))
            self.read, self.best, self.differ = self.wanted.of_part(self.best, self.differ is not None)


def _searched(search: Search) -> Trial | None:
    """The model of a search, whose damping depends on s where that is better."""
    found = search.run()
    return found and with_dissipation(search, found)
