"""What the data leave open of free runs beyond them, and that a fit to too short a recording says so."""

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import fit, foresight, verdict
from herglotz.training.foresight import _Ahead, _open
from herglotz.training.free_run import states_everywhere
from herglotz.training.objectives import Fitted


@pytest.mark.parametrize(("steps", "verdict"), [(40, "does not fit: too little"), (300, "fits to the noise")])
def test_a_recording_that_is_too_short_says_so(steps, verdict):
    # fails if what the data leave open is not looked at (0.4 of a period fits to the noise and tells nothing of the
    # next one), is not carried to longer times, or is asked of terms that a longer recording excludes
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=steps, h=0.06, noise=0.01, seed=2)
    run = fit(data, objective="trajectory", departures=(2e-3,), progress=False)
    assert run.metrics["verdict"].startswith(verdict), run.metrics["verdict"]


def _driven_axis(seed: int, count: int = 150, h: float = 0.09) -> Trajectories:
    """x″ = −0.76 x′ + 0.6 u in three recordings, u three sines, held; exact steps with noise of 2 % of the spread."""
    make, k = torch.Generator().manual_seed(seed), torch.arange(count, dtype=torch.float64)
    random = lambda: torch.rand(3, generator=make, dtype=torch.float64)  # noqa: E731
    inputs, parts, decay = [], [], math.exp(-0.76 * h)
    for _ in range(3):
        u = 0.5 * torch.sin((0.5 + 2.5 * random()) * (k * h)[:, None] + 6.28 * random()).sum(1)
        x, v, q = 0.0, 0.0, []
        for to in (0.6 / 0.76 * u).tolist():
            q.append(x)
            x, v = x + to * h + (v - to) * (1 - decay) / 0.76, to + (v - to) * decay
        inputs.append(u)
        parts.append(torch.tensor(q).double() + 0.0065 * torch.randn(count, generator=make, dtype=torch.float64))
    return Trajectories.of((k * h).repeat(3), torch.cat(parts), 3 * (count,), u=torch.cat(inputs)[:, None], hold="zero")


def test_unseen_samples_that_are_met_tell_of_hidden_forces(monkeypatch):
    # fails if a force that the unseen part would show may still act: a servo axis, met to the noise over all unseen
    # time, was refused with exit code 3 for a force x⁵ that nothing shows; or if that counts where it tells nothing
    data = _driven_axis(5)
    assert fit(data, progress=False).metrics["verdict"].startswith("fits to the noise")
    # Inputs that follow from the state, as under a controller: the unseen part counts for nothing.
    monkeypatch.setattr(foresight, "unexplained", lambda *_: 0.0)
    assert fit(data, progress=False).metrics["verdict"].startswith("does not fit: too little was recorded")


def _runs(beyond: int, *lengths: int) -> _Ahead:
    """Runs of these numbers of samples 0.1 apart, all recorded, that go on beyond the training part after `beyond`."""
    t = 0.1 * torch.cat([torch.arange(length, dtype=torch.float64) for length in lengths])
    data = Trajectories.of(t, 0 * t, lengths)
    return _Ahead(data, torch.arange(len(t)), list(range(len(lengths))), t > 0.1 * beyond + 0.05, 1.0)


@pytest.mark.parametrize(("missed", "weight"), [(1.4, 1.0), (1.6, 1 / (4 * 1.6**2)), (math.inf, 0.0)])
def test_a_run_that_misses_unseen_samples_is_one_reading(missed, weight):
    # fails if such a run tells nothing (a run over 50 s met to 1.8 times the noise: "too little was recorded"), tells
    # as much as one at the noise, or if samples of the training part count
    runs, Z = _runs(1, 6), torch.randn(6, 1, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    problem = SimpleNamespace(
        P=1, d=2, grid=SimpleNamespace(segments=1), deviations=0.5, places=lambda _: torch.arange(3)
    )  # fmt: skip
    q = runs.data.q + torch.tensor([9.0, 9.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)[:, None] * 0.5 * missed
    found = foresight._of_unseen(Z, q, cast(Any, problem), runs, runs.data)
    J = Z[2:, 0] / 0.5
    torch.testing.assert_close(found, weight * J.T @ J)


def test_a_chaotic_motion_counts_for_half_of_the_time_until_its_start_loses_it():
    # fails if the time is counted from the start of a run, that of another run, or not at all
    runs = _runs(2, 10, 8)
    lost = torch.zeros(18, dtype=torch.bool)
    lost[[1, 7, 9]] = True  # sample 1 is of the training part
    known = runs.known_for(lost)
    assert known.tolist() == [pytest.approx(0.4), math.inf]
    assert runs.within(known / 2).nonzero()[:, 0].tolist() == [3, 4, 5, *range(13, 18)]


def test_what_is_left_open_counts_until_a_start_is_half_lost():
    # fails if all of the time until the start loses a chaotic motion counts (hidden forces lose it a bit earlier, and
    # exact laws were refused), or if after that time an unseen run is said to be known
    runs, start = _runs(2, 10), torch.tensor([0.0, 0.0, 0.0, 0.01, 0.02, 0.04, 0.08, 0.2, 0.4, 0.9]).double()
    Z = torch.stack([2 * start, start, 0 * start], -1)[:, None]
    problem: Any = SimpleNamespace(P=1, data=runs.data, places=lambda _: torch.arange(3))
    A, inside = torch.eye(3, dtype=torch.float64), torch.ones(10, dtype=torch.bool)
    found = foresight._summary(A[None, 1:, 1:], A, Z, problem, runs, {}, inside, 1.5)
    assert found.followed == pytest.approx(0.4)
    var = 5 * start.square()
    assert found.parameters == pytest.approx(float(var[3:6].mean().sqrt()))
    var[8], var[9] = 1.5**2, max(1.5**2, float(var[9]))
    assert found.unseen == pytest.approx(float(var[3:].mean().sqrt()))


def test_two_motions_that_wander_are_farther_apart_than_two_about_a_place():
    # fails if the distance of a pendulum that turns over is that of one that swings (free runs that chaos explains were
    # refused), or a swing that repeats itself counts as no distance
    t = 0.1 * torch.arange(300, dtype=torch.float64)
    swing, turns = torch.sin(2 * math.pi * t / 10), torch.where(t < 20, 0.0, t - 20)
    for q, expected in ((swing, math.sqrt(2)), (turns, 10 / math.sqrt(3))):
        data = Trajectories.of(t, q)
        found = foresight._apart(data, Trajectories.of(t[:200], q[:200]), torch.ones(1, dtype=torch.float64))
        assert found == pytest.approx(expected if q is swing else max(math.sqrt(2), expected / math.sqrt(2)), rel=0.02)


def test_runs_that_go_on_by_one_sample_are_followed():
    # fails if a run of two samples, the last known one and the next, is taken for a trajectory: the fit then ended with
    # "trajectory 0 has 2 samples, at least 3 are needed" (27 samples at h = 1)
    model = ContactLagrangian(ModelConfig((True,), "linear", (1.0,), (1.0,), (1.0,), (0.0,), potential_width=0))
    t = 0.1 * torch.arange(5, dtype=torch.float64)
    made = Trajectories.of(t, 0 * t, angles=(True,))
    runs = _Ahead(made, torch.tensor([0, 1, 2, 3, -1]), [0], t > 0.15, 0.3)
    with torch.no_grad():
        out = Stepper(model).rollout(*torch.tensor([[0.5], [0.1]], dtype=torch.float64), h=0.1, steps=4)
    states = torch.cat([out.q, out.p, out.s[:, None]], -1)
    found = runs.stepped_on(model, states[:4], 0.1)
    torch.testing.assert_close(found, states)


def test_a_term_that_other_terms_nearly_replace_may_be_large():
    # fails if the little information left is taken for rounding (under a controller 1e-11 of all: a wrong effect of the
    # torque, "fits to the noise"), or if a term that others replace altogether may be anything
    J = torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    near = J[:, 0] + 1e-5 * J[:, 2]
    A = (rows := torch.stack([J[:, 0], J[:, 1], near, J[:, 0]], 1)).T @ rows
    problem = cast(Any, SimpleNamespace(data=SimpleNamespace(q=J[:, :1])))
    _, follow = _open(A, {"near": [2], "twin": [3]}, problem)
    assert follow[2, 0] == pytest.approx(math.sqrt(math.log(200)) * 1e5 / 200**0.5, rel=0.2)
    assert not follow[:, 1].any()


@pytest.mark.parametrize(("last", "ends"), [(0.9, None), (1.1, 6)])
def test_a_run_that_fails_beyond_the_recorded_range_says_nothing(last, ends):
    # fails if a motion under inputs that drive it far away, where a step fails, rejects a model (a rotary pendulum at
    # the noise: exit code 3), or one that fails where data were recorded is believed
    t = 0.1 * torch.arange(10, dtype=torch.float64).repeat(2)
    made = Trajectories.of(t, 0 * t, (10, 10))
    runs = _Ahead(made, torch.arange(20), [0, 1], t > 0.15, 0.8)
    states = torch.zeros(20, 3, dtype=torch.float64)
    states[15, 0] = last  # of the second run, within or beyond the range from −1 to 1
    states[16:] = torch.nan
    one = torch.ones(1, dtype=torch.float64)
    cut, known = runs.until_lost(states, -one, one)
    if ends is None:
        assert known is None
        return
    assert cut.data.lengths == (10, ends)
    assert known is not None
    assert bool(torch.isfinite(known).all())
    assert cut.rows.tolist() == list(range(16))
    assert torch.equal(cut.beyond, runs.beyond[:16])


def test_the_start_is_asked_for_over_the_unseen_samples_alone(monkeypatch):
    # fails if the time after the recording has a say in how far the start is known
    starts, foresee = [], verdict.foresee

    def for_longer_and_longer(*arguments):
        for turns in (2, 6):
            monkeypatch.setattr(foresight, "TURNS", turns)
            found = foresee(*arguments)
            assert found is not None
            starts.append(found.unseen)
        return found

    monkeypatch.setattr(verdict, "foresee", for_longer_and_longer)
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=120, h=0.1, noise=0.01, seed=2)
    fit(data, objective="trajectory", departures=(2e-3,), progress=False)
    assert starts[0] == pytest.approx(starts[1], rel=1e-6)
    assert starts[0] > 0


def test_a_free_run_that_fails_says_from_when_on():
    # fails if the time is another trajectory's, a run that succeeds is lost with it, or samples before it are
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=20, h=0.1, gaps=0, keep_state=True)
    model = ContactLagrangian(ModelConfig((True,), "linear", (1.0,), (1.0,), (1.0,), (0.0,), potential_width=0))
    assert data.p is not None
    assert data.s is not None
    whole = torch.cat([data.q, data.p, data.s[:, None]], -1)
    states = torch.cat([whole[:10], whole[21:36]])
    states[-1] = torch.nan
    found, status = states_everywhere(Fitted(model, states, "trajectory", 0.0, {}), data, (10, 15), 0.1)
    assert status == "a step failed after t = 1.4; nothing is predicted beyond it"
    assert torch.isfinite(found.q[:35]).all()
    assert torch.isnan(found.q[35:]).all()
