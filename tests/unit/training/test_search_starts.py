"""Where a search for terms starts, which of its fits stands in for another, and when its steps are halved again."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.smoothing import local_polynomials
from herglotz.scenes import scene
from herglotz.training import FitConfig, dictionary_search, structure, trajectory_fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.dictionary_search import BETTER, DictionarySearch
from herglotz.training.found_terms import Found
from herglotz.training.linear_start import LinearFit
from herglotz.training.linear_terms import SINGULAR, LinearStart, LinearTerms, starts_of
from herglotz.training.named_terms import DRY, MOVING, NamedTerms, candidates
from herglotz.training.trajectory_fit import TrajectoryFit

CART = ("mass", "mass", "mass", MOVING)  # a cart, a pole, and a mass of both that turns with the pole's angle


@pytest.mark.parametrize(("friction", "dry"), [((-1.0, 0.0), [True, False]), ((-1.0, 0.1), [True])])
def test_a_start_with_friction_that_pushes_is_tried_without_it(friction, dry):
    # fails if a cart with a pole whose smoothed accelerations show such friction is left without a start
    start = LinearStart(NamedTerms(("cos(q2) v1 v2",), (), True), {DRY: friction}, 0.0, 9)
    assert [terms.dry for terms in start.ways] == dry
    assert all(terms.features == start.terms.features for terms in start.ways)


@pytest.mark.parametrize("coupling", [0.5, 0.99, -1.5])
def test_masses_of_a_start_are_regular_at_all_samples(coupling):
    # fails if a pole that smoothing couples to its cart as strongly as to itself stays so: no step is solved there
    cos = torch.cos(torch.linspace(0, 2, 50, dtype=torch.float64))
    M = torch.zeros(50, 2, 2, 4, dtype=torch.float64)
    M[:, 0, 0, 0] = M[:, 1, 1, 2] = 1.0
    M[:, 0, 1, 3] = M[:, 1, 0, 3] = cos
    terms: Any = object.__new__(LinearTerms)
    terms.fit = LinearFit(torch.zeros(50, 2, 4), -M / 0.1, CART)
    x = torch.tensor([1.0, 0.0, 1e-6, coupling * 1e-3], dtype=torch.float64)
    left = terms._regular(x)
    d = torch.tensor([1.0, 1e-3], dtype=torch.float64)
    assert float(torch.linalg.eigvalsh((M @ left) / d[:, None] / d).min()) > SINGULAR
    assert torch.equal(left[:3], x[:3])
    assert torch.equal(left, x) is (coupling == 0.5)


@pytest.mark.parametrize(("errors", "first"), [((1.0, 0.99), 0), ((1.0, 0.5), 1), ((1e-12, 1e-300), 1)])
def test_the_likeliest_family_is_first(errors, first):
    # fails if the least error decides: nine candidates more lower that of noise always. ½ · 9 · log 100 is worth 19 %
    terms: Any = object.__new__(LinearTerms)
    terms.count = 100
    starts = [LinearStart(NamedTerms(), {}, error, size) for error, size in zip(errors, (10, 19), strict=True)]
    assert terms.likeliest(starts) == first
    assert terms.likeliest([]) == 0


@pytest.mark.parametrize(("misses", "hold"), [((0.7, 0.75), "first"), ((0.9, 0.85), ""), ((None, 0.6), "smooth")])
def test_another_hold_has_to_miss_far_less(monkeypatch, misses, hold):
    # fails if any gain is worth another search, or a hold that cannot be followed ends it
    made = dict(zip(("first", "smooth"), misses, strict=True))

    def searching(data, *_args, **_settings):
        miss = made[data.hold]
        return stub(refit=lambda _found, _terms: None if miss is None else stub(rms=miss))

    monkeypatch.setattr(structure, "DictionarySearch", searching)
    t = torch.arange(9.0)
    data = Trajectories.of(t, t[:, None], u=t[:, None])
    found = stub(rms=1.0, terms=None, base=None, config=None)
    assert structure._better_hold(found, data, tuple(made), outliers=False) == hold


def stub(**values) -> Any:
    return SimpleNamespace(**values)


@pytest.mark.parametrize(
    ("coloured", "whole", "good", "likely", "taken"),
    [(True, True, True, False, True), (True, True, False, True, False), (True, False, True, True, False),
     (False, False, False, True, True), (False, True, True, False, False)],
)  # fmt: skip
def test_fewer_terms_stand_in_for_more(coloured, whole, good, likely, taken):
    # fails if 38 terms that leave residuals which are no noise have no rival: likelihoods tell nothing of these, and
    # free runs of three pendulums missed by 32 % of their motion
    less = stub(whole=whole, as_good=lambda *_: good, as_likely=lambda *_: likely)
    assert Found.instead_of(less, stub(coloured=coloured), 0.0) is taken


@pytest.mark.parametrize(
    ("whole", "rms", "bare_whole", "bare_rms", "kept"),
    [(False, 2.6e-5, True, 2.5e-3, "found"), (True, 4e-5, True, 3e-5, "bare"), (False, 4e-5, False, 5e-5, "found"),
     (True, 4e-5, False, 1e-5, "found")],
)  # fmt: skip
def test_a_model_without_terms_has_to_miss_less(monkeypatch, whole, rms, bare_whole, bare_rms, kept):
    # fails if an overdamped model that misses by a quarter of the motion takes the place of one that is lost late
    fits = {"found": stub(whole=whole, rms=rms, coloured=True), "bare": stub(whole=bare_whole, rms=bare_rms)}
    fits["bare"].misses_less = lambda other: Found.misses_less(fits["bare"], other)
    search: Any = object.__new__(DictionarySearch)
    search.coarse, search.precision, search.data, search.base, search.all = False, 1e-6, stub(dof=1), None, None
    search.recorded = None
    search._grown = lambda terms, *_: fits[terms]
    search._bare = lambda _start: fits["bare"]
    search._simpler = search._held = search._finer = lambda found, **_: found
    start = stub(terms="found", values={}, ways=["found"])
    monkeypatch.setattr(dictionary_search, "starts_of", lambda *_: [start])
    assert search._first(None, None)[0] is fits[kept]


def test_masses_that_are_no_cause_of_a_singular_start_stay():
    # fails if masses that turn with angles are taken off where the constant ones are singular
    M = torch.zeros(5, 2, 2, 4, dtype=torch.float64)
    M[:, 0, 0, 0], M[:, 1, 1, 2], M[:, 0, 1, 1], M[:, 1, 0, 1] = 1.0, 1.0, 1.0, 1.0
    terms: Any = object.__new__(LinearTerms)
    terms.fit = LinearFit(torch.zeros(5, 2, 4), -M, CART)
    x = torch.tensor([1.0, 1.0, 1.0, 0.3], dtype=torch.float64)
    assert torch.equal(terms._regular(x), x)


def bare_search(monkeypatch, families) -> Any:
    """A search of two coordinates with these starts."""
    search: Any = object.__new__(DictionarySearch)
    search.coarse, search.precision, search.data, search.base, search.all = False, 1e-6, stub(dof=2), None, None
    search.recorded = None
    search._simpler = search._held = search._finer = lambda found, **_: found
    monkeypatch.setattr(dictionary_search, "starts_of", lambda *_: families)
    return search


def test_the_next_family_follows_one_that_cannot_be_stepped(monkeypatch):
    # fails if a search falls back to a model without terms while other families have a start; or if those that are
    # left to compare with are not the ones behind it
    families = [stub(terms=name, values={}, ways=ways) for name, ways in (("a", "ab"), ("c", "c"), ("d", "d"))]
    found, search = stub(whole=True, rms=1.0, coloured=False), bare_search(monkeypatch, families)
    search._grown = lambda terms, *_: {"c": found, "d": found}.get(terms)
    assert search._first(None, None) == (found, families[2:])


@pytest.mark.parametrize(
    ("rms", "sticking", "again"), [(0.9, False, False), (0.7, False, True), (0.9, True, True), (BETTER, False, True)]
)
def test_other_terms_ask_for_shorter_steps_again(rms, sticking, again):
    # fails if steps that were halved in vain with some terms are never halved with others: 8 samples a period left
    # x³ and x⁵ to make up for them; or if what was in vain with one kind of dry friction is so with the other
    search: Any = object.__new__(DictionarySearch)
    search.in_vain, search.finest, search.floor = ((1, False), 1.0), 16, 0.0
    search._problem = lambda *_: (None, None)
    found = stub(config=stub(substeps=1, sticking=sticking), rms=rms, terms=None, changed_by=lambda _: 1.0)
    assert search._too_long(found) is again


def test_friction_that_holds_is_judged_in_steps_that_are_short_enough():
    # fails if it is turned away for its own step's length, of which its error at a turn is of order 1: an axis at 100
    # samples a period missed by 11 times the noise beyond its recording
    search: Any = object.__new__(DictionarySearch)
    search.data, search.floor, search.noise = stub(q=torch.zeros(100, 1), dof=1), 0.0, 0.0
    search.config, search._longer = stub(sticking=None), lambda found: found

    def make(rms, substeps, at=None):
        config = stub(sticking=False, substeps=substeps)
        values = {"friction.coulomb": (1.0,), "at": at}
        return stub(rms=rms, values=values, terms=stub(dry=True), pushes=False, config=config)

    search._sticking = lambda found, start: make(1.5 if found.config.substeps == 1 else 1.0, 1, start)
    said = {}

    def finer(found, **how):
        said.update(how)
        return make(1.0, 8, found.values["at"])

    search._finer = finer
    held = search._held(make(1.0, 1))
    assert said == {"longer": False}  # misfits of longer segments are larger, and cannot be compared
    assert (held.values["at"], held.config.substeps) == (0.0, 8)


@pytest.mark.parametrize("network", [None, "network"])
@pytest.mark.parametrize(("robust", "kept"), [(1.4, "robust"), (1.6, "plain")])
def test_student_loses_no_data_that_least_squares_follow(monkeypatch, robust, kept, network):
    # fails if a recording of exact data that a heavy-tailed loss has let go of is left to it: its free run missed by
    # 3 % of the motion, and least squares met it to rounding; networks let windows of two joints go (0.019 for 0.002)
    def made(rms):
        found: Any = object.__new__(TrajectoryFit)
        monkeypatch.setattr(TrajectoryFit, "misfit", property(lambda self: torch.full((4, 1), self.rms)), raising=False)
        object.__setattr__(found, "rms", rms)
        object.__setattr__(found, "problem", stub(freedom=None))
        return found

    plain, last = made(1.0), made(robust)
    stages = stub(
        at_once=lambda _: plain, robust_or_not=lambda first, **_: first, whole=lambda *_: last, grow=lambda *_: last
    )
    monkeypatch.setattr(trajectory_fit, "SegmentStages", lambda *_: stages)
    monkeypatch.setattr(trajectory_fit, "_wide_enough", lambda *_: (stages, last))
    monkeypatch.setattr(trajectory_fit, "heavy_tailed", lambda _: True)
    task: Any = trajectory_fit.Task(stub(), stub(), FitConfig(), stub())
    monkeypatch.setattr(trajectory_fit.Task, "size", 1.0, raising=False)
    found = trajectory_fit._longest(task, stub(potential=stub(network=network)), 1.0, known=True)
    assert found[1] is {"plain": plain, "robust": last}[kept]


@pytest.mark.parametrize(("noise", "kept"), [(0.9, True), (1073.0, False), (math.nan, False)])
def test_a_start_that_follows_nothing_is_none(noise, kept):
    # fails if terms whose shortest segments miss by a thousand times the motion are grown, in place of another start
    search: Any = object.__new__(DictionarySearch)
    first = stub(noise=noise)
    stages = stub(lengths=[20], fit=lambda *_, **__: first, grow=lambda fit, _: fit)
    search.config, search.precision, search.spread, search.floor, search.freedom = FitConfig(), 0.1, 1.0, 0.0, None
    search._stages = lambda *_: stages
    search._found = lambda terms, stages, fit: fit  # noqa: ARG005
    assert search._grown(NamedTerms(()), {}, None) is (first if kept else None)


def test_a_start_is_stepped_in_each_of_its_ways(monkeypatch):
    # fails if friction that pushes, where no step is solved with it, costs the family: the next one takes its place
    families = [stub(terms="a", values={}, ways=["a", "b"]), stub(terms="c", values={}, ways=["c"])]
    found, search = stub(whole=True, rms=1.0, coloured=False), bare_search(monkeypatch, families)
    search._grown = lambda terms, *_: {"b": found, "c": stub()}.get(terms)
    assert search._first(None, None) == (found, families[1:])


def test_a_simpler_family_stands_in_where_residuals_are_no_noise():
    # fails if likelihoods decide there, or the first family has no rival
    search: Any = object.__new__(DictionarySearch)
    t = torch.arange(30.0, dtype=torch.float64)
    search.data, search.floor, search.every = Trajectories.of(t, t[:, None].sin()), 0.0, 1
    search.recorded = search.data
    other = stub(instead_of=lambda *_: True, as_likely=lambda *_: False)
    search._first = lambda *_: (stub(coloured=True), [stub(terms="simple", values={})])
    search._grown = lambda *_: other
    search._held = search._finer = lambda found, **_: found
    assert search._begun() is other


@pytest.mark.parametrize("lacking", [3, 9, 40])
def test_terms_join_one_by_one(monkeypatch, lacking):
    # fails if a search stops while its terms are still wanted: six joined for three pendulums, in seven rounds, for one
    # went to friction that pushed
    def made(count):
        terms = stub(names=tuple(map(str, range(count))), dry=False, apart=False, features=())
        return stub(terms=terms, pushes=False, coloured=False, rms=1.0, joined_by=lambda *_: True)

    search: Any = object.__new__(DictionarySearch)
    search.data, search.floor, search.order = stub(samples=10, liveliest=lambda _: stub(samples=10)), 0.0, 2
    search.all = NamedTerms(tuple(map(str, range(50))))
    search._begun = lambda: made(0)
    search._missing = lambda found: str(len(found.terms.names)) if len(found.terms.names) < lacking else None
    search.refit = lambda found, terms: made(len(found.terms.names) + 1)  # noqa: ARG005
    search._held = search._finer = search._longer = search._pruned = lambda found, **_: found
    search._likeliest = search._last_terms = lambda found: found
    search._problem = None
    monkeypatch.setattr(dictionary_search, "sparsest", lambda _: 1)
    monkeypatch.setattr(dictionary_search, "offered", lambda data, every, *_, **__: every)  # noqa: ARG005
    monkeypatch.setattr(dictionary_search, "FewerNumbers", lambda *_: stub(of=lambda found: found))
    exchanges = []
    monkeypatch.setattr(dictionary_search, "exchanged", lambda found, *_: exchanges.append(found) or found)
    assert len(search.run().terms.names) == min(lacking, dictionary_search.ADDED)
    assert dictionary_search.ADDED >= 10
    assert len(exchanges) == 1


def test_every_start_is_made_regular(monkeypatch):
    # fails if masses that are nearly singular go into a fit
    data = simulate(scene("cart_pole"), trajectories=2, steps=60, h=0.05, seed=0).unwrapped()
    seen = []
    monkeypatch.setattr(LinearTerms, "_regular", lambda self, x: (seen.append(x), x)[1])  # noqa: ARG005
    local = local_polynomials(data)
    assert local is not None
    starts = starts_of(data, estimate_baseline(data), candidates(data), local)
    assert len(seen) >= len(starts) > 0


def test_least_squares_stay_where_no_robust_fit_is_found(monkeypatch):
    # fails if a fit that follows the data is dropped because its shortest segments cannot be fitted again
    plain: Any = stub(misfit=torch.ones(4, 1), follows=lambda _: True)
    monkeypatch.setattr(trajectory_fit, "SegmentStages", lambda *_: stub(at_once=lambda _: plain))
    monkeypatch.setattr(trajectory_fit, "_wide_enough", lambda *_: (None, None))
    monkeypatch.setattr(trajectory_fit, "heavy_tailed", lambda _: True)
    monkeypatch.setattr(trajectory_fit.Task, "size", 1.0, raising=False)
    task: Any = trajectory_fit.Task(stub(), stub(), FitConfig(), stub())
    found = trajectory_fit._longest(task, stub(potential=stub(network=None)), 1.0, known=True)
    assert found[1] is plain


@pytest.mark.parametrize(("dof", "coloured", "left"), [(1, False, 2), (2, False, 5), (2, True, 0)])
def test_terms_that_held_out_blocks_do_not_ask_for_leave(dof, coloured, left):
    # fails if white residuals keep the powers of one coordinate that its free run pays for, if there each loss is
    # weighed against the one before and not against all, or if several coordinates lose theirs to noise
    def made(count):
        good = lambda other, _floor: len(other.terms.names) - count <= 3  # noqa: E731  each one alone is
        terms = lambda *_, **__: stub(names="x" * (count - 1))  # noqa: E731
        return stub(terms=stub(names="x" * count), coloured=coloured, rms=1.0, needed=terms, as_good=good)

    search: Any = object.__new__(DictionarySearch)
    search.data, search.floor, search.order, search.own = stub(dof=dof, q=torch.zeros(9, dof)), 0.0, 2, ()
    search.refit = lambda _found, terms: made(len(terms.names))
    search._finer = lambda found: found
    assert len(search._last_terms(made(5)).terms.names) == left
