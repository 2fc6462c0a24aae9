"""Motion that a controller holds: the growth of errors with the inputs as recorded, and inputs that follow."""

import math
import re
from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from herglotz.cli.common import exit_code
from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.errors_of_runs import Errors
from herglotz.training.feedback import (
    acting_set_points,
    caveat_of_inputs,
    growth_of_noise,
    leaves_without_inputs,
    reason_of_inputs,
    reason_of_set_points,
    work_of_friction,
)
from herglotz.training.following import unexplained
from herglotz.training.foresight import Foresight
from herglotz.training.search import Search
from herglotz.training.trials import Variant, of_one_length
from herglotz.training.verdict import in_words
from runge_kutta import step

H, K, NOISE = 0.02, 300, 1e-3


def balanced(stiffness, moved=0.15):
    """q″ = −stiffness q − 0.1 q′ + u with u = −25 (q − goal) − 8 q′ at the last sample; model, data, states."""
    one = (1.0,)
    config = ModelConfig(
        (False,), "forced", one, one, (stiffness,), (0.0,), potential_width=0, inputs=1, input_map=one, rate=0.1
    )
    model, random = ContactLagrangian(config), torch.Generator().manual_seed(0)
    x, states, inputs, goal = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64), [], [], 0.0
    for k in range(K):
        goal = moved * (2 * float(torch.rand((), generator=random)) - 1) if k % 50 == 0 else goal
        u = -25 * (x[0] - goal) - 8 * x[1]
        states, inputs = [*states, x], [*inputs, u]
        with torch.no_grad():
            q, p, s = x[None, :1], x[None, 1:2], x[2:3]
            x = Stepper(model).rollout(q, p, s, h=H, inputs=u.reshape(1, 1, 1)).states.joined[0, -1]
    states, u = torch.stack(states), torch.stack(inputs)[:, None]
    t, noise = H * torch.arange(K, dtype=torch.float64), torch.randn(K, 1, generator=random, dtype=torch.float64)
    return model, Trajectories.of(t, states[:, :1] + NOISE * noise, u=u, hold="zero"), states


def test_noise_of_a_start_grows_as_the_unstable_motion_does():
    # fails if the growth is that of the recorded, balanced motion, or is not over the spread
    model, data, states = balanced(-9.0)
    growth = growth_of_noise(model, data, states, H)
    expected = NOISE / float(data.q.std(correction=0)) * torch.exp(-0.05 * data.t) * torch.cosh(3 * data.t)
    assert (growth / expected).tolist() == pytest.approx([1.0] * K, rel=0.05)


@pytest.mark.parametrize(
    ("stiffness", "moved", "expected"),
    [
        (-9.0, 0.15, "The motion is unstable and its inputs hold it: "),
        (9.0, 0.15, ""),  # it is stable, and the goals act
        (9.0, 0.0, "Positions and velocities give the inputs, "),
    ],
)
def test_the_reason_is_what_is_measured(stiffness, moved, expected):
    # fails if a controller's recording is told to be longer, or a stable motion, or inputs of their own, to be shorter
    model, data, states = balanced(stiffness, moved=moved)
    reason = reason_of_inputs(model, data, states, H)
    assert reason.startswith(expected)
    assert bool(reason) == bool(expected)
    if stiffness < 0:
        # fails if a model that does not fit says of the motion what is true of the model alone
        assert reason_of_inputs(model, data, states, H, fits=False).startswith("The model, and maybe the motion, is un")
        # exp(2.95 t)/2 = spread / noise
        t = math.log(2 * float(data.q.std(correction=0)) / NOISE) / 2.95
        said = float(re.findall(r"within ([\d.]+)", reason)[0])
        assert said == pytest.approx(t, rel=0.05)
    assert reason_of_inputs(model, replace(data, u=None), states, H) == ""
    assert reason_of_inputs(model, data, states * math.nan, H) == ""


@pytest.mark.parametrize(("stiffness", "last"), [(-9.0, 80), (9.0, K - 1)])
def test_segments_of_an_unstable_motion_end_where_noise_is_lost(stiffness, last):
    # fails if segments of a balanced motion grow until an error of the start, e^(3 t) times the noise, is the motion:
    # held-out blocks then compared starts, and a cart with a pole lost what couples the two
    _, data, _ = balanced(stiffness)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    fitter = search.fitter(Variant(2))
    trial = fitter.fit({"q1^2", "friction.input_map"}, {}, 20, None, 30)
    assert trial is not None
    assert not trial.lost
    assert fitter.grow(trial).length == last
    assert fitter.grow(trial).unstable is (stiffness < 0)
    # fails if noise that no window of nine readings tells counts as noise that grows to the spread
    grown = fitter.grow(trial)
    unknown: Any = copy(fitter)
    unknown.precision = math.inf
    assert not replace(grown, fitter=unknown).lost


@pytest.mark.parametrize(
    ("unstable", "at_the_noise", "compared"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_wrong_motion_that_is_stable_does_not_win_by_its_length(unstable, at_the_noise, compared):
    # fails if a model that misses long segments replaces the law of an unstable motion, which follows short ones to the
    # noise; or if an unstable model of short segments replaces one that meets longer ones
    same = SimpleNamespace(length=80)
    long: Any = SimpleNamespace(length=640, segments_at_the_noise=at_the_noise, over=lambda _: same)
    short: Any = SimpleNamespace(length=80, unstable=unstable)
    assert of_one_length(long, short) == ((same, short) if compared else None)
    assert of_one_length(short, long) == ((short, same) if compared else None)


def test_inputs_that_hold_a_motion():
    # fails if a motion that stays without its inputs, as chaotic ones do, is said to be held by them
    for stiffness, leaves in ((-9.0, True), (9.0, False)):
        model, data, states = balanced(stiffness)
        assert leaves_without_inputs(model, data, states, H) is leaves


def test_inputs_that_follow():  # fails if a motion is not the state's, or a signal of its own counts as following
    model, data, states = balanced(9.0, moved=0.0)
    assert unexplained(data, states) < 0.05
    said = reason_of_inputs(model, data, states, H, "a longer one")
    assert said.endswith("Try a small random signal on the inputs, or set points that jump, or a longer one")
    signal = torch.randn(K, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert unexplained(replace(data, u=signal), states) > 0.9


def regulated(noise_of_u, signal=0.0):
    """θ″ = −18 sin θ − 0.9 θ′ + 5 u, four recordings under u = −5 θ − 0.3 θ′ + a signal, all with white noise."""
    random, q, u = torch.Generator().manual_seed(3), [], []
    for start in (0.8, -0.5, 0.6, -0.9):
        x = torch.tensor([start, 0.0], dtype=torch.float64)
        for _ in range(K):
            more = signal * torch.randn((), generator=random, dtype=x.dtype)
            given = -5 * x[0] - 0.3 * x[1] + more
            q, u = [*q, x[0]], [*u, given]
            x = step(lambda x, u=given: torch.stack([x[1], -18 * x[0].sin() - 0.9 * x[1] + 5 * u]), x, H)
    q, u = torch.stack(q)[:, None], torch.stack(u)[:, None]
    q = q + NOISE * torch.randn(q.shape, generator=random, dtype=q.dtype)
    u = u + noise_of_u * torch.randn(u.shape, generator=random, dtype=q.dtype)
    t = H * torch.arange(K, dtype=torch.float64).repeat(4)
    return replace(Trajectories.of(t, q, (K,) * 4, u=u, hold="zero", angles=(True,)), names=("theta",))


def test_a_law_of_machine_and_controller_is_no_fit():
    # fails if a force that was recorded with noise has no effect and is believed: "fits to the noise", exit code 0
    run = fit(regulated(noise_of_u=0.05), progress=False)
    said = run.metrics["verdict"]
    assert said.startswith("does not fit: "), said
    assert "and the model has no effect of theirs: its equation is that of the machine with the controller" in said
    assert exit_code(run) == 3


def test_a_set_point_has_no_force_of_its_own():
    # fails if a cart "fits to the noise" by the law of its controller, because its force was recorded with noise; if a
    # set point without a recorded force refuses the fit; if an input that is no set point is taken for one; or if the
    # refusal depends on a note, which a user who names the inputs does not get
    one = (1.0,)
    config = ModelConfig(
        (False,), "forced", one, one, (9.0,), (0.0,), potential_width=0, inputs=2, input_map=(9.0, 0.0), rate=0.1
    )
    model, u = ContactLagrangian(config), torch.arange(40, dtype=torch.float64).reshape(20, 2)
    data = Trajectories.of(torch.arange(20, dtype=torch.float64), 0 * u[:, :1], u=u)
    goal, states = ("goal x", "input", "m"), torch.zeros(20, 3, dtype=torch.float64)
    forced = replace(data, columns=(goal, ("force", "input", "N")))
    assert reason_of_set_points(model, forced) == (
        "goal x acts in the model, and a set point acts through a controller alone: its law is in the equation, in the "
        "place of the machine's. Try --drop 'goal x', which leaves the forces that were recorded"
    )
    assert caveat_of_inputs(model, forced, states).endswith(
        "a part of the equation; for the law of the machine alone, by the forces that were recorded, try --drop "
        "'goal x'"
    )
    unforced = replace(data, columns=(goal, ("goal force", "input", "N")))
    assert reason_of_set_points(model, unforced) == ""
    assert caveat_of_inputs(model, unforced, states).endswith("its law is a part of the equation")
    idle = ContactLagrangian(replace(config, input_map=(0.0, 9.0)))
    assert reason_of_set_points(idle, forced) == ""
    assert acting_set_points(idle, forced) == []
    # fails if a model without inputs is asked for its map: an internal error where friction alone is learned
    free = ContactLagrangian(replace(config, inputs=0, input_map=()))
    assert reason_of_set_points(free, replace(data, u=None, columns=())) == ""


def test_an_input_that_never_changes_is_a_constant_force():
    # fails if its gain stands in the verdict as if it were measured, or if it "follows from positions and velocities"
    one = (1.0,)
    config = ModelConfig((False,), "forced", one, one, (9.0,), (0.0,), potential_width=0, inputs=2, input_map=(9.0, 1))
    model, make = ContactLagrangian(config), torch.Generator().manual_seed(0)
    states = torch.randn(20, 3, generator=make, dtype=torch.float64)
    u = torch.randn(20, 2, generator=make, dtype=torch.float64)
    u[:, 0] = 2.0
    data = Trajectories.of(torch.arange(20, dtype=torch.float64), states[:, :1], u=u)
    data = replace(data, columns=(("load", "input", "N"), ("force", "input", "N")))
    assert caveat_of_inputs(model, data, states) == (
        "load never changes in these data, which do not tell its effect from a constant force. Where that matters, "
        "record other values"
    )
    assert unexplained(data, states) == pytest.approx(unexplained(replace(data, u=u[:, 1:]), states))
    assert unexplained(replace(data, u=u[:, :1]), states) == math.inf
    # an input that does not act has no effect to be told
    idle = ContactLagrangian(replace(config, input_map=(0.0, 1.0)))
    assert caveat_of_inputs(idle, data, states) == ""


def test_a_servo_that_is_met_fits_by_its_set_point():
    # fails if a model at the noise is refused because a set point acts: without it the load, in %, misses 6 times more
    random, q, u = torch.Generator().manual_seed(0), [], []
    for start in (0.2, -0.3):
        x, goal = torch.tensor([start, 0.0], dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        for k in range(K):
            if k % 50 == 0:
                goal = 2 * torch.rand((), generator=random, dtype=x.dtype) - 1
            pull = 60 * (goal - x[0])
            q, u = [*q, x[0]], [*u, torch.stack([goal, pull + torch.randn((), generator=random, dtype=x.dtype)])]
            x = step(lambda x, u=goal: torch.stack([x[1], 60 * (u - x[0]) - 7 * x[1] - 5 * x[0].sin()]), x, H)
    read = torch.stack(q)[:, None] + NOISE * torch.randn(2 * K, 1, generator=random, dtype=torch.float64)
    data = Trajectories.of(
        H * torch.arange(K, dtype=read.dtype).repeat(2), read, (K,) * 2, u=torch.stack(u), hold="zero", angles=(True,)
    )
    run = fit(replace(data, columns=(("goal", "input", "rad"), ("load", "input", "%"))), progress=False)
    said = run.metrics["verdict"]
    assert said.startswith("fits to the noise: "), said
    assert "goal acts in the model" in said
    assert said.endswith("try --drop goal")


@pytest.mark.parametrize(("signal", "told"), [(0.0, True), (3.0, False)])
def test_a_fit_says_what_the_effect_of_following_inputs_rests_on(signal, told):
    # fails if a fit keeps to itself that its inputs follow, or says so of inputs of their own
    run = fit(regulated(0.0, signal), progress=False)
    said = run.metrics["verdict"]
    assert said.startswith("fits to the noise: "), said
    assert ("what the inputs do by themselves rests on the rest of their spread" in said) is told
    assert exit_code(run) == 0


def test_the_verdict_says_what_the_inputs_leave():
    # fails if the recording of a balanced motion is said to be too short, or the unseen part to differ from the other
    ahead = Foresight(
        unseen=0.0, apart=2**0.5, followed=math.inf, parameters=0.4, hidden=0.02, name="q1^3", horizon=7.0, reached=True
    )
    good = {"follows_data": True, "objective": "trajectory"}
    unstable = lambda *_: "It is unstable. Try shorter ones"  # noqa: E731
    said = in_words(Errors(0.01, 0.01, 0.01, noise=0.01, spread=1.0), ahead, good, unstable)
    assert said.startswith("does not fit: the inputs leave it open; ")
    assert said.endswith("It is unstable. Try shorter ones")
    told = in_words(Errors(0.01, 0.01, 0.01, noise=0.01, spread=1.0), ahead, good, lambda _, longer: f"Try {longer}")
    assert told.endswith("Try a recording 16 times as long, or several from other starts")
    lost = in_words(Errors(0.01, 0.01, 2.0, noise=0.01, spread=1.0), ahead, good, unstable)
    assert lost.startswith("does not fit beyond the recording: ")
    assert lost.endswith("It is unstable. Try shorter ones")


@pytest.mark.parametrize(("unit", "told"), [("V", []), ("rad", ["sat(cmd/3)"])])
def test_a_commanded_voltage_that_saturates_is_no_set_point(unit, told):
    # fails if the saturation, which has no unit, loses the unit of its input: a voltage was said to act by a controller
    labels = (("cmd", unit), ("sat(cmd/3)", ""))
    model = ContactLagrangian(ModelConfig(level="forced", inputs=2, input_map=(0.0, 2.0)))
    assert acting_set_points(model, cast(Any, SimpleNamespace(input_labels=labels))) == told


def held_at_a_set_point(starts, gain, rate, h, seed=0):
    """θ″ = −18 sin θ − 0.9 θ′ + 5 u under u = gain (0.4 − θ) − rate θ′ at every time, recorded without noise."""
    random, q, u = torch.Generator().manual_seed(seed), [], []
    law = lambda x: gain * (0.4 - x[0]) - rate * x[1]  # noqa: E731
    for start in starts:
        x = torch.tensor([start, 0.0], dtype=torch.float64)
        for _ in range(K):
            q, u = [*q, x[0]], [*u, law(x)]
            for _ in range(4):
                x = step(lambda x: torch.stack([x[1], -18 * x[0].sin() - 0.9 * x[1] + 5 * law(x)]), x, h / 4)
    q, u = torch.stack(q)[:, None], torch.stack(u)[:, None]
    q = q + NOISE * torch.randn(q.shape, generator=random, dtype=q.dtype)
    t = h * torch.arange(K, dtype=torch.float64).repeat(len(starts))
    return replace(Trajectories.of(t, q, (K,) * len(starts), u=u, angles=(True,)), names=("theta",))


def test_the_law_of_machine_and_controller_competes():
    # fails if a torque with the wrong sign, −17.8 for 5, "fits to the noise" where a model without inputs does with
    # fewer numbers: from a model with inputs the search does not come there
    run = fit(held_at_a_set_point((0.8,), 20.0, 2.0, 0.02), progress=False)
    said = run.metrics["verdict"]
    assert said.startswith("does not fit: "), said
    assert "and the model has no effect of theirs: its equation is that of the machine with the controller" in said
    assert exit_code(run) == 3


def test_the_work_of_friction_has_all_its_terms_in_one_unit():
    # fails if forces are impulses beside the power of damping: −0.3 θ′ + 1.5 tanh θ′ was said to drive the motion
    one = (1.0,)
    model = ContactLagrangian(ModelConfig((False,), "forced", one, one, one, (0.0,), potential_width=0, rate=-0.3))
    with torch.no_grad():
        model.get_parameter("friction.viscous").fill_(0.5)
    t = H * torch.arange(K, dtype=torch.float64)
    q, p = t.cos()[:, None], -t.sin()[:, None]
    run = SimpleNamespace(model=model, data=Trajectories.of(t, q), train_lengths=(K,), states=SimpleNamespace(q=q, p=p))
    expected = -0.2 * float((q.diff(dim=0).square() / H).sum())
    assert float(work_of_friction(cast(Any, run)).detach()) == pytest.approx(expected, rel=1e-3)
