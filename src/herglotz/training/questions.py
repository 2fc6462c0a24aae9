"""Questions to the data beside the terms of a model, asked one after the other of the best model so far.

1. Zeros of the sensors and the hold of the inputs, because terms could make up for either.
2. The terms of the model, damping by s among them (`Search.run`).
3. The terms by which inputs act (`how_inputs_act`), and whether an angle is rather a position on a line.
4. Learned functions in the place of missing named terms (`functions`).

Of a long recording a part answers these questions, and `all_data` fits the answer to all samples.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from herglotz.data.input_terms import saturation
from herglotz.data.sensors import measured
from herglotz.models.drag import input_columns
from herglotz.training.acting_inputs import asked_terms, sharpened, taken_terms
from herglotz.training.dictionary import WEIGHTS
from herglotz.training.friction_search import with_sticking
from herglotz.training.function_search import with_functions
from herglotz.training.search import Search
from herglotz.training.sensor_zeros import differ_between
from herglotz.training.trials import Trial, Variant


class Questions:
    """The answers so far; making the object asks questions 1 and 2, its methods ask the others.

    `wanted` is the search of all data, and `unread` that of all data as they were recorded. `read` is the search of the
    part; once zeros of sensors are found, `read` has the readings less these zeros. `best` is the model in `read`, and
    `differ` the zeros (B, n) with their standard deviations. `hold` is empty until another hold is found. `terms` are
    all terms by which inputs act, `input_terms` those that are further columns of the inputs; `undriven` is the search
    of all data without these.
    """

    def __init__(self, wanted: Search, holds: Sequence[str]):
        # The hold of the data is among the candidates, because it is tried again after another hold was found.
        self.unread, self.wanted, self.holds = wanted, wanted, (*holds, *([wanted.hold] if holds else []))
        self.hold, self.terms, self.input_terms, self.undriven = "", (), (), wanted
        self.read: Search = wanted.part
        self.best: Trial | None = None
        self.differ: tuple[Tensor, Tensor] | None = None
        asked = False
        # A first model that already misses segments by more than the noise is not grown to whole trajectories.
        if wanted.part.misses_segments or (simple := wanted.part.first) is None or not simple.at_the_noise:
            # The whole dictionary lacks no term for which zeros or another hold could make up.
            read, found, differ = self.read.with_zeros_of_segments()
            if found is not None:
                read.full, self.read, self.differ = found, read, differ
            self.best = self.read.full
            asked = self.best is not None and self.best.whole
            if asked and any([self.differ is None and self.zeros(), self.how_inputs_hold(by_residuals=True)]):
                self.read.full = self.best
        self.best = self.read.run()
        # Terms that made up for zeros or another hold are searched anew.
        if not asked and self.zeros():
            self.best = self.read.better(self.best, self.read.run())
        if not asked and self.how_inputs_hold():
            self.best = self.read.better(self.best, self.read.run())
        self._rather_as_recorded()

    def _rather_as_recorded(self) -> None:
        """Take the readings as they are, if all recordings have the same zeros and a model without is no worse.

        One zero of all is the middle of a force. About it other terms of the dictionary may be many.
        """
        if self.best is None or self.differ is None or differ_between(*self.differ):
            return
        plain = self.unread.part.run()
        if plain is not None and self.best.gain(plain, int((self.differ[1] > 0).sum())) <= 0:
            self.wanted = self.undriven = self.unread
            self.read, self.best, self.differ, self.hold = self.unread.part, plain, None, ""

    def zeros(self) -> bool:
        """Find zeros of sensors that differ between recordings; True if the model is better with them."""
        read, best, differ = self.read.with_zeros(self.best)
        # Zeros may make up for a function that no dictionary of terms has.
        if differ is None or best is None or (not best.at_the_noise and self._rather_functions(best)):
            return False
        self.read, self.best, self.differ = read, best, differ
        return True

    def _rather_functions(self, best: Trial) -> bool:
        """True if functions, with the readings as they are, foretell more than the model `best` with zeros."""
        flexible = self.read.flexible
        return flexible is not None and flexible.foretells(best)

    def how_inputs_hold(self, *, by_residuals: bool = False) -> bool:
        """Find another hold of the inputs (`Search.better_hold`); True if the model is better with it."""
        if self.best is None:
            return False
        if not (hold := self.read.better_hold(self.best, self.holds, by_residuals=by_residuals)):
            return False
        each = self.wanted, self.read, self.undriven
        self.wanted, self.read, self.undriven = (x.held(hold) for x in each)
        self.hold, self.best = hold, self.read.again(self.best)
        return True

    def how_inputs_act(self) -> None:
        """Find terms by which the inputs act, search the terms of the model anew with them, then the hold.

        A hold may have made up for a missing term of the inputs. If another hold is found now, terms of the inputs
        that only made up for the hold leave. Rates of inputs make up well for a wrong hold, because u(t + τ) is
        u + τ u′, so that beside them no other hold may be found: if there are rates, or the misfit exceeds the noise,
        every hold is tried without the rates.
        """
        if self.best is None or (asked := _asked(self.read, self.best)) is None:
            return
        recorded = self.wanted, self.read
        # Zeros, and a hold that was found beside them, may have made up for the terms.
        if self.differ is not None and (plain := self.unread.part.run()) is not None:
            other, more = _asked(self.unread.part, plain), int((self.differ[1] > 0).sum())
            if other is not None and asked[2].gain(other[2], more) <= 0:
                asked, recorded = other, (self.unread, self.unread.part)
                self.differ, self.hold = None, ""
        terms, driven, found = asked
        self._drive(terms, recorded[0], driven, found)
        for hold, left in self._fewer_terms(found, recorded[1]):
            wanted, plain = (x.held(hold) for x in recorded)
            read = plain.driven_by(left)
            if (found := read.run()) is None:
                continue
            left, read, found = _at_best_levels(plain, read, found, left)
            if self.read.better(self.best, found) is found:
                self.hold = hold
                self._drive(left, wanted, read, found)
        # Beside wrong forces of the inputs no zeros were clear.
        if self.differ is None and self.zeros():
            self.best = self.read.better(self.best, self.read.run())

    def _fewer_terms(self, found: Trial, recorded: Search) -> list[tuple[str, tuple[str, ...]]]:
        """Holds, each with the terms of the inputs that may be left with that hold; none if all terms stay.

        `recorded` is the search of the part without the terms. If another hold is found, the levels at which inputs
        saturate are sharpened for that hold first.
        """
        assert self.best is not None
        if self.how_inputs_hold():
            plain = recorded.held(self.hold)
            terms, read, settled = _at_best_levels(plain, self.read, self.read.settled(self.best), self.terms)
            if terms != self.terms:
                self._drive(terms, self.undriven, read, settled)
            left = taken_terms(settled, terms)
            return [(self.hold, left)] if left != terms else []
        left = tuple(term for term in self.terms if not term.endswith("'"))
        open_to = self.holds if left != self.terms or not found.at_the_noise else ()
        return [(hold, left) for hold in open_to if hold != self.read.hold]

    def _drive(self, terms: Sequence[str], wanted: Search, read: Search, found: Trial) -> None:
        """Keep these terms of the inputs, the search of the part that has them, and its model."""
        self.terms, self.input_terms, self.undriven = tuple(terms), input_columns(terms), wanted
        self.wanted, self.read, self.best = wanted.driven_by(terms), read, found

    def better_on_a_line(self) -> bool:
        """True if a model is better with every angle taken for a position on a line, as of a coil spring."""
        trial, read = self.best, self.read
        if not any(read.data.angles) or read.config.translations:
            return False
        line = read.on_a_line()
        if trial is not None and not _may_be_better(line, trial):
            return False
        other = line.run()
        if read.data.u is not None and not (other and other.at_the_noise):
            # Terms of the inputs that are found beside wrong forces of the angle may be wrong, too.
            asked = Questions(self.unread.on_a_line(), self.holds[:-1])
            asked.how_inputs_act()
            other = read.better(other, asked.best)
        turned = {offer.name for offer in read.fitter(Variant(read.order)).offers}
        # A weight alone is the potential of a pendulum.
        if other is None or (not other.taken.isdisjoint(WEIGHTS) and other.taken <= turned):
            return False
        return trial is None or _is_better(other, trial, read)

    def functions(self) -> None:
        """Find a better model with learned functions."""
        self.best = self.best and with_functions(self.read, self.best)

    def all_data(self) -> None:
        """Fit the model of a part to all data, and ask these for zeros and more terms."""
        if self.wanted.part is self.wanted:
            if self.best is not None and self.differ is not None:
                found = self._zeros_again(self.best, self.differ)
                self.best = found if found is self.best else self.read.settled(found)
            return
        first = self.read.first
        self.read, self.best, self.differ = self.wanted.of_part(self.best, self.differ)
        # Held-out time of all samples may ask for fewer terms than that of a part.
        if first is not None and not (self.best and self.best.at_the_noise):
            other = self.read.again(first)
            self.best = self.read.better(self.best, other and self.read.settled(other))

    def _zeros_again(self, best: Trial, differ: tuple[Tensor, Tensor]) -> Trial:
        """The model with zeros fitted once more, and with the levels at which its inputs saturate beside these."""
        self.read, best, self.differ = self.wanted.zeros_again(self.read, best, differ)
        plain = self.undriven.of(measured(self.undriven.data, self.differ[0].flatten().tolist()))
        terms, driven, found = _at_best_levels(plain, self.read, best, self.terms)
        if found is best:
            return best
        self._drive(terms, self.undriven, driven, found)
        self.read, best, self.differ = self.wanted.zeros_again(driven, found, self.differ)
        return best


def _asked(read: Search, best: Trial) -> tuple[tuple[str, ...], Search, Trial] | None:
    """Terms by which the inputs act, the search with them, and its model if that replaces `best`; else None."""
    if not (terms := asked_terms(read, best)):
        return None
    driven = read.driven_by(terms)
    found = driven.run()
    return None if found is None or not found.replaces(best) else (terms, driven, found)


def _at_best_levels(
    plain: Search, driven: Search, best: Trial, terms: tuple[str, ...]
) -> tuple[tuple[str, ...], Search, Trial]:
    """Terms of the inputs, the search with them and its model, at the levels at which the model misses the data least.

    The levels may have been found with another hold, or with other zeros of sensors. `plain` is the search without the
    terms, `driven` that with them. All stay as they are if no levels are better.
    """
    if not any(map(saturation, terms)):
        return terms, driven, best
    sharp = sharpened(plain, best, terms)
    other = plain.driven_by(sharp)
    found = other.again(best)
    if found is None or found.length < best.length or not found.rms < best.rms:
        return terms, driven, best
    return sharp, other, other.settled(found)


def _may_be_better(line: Search, trial: Trial) -> bool:
    """True if a search on a line is worth its time beside a model of angles."""
    straight = {offer.name for offer in line.fitter(Variant(line.order)).offers}.difference(WEIGHTS)
    turning = trial.taken - straight
    # The simplest model on a line has a single term for each coordinate, stiffness. With several coordinates this term
    # has the same name for an angle.
    if trial.lacks_nothing and (len(turning) <= (line.data.dof == 1) or not line.meets_segments):
        return False
    # The first model on a line must be no worse, with dry friction of the same kind.
    if not trial.whole:
        return True
    if line.first is None:
        return False
    first = with_sticking(line, line.first) if trial.fitter.variant.sticking else line.first
    return not trial.replaces(first)


def _is_better(other: Trial, trial: Trial, read: Search) -> bool:
    """True if the model `other` on a line is better than the model `trial` of angles, over segments that both follow.

    Free runs over held-out time must not contradict. Of two models with equal errors the simpler model is better.
    """
    length = min(trial.length, other.length)
    turning, line = (x if x.length == length else x.over(length) for x in (trial, other))
    if turning is None or line is None or read.better(turning, line) is turning:
        return turning is None and line is not None
    of_angles, on_line = (x.fitter.free_run_score(x) for x in (turning, line))
    if on_line is None or of_angles is None:
        return on_line is not None
    offered = trial.fitter.offered
    if of_angles.numbers > on_line.numbers:
        return not of_angles.replaces(on_line, offered)
    return on_line.replaces(of_angles, offered)
