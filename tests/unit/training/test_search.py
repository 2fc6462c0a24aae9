"""The search over offers: what it takes, what it leaves, and what its score says."""

import math
import os
import sys
from copy import copy
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.sensors import measured
from herglotz.scenes import scene
from herglotz.training import FitConfig, Plan, fit, flow, search as search_module, structure
from herglotz.training.baseline import estimate_baseline
from herglotz.training.errors_of_runs import EXACT_ENOUGH
from herglotz.training.found_model import settings
from herglotz.training.friction_search import with_sticking, without_injecting_friction
from herglotz.training.held_out import HeldOut, blocks
from herglotz.training.look import look
from herglotz.training.moves import BLOCKS, MAX_VALUES_AT_ONCE, Moves
from herglotz.training.offers import Offer
from herglotz.training.score import Score, correlation_time, fitted_score
from herglotz.training.search import Search
from herglotz.training.stages import Stages
from herglotz.training.task import build_model
from herglotz.training.trials import Variant, masses, scores_of
from tests import runge_kutta
from tests.compared import dense

NOISE = 0.003
T = TypeVar("T")

FEW = SimpleNamespace(q=torch.zeros(9, 1))  # data of a search that a test stands in for


def there(found: T | None) -> T:
    assert found is not None
    return found


def searched(data, **changes):
    config = FitConfig(**changes).resolved(data)
    return Search(data, estimate_baseline(data), config)


@cache
def oscillator(count=1):
    return simulate(scene("damped_oscillator"), trajectories=count, steps=80, h=0.15, noise=0.01, seed=1)


@cache
def pendulum(count=1):
    data = simulate(scene("damped_pendulum"), trajectories=count, steps=60, h=0.2, noise=0.01, seed=3)
    return replace(data, p=None, s=None)


def grown(search):
    """The pendulum's law, fitted to whole trajectories."""
    fitter = search.fitter(Variant(2))
    return there(fitter.grow(there(fitter.fit({"cos(q1)"}, {}, 20, None, 60))))


@pytest.fixture(scope="module")
def duffing():
    """A search over 201 samples with noise, and the model that it ends in."""
    search = searched(simulate(scene("duffing"), trajectories=1, steps=200, h=0.1, noise=NOISE, seed=0))
    return search, there(search.run())


def test_a_term_without_a_rule_of_order_4_keeps_order_2():
    # fails if a fit of exact data of several coordinates ends in an error about an order that nobody asked for
    search = searched(simulate(scene("cart_pole"), trajectories=1, steps=60, h=0.1, seed=0))
    fitter = search.fitter(Variant(2, substeps=2))
    trial = there(fitter.fit({"q1 sin(q2)"}, {}, fitter.lengths[0], None))
    assert "q1 sin(q2)" in trial.names
    assert settings(trial, search.config)[0].order == 2


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_segments_of_exact_data_are_missed_by_the_rule_alone(noise):
    # fails if the search of exact data is given up over segments, where the rule of order 2 is all that is missed
    search = searched(simulate(scene("cart_pole"), trajectories=1, steps=100, h=0.02, noise=noise, seed=0))
    missing = SimpleNamespace(fitter=search.fitter(Variant(search.order)), segments_at_the_noise=False)
    search.begun = cast(Any, missing)
    assert search.misses_segments == bool(noise)


def test_a_cart_and_its_pole_are_found_in_noise():
    # fails if the search ends in masses that turn with their own angle, or keeps a mass or a spring that cart and pole
    # lack. The mass between them is 0.15/1.3 of both; the cart's unit is 500 times the pole's
    data = simulate(scene("cart_pole"), trajectories=3, steps=80, h=0.12, noise=NOISE, seed=0)
    data = replace(data, q=data.q * torch.tensor([0.002, 1.0], dtype=data.q.dtype), p=None, s=None)
    found = there(searched(data).run())
    assert [name for name in found.taken if "v" in name and "viscous" not in name] == ["cos(q2) v1 v2"]
    assert not {"potential.stiffness[0]", "potential.tilt[0]", "kinetic.off_diagonal"} & found.taken
    (number,) = [name for name, key in found.fitter.keys.items() if key == "cos(q2) v1 v2"]
    assert found.values[number] / 0.002 == pytest.approx(0.15 / 1.3, rel=0.02)


def test_six_exact_samples_a_period_give_the_equation():
    # fails if the search starts from accelerations over 1 s alone, or with a rule of order 2 in long steps
    data, _ = simulate(scene("damped_pendulum"), trajectories=5, steps=40, h=1.0, seed=1).unwrapped().split_time(0.67)
    found = there(searched(data).run())
    assert found.taken == {"cos(q1)"}
    assert found.rms < 1e-7


def test_longer_steps_do_not_hide_in_the_parameters():
    # fails if steps are halved only where that lowers the misfit: small motions fit as well at one step a sample, with
    # a coefficient that is 1 % off and wrong for large motions
    data = simulate(
        scene("damped_pendulum"), trajectories=2, steps=140, h=0.39, noise=0.004, seed=0, q_range=(-0.6, 0.6),
        v_range=(-0.3, 0.3),
    )  # fmt: skip
    found = there(searched(data).run())
    assert found.taken == {"cos(q1)"}
    (number,) = [name for name, key in found.fitter.keys.items() if key == "cos(q1)"]
    assert found.values[number] == pytest.approx(-1.0, abs=0.008)


def test_friction_that_holds_is_fitted_as_such():
    # fails if the variant with set-valued friction is the smooth model under another name: an axis that stands still at
    # times, in a noise of 1e-4 of its motion, is missed twice as far by smooth friction with the same offers
    search = searched(simulate(scene("servo_axis"), trajectories=2, steps=100, h=0.02, noise=3e-6, seed=0))
    found = there(search.run())
    assert found.fitter.model.capabilities.sticking
    assert "friction.log_smooth" not in found.values
    assert "friction.coulomb" in found.taken
    assert found.problem.P == 4
    smooth = search.fitter(replace(found.fitter.variant, sticking=False))
    assert 2 * found.rms < there(smooth.fit(found.taken, found.values, found.length, found, 60)).rms
    of, base = settings(found, FitConfig())
    assert of.sticking
    assert base.start["friction.coulomb"] == (pytest.approx(found.values["friction.coulomb"]),)


def rolled(acceleration, starts, steps, h, noise, angles=(False, True)):
    """Motion of two coordinates by Runge and Kutta: q″ = acceleration(q, q′)."""

    def rate(x):
        return torch.cat([x[:, 2:], torch.stack(acceleration(*x.T), -1)], -1)

    state, samples = starts, []  # (B, 4)
    for _ in range(steps + 1):
        samples.append(state[:, :2])
        for _ in range(4):
            state = runge_kutta.step(rate, state, h / 4)
    q = torch.stack(samples, 1).flatten(0, 1)
    q = q + noise * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    t = (h * torch.arange(steps + 1, dtype=q.dtype)).repeat(len(starts))
    return Trajectories.of(t, q, (steps + 1,) * len(starts), angles=angles)


def test_a_spherical_pendulum_is_found_in_noise():
    # fails if no named mass has cos 2q: functions had to say it, in the place of one term
    def acceleration(_, b, v, w):
        return -2 * b.cos() / b.sin() * v * w - 0.05 * v, b.sin() * b.cos() * v**2 - 9.81 * b.sin() - 0.05 * w

    starts = torch.tensor([[0.0, 0.9, 2.5, 0.0], [1.0, 0.6, 4.5, -1.0]], dtype=torch.float64)
    found = there(searched(rolled(acceleration, starts, 120, 0.02, 1e-3, (True, True))).run())
    assert {name for name in found.taken if " v" in name} == {"cos(2q2) v1 v1"}
    assert found.at_the_noise


def test_a_pendulum_on_a_spring_is_found_in_noise():
    # fails if no term is a power beside a wave, or if no mass grows with the square of a length
    def acceleration(r, a, v, w):
        return r * w**2 + 9.81 * a.cos() - 80.0 * (r - 0.4) - 0.1 * v, (-9.81 * a.sin() - 2 * v * w) / r

    starts = torch.tensor([[0.45, 0.9, 0.0, 0.0], [0.6, 0.5, 0.0, 0.0]], dtype=torch.float64)
    found = there(searched(rolled(acceleration, starts, 150, 0.02, 5e-4)).run())
    assert {"q1 cos(q2)", "q1^2 v2^2"} <= found.taken
    assert not any(" v" in name for name in found.taken - {"q1^2 v2^2"})
    assert found.at_the_noise


def test_a_fit_is_told_how_long_segments_the_search_followed(duffing, monkeypatch):
    # fails if the final fit of a motion that no model follows for long tries whole trajectories
    search, _ = duffing
    fitter = search.fitter(Variant(4))
    found = there(fitter.fit(fitter.simple, {}, fitter.lengths[0], None))
    asked = SimpleNamespace(best=found, differ=None, hold="", input_terms=(), wanted=SimpleNamespace())
    asked.read, asked.better_on_a_line = SimpleNamespace(fitters={}), lambda: False
    asked.wanted.config = asked.wanted.part = search.config
    asked.how_inputs_act = asked.functions = asked.all_data = lambda: None
    monkeypatch.setattr(structure, "Questions", lambda *_: asked)
    monkeypatch.setattr(structure, "drifts", lambda *_, **__: None)
    said = structure.search(search.data, search.base, search.config, outliers=False)
    assert said.length == found.length == fitter.lengths[0]


def closed_loop(steps, noise=5e-4):
    """θ″ = −18 sin θ − 0.9 θ′ + 5 τ under a controller that holds it at slowly moving angles, τ held over each step."""
    make, h, parts = torch.Generator().manual_seed(3), 0.01, 10
    x = v = 0.0
    torques, angles = [], []
    for k in range(steps):
        goal = 0.3 + 0.1 * torch.sin(torch.tensor(0.01 * k)).item()
        angles.append(x)
        tau = 18 / 5 * goal + 8 * (goal - x) - 1.2 * v
        torques.append(tau)
        for _ in range(parts):
            v += h / parts * (-18 * torch.sin(torch.tensor(x)).item() - 0.9 * v + 5 * tau)
            x += h / parts * v
    q = torch.tensor(angles, dtype=torch.float64)
    q = q + noise * torch.randn(steps, generator=make, dtype=torch.float64)
    u = torch.tensor(torques, dtype=torch.float64)
    t = h * torch.arange(steps, dtype=torch.float64)
    return Trajectories.of(t, q, u=u, angles=(True,), hold="zero")


def test_inputs_that_follow_from_the_state_do_not_mislead():
    # fails if coefficients that cancel take the place of the law: torque with the wrong sign, numbers of 1e5
    found = there(searched(closed_loop(400)).run())
    value = {found.fitter.keys[name]: x for name, x in found.values.items()}
    assert value["friction.input_map"] == pytest.approx(5.0, rel=0.05)
    assert value["cos(q1)"] == pytest.approx(-18.0, rel=0.05)
    assert value["damping.rate"] == pytest.approx(0.9, rel=0.2)


@pytest.mark.parametrize(
    ("whole", "at_the_noise", "joined"), [(False, False, True), (False, True, False), (True, False, False)]
)
def test_offers_join_segments_that_are_missed(whole, at_the_noise, joined):
    # fails if offers join that segments at the noise need no more: under a controller they made up for one another, and
    # no change of a single offer led back to the law of the machine
    trial: Any = SimpleNamespace(whole=whole, segments_at_the_noise=at_the_noise)
    met: Any = SimpleNamespace(whole=whole, segments_at_the_noise=True)
    more = iter([met])
    search: Any = SimpleNamespace(finer=lambda trial: trial, moved=lambda _: next(more, None))
    assert (Search.joined(search, trial) is met) is joined


def test_friction_of_one_direction_is_found():
    # z″ = −40 z − 1.5 z′ + |z′|: fails if no offer is even in the speed
    x, v, path = 0.1, 0.0, []
    for _ in range(200):
        path.append(x)
        for _ in range(20):
            v += 0.001 * (-40 * x - 1.5 * v + abs(v))
            x += 0.001 * v
    q = torch.tensor(path, dtype=torch.float64)
    q = q + 2e-4 * torch.randn(200, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = there(searched(Trajectories.of(0.02 * torch.arange(200, dtype=torch.float64), q)).run())
    assert found.taken == {"q1^2", "|v1|"}


@pytest.mark.parametrize(("rate", "word"), [(0.3, "friction.coulomb"), (-0.3, "load 1")])
def test_what_pushes_on_a_joint_that_turns_one_way_is_a_load(rate, word):
    # fails if friction drives a joint, which creates energy: where a joint never turns back a load is the same force
    t = 0.05 * torch.arange(200, dtype=torch.float64)
    speed = 12 if rate > 0 else 2
    phi = speed * (1 - torch.exp(-0.2 * t)) / 0.2 - rate / 0.2 * (t - (1 - torch.exp(-0.2 * t)) / 0.2)
    phi = phi + 1e-3 * torch.randn(200, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = Trajectories.of(t, phi, angles=(True,)).unwrapped()
    found = there(searched(data, sticking=False).run())
    of_friction = {name for name in found.taken if name in ("friction.coulomb", "load 1")}
    assert of_friction == {word}


def test_the_settings_of_a_model_have_what_it_has_taken(duffing):
    search, found = duffing
    of, base = settings(found, search.config)
    assert set(of.features) == found.taken == {"q1^2", "q1^4"}
    assert (of.drag, of.coulomb, of.level) == ((), False, "linear")
    assert base.rate == pytest.approx(found.values["damping.rate"])
    assert set(base.start) == {"potential.features.sum.coefficient"}


def test_an_offer_that_says_nothing_is_not_taken(duffing):
    # fails if the price of a number is not paid, or the law goes for a worse one
    search, found = duffing
    more = there(found.fitter.fit(found.taken | {"q1^6"}, found.values, found.length, found))
    less = there(found.fitter.fit(found.taken - {"q1^4"}, found.values, found.length, found))
    assert not more.replaces(found)
    assert found.replaces(less)
    assert search.moved(found, whole=True) is None


def test_a_start_without_a_path_is_none():
    search = searched(simulate(scene("duffing"), trajectories=1, steps=60, h=0.1, noise=NOISE, seed=0))
    fitter = search.fitter(Variant(2))
    assert fitter.fit(fitter.simple, {"potential.features.sum.coefficient[0]": 1e300}, 5, None) is None


@pytest.mark.parametrize(("gains", "more", "time", "replaces"), [
    ((20.0,) * 10, 1, 1.0, True), ((20.0,) * 10, 60, 1.0, False), ((20.0,) * 10, 1, 80.0, False),
    ((200.0, *[0.0] * 9), 1, 1.0, False), ((3.1, -1.1) * 5, 1, 1.0, False), ((0.3,) * 10, 1, 1.0, False),
])  # fmt: skip
def test_a_richer_model_pays_for_its_numbers_and_their_chance(gains, more, time, replaces):
    # fails if a price is left out, if one block alone decides, if samples that repeat one another count as so many, or
    # if what blocks differ by is not added to the price
    simple = Score(torch.tensor(gains), 400, 3.0, 3, 1.0)
    rich = Score(torch.zeros(10), 400, 3.0 + more, 3 + more, 1.0, time)
    assert rich.replaces(simple, 80) is replaces


@pytest.mark.parametrize(
    ("held_out", "fitted", "replaces"), [(20.0, 20.0, True), (20.0, 0.3, False), (0.3, 20.0, False)]
)
def test_a_richer_model_meets_all_samples_better_and_foretells_blocks_better(held_out, fitted, replaces):
    # fails if one of both is enough: a simple model that is ill-determined without a block misses the block, whatever
    # the further number of a rich model is
    simple = Score(torch.full((10,), float(held_out)), 400, 3.0, 3, 1.0, fitted=torch.full((10,), float(fitted)))
    rich = Score(torch.zeros(10), 400, 4.0, 4, 1.0, fitted=torch.zeros(10))
    assert rich.replaces(simple, 80) is replaces


def test_samples_that_repeat_one_another_tell_as_much_as_one():
    # fails if τ is not that of an autoregressive process, (1 + φ)/(1 − φ), or a residual that is no number makes it one
    torch.manual_seed(0)
    noise = torch.randn(3, 20_000, 2, dtype=torch.float64)
    for k in range(1, noise.shape[1]):
        noise[1, k] += 0.9 * noise[1, k - 1]
    noise[2, 7] = torch.nan
    white, repeated, broken = correlation_time(noise).tolist()
    assert white == pytest.approx(1, abs=0.1)
    assert broken == pytest.approx(1, abs=0.1)
    assert repeated == pytest.approx(19, rel=0.2)


@pytest.mark.parametrize(("time", "wins"), [(1.0, True), (20.0, False)])
def test_a_free_run_of_few_independent_samples_decides_less(time, wins):
    # fails if what a free run misses early, and later too, counts anew with every sample
    def end(name, loss, numbers) -> Any:
        score = Score(torch.full((10,), loss), 400, numbers, 1, 1.0, time)
        fitter = SimpleNamespace(offered=8, simple={"a"}, free_run_score=lambda _: score, variant=Variant(2))
        return SimpleNamespace(
            fitter=fitter, taken=frozenset(name), whole=True, length=9, at_the_noise=False, values={}
        )  # fmt: skip

    simple, rich = end("a", 5.0, 2.0), end("b", 0.0, 4.0)
    rich.fitter.fit = lambda *_: simple
    assert (Search.finalist(cast(Any, None), rich, (rich,)) is rich) is wins


def test_misfits_below_the_floor_are_alike(duffing):
    # fails if residuals of rounding size, of steps or of sums, make one of two exact models better
    search, found = duffing
    problem, path = found.problem, found.path
    assert fitted_score(problem, path, 10.0).losses.tolist() == pytest.approx(
        fitted_score(problem, replace(path, x=path.x + 0.5), 10.0).losses.tolist(), rel=1e-12
    )
    assert there(search.fitter(Variant(2)).free_run_score(found)).choices == 0  # a free run has paid for these before


def test_numbers_that_come_together_are_one_choice():
    # fails if a function of many waves is as unlikely a choice as so many terms, or its numbers are free
    one, band = Score(torch.zeros(10), 400, 4.0, 4, 1.0), Score(torch.zeros(10), 400, 11.0, 4, 1.0)
    assert one.price(band, 53) - one.price(one, 53) == pytest.approx(3.5 * math.log(400))


def test_zeros_are_numbers_that_come_together():
    # fails if many recordings have more zeros than there are offers, or zeros are free
    plain = Score(torch.zeros(10), 400, 9.0, 9, 1.0)
    assert plain.price(replace(plain, zeros=100), 53) - plain.price(plain, 53) == pytest.approx(50 * math.log(400))


def test_held_out_residuals_are_those_of_fits_without_the_blocks():
    # fails if a step of parameters or starts has the wrong sign or size. A linear system: to first order is exact
    data = oscillator(2)
    search = searched(data)
    fitter = search.fitter(Variant(2))
    whole = fitter.grow(there(fitter.fit({"q1^2"}, {}, 5, None, 60)))
    whole = there(fitter.fit({"q1^2"}, whole.values, whole.length, whole, 60))
    block, model = blocks(data), HeldOut(whole.problem, whole.path, whole.theta)
    (found,) = model.residuals([range(whole.problem.P)])
    for k in (0, 4, 9):
        out = block == k
        names = whole.problem.parameters.numbers
        problem = whole.problem.of(names, whole.problem.sigma, fitter.prior(names))
        problem.used = ~out
        problem._weigh()
        x = problem.unknowns(whole.theta, whole.path)
        for _ in range(6):
            _, A, b = problem.normal_equations(x)
            x = x - torch.linalg.solve(dense(A), b)
        missed = problem.misfit(there(problem.solve(x)))[out]
        torch.testing.assert_close(found[out], missed, rtol=0.05, atol=2e-4)


def test_residuals_of_a_smaller_set_are_those_of_its_fit():
    # fails if numbers that leave do not go, or those that stay and the starts do not follow. To first order is exact
    data = oscillator(2)
    data = replace(data, q=data.q + 0.01)
    fitter = searched(data).fitter(Variant(2))
    assert "q1" in {offer.name for offer in fitter.offers}
    whole = fitter.grow(there(fitter.fit({"q1^2", "q1"}, {}, 5, None, 60)))
    more = there(fitter.fit({"q1^2", "q1"}, whole.values, whole.length, whole, 60))
    less = there(fitter.fit({"q1^2"}, more.values, more.length, more, 60))
    fewer, every = Moves(more).scores([frozenset({"q1^2"}), more.taken])
    assert there(fewer.fitted).tolist() == pytest.approx(there(less.score.fitted).tolist(), abs=0.1)
    assert there(every.fitted).tolist() == pytest.approx(there(more.score.fitted).tolist(), abs=0.1)
    assert float((there(fewer.fitted) - there(every.fitted)).abs().max()) > 1
    # The correlation time is that of the fit to all samples.
    seen = [correlation_time(x.problem.misfit(x.path)[None] / x.rms) for x in (less, more)]
    assert [fewer.correlation_time, every.correlation_time] == pytest.approx([float(x) for x in seen], rel=0.1)
    assert fewer.correlation_time > 1.5 * every.correlation_time


def test_sets_that_lack_few_numbers_are_solved_as_each_alone():
    # fails if a number that leaves stays, leaves from the wrong value or by the wrong multiplier, or if one that has no
    # solution takes the sets without it with it
    data = simulate(scene("chain", masses=3), trajectories=4, steps=30, h=0.1, noise=0.003, seed=0)
    fitter = searched(data).fitter(Variant(2))
    every = [offer.name for offer in fitter.offers]
    model, _ = Moves(there(fitter.fit(every, {}, fitter.lengths[0], None, 10)))._linear
    P = model.rows.shape[-1] - 1
    sets = [[x for x in range(3, P) if x not in out] for out in [(), *((k, k + 7 * (k % 2)) for k in range(4, P))]]
    assert P > 40
    assert float(model.leaving.abs().max()) > 0
    found = model.residuals(sets), model.fitted_residuals(sets)
    alone = [torch.cat([of([own]) for own in sets]) for of in (model.residuals, model.fitted_residuals)]
    # The two ways differ by 4e-5 σ, and both from 60 digits by 1e-3 σ: curvatures have a condition of 2e11.
    for x, own in zip(found, alone, strict=True):
        assert float((x - own).abs().max()) < 1e-3 * model.sigma
    # fails if sets that lack nothing have no solution
    assert torch.equal(model.residuals(4 * sets[:1]).isnan(), found[0][:1].isnan().expand(4, -1, -1))
    model.equations[:, 5, 5] = -1.0
    missed = model.residuals(sets).isnan().any(-1).any(-1)
    assert missed.tolist() == [5 in own for own in sets]


def test_fits_start_where_the_linear_motion_sees_their_numbers(duffing):
    # fails if a model that has lost terms starts with their work undone: many steps then, or none that follows
    _, found = duffing
    names = {offer.name for offer in found.fitter.offers}
    every = there(found.fitter.fit(names, found.values, found.length, found, 60))
    values, states = Moves(every).start(found.taken)
    started = there(found.fitter.fit(found.taken, values, found.length, every, 0, states))
    undone = there(found.fitter.fit(found.taken, every.values, found.length, every, 0))
    assert started.rms < 1.1 * found.rms < 0.2 * undone.rms
    assert all(values[name] == 0 for offer in found.fitter.offers for name in offer.amplitudes
               if offer.name not in found.taken)  # fmt: skip


def test_a_kernel_has_the_slopes_of_torch():
    # fails if noise of the start is carried along by other derivatives where a kernel makes them
    fitter = searched(oscillator(2)).fitter(Variant(2))
    fit = there(fitter.fit({"q1^2"}, {}, 5, None, 60))
    eager = copy(fit.problem)
    eager.compiled = None
    path = there(eager.solve(eager.unknowns(fit.theta, fit.path)))
    samples, ends = fit.problem.slopes_by_start(fit.theta, fit.path)
    torch.testing.assert_close((samples, ends), eager.slopes_by_start(fit.theta, path), rtol=1e-10, atol=1e-12)
    assert torch.equal(samples, fit.problem.slopes_at_samples(fit.theta, fit.path)[..., fit.problem.P :])


def test_a_segment_that_is_left_out_whole_is_told_by_its_own_samples():
    # fails if its start stays where all samples put it, if it still has a say of the numbers, or if numbers of a fit
    # with joints stay where these hold them: against least squares in all starts and numbers at once
    data = oscillator(2)
    fitter = searched(data).fitter(Variant(2))
    fit = there(fitter.fit({"q1^2"}, {}, 5, None, 60))
    problem, P, d = fit.problem, fit.problem.P, fit.problem.d
    assert problem.jointed
    (found,) = HeldOut(problem, fit.path, fit.theta).residuals([range(P)])
    slopes = problem.slopes_at_samples(fit.theta, fit.path)[:, 0] / problem.deviations
    segment, block = problem.grid.node // (problem.grid.h.shape[1] + 1), blocks(data)
    J = slopes.new_zeros(len(slopes), P + problem.grid.segments * d)
    J[:, :P] = slopes[:, :P]
    for i in range(d):
        J[torch.arange(len(J)), P + segment * d + i] = slopes[:, P + i]
    r = problem.misfit(fit.path)[:, 0] / problem.sigma
    _, A, b = problem.prior_equations(fit.theta)
    known = A.diagonal() > 0
    of_prior, at = torch.zeros(P, J.shape[1], dtype=J.dtype)[known], known.nonzero()[:, 0]
    of_prior[torch.arange(len(at)), at] = A.diagonal()[at].sqrt()
    for k in (1, 4, 9):
        out = block == k
        gone = torch.isin(segment, segment[~out], invert=True)
        assert bool(gone.any())
        right = torch.cat([r[~out], b[at] / A.diagonal()[at].sqrt()])[:, None]
        x = -torch.linalg.lstsq(torch.cat([J[~out], of_prior]), right, driver="gelsd")[0]
        x[P:] = torch.where(torch.isin(torch.arange(len(x) - P) // d, segment[gone])[:, None], 0.0, x[P:])
        rest = r[gone] + (J[gone] @ x)[:, 0]
        own = torch.linalg.lstsq(J[gone][:, P:], -rest[:, None], driver="gelsd")[0]
        moved = r + (J @ x)[:, 0] + (J[:, P:] @ own)[:, 0] * gone
        left = torch.bincount(segment[~out], minlength=problem.grid.segments)[segment]
        sure = out & ((left == 0) | (left >= d))  # one sample does not tell a start
        torch.testing.assert_close(found[sure, 0] / problem.sigma, moved[sure], rtol=1e-5, atol=1e-6)


def test_the_linear_motion_foretells_the_scores_of_fits(duffing):
    # fails if numbers that leave do not move to 0, if those that join are not followed by the others, or if sets of
    # different sizes are mixed up
    _, found = duffing
    more = there(found.fitter.fit(found.taken | {"q1^6", "|v1| v1"}, found.values, found.length, found, 60))
    offered = found.fitter.offered
    for trial, sets in (
        (found, [found.taken | {"q1^6"}, more.taken, found.taken | {"q1 v1"}]),
        (more, [found.taken, found.taken | {"q1^6"}]),
    ):
        own, *others = Moves(trial).scores([trial.taken, *sets])
        assert own.losses == pytest.approx(trial.score.losses, abs=1e-6)
        for taken, foretold in zip(sets, others, strict=True):
            fit = there(found.fitter.fit(taken, trial.values, trial.length, trial, 60))
            assert foretold.gain(own, offered) == pytest.approx(fit.gain(trial), rel=0.1, abs=0.2)
            assert foretold.numbers == fit.problem.P
    own, without = Moves(found).scores([found.taken, found.taken - {"q1^4"}])
    assert own.gain(without, offered) > 100


def test_moves_are_the_offers_that_are_better(duffing):
    # fails if a search has to fit every single offer on its way, or if what nothing asks for stays
    _, found = duffing
    names = {offer.name for offer in found.fitter.offers}
    every = there(found.fitter.fit(names, found.values, found.length, found, 60))
    ways = Moves(every).leaving(every.taken)
    assert ways[0] == found.taken
    assert all(fewer < more for fewer, more in pairwise(ways))
    poor = there(found.fitter.fit({"q1^2"}, found.values, 20, None, 60))
    assert Moves(poor).joining(poor.taken)[0] == poor.taken | {"q1^4"}


def test_of_many_offers_some_leave_at_once_but_not_those_that_stand_for_one_another():
    # fails if offers that may leave alone leave together. Of sixteen pairs one is enough; without both 20 are lost
    names, asked = [f"{x}{i}" for i in range(16) for x in "ab"], []

    class Pairs(Moves):
        def computed(self, sets, *, rough=False):  # noqa: ARG002
            asked.extend(sets)
            lost = [sum(not {f"a{i}", f"b{i}"} & own for i in range(16)) for own in sets]
            every = zip(sets, lost, strict=True)
            return [Score(torch.full((10,), 2.0 * none), 400, len(own), len(own), 1.0) for own, none in every]

    fitter = SimpleNamespace(offered=32, offers=[Offer(name, (name,)) for name in names], data=FEW, numbers=list)
    moves = Pairs(cast(Any, SimpleNamespace(fitter=fitter)))
    fewest = moves.leaving(frozenset(names))[0]
    assert len(fewest) == 16
    assert all(len(fewest & {f"a{i}", f"b{i}"}) == 1 for i in range(16))
    assert len(asked) < 16 * 24  # of one after the other


def test_offers_of_many_numbers_are_compared_in_parts():
    # fails if memory is counted by offers, of which one may be a hundred waves: 12 GB of curvatures then
    asked = []

    class Parts(Moves):
        def computed(self, sets, *, rough=False):  # noqa: ARG002
            asked.append(len(sets))
            return [Score(torch.zeros(10), 400, len(own), len(own), 1.0) for own in sets]

    fitter = SimpleNamespace(offered=9, offers=[], data=FEW, numbers=lambda own: range(300 * len(own)))
    Parts(cast(Any, SimpleNamespace(fitter=fitter))).scores([frozenset({str(i)}) for i in range(40)])
    assert sum(asked) == 40
    assert max(asked) * BLOCKS * 300**2 <= MAX_VALUES_AT_ONCE


def test_an_excess_comes_and_goes_with_what_it_is_of():
    # fails if friction at breakaway is taken without the dry friction whose excess it is: by itself a fit made it a
    # force that is there near rest alone
    dry, excess = Offer("dry", ("dry",)), Offer("excess", ("excess",), on="dry")

    class Friction(Moves):
        def computed(self, sets, *, rough=False):  # noqa: ARG002
            lost = [10.0 * ("excess" not in own) + 0.1 * ("dry" in own) for own in sets]
            every = zip(sets, lost, strict=True)
            return [Score(torch.full((10,), none), 400, len(own), len(own), 1.0) for own, none in every]

    def moves(*offers):
        return Friction(
            cast(Any, SimpleNamespace(fitter=SimpleNamespace(offered=3, offers=offers, data=FEW, numbers=list)))
        )

    free = Offer("free", ("free",))
    assert moves(dry, excess, free).joining(frozenset()) == [{"dry", "excess"}]
    assert all(
        "dry" in own or "excess" not in own for own in moves(dry, excess, free).leaving(frozenset({"dry", "excess"}))
    )
    fitter = searched(oscillator()).fitter(Variant(2))
    assert {offer.on for offer in fitter.offers if offer.name == "friction.breakaway"} == {"friction.coulomb"}


def test_the_start_of_a_linear_problem_is_always_tried(monkeypatch):
    # fails if a climb that ends at the noise is believed: it may have taken other terms, and more, than the law has
    asked = []
    monkeypatch.setattr(Search, "linear_start", lambda _, fitter: asked.append(fitter))
    assert there(searched(oscillator()).run()).at_the_noise
    assert len(asked) == 1


def test_masses_start_from_velocities():
    # fails if the mass of a coordinate starts from its positions: beside a cart that drifted, a pole had a mass 300
    # times too large, and fits from there ended in other minima; or if one without a force has an infinite mass
    t = 0.05 * torch.arange(200, dtype=torch.float64)
    data = Trajectories.of(t, torch.stack([t.sin() + 20 * t, 2 * t.sin(), t], 1))
    twice, free = masses(data)
    assert twice == pytest.approx(math.log(0.5), rel=1e-3)
    assert 1 < free < 3


def test_a_model_that_has_lost_its_friction_holds_no_joint():
    # fails if its settings ask for friction that holds without any, which no model can be made of
    fitter = searched(oscillator()).fitter(Variant(2, sticking=True))
    of, base = settings(there(fitter.fit({"q1^2"}, {}, 5, None)), FitConfig())
    assert not of.sticking
    assert not build_model(base, of, "none").capabilities.sticking


@pytest.mark.parametrize(("coarse", "told"), [(True, None), (False, None), (False, False)])
def test_friction_that_holds_is_compared_at_steps_short_enough(coarse, told):
    # fails if the smooth model wins because steps in which the joint stops are too long: a pendulum with Stribeck
    # friction was missed by 4.7 times the noise; or if the user's `sticking=False` is overruled
    fine = SimpleNamespace(name="fine")
    smooth: Any = SimpleNamespace(
        taken={"friction.coulomb"}, values={"friction.coulomb": 0.1}, length=9,
        fitter=SimpleNamespace(variant=Variant(2)), replaces=lambda other: coarse or other is not fine,
    )  # fmt: skip
    fitter = SimpleNamespace(fit=lambda *_: SimpleNamespace(name="coarse"))
    search = SimpleNamespace(
        config=FitConfig(sticking=told), base=SimpleNamespace(speed=(1.0,)), fitter=lambda _: fitter,
        finer=lambda _: fine,
        settled=lambda trial: trial,
    )  # fmt: skip
    assert with_sticking(search, smooth) is (smooth if coarse or told is False else fine)


@pytest.mark.parametrize(
    ("met", "rms", "at_the_noise", "replaced"),
    [(True, 0.011, True, True), (True, 0.02, False, False), (False, 0.02, False, True), (False, 26.0, False, False)],
)
def test_finer_steps_replace_a_model_at_the_noise_at_the_noise(met, rms, at_the_noise, replaced, monkeypatch):
    # fails if a fit that has lost its way, from 1.2 to 2.1 or 2300 mm of a balanced pole, counts as that of finer steps
    monkeypatch.setattr(search_module, "moved", lambda *_: 1.0)
    search = searched(Trajectories.of(torch.arange(9.0), torch.arange(9.0) ** 2))
    fine: Any = SimpleNamespace(rms=rms, segments_at_the_noise=at_the_noise, fitter=None)
    other: Any = SimpleNamespace(
        variant=Variant(2, substeps=64), problem=lambda _: SimpleNamespace(of=lambda *_: None), numbers=lambda _: [],
        spread=100.0, fit=lambda *_: fine, grow=lambda trial: trial, finest=16, rounding=1e-9,
        explain=lambda *_: None,
    )  # fmt: skip
    fine.fitter, fine.theta, fine.length, fine.taken = other, None, 9, frozenset()
    fine.problem = SimpleNamespace(sigma=1.0)
    monkeypatch.setattr(search, "fitter", lambda _: other)
    trial: Any = SimpleNamespace(
        fitter=SimpleNamespace(variant=Variant(2), rounding=1e-9, finest=16), length=9, taken=frozenset(), theta=None,
        rms=0.01, problem=SimpleNamespace(sigma=1.0), values={}, segments_at_the_noise=met, replaces=lambda _: False,
    )  # fmt: skip
    assert search.finer(trial) is (fine if replaced else trial)


@pytest.mark.parametrize(("change", "explained"), [(3.0, [6.0]), (0.3, [])])
def test_the_finest_steps_explain_what_they_change(change, explained, monkeypatch):
    # fails if terms make up for the error of the steps (a double pendulum without noise got four masses of 2e-8), or if
    # steps that change next to nothing explain a misfit
    monkeypatch.setattr(search_module, "moved", lambda *_: change)
    search, told = searched(Trajectories.of(torch.arange(9.0), torch.arange(9.0) ** 2)), []
    other = SimpleNamespace(problem=lambda _: SimpleNamespace(of=lambda *_: None), numbers=lambda _: [])
    monkeypatch.setattr(search, "fitter", lambda _: other)
    own = SimpleNamespace(
        variant=Variant(2, substeps=16), rounding=0.5, finest=16, explain=lambda _, by_steps: told.append(by_steps)
    )  # fmt: skip
    trial: Any = SimpleNamespace(
        fitter=own, length=9, taken=frozenset(), theta=None, rms=5.0, problem=SimpleNamespace(sigma=1.0)
    )  # fmt: skip
    assert search.finer(trial) is trial
    assert told == pytest.approx(explained)


def test_the_floor_of_misfits_is_one_for_all_fits_of_an_order():
    # fails if what the finest steps miss asks for terms in a fit of coarser ones, or fits of order 4 miss as much; if a
    # force that is missing is taken for an error of steps, or if steps explain what is below the noise
    search = searched(simulate(scene("duffing"), trajectories=1, steps=200, h=0.02, seed=0))
    coarse, fine, fourth = (search.fitter(Variant(*own)) for own in ((2, 1), (2, 64), (4, 1)))
    noise, none = coarse.about_the_noise, EXACT_ENOUGH * coarse.spread
    for rms, by_steps in ((1.1 * none, 9.0), (0.5 * none, 0.3 * none), (0.9 * noise, 9.0)):
        fine.explain(cast(Any, SimpleNamespace(rms=rms)), by_steps)
        assert coarse.floor == coarse.rounding
    fine.explain(cast(Any, SimpleNamespace(rms=0.5 * none)), 0.6 * none)
    assert (coarse.floor, fourth.floor) == pytest.approx((math.hypot(noise, 0.6 * none), fourth.rounding), rel=1e-12)
    assert coarse.about_the_noise > coarse.floor > noise


def test_two_models_are_compared_above_one_floor(duffing):
    # fails if a loss known from a lower floor stands against a loss above a higher one: the richer of two exact models
    # stayed, by 770
    search, found = duffing
    search = Search(search.data, search.base, search.config)
    fitter = search.fitter(found.fitter.variant)
    other_order = search.fitter(Variant(6 - fitter.variant.order))
    own, other = replace(found, fitter=fitter), replace(found, fitter=other_order)
    before = own.score.losses
    fitter.of_steps[fitter.variant.order] = 10.0
    few, many = scores_of(own, other)
    assert few.losses.tolist() == many.losses.tolist() == own.score.losses.tolist() != before.tolist()
    assert own.gain(other) == 0


@pytest.mark.parametrize(("rms", "joins"), [(0.2, True), (0.3, False)])
def test_a_model_that_goes_astray_takes_no_place(rms, joins, monkeypatch):
    # fails if a model that misses a quarter of the spread replaces one that follows: unstable motion, whose own score
    # over held-out blocks is lost, ended in a model of rest
    moves = SimpleNamespace(joining=lambda _: [frozenset("a")], start=lambda _: ({}, None))
    monkeypatch.setattr(search_module, "Moves", lambda _: moves)
    search, other = (
        searched(Trajectories.of(torch.arange(9.0), torch.arange(9.0) ** 2)),
        SimpleNamespace(rms=rms, injecting_friction={}),
    )
    monkeypatch.setattr(search, "better", lambda _, richer: richer)
    fitter = SimpleNamespace(spread=1.0, fit=lambda *_: other)
    trial: Any = SimpleNamespace(taken=frozenset(), rms=0.1, injecting_friction={}, length=5, fitter=fitter)
    assert search.moved(trial) is (other if joins else None)


def test_friction_that_pushes_does_not_join():
    # x″ = −4 x + 0.3 sgn x′ − 0.2 x′: fails if a search goes on from a model that creates energy. The load that takes
    # its place in the end may then leave offers that were taken to make up for it
    x, v, path = 1.0, 0.0, []
    for _ in range(300):
        path.append(x)
        for _ in range(10):
            v += 0.005 * (-4 * x + 0.3 * math.tanh(v / 0.05) - 0.2 * v)
            x += 0.005 * v
    search = searched(Trajectories.of(0.05 * torch.arange(300, dtype=torch.float64), torch.tensor(path).double()))
    search.order = 2
    fitter = search.fitter(Variant(2))
    simple = there(fitter.fit(fitter.simple, {}, fitter.lengths[0], None))
    assert Moves(simple).joining(simple.taken)[0] - simple.taken == {"friction.coulomb"}
    pushed = there(fitter.fit(simple.taken | {"friction.coulomb"}, simple.values, simple.length, simple, 60))
    assert pushed.injecting_friction == {"friction.coulomb": 0}
    assert pushed.replaces(simple)
    other = search.moved(simple)
    assert other is None or "friction.coulomb" not in other.taken
    both = fitter.fit(pushed.taken | {"friction.breakaway"}, pushed.values, pushed.length, pushed, 60)
    # No excess of a friction that is gone.
    assert "friction.breakaway" not in without_injecting_friction(search, there(both)).taken
    braked = without_injecting_friction(search, pushed)
    assert not braked.injecting_friction
    assert search.moved(braked, whole=True) is None


def test_a_block_that_is_lost_weighs_no_more_than_it_may():
    # fails if a number that is none, or one far away, makes a whole score infinite
    search = searched(oscillator())
    fitter = search.fitter(Variant(2))
    found = there(fitter.fit({"q1^2"}, {}, 5, None))
    found.path.x[-1, -1, 0] = 1e12
    assert bool(torch.isfinite(found.score.losses).all())


@pytest.mark.parametrize(("zero", "deviation", "better"), [(0.2, 1e-6, None), (0.001, 0.01, True)])
def test_zeros_are_clearly_there_and_make_the_fit_better(zero, deviation, better, monkeypatch):
    # fails if zeros with which the fit misses more are taken, or those within their deviations
    search = searched(pendulum(2), find_zeros=True)
    best = grown(search)
    found = torch.tensor([[0.0], [zero]], dtype=torch.float64), torch.tensor([[0.0], [deviation]], dtype=torch.float64)
    monkeypatch.setattr(search, "zeros", lambda *_: found)
    if better is not None:
        monkeypatch.setattr(type(best), "fits_better", lambda *_: better)
    assert search.with_zeros(best) == (search, best, None)


def test_zeros_are_those_of_the_model_that_is_found():
    # fails if zeros stay what another model, which had terms that made up for them, asked for
    data = pendulum(2)
    second = (data.trajectory == 1).double()[:, None]
    search = searched(replace(data, q=data.q + 0.1 * second), find_zeros=True)
    wrong = torch.tensor([[0.0], [0.07]], dtype=torch.float64)
    read = search.of(measured(search.data, wrong.flatten().tolist()))
    best = grown(read)
    _, found, zeros = search.zeros_again(read, best, (wrong, torch.zeros_like(wrong)))
    assert there(found).rms < 0.9 * best.rms
    assert there(zeros)[0].flatten().tolist() == pytest.approx([0.0, 0.1], abs=0.01)


def test_the_whole_dictionary_is_asked_for_a_hold_by_its_residuals(monkeypatch):
    # fails if blocks that are left out to first order decide of very many numbers, or residuals of a few
    search = searched(pendulum())
    other = SimpleNamespace(fits_better=lambda _: True, replaces=lambda _: False)
    monkeypatch.setattr(search, "of", lambda _: SimpleNamespace(again=lambda _: other))
    trial = cast(Any, SimpleNamespace(lacks_nothing=False))
    assert search.better_hold(trial, ["first"], by_residuals=True) == "first"
    assert search.better_hold(trial, ["first"]) == ""


@pytest.mark.parametrize(("white", "hold"), [(False, "first"), (True, "")])
def test_a_hold_is_asked_for_until_residuals_are_white(white, hold, monkeypatch):
    # fails if a model that terms brought to the noise, beside a wrong hold, is asked for no other hold
    search = searched(pendulum())
    other = SimpleNamespace(replaces=lambda _: True)
    monkeypatch.setattr(search, "of", lambda _: SimpleNamespace(again=lambda _: other))
    trial = cast(Any, SimpleNamespace(at_the_noise=True, lacks_nothing=white))
    assert search.better_hold(trial, ["first"]) == hold


@pytest.mark.parametrize("lost", [True, False])
def test_a_model_that_other_inputs_lose_is_grown_anew(lost, monkeypatch):
    # fails if a chaotic motion, which no fit of whole trajectories follows with another hold, speaks for the old hold
    data = pendulum()
    search, whole, short, grown = searched(data), SimpleNamespace(rms=3.0 if lost else 1.0), object(), object()
    found = cast(Any, SimpleNamespace(
        fitter=SimpleNamespace(data=replace(data), variant=Variant(2)), taken=(), values={}, length=60,
        followed=2.0,
    ))  # fmt: skip
    fitter = search.fitter(Variant(2))
    monkeypatch.setattr(fitter, "fit", lambda _taken, _values, _length, before, *_: short if before is None else whole)
    monkeypatch.setattr(fitter, "leap", lambda trial: grown if trial is short else None)
    monkeypatch.setattr(search, "finer", lambda trial: trial)
    assert search.again(found) is (grown if lost else whole)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_child_has_threads_of_its_own():
    # fails if a process that was forked waits for threads that only its parent has
    flow._pool(2).submit(int).result()
    child = os.fork()
    if child == 0:
        os._exit(flow._pool.cache_info().currsize)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_a_missing_position_has_no_share_in_the_score_of_a_fit():
    # fails if what stands for a blank cell counts where zeros of sensors, or another hold, are asked for
    found = there(searched(oscillator()).fitter(Variant(2)).fit({"q1^2"}, {}, 5, None))
    problem, path = found.problem, found.path
    q, observed = problem.data.q.clone(), torch.ones_like(problem.data.q)
    q[40], observed[40] = 1e3, 0.0
    problem.data = replace(problem.data, q=q, observed=observed)
    problem._weigh()
    score = fitted_score(problem, path, 1e-8)
    assert score.rms < 0.1
    assert score.count == len(q) - 1


def test_a_search_of_many_samples_is_made_of_some(monkeypatch):
    # fails if every trial of a long recording is fitted to all of it, or the model to a part alone
    import herglotz.training.search as module

    monkeypatch.setattr(module, "SAMPLES_OF_A_PART", 150)
    data, seen = simulate(scene("duffing"), trajectories=1, steps=400, h=0.05, noise=NOISE, seed=0), []
    fit = module.Fitter.fit
    monkeypatch.setattr(
        module.Fitter, "fit", lambda self, *a, **k: seen.append(self.data.samples) or fit(self, *a, **k)
    )
    search = searched(data)
    found = there(search.of_part(search.part.run(), None)[1])
    assert found.problem.data.samples == 401
    assert found.taken == {"q1^2", "q1^4"}
    assert sum(count < 400 for count in seen) > sum(count > 400 for count in seen)


def test_zeros_of_a_part_are_where_those_of_all_data_begin(monkeypatch):
    # fails if all data are fitted without the zeros that the part has shown, which the model does not follow; if zeros
    # of some recordings stand for those of all; or if the zeros of the part are the last word
    import herglotz.training.search as module

    monkeypatch.setattr(module, "SAMPLES_OF_A_PART", 150)
    data = simulate(scene("duffing"), trajectories=2, steps=220, h=0.05, noise=NOISE, seed=0)
    shift = torch.tensor([0.0, 0.5], dtype=torch.float64)
    data = replace(data, q=data.q + shift[data.trajectory][:, None], p=None, s=None)
    search, firsts, again = searched(data), [], module.Search.again
    differ = 0.8 * shift[:, None], torch.full((2, 1), 0.01, dtype=torch.float64)
    fitter = search.part.of(module.measured(search.part.data, shift.tolist())).fitter(Variant(2))
    found = fitter.grow(there(fitter.fit({"q1^2", "q1^4"}, {}, fitter.lengths[0], None)))

    def watched(self, trial):
        firsts.append(float(self.data.q.mean() - data.q.mean()))
        return again(self, trial)

    monkeypatch.setattr(module.Search, "again", watched)
    _, best, zeros = search.of_part(found, differ)
    assert firsts[0] == pytest.approx(-0.2)
    assert float((there(zeros)[0].flatten() - shift).abs().max()) < 5 * NOISE
    assert there(best).taken == found.taken
    firsts.clear()
    search.of_part(found, (differ[0][1:], differ[1][1:]))
    assert firsts[0] == 0


def test_a_search_gives_the_same_twice():
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=80, h=0.2, noise=0.01, seed=2)
    one, other = (there(look(data, FitConfig(), Stages()).found) for _ in range(2))
    assert one.config == other.config
    assert one.base.start == other.base.start


def test_zeros_that_say_nothing_are_not_taken_off():
    # fails if zeros are taken off that the score does not ask for, unless a part of the recordings has them
    search = searched(pendulum(2), find_zeros=True)
    best = grown(search)
    assert search.with_zeros(best) == (search, best, None)
    read, other, zeros = search.with_zeros(best, accepted=True)
    assert there(zeros)[0].abs().max() > 0
    assert there(other).fitter.data is read.data


def test_a_line_and_zeros_are_found_one_after_the_other(monkeypatch):
    # fails if what a second look finds is forgotten, or if terms that were found with zeros are searched once more
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=60, h=0.2, noise=0.01, seed=2)
    data, seen, zeros = replace(data, p=None, s=None), [], (0.0, 0.3)
    first = look(data, FitConfig(find_zeros=False), Stages())
    found = there(first.found)
    more = {"zeros": zeros, "hold": "first", "drifts": (0.1,), "why": (("zeros", "so"), ("drifts", "since"))}
    answers = [found._replace(turning=False), found._replace(**more), found]

    def asked(data, _settings, stages, _plan, zeros=(), drifts=(), known=None):
        seen.append((stages.label, data.angles, data.hold, zeros, drifts, known))
        return replace(first, found=answers.pop(0))

    monkeypatch.setattr(sys.modules["herglotz.training.look"], "_seen", asked)
    last = look(data, FitConfig(), Stages())
    assert [(angles, *rest) for _, angles, *rest in seen] == [
        ((True,), "", (), (), None), ((False,), "", (), (), None), ((False,), "first", zeros, (0.1,), found)
    ]  # fmt: skip
    assert len({label for label, *_ in seen}) == 3  # a checkpoint remembers each by its own name
    assert (last.turning, last.why["zeros"], last.why["drifts"]) == (False, "so", "since")


def test_an_angle_with_a_spring_is_a_position_on_a_line():
    # θ″ = −0.8 θ − 0.06 θ′ over turns: fails if an angle has no offer but a pendulum's, if a plan forgets what was
    # found, or if another recording is read otherwise
    t = 0.1 * torch.arange(150, dtype=torch.float64)
    omega = (0.8 - 0.03**2) ** 0.5
    q = 11 * torch.exp(-0.03 * t) * torch.cos(omega * t)
    q = q + 0.01 * torch.randn(150, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = Trajectories.of(t, q, names=("theta",), units=("rad",), angles=(True,))
    run = fit(data, progress=False)
    plan = run.metrics["plan"]
    assert (plan["features"], plan["turning"]) == (("q1^2",), False)
    assert run.metrics["extrapolation_rms"] < 0.012
    assert there(run.predict(replace(data, q=0.9 * data.q), warmup=30).rms) < 0.015
    again = fit(data, plan=Plan.from_dict(plan), progress=False)
    assert again.metrics["extrapolation_rms"] == run.metrics["extrapolation_rms"]


def test_a_brake_by_an_input_is_an_offer_on_a_line_too():
    # fails if it is not, when Pohl's wheel keeps its waves and misses unseen time by 1 300 times the noise; or if a
    # force that turns with an angle is, which a position on a line has no name for
    t = 0.05 * torch.arange(80, dtype=torch.float64)
    data = Trajectories.of(t, t.cos(), u=t[:, None].sin(), names=("a",), units=("rad",), angles=(True,))
    driven = Search(data, estimate_baseline(data), FitConfig()).driven_by(("u1 cos(q1)", "u1^2 v1"))
    assert driven.config.drag == ("u1 cos(q1)", "u1^2 v1")
    assert driven.on_a_line().config.drag == ("u1^2 v1",)


def test_a_weight_on_a_torsion_spring_is_found():
    # θ″ = −7 θ − 12 sin θ − 0.15 θ′: fails if a weight is no offer on a line, or joins a model that powers complete
    # already: θ, θ³ and θ⁵ were found in its place
    rows, x = [], np.array([2.6, 0.0])
    for _ in range(300):
        rows.append(x[0])
        for _ in range(4):
            x = runge_kutta.step(lambda x: np.array([x[1], -7 * x[0] - 12 * np.sin(x[0]) - 0.15 * x[1]]), x, 0.025 / 4)
    q = np.array(rows) + 0.004 * np.random.default_rng(0).standard_normal(300)
    run = fit(Trajectories.of(0.025 * np.arange(300), q, names=("a",), units=("rad",), angles=(True,)), progress=False)
    terms = {term.what: (term.value, term.deviation) for term in run.equation().terms}
    assert set(terms) == {"a′", "a", "sin(a)"}
    for what, true in {"a′": -0.15, "a": -7.0, "sin(a)": -12.0}.items():
        value, deviation = terms[what]
        assert deviation is not None
        assert value == pytest.approx(true, abs=4 * deviation)


@pytest.mark.slow
def test_several_angles_are_read_on_a_line_though_a_pendulum_meets_the_noise():
    # fails if Wilberforce's pendulum, z″ = −50 z − 0.0186 θ and θ″ = −50.5 θ − 12.9 z, is one with masses that turn and
    # friction that drives: training was at the noise, and other motions were missed by 17 times the noise
    rows, x = [], np.array([0.08, 0.0, 0.0, 0.0])
    rate = lambda x: np.array([  # noqa: E731
        x[2], x[3], -50 * x[0] - 0.0186 * x[1] - 0.06 * x[2], -50.5 * x[1] - 12.9 * x[0] - 0.05 * x[3]
    ])  # fmt: skip
    for _ in range(1500):
        rows.append(x[:2])
        for _ in range(6):
            x = runge_kutta.step(rate, x, 0.005)
    q = np.stack(rows) + np.random.default_rng(0).standard_normal((1500, 2)) * [3e-4, 0.01]
    data = Trajectories.of(0.03 * np.arange(1500), q, names=("z", "theta"), units=("m", "rad"), angles=(False, True))
    run = fit(data, progress=False)
    assert not run.metrics["plan"]["turning"]
    assert run.metrics["verdict"].startswith("fits to the noise")
