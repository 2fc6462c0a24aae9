"""Fewer numbers: which refits are tried, and which of them stay."""

from types import SimpleNamespace

import pytest
import torch

from herglotz.training.fewer_numbers import FewerNumbers
from herglotz.training.named_terms import NamedTerms


class FakeFound(SimpleNamespace):
    """What the refits look at: a misfit, a number of parameters, and terms."""

    def changed_by(self, _problem):
        return self.change

    def as_good(self, _other, _floor):
        return False

    def cost_without(self, _names, _floor):
        return 1e9  # shared masses are needed


def found(terms, rms, parameters, *, sticking=True, substeps=1, change=0.0):
    config = SimpleNamespace(sticking=sticking, substeps=substeps, level="forced")
    fit = SimpleNamespace(theta=torch.zeros(parameters))
    return FakeFound(terms=terms, rms=rms, fit=fit, config=config, coloured=False, change=change)


def simplified(start, misfits):
    """The model that stays, and the terms that were tried; `misfits` by the drag that is left and the model steps."""
    tried = []

    def refit(of, terms, substeps=None):
        tried.append((terms.drag, substeps))
        rms = misfits[terms.drag]
        return found(terms, rms, len(of.fit.theta) - 1, substeps=substeps or of.config.substeps)

    data = SimpleNamespace(q=torch.zeros(500, 1), dof=1, angles=(False,), u=None)
    fewer = FewerNumbers(data, 0.0, 2, refit, lambda *_: (None, None))  # type: ignore[arg-type]
    return fewer.of(start), tried


@pytest.mark.parametrize(("without", "stays"), [(1.005, ()), (1.02, ("|v1| v1",))])
def test_drag_beside_friction_that_holds_stays_where_it_is_worth_a_number(without, stays):
    # fails if drag is kept out of habit, or dropped against the criterion: 500 samples, one number less, misfits may
    # grow by a factor of (1 + ln 500 / 500)^½ = 1.0062
    kept, tried = simplified(found(NamedTerms((), ("|v1| v1",), True), 1.0, 5), {(): without})
    assert kept.terms.drag == stays
    assert tried == [((), None)]


def test_drag_beside_smooth_friction_is_not_asked_for():
    # fails if terms that the search weighed already are fitted without each of them again
    start = found(NamedTerms((), ("|v1| v1",), True), 1.0, 5, sticking=False)
    assert simplified(start, {}) == (start, [])


@pytest.mark.parametrize(("single", "refits"), [(1.4, 2), (1.6, 1)])
def test_short_steps_are_not_taken_for_terms_that_are_hopeless(single, refits):
    # fails if terms that miss half as much again in long steps, beyond what long steps miss, are fitted in short ones
    start = found(NamedTerms((), ("|v1| v1",), True), 0.8, 5, substeps=4, change=0.2)
    _, tried = simplified(start, {(): single})
    assert tried == [((), 1), ((), None)][:refits]
