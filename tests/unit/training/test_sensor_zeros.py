"""Zeros of sensors that differ between recordings: as unknowns, found, kept where they help, and met by predictions."""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories
from herglotz.data.sensors import measured
from herglotz.training import FitConfig, Plan, fit, rivals
from herglotz.training.first_states import first_states, states_of_pairs
from herglotz.training.look import look
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.predict import predict
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.zeros import WithZeros
from herglotz.training.sensor_zeros import (
    Apart,
    FoundZeros,
    ZerosOf,
    _by_steps,
    odd,
    refined,
    sensor_zeros,
    zeros_of_one,
)
from herglotz.training.stages import Stages
from herglotz.training.task import build_model
from herglotz.training.verdict import Errors, in_words

predict_module, sensor_zeros_module = (sys.modules[f.__module__] for f in (predict, sensor_zeros))

NOISE, PLANTED, SAMPLES = 0.003, 0.1, 150


def rate(x):
    return np.array([x[1], -9 * np.sin(x[0]) - 0.2 * x[1]])


@cache
def pendulums(planted=PLANTED, seed=2, recordings=2):
    """θ″ = −9 sin θ − 0.2 θ′ from rest, 0.05 s apart; the sensor of every second recording reads `planted` at 0."""
    draw = np.random.default_rng(seed)
    parts = []
    for b in range(recordings):
        x, rows = np.array([draw.uniform(0.5, 1.5) * (-1) ** b, 0.0]), []
        for _ in range(SAMPLES):
            rows.append(x[0])
            for _ in range(8):  # midpoint steps of 6 ms: 1e-5 rad off at the end
                x = x + 0.00625 * rate(x + 0.003125 * rate(x))
        parts.append(np.array(rows) + NOISE * draw.standard_normal(SAMPLES) + planted * (b % 2))
    t = np.tile(np.arange(SAMPLES) * 0.05, recordings)
    return Trajectories.of(
        t, np.concatenate(parts), (SAMPLES,) * recordings, names=("theta",), units=("rad",), angles=(True,)
    )


def silent():
    return Stages(False, None, "", resume=False)


@cache
def seen(planted=PLANTED):
    return look(pendulums(planted), FitConfig(), silent())


@cache
def run():
    return fit(pendulums(), find_zeros=True)


def test_the_normal_equations_of_zeros_are_the_derivatives_of_the_cost():
    of, data = seen(), seen().kept
    model = build_model(of.base, of.settings, "none")
    problem = ShootingProblem(model, data, segment_grid(data, 20, of.base.model_step), sigma=NOISE)
    problem.guess_from_states(states_of_pairs(model, data))
    theta = problem.parameters.get()
    target = WithZeros(problem)
    x = torch.cat([problem.pack(theta, first_states(problem, theta)), theta.new_tensor([0.03])])
    cost, A, b = target.normal_equations(x)
    step = torch.zeros_like(x)
    step[-1] = 1e-4
    up, down = target.cost(x + step), target.cost(x - step)
    # fails if the zero has the wrong sign, belongs to the reference, or misses a weight: the cost is a parabola in z
    assert float((up - down) / 2e-4) == pytest.approx(float(b[-1]), rel=1e-6)
    assert float((up - 2 * cost + down) / 1e-8) == pytest.approx(float(A[-1, -1]), rel=1e-4)
    for i in (0, problem.P, problem.P + 3):  # a parameter, a position and a momentum: J_iᵀJ_z from gradients by x_i
        step = torch.zeros_like(x)
        step[i] = 1e-5
        change = (target.normal_equations(x + step)[2][-1] - target.normal_equations(x - step)[2][-1]) / 2e-5
        assert float(change) == pytest.approx(float(A[i, -1]), rel=1e-4, abs=1e-4 * float(A[-1, -1]))


def test_recordings_of_one_zero_are_not_suspected():
    # fails if noise alone makes zeros stay beside the terms: no time is then spent on them
    found = seen(0.0).found
    assert found is not None
    assert not found.apart


@pytest.mark.parametrize("planted", [0.02, PLANTED, 1.0])
def test_a_planted_zero_is_found_with_its_deviation(planted):
    of = seen(planted).found
    assert of is not None
    assert of.apart
    found = sensor_zeros(pendulums(planted), FitConfig(), seen(planted))
    assert found is not None
    assert found.zeros[0] == 0.0  # the reference
    # fails if terms make up for a part of it; chance exceeds four standard deviations once in 16 000
    assert abs(found.zeros[1] - planted) < 4 * found.deviations[1]
    assert found.deviations[1] < 0.5 * NOISE


@pytest.mark.parametrize("planted", [-0.5, 0.02, PLANTED, 1.0])
def test_single_steps_tell_a_zero_between_those_that_are_tried(planted):
    # fails if Gauss–Newton does not go on from the best of the twelve angles around a turn, which are 0.52 rad apart:
    # over 20 recordings its zeros were within 0.0023 rad
    of = seen(0.0)
    model = build_model(of.base, of.settings, "none")
    shifted = pendulums(planted, seed=1)[1]
    assert float(_by_steps(model, shifted, of.base.max_step)) == pytest.approx(planted, abs=0.007)


def test_symmetry_says_where_the_reference_is_too():
    # fails if a zero of the longest recording stays in the terms: sin(q1) and friction make up for it there
    data = replace(pendulums(), q=pendulums().q + 0.2)
    found = sensor_zeros(data, FitConfig(), look(data, FitConfig(), silent()))
    assert found is not None
    assert "zeros of all recordings" in str(found)
    for z, planted, deviation in zip(found.zeros, (0.2, 0.2 + PLANTED), found.deviations, strict=True):
        assert abs(z - planted) < 4 * deviation
        assert deviation < NOISE


def test_terms_that_turn_round_with_the_motion_are_held():
    # fails if a term of a symmetric machine is held at 0, or one that a shifted zero makes is not
    features = ("cos(q1 + q2)", "sin(q1 + q2)", "cos(q2) v1 v2", "sin(q2) v1 v1", "q1^3 v2", "q1^2", "q1^3")
    settings = FitConfig(level="forced", features=features, drag=("q1 v1", "q1^2 v1", "|v2| v2", "load 2"))
    base = replace(seen().base, angles=(False, True), scale=(1.0, 1.0), speed=(1.0, 1.0))
    model = build_model(replace(base, stiffness=(1.0, 1.0), tilt=(0.0, 0.0), start={}), settings, "none")
    parameters = ParameterVector(model)
    turned = torch.zeros(len(parameters.get()), dtype=torch.bool)
    turned[odd(model)] = True
    named = {name: x.flatten().tolist() for name, x in parameters.unflatten(turned).items()}
    assert named["potential.tilt"] == [True, True]
    assert named["potential.features.sum.coefficient"] == [False, True, False, True]
    assert named["kinetic.sum.coefficient"] == [False, True, False]
    assert named["drag.coefficient"] == [True, False, False, True]
    assert int(turned.sum()) == 7


@pytest.mark.parametrize("order", [2, 4])
def test_the_tilts_of_the_baseline_are_held_at_both_orders(order):
    # fails if q1² or cos(q2) of the baseline is taken for its tilt, q1 or sin(q2), where both are features
    settings = FitConfig(level="forced", order=order)
    base = replace(seen().base, angles=(False, True), scale=(1.0, 1.0), speed=(1.0, 1.0), start={})
    model = build_model(replace(base, stiffness=(2.0, 3.0), tilt=(0.5, 0.7)), settings, "none")
    parameters = ParameterVector(model)
    held = parameters.get()[odd(model)].tolist()
    assert held == pytest.approx([0.5, 0.7])


def test_a_round_that_leaves_the_zero_of_the_reference_keeps_its_deviation(monkeypatch):
    # fails if the reference's zero of the round before is lost, or told as 0
    found = FoundZeros(torch.tensor([[0.0], [0.01]]), torch.tensor([[0.0], [0.001]]), NOISE)
    monkeypatch.setattr(ZerosOf, "moved", lambda *_: found)
    monkeypatch.setattr(ZerosOf, "symmetric", lambda _, model, found: found)  # noqa: ARG005
    more = refined(Apart(0, 0.01, 0.01, (0.2, 0.3), (0.002, 0.003), "rad"), seen())
    assert more is not None
    assert more.zeros == pytest.approx((0.2, 0.31))
    assert more.deviations == pytest.approx((0.002, 0.001))
    assert "zeros of all recordings: 0.2 ± 0.002, 0.31 ± 0.001" in str(more)


def test_a_coordinate_that_no_force_depends_on_has_no_zero():
    """An axis x″ = −0.3 x′ + …: where it starts is no zero of a sensor."""
    t = torch.arange(120).double() * 0.05
    draw = torch.Generator().manual_seed(0)
    q = torch.cat([a * (1 - torch.exp(-0.3 * t)) + c for a, c in ((1.0, 0.0), (-0.7, 5.0))])
    data = Trajectories.of(
        t.repeat(2), q + 0.001 * torch.randn(240, generator=draw, dtype=torch.float64), (120, 120), units=("m",)
    )
    of = look(data, FitConfig(), silent())
    assert of.found is not None
    zeros = ZerosOf(of).zeros(build_model(of.base, of.settings, "none"))
    assert not zeros.z.any()  # fails if a flat direction is taken for one that is known


def test_a_fit_finds_the_zero_and_says_so():
    plan = run().metrics["plan"]
    assert plan["zeros"][1] == pytest.approx(PLANTED, abs=NOISE)
    assert "zeros that differ from those of recording 0: 0.1" in plan["reasons"]["zeros"]
    assert run().metrics["verdict"].startswith("fits to the noise")
    assert torch.allclose(run().data.q, measured(pendulums(), plan["zeros"]).q)  # fails if the run keeps readings
    (line,) = [x for x in run().equation().terms if x.what == "sin(theta)"]
    assert line.value == pytest.approx(-9.0, abs=0.05)


def test_the_plan_is_followed_again():
    again = fit(pendulums(), plan=Plan.from_dict(run().metrics["plan"]))
    assert torch.equal(again.data.q, run().data.q)  # fails if zeros of a plan are forgotten, or taken off twice


def test_a_prediction_takes_off_the_zeros_that_suit_its_warm_up():
    other = replace(pendulums(0.0, seed=7, recordings=1), source="other")

    def rms(planted, **settings):
        found = run().predict(replace(other, q=other.q + planted), **settings)
        return found.rms or np.inf, found.zeros

    for planted in (0.0, PLANTED):
        error, zeros = rms(planted)
        assert error < 1.5 * NOISE, planted  # fails if every recording is taken for one like the reference
        assert bool(zeros) == bool(planted)
    # what the user says is taken as it is, also where it is wrong
    assert rms(PLANTED, sensor_zeros=(PLANTED,)) < (1.5 * NOISE, ())
    assert rms(PLANTED, sensor_zeros=(0.0,)) > (5 * NOISE, ())


@pytest.mark.parametrize(("planted", "found"), [(-0.06, True), (0.002, False)])
def test_a_prediction_finds_zeros_that_no_recording_of_the_fit_had(planted, found):
    # fails if the nearest of the fit's zeros is all there is, which leaves 0.06 rad; if a zero is taken from the noise
    # of the warm-up; or if it is given with the wrong sign
    other = replace(pendulums(0.0, seed=7, recordings=1), source="other")
    prediction = run().predict(replace(other, q=other.q + planted), warmup=60)
    assert prediction.rms is not None
    assert prediction.rms < 2 * NOISE
    assert prediction.zeros == (pytest.approx((planted,), abs=2 * NOISE) if found else ())


def test_zeros_of_its_own_are_taken_only_where_the_warm_up_suits_no_worse(monkeypatch):
    # fails if zeros that the states over the warm-up speak against are taken off
    monkeypatch.setattr(predict_module, "_own_zeros", lambda *_: (1.0,))
    assert run().predict(pendulums(0.0, seed=7, recordings=1), warmup=60).zeros == ()


@pytest.mark.parametrize(("most", "found"), [(16, 15.0), (9, 14.0), (2, 8.0), (1, 0.0)])
def test_parts_that_are_not_followed_are_left_out(monkeypatch, most, found):
    # fails if one of sixteen parts that the model cannot follow hides the zeros of all, or if parts are not thinned
    parts = Trajectories.of(np.tile(np.arange(3.0), 16), np.repeat(np.arange(16.0), 3), (3,) * 16)
    last = lambda _, data, *__: None if len(data) > most else (float(data.q[-1]),)  # noqa: E731
    monkeypatch.setattr(sensor_zeros_module, "_of_parts", last)
    assert zeros_of_one(None, parts, 1.0, 1.0) == (found,)  # pyright: ignore


def test_zeros_are_not_looked_for_where_the_user_says_so():
    first = {"windows": 1.0, "rms": 1.0}
    # fails if the search for zeros begins against the user's word
    assert rivals._aligned(pendulums(), FitConfig(find_zeros=False), silent(), seen(), first) == (seen(), first)
    assert "--find-zeros" in seen().apart  # fails if nobody is told of it


def test_zeros_are_looked_for_by_default_where_terms_miss_the_data(monkeypatch):
    tried = []
    monkeypatch.setattr(rivals, "_held_out", lambda *_: {"rms": 10 * NOISE, "windows": 10 * NOISE, "until": 10 * NOISE})
    monkeypatch.setattr(rivals, "sensor_zeros", lambda *_: tried.append(True))
    looked = replace(seen(), found=seen().found._replace(doubt=False))  # type: ignore[union-attr]
    rivals.held_out_winner(pendulums(), FitConfig(), silent(), looked)
    assert tried == [True]  # fails if they wait for the flag
    monkeypatch.setattr(rivals, "_held_out", lambda *_: {"rms": NOISE, "windows": NOISE, "until": NOISE})
    rivals.held_out_winner(pendulums(), FitConfig(), silent(), looked)
    assert tried == [True]  # fails if time is spent on data that are met
    assert seen(0.0).apart == ""


def held_out(monkeypatch, before, after):
    """Whether zeros are taken that lead from these errors over held-out time (windows, free run) to those."""
    errors = iter([dict(zip(("windows", "rms"), after, strict=True))])
    monkeypatch.setattr(rivals, "_held_out", lambda *_: next(errors))
    monkeypatch.setattr(rivals, "look", lambda *_, zeros: replace(seen(), zeros=zeros))
    monkeypatch.setattr(rivals, "refined", lambda *_: None)
    monkeypatch.setattr(rivals, "sensor_zeros", lambda *_: Apart(0, 0.016, 0.003, (0.0, PLANTED), (0.0, 0.001), "rad"))
    first: dict[str, float] = dict(zip(("windows", "rms"), before, strict=True))
    return rivals._aligned(pendulums(), FitConfig(find_zeros=True), silent(), seen(), first)[0].zeros != ()


def test_zeros_stay_only_where_held_out_time_asks_for_them(monkeypatch):
    assert held_out(monkeypatch, (0.01, 0.02), (0.003, 0.004))
    assert held_out(monkeypatch, (0.0038, 0.0038), (0.003, 0.003))
    assert not held_out(monkeypatch, (0.0036, 0.0036), (0.003, 0.003))  # by less than a fifth
    assert held_out(monkeypatch, (0.01, float("inf")), (0.003, 5.0))  # chaos: both are lost, windows are not
    assert not held_out(monkeypatch, (0.003, float("inf")), (0.003, 5.0))  # fails if a lost free run decides
    for lost in (float("inf"), float("nan")):  # fails if zeros stay that held-out time says nothing of
        assert not held_out(monkeypatch, (lost, 0.02), (lost, 0.02))


def test_recordings_that_zeros_do_not_explain_are_named():
    errors = Errors(0.1, 0.1, 0.1, 0.003, 0.5, "rad")
    metrics = {"follows_data": True, "objective": "trajectory", "apart": "recording 0 is missed by 0.003 rad alone"}
    said = in_words(errors, None, metrics)
    # fails if the verdict keeps to itself that recordings are followed alone and not together
    assert "recording 0 is missed by 0.003 rad alone" in said
    assert "--sensor-zeros" in said
