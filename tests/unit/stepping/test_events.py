"""Events: located within the step, recorded or ending a trajectory."""

import math

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.stepping import State, Status, Stepper
from herglotz.stepping.events import Event

GAMMA = 0.2
OMEGA = math.sqrt(1 - GAMMA**2 / 4)


def oscillator():
    return Stepper(scene("damped_oscillator", gamma=GAMMA).L_d)


def start(*p):
    p = torch.tensor(p, dtype=torch.float64)[:, None]
    return State(torch.zeros_like(p), p, torch.zeros_like(p[:, 0]))


def position(x):
    return x.q[..., 0]


def test_crossings_of_an_exact_flow_are_exact():
    # fails if the root is that of an interpolation, a crossing is lost, or t is counted from the step
    with torch.no_grad():
        out = oscillator().rollout(*start(1.0, -0.5), h=0.7, steps=20, events=[Event(position, terminal=False)])
    found = out.events[0]
    for sample in (0, 1):
        t = found.t[found.sample[:, 0] == sample]
        # q = e^{−γt/2} sin ωt
        expected = math.pi / OMEGA * torch.arange(1, len(t) + 1, dtype=torch.float64)
        assert len(t) == int(14 * OMEGA / math.pi)
        torch.testing.assert_close(t, expected, rtol=1e-14, atol=1e-13)
    assert float(found.state.q.abs().max()) < 1e-13
    assert bool((found.step == (found.t / 0.7).floor()).all())
    assert bool(out.ok.all())
    plain = oscillator().rollout(*start(1.0, -0.5), h=0.7, steps=20)
    torch.testing.assert_close(out.q, plain.q, rtol=0, atol=0)


def test_direction_selects_crossings():
    # fails if rising and falling are exchanged
    with torch.no_grad():
        events = [Event(position, terminal=False, direction=d) for d in (-1, 1)]
        out = oscillator().rollout(*start(1.0), h=0.3, steps=40, events=events)
    fall, rise = (e.t for e in out.events)
    torch.testing.assert_close(fall[:2], math.pi / OMEGA * torch.tensor([1.0, 3.0], dtype=torch.float64))
    torch.testing.assert_close(rise[:1], math.pi / OMEGA * torch.tensor([2.0], dtype=torch.float64))


def test_a_terminal_event_freezes_its_sample_only():
    # fails if a stopped sample moves on, counts as failed, or stops its neighbours
    stop = Event(lambda x: x.q[..., 0] - 0.5)
    with torch.no_grad():
        out = oscillator().rollout(*start(1.0, 0.1), h=0.4, steps=10, events=[stop])
        plain = oscillator().rollout(*start(1.0, 0.1), h=0.4, steps=10)
    assert out.status[0].tolist() == [0] + [Status.STOPPED] * 9
    assert out.status[1].tolist() == [0] * 10
    assert out.ok.tolist() == [True, True]
    torch.testing.assert_close(out.q[1], plain.q[1], rtol=0, atol=0)
    assert float((out.q[0, 2:] - 0.5).abs().max()) < 1e-14
    t, sample = float(out.events[0].t[0]), int(out.events[0].sample[0, 0])
    assert sample == 0
    flow = scene("damped_oscillator", gamma=GAMMA).flow
    q, p, s = start(1.0)
    exact = flow(q, p, s, torch.tensor(t, dtype=torch.float64))
    torch.testing.assert_close((out.q[:1, -1], out.p[:1, -1], out.s[:1, -1]), exact, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(out.sigma[0, -1], torch.tensor(math.exp(-GAMMA * t), dtype=torch.float64))


def test_the_first_of_two_terminal_events_wins():
    # fails if events of a step are handled in the order of the list, or a crossing after the stop is recorded
    late, early = Event(lambda x: x.q[..., 0] - 0.5), lambda x: x.q[..., 0] - 0.45
    seen = Event(lambda x: x.q[..., 0] - 0.48, terminal=False)
    with torch.no_grad():
        out = oscillator().rollout(*start(1.0), h=0.6, steps=4, events=[late, early, seen])
        turned = oscillator().rollout(*start(1.0), h=0.6, steps=4, events=[early, late, seen])
    assert float((out.q[0, -1] - 0.45).abs()) < 1e-14
    assert [len(e.t) for e in out.events] == [0, 1, 0]
    assert [len(e.t) for e in turned.events] == [1, 0, 0]
    torch.testing.assert_close(turned.q, out.q, rtol=0, atol=0)


def test_nothing_left_to_step_ends_the_work():
    # fails if a batch whose samples have all stopped goes on stepping
    count = [0]
    L_d = scene("damped_oscillator", gamma=GAMMA).L_d

    def counted(q0, q1, s0, h):
        count[0] += 1
        return L_d(q0, q1, s0, h)

    work, event = [], lambda x: position(x) - 0.5
    with torch.no_grad():
        for steps in (5, 500):
            count[0] = 0
            out = Stepper(counted).rollout(*start(1.0), h=0.4, steps=steps, every=5, events=[event])
            work.append(count[0])
    assert work[0] == work[1]
    assert out.q.shape == (1, 101, 1)
    assert out.status[0, 0] == Status.STOPPED


def test_a_failed_sample_has_no_events():
    # fails if NaN counts as a sign change, or disturbs the search in other samples
    x = start(1.0, 1.0)
    x.q[1] = torch.nan
    with torch.no_grad():
        out = oscillator().rollout(*x, h=0.4, steps=6, events=[lambda y: y.q[..., 0] - 0.5])
    assert out.events[0].sample.tolist() == [[0]]
    assert out.status[1].tolist() == [Status.DIVERGED] * 6


def test_a_start_on_the_surface_is_no_event():
    # fails if g = 0 at the start, or at a step's end, is counted (twice)
    with torch.no_grad():
        out = oscillator().rollout(
            *start(1.0), h=math.pi / OMEGA / 4, steps=5, events=[Event(position, terminal=False)]
        )
    assert len(out.events[0].t) == 1


def test_events_of_a_single_unbatched_trajectory():
    # fails if a batch dimension is needed
    x = State(*(y[0] for y in start(1.0)))
    out = oscillator().rollout(*x, h=0.4, steps=6, events=[lambda y: y.q[..., 0] - 0.5])
    assert out.events[0].sample.shape == (1, 0)
    assert out.events[0].state.q.shape == (1, 1)
    assert out.status.tolist()[-1] == Status.STOPPED


def test_wrong_events_are_named():
    # fails if a wrong event reaches the search
    with pytest.raises(InputError, match="direction must be -1, 0 or 1, got 2"):
        Event(position, direction=2)
    with pytest.raises(InputError, match=r"one value per sample, shape \(1,\); got \(1, 1\)"):
        oscillator().rollout(*start(1.0), h=0.1, steps=2, events=[lambda x: x.q])
    with pytest.raises(InputError, match="events and checkpoint exclude one another"):
        oscillator().rollout(*start(1.0), h=0.1, steps=2, events=[position], checkpoint=2)
