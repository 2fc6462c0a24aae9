"""What the residual of a model that does not fit shows of the reason."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories
from herglotz.data.polar import in_polar, pairs_of
from herglotz.data.rates import filled_inputs
from herglotz.data.units import with_angles_in_degrees
from herglotz.training import FitConfig, fit, verdict
from herglotz.training.baseline import estimate_baseline
from herglotz.training.errors_of_runs import Errors
from herglotz.training.missed import FEW, reason_of, reason_of_data, ways_of_columns
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.verdict import in_words
from runge_kutta import step

N, H, NOISE = 800, 0.1, 1e-3
T = H * torch.arange(N, dtype=torch.float64)
OWNER = torch.arange(N) // 20  # free runs of 20 samples
MAKE = torch.Generator().manual_seed(0)
Q = torch.sin(T) + 0.6 * torch.sin(math.sqrt(2.3) * T + 1)  # fills its states, time and again
V = torch.gradient(Q, spacing=H)[0]


def noisy(x=Q):
    return x + NOISE * torch.randn(N, generator=MAKE, dtype=torch.float64)


def left(force):
    """The residual of free runs of 20 samples that lack a force (N,), from starts that are fitted."""
    out = torch.zeros(N, dtype=torch.float64)
    line = torch.stack([torch.ones(20).double(), torch.arange(20).double()], -1)
    for rows in torch.arange(N).split(20):
        moved = (force[rows].cumsum(0) * H).cumsum(0) * H
        out[rows] = moved - line @ torch.linalg.lstsq(line, moved[:, None]).solution[:, 0]
    return (out + NOISE * torch.randn(N, generator=MAKE, dtype=torch.float64))[:, None]


def kicks(count=8):
    """Steps of the velocity, eight at most."""
    force = torch.zeros(N, dtype=torch.float64)
    force[30::100] = torch.tensor([1.0, -1.3, 0.8, 1.1, -0.9, 1.2, -1.0, 0.9])
    return torch.where(torch.arange(N) < 100 * count, force, 0.0)


FORCES = {
    "a force of the position": (0.3 * Q**3, ""),
    "a force of the position, near the noise": (0.016 * Q**3, ""),
    "friction": (0.3 * torch.tanh(3 * V), ""),
    "noise alone": (torch.zeros(N, dtype=torch.float64), ""),
    "what nobody recorded": (0.2 * torch.sin(0.37 * T), "It misses differently where positions, velocities and inputs"),
    "the past": (0.2 * Q.roll(40), "the force depends on the past"),
    "a mass that grows, beside its mean": (0.01 * (T - T.mean()) * Q, "What is missed changes with time"),
    "kicks": (kicks(), "What is missed comes in kicks, the hardest at t = "),
    "two kicks, as where a fit goes astray": (kicks(2), "or on what was not recorded"),
}


@pytest.mark.parametrize("what", FORCES)
def test_what_a_residual_shows(what):
    # fails if a function of the state is said to be the past, or the other way round; if kicks or a mass that grows
    # are a memory; or if noise has a reason
    force, said = FORCES[what]
    for _ in range(2):
        found = reason_of(Trajectories.of(T, noisy()[:, None]), left(force), OWNER)
        assert (said in (found or "")) if said else not found, found
        assert ("Try " in (found or "")) is bool(said)


@pytest.mark.parametrize(("driven", "level", "columns", "ways"), [
    (False, "forced", (), "--level full, whose action remembers, or a record of what else acts (--inputs)"),
    (False, "full", (), "a record of what else acts (--inputs)"),
    (True, "forced", (), "a record of what else acts (--inputs)"),
    (True, "forced", (("wind", "left aside", "m/s"),), "--inputs volt,wind, which takes wind, left aside so far"),
    (False, "forced", (("wind", "left aside", "m/s"),),
     "--inputs wind, which takes wind, left aside so far, or --level full, whose action remembers"),
    (True, "forced", (("x_ref", "left aside", "mm"),), "a record of what else acts (--inputs)"),
    (True, "forced", (("speed", "left aside", "m/s"), ("dx", "left aside", "m/s")), "a record of what else acts"),
])  # fmt: skip
def test_a_remedy_would_run(driven, level, columns, ways):
    # fails if the level full is offered where it takes no inputs, or was tried; or if a column that its unit alone left
    # aside is not named, or one is that the user dropped or that is a rate of the motion
    u = torch.randn(N, 1, generator=MAKE, dtype=torch.float64) if driven else None
    columns = (("x", "coordinate", "mm"), *((("volt", "input", "V"),) if driven else ()), *columns)
    data = Trajectories.of(T, noisy()[:, None], u=u, names=("x",), units=("mm",), columns=columns)
    found = reason_of(data, left(0.2 * Q.roll(40)), OWNER, level) or ""
    assert f"not recorded. Try {ways}" in found, found


@pytest.mark.parametrize(
    ("driven", "objective", "ways"),
    [
        (
            False,
            "trajectory",
            "--objective smoothing, or another --level (herglotz select), or a --feature for it; where motors, hands "
            "or other bodies drive the motion, record their forces (--inputs), as no input was",
        ),
        (True, "smoothing", "a --feature for it"),
    ],
)
def test_what_was_tried_and_what_inputs_leave_no_choice_of_is_no_remedy(driven, objective, ways):
    # fails if another level is offered for inputs, which one level takes, or the objective that missed; or if nothing
    # is said of a crane whose drives move what was recorded, and whose forces were not
    metrics = {"follows_data": True, "objective": objective, "driven": driven}
    text = in_words(Errors(0.5, 0.5, 0.5, noise=0.01, spread=1.0), None, metrics)
    assert text.endswith(f"A force is missing. Try {ways}"), text


def test_columns_left_aside_are_named_where_something_is_missing():
    # fails if blows, or a missing force, are said beside a column that was left aside in silence
    columns = (("x", "coordinate", "mm"), ("valve", "left aside", "W"))
    data = Trajectories.of(T, noisy()[:, None], names=("x",), units=("mm",), columns=columns)
    takes = "--inputs valve, which takes valve, left aside so far, or"
    assert f"end stops. Try {takes} recordings that are cut there" in (reason_of(data, left(kicks()), OWNER) or "")
    metrics = {"follows_data": True, "objective": "smoothing", "driven": True, "columns": ways_of_columns(data)}
    text = in_words(Errors(0.5, 0.5, 0.5, noise=0.01, spread=1.0), None, metrics)
    assert text.endswith(f"A force is missing. Try {takes} a --feature for it")
    text = in_words(Errors(0.5, 0.5, 0.5, noise=0.01, spread=1.0), None, metrics | {"objective": "residual"})
    assert f"Try --objective trajectory, or {takes.removesuffix(', or')}; or --substeps" in text
    # fails if settings that a fit of one's own L_d refuses are the remedies of that fit
    text = in_words(Errors(0.5, 0.5, 0.5, noise=0.01, spread=1.0), None, {**metrics, "columns": (), "own": "Net"})
    assert text.endswith("Try other first values of Net, or more terms in it")
    grows = reason_of(data, left(0.01 * (T - T.mean()) * Q), OWNER) or ""
    assert grows.endswith(f"each with a fit of its own, or {takes.removesuffix(', or')}")


def test_neighbours_are_of_other_times():
    # fails if the samples before and behind, which lack the same as all that changes slowly does, are the neighbours
    q = torch.sin(0.3 * T) + 0.6 * torch.sin(0.3 * math.sqrt(2.3) * T + 1)
    data = Trajectories.of(T, (q + 1e-5 * torch.randn(N, generator=MAKE, dtype=torch.float64))[:, None])
    assert "the force depends on the past" in (reason_of(data, left(0.2 * torch.sin(0.37 * T)), OWNER) or "")


def test_a_stiff_force_between_two_coordinates_is_no_past():
    # fails if neighbours, farther apart than a belt stretches, are said to be alike: their forces differ by the
    # stiffness times what the belt is stretched more
    stretch = 0.01 * torch.sin(1.9 * T + 2)
    q = torch.stack([Q, Q + stretch], 1) + 1e-5 * torch.randn(N, 2, generator=MAKE, dtype=torch.float64)
    force = 20 * stretch
    assert not reason_of(Trajectories.of(T, q), torch.cat([left(force), left(-force)], 1), OWNER)
    # A force as large that nobody recorded is told beside the belt.
    both = force + 0.2 * torch.sin(0.37 * T)
    found = reason_of(Trajectories.of(T, q), torch.cat([left(both), left(-both)], 1), OWNER)
    assert "the force depends on the past" in (found or "")


def test_the_hardest_kick_is_named():  # fails if the place is a row of the windows, or that of any other kick
    both = torch.cat([noisy(), noisy()])[:, None]
    data = Trajectories.of(torch.cat([T, T]), both, (N, N), recordings=["run 3", "run 8"])
    owner, blows = torch.cat([OWNER, OWNER + N]), 3 * kicks()
    # Noise decides between kicks that are alike.
    blows[130] *= 1.5
    found = reason_of(data, torch.cat([left(0 * T), left(blows)]), owner) or ""
    when = float(found.split("t = ")[1].split()[0])
    assert abs(when - 13.0) <= 5 * H, found  # the second kick, at row 130
    assert "of trajectory 1 (run 8)," in found


@pytest.mark.parametrize(("hidden", "start", "noise"), [(True, 0.0, 1e-3), (False, 0.5, 5e-4)])
def test_steps_so_short_that_noise_hides_a_force_are_thinned(hidden, start, noise):
    # fails if a second mass that nobody recorded has no reason at 100 samples a second, where noise is nine tenths of
    # the curvature of nine of them; or damping near the middle, which the model lacks, is one of the past
    h, x, rows = 0.01, np.array([start, 0.0, 0.0, 0.0]), []
    t = h * np.arange(1600 if hidden else 1200)
    u = 3 * np.sin(1.7 * t) + 2 * np.sin(4.4 * t)

    def rate(x, u):
        pull = 30 * (x[0] - x[1]) if hidden else 4 * x[0] + 3 * math.exp(-((x[0] / 0.3) ** 2)) * x[2]
        return np.array([x[2], x[3], u - pull - 0.3 * x[2], 30 * (x[0] - x[1]) - 8 * x[1] - 0.3 * x[3]])

    for force in u:
        rows.append(x[0])
        x = x + h * rate(x + h / 2 * rate(x, force), force)
    q = np.array(rows) + noise * np.random.default_rng(0).normal(size=len(u))
    data = {"t[s]": t, "x[m]": q, "force[N]": u}
    run = fit(data, level="forced", features="q1^2", objective="trajectory", progress=False)
    assert run.metrics["window_rms"] > 1.5 * noise
    assert ("a record of what else acts" in run.metrics["verdict"]) is hidden, run.metrics["verdict"]


def test_a_model_that_cannot_be_stepped_is_judged_by_the_motion(monkeypatch):
    # fails if nothing is said where the windows of a model fail: two frequencies are no force of the state
    monkeypatch.setattr(verdict, "with_own_starts", lambda *_: None)
    data = Trajectories.of(T, noisy()[:, None])
    task = Task(data, estimate_baseline(data), FitConfig(), Stages())
    none: Any = SimpleNamespace(model=None)
    seen: Any = SimpleNamespace(train=data, outlying=())
    assert "It misses differently" in verdict._reason_of_residuals(task, none, seen)
    seen.train = Trajectories.of(T, noisy(torch.sin(T))[:, None])
    assert verdict._reason_of_residuals(task, none, seen) == ""


def test_residuals_are_in_units_of_q(monkeypatch):
    # fails if what a model misses stays over the balance, where its noise is in units of q
    grid = SimpleNamespace(node=torch.arange(N), longest=N)
    problem, asked = SimpleNamespace(misfit=lambda _: torch.ones(N, 2), grid=grid), []
    monkeypatch.setattr(verdict, "with_own_starts", lambda *_: SimpleNamespace(problem=problem, path=None))
    monkeypatch.setattr(verdict, "reason_of", lambda _, miss, *__: asked.append(miss) or "")
    data = Trajectories.of(T, torch.stack([Q, 100 * Q], -1), units=("rad", "mm"))
    seen: Any = SimpleNamespace(train=data, outlying=())
    fitted: Any = SimpleNamespace(model=None)
    verdict._reason_of_residuals(Task(data, estimate_baseline(data), FitConfig(), Stages()), fitted, seen)
    assert asked[0][0].tolist() == pytest.approx([0.01, 1.0])


def test_few_samples_show_nothing():  # fails if an empty table of neighbours raises
    rows = FEW + 7
    data = Trajectories.of(T[:rows], noisy()[:rows, None])
    assert reason_of(data, left(0.3 * torch.sin(0.4 * T))[:rows], torch.zeros(rows)) == ""
    short = Trajectories.of(T[:5], Q[:5, None])
    assert reason_of(short, Q[:5, None], torch.zeros(5)) == ""


def test_a_body_on_an_arm_is_told():
    # fails if x and y of one angle lack a force, as the verdict says, and the hint stands above a page of other words
    q = torch.stack([0.4 * Q.sin(), -0.4 * Q.cos()], -1) + 1e-4 * torch.randn(N, 2, generator=MAKE, dtype=torch.float64)
    found = reason_of_data(Trajectories.of(T, q, names=("x", "y"), units=("m", "m")))
    assert found.startswith("x, y stay on a circle about ")
    assert "--polar x,y" in found


def test_what_was_warned_of_when_the_table_was_read_is_the_reason():
    # fails if a misfit is said to be "the past" where the acceleration of a crane's trolley was left aside, or where
    # the length of a swing changes: what was printed above stands a page before the verdict
    columns = (("wind", "input", "N"), ("sway", "angle", "rad"), ("trolley acc", "left aside", "m/s²"))
    data = Trajectories.of(T, Q[:, None], angles=(True,), units=("rad",), names=("sway",), columns=columns)
    assert (
        reason_of_data(data)
        == "trolley acc was left aside, and it is of no coordinate. Try --inputs 'wind,trolley acc'"
    )
    assert reason_of_data(replace(data, columns=columns[:-1])) == ""
    arm = torch.stack([Q.sin(), -Q.cos()], 1) * (1 + 0.2 * torch.sin(0.7 * T))[:, None]
    swing = in_polar(Trajectories.of(T, arm, names=("x", "y"), units=("m", "m")), pairs_of("x,y"))
    assert "if a length changes: --polar x,y,X,Y,r" in reason_of_data(swing)
    pair = "warning: x2, y2 stay on a circle about x1, y1, at 252; one body on an arm? --polar x2,y2,x1,y1"
    assert reason_of_data(replace(data, notes=(pair,))).startswith("x2, y2 stay on a circle about x1, y1, at 252")
    counts = with_angles_in_degrees(Trajectories.of(T, (900 * Q).round(), names=("wheel",)), None, None, None)
    assert reason_of_data(counts).startswith("Whole numbers without a unit, wheel may be counts of an encoder: if")


@pytest.mark.parametrize("angle", [False, True])
@pytest.mark.parametrize(("step", "told"), [(1, False), (60, True)])
def test_samples_that_are_too_far_apart(angle, step, told):
    # fails if a force is missing from a model of samples without a neighbour; or if an angle that turns, whose spread
    # grows for ever, is not told; or if finer samples of the same motion are
    t = torch.arange(500, dtype=torch.float64) * step
    q = 2 * (0.11 * t + 1.5 * torch.sin(0.071 * t) + 1.1 * torch.sin(0.0317 * t + 1))
    found = reason_of_data(Trajectories.of(t, (q if angle else torch.sin(q))[:, None], angles=(angle,)).unwrapped())
    assert found.startswith("Neighbouring samples tell nothing of each other") is told, found


def test_neighbours_that_are_far_tell_nothing():
    # fails if the states of eight coordinates, none of which comes twice, are taken for alike
    speeds = torch.linspace(0.5, 2.1, 8, dtype=torch.float64).sqrt()
    q = torch.sin(T[:, None] * speeds) + NOISE * torch.randn(N, 8, generator=MAKE, dtype=torch.float64)
    assert reason_of(Trajectories.of(T, q), left(0.3 * Q).expand(N, 8), OWNER) == ""


@pytest.mark.parametrize(("rows", "told"), [
    ([2, 3, 3], True), ([1, 2], True), ([3], False), ([40, 55, 70], False), ([40, 55], False), ([1], False),
    ([2] * 40 + [3], False),
])  # fmt: skip
def test_inputs_that_were_filled_in(rows, told):
    # fails if a controller that runs at a third of the rate is told of, set points that come at any time are, or a
    # clock of its own is not
    lengths = torch.tensor(rows * (4000 // sum(rows)))[:400]
    levels = torch.randn(len(lengths), generator=MAKE, dtype=torch.float64)
    u = levels.repeat_interleave(lengths)
    t = H * torch.arange(len(u), dtype=torch.float64)
    data = Trajectories.of(t, torch.sin(t)[:, None], u=torch.stack([torch.cos(t), u], -1))
    assert filled_inputs(data) == (["u2"] if told else [])
    found = reason_of_data(data)
    assert (
        found.startswith("The input u2 was recorded more slowly than the motion and filled in, and its steps act")
        is told
    )


def test_recordings_of_a_slow_input_begin_anywhere():
    # fails if rows are counted from the last step of one recording to the first of the next
    u = torch.randn(14, generator=MAKE, dtype=torch.float64).repeat_interleave(3)[:19].repeat(30)
    t = H * torch.arange(19, dtype=torch.float64).repeat(30)
    assert filled_inputs(Trajectories.of(t, torch.sin(t)[:, None], (19,) * 30, u=u[:, None])) == []


@pytest.mark.parametrize(
    ("errors", "told"),
    [
        ({"windows": 0.05, "free": 1.2}, True),
        ({"windows": 0.5}, True),
        ({"windows": 0.012, "unseen": 0.3, "free": 1.2}, False),  # the training part is met: the other part differs
    ],
)
def test_a_verdict_gives_the_reason(errors, told):
    # fails if a misfit of the training data is blamed on the unseen part, or a reason is looked for where none is asked
    all_errors: Any = {"windows": 0.01, "unseen": 0.01, "free": 0.01, "noise": 0.01, "spread": 1.0} | errors
    metrics = {"follows_data": True, "objective": "trajectory"}
    text = in_words(Errors(**all_errors), None, metrics, lambda missed: "It is late. Try earlier" if missed else "")
    assert text.endswith("It is late. Try earlier") is told
    assert ("the unseen part differs from the training part" in text) is not told
    assert ("A force is missing. Try " in in_words(Errors(**all_errors), None, metrics)) is told


def transients(force, starts=6, rows=200, h=0.15):
    """Positions of motions that decay, from some starts, and the residual that lacks a force(q, v, w), ẇ = v − w."""
    q, owner, miss = [], [], []
    for b in range(starts):
        x, path, lacking = np.array([1.4 - 0.5 * b, 0.8 * (-1) ** b, 0.0]), [], []
        rate = lambda x: np.array([x[1], -x[0] - 0.05 * x[1] + force(*x), x[1] - x[2]])  # noqa: E731
        for _ in range(rows):
            path.append(x[0])
            lacking.append(force(*x))
            for _ in range(10):
                middle = x + 0.05 * h * rate(x)
                x = x + 0.1 * h * rate(middle)
        q += path
        miss += lacking
        owner += [b] * rows
    t = torch.arange(rows, dtype=torch.float64).repeat(starts) * h
    moved = torch.tensor(miss, dtype=torch.float64)
    twice = torch.cat([(part.cumsum(0) * h).cumsum(0) * h for part in moved.split(20)])
    line = torch.stack([torch.ones(20).double(), torch.arange(20).double()], -1)
    left_over = [part - line @ torch.linalg.lstsq(line, part[:, None]).solution[:, 0] for part in twice.split(20)]
    data = Trajectories.of(t, torch.tensor(q, dtype=torch.float64)[:, None], (rows,) * starts)
    return data, torch.cat(left_over)[:, None], torch.arange(rows * starts) // 20


@pytest.mark.parametrize(("force", "said"), [
    (lambda _, v, w: -2.0 * v * w**2, "the force depends on the past"),
    (lambda q, _, __: -0.3 * q**3, ""),
    (lambda _, v, __: -0.3 * abs(v) * v, ""),
], ids=["damping by a hidden state", "a spring that hardens", "drag"])  # fmt: skip
def test_motions_that_decay_show_the_past(force, said):
    # fails if only neighbours of other times count, which motions that decay do not have; or if the largest
    # accelerations of such motions, all at their start, are kicks; or if the past stands for a force of the state
    found = reason_of(*transients(force)) or ""
    assert said in found if said else not found, found
    assert "kicks" not in found


def test_a_stop_that_the_terms_of_a_model_imitate():
    # fails if a pendulum that strikes a stop "depends on the past", because a steep potential leaves no kicks
    x, rows, h = torch.tensor([1.2, 0.0], dtype=torch.float64), [], 0.002
    for k in range(5 * N):
        if k % 5 == 0:
            rows.append(x[0])
        x = step(lambda x: torch.stack([x[1], -9 * x[0].sin() - 0.1 * x[1]]), x, h)
        if x[0] < -0.3 and x[1] < 0:
            x = torch.stack([-0.6 - x[0], -0.8 * x[1]])
    q = torch.stack(rows)
    data = Trajectories.of(5 * h * torch.arange(N, dtype=torch.float64), noisy(q)[:, None], angles=(True,))
    found = reason_of(data, left(0.2 * q.roll(40)), OWNER) or ""
    assert found.startswith("The recorded velocity jumps, the hardest at t = "), found


def test_an_end_stop_kicks():
    # fails if kicks that the position tells are "a force is missing": the time of a blow says where to look
    stop = torch.where(Q > 1.4, 80 * (Q - 1.4), 0.0)
    found = reason_of(Trajectories.of(T, noisy()[:, None]), left(-stop), OWNER) or ""
    assert found.startswith("What is missed comes in kicks"), found
