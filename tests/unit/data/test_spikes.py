"""Spikes in recorded positions: found where there are some, and nowhere else; inputs over what is left out."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.noise import spikes
from herglotz.errors import InputError
from herglotz.scenes import scene


@pytest.mark.parametrize("h", [0.02, 0.2, 0.5, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_smooth_motion_has_none(h, noise):
    # fails if fast motion at few samples a period, or plain noise, is taken for errors
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=60, h=h, noise=noise, gaps=2, seed=1)
    assert int(spikes(data.unwrapped()).sum()) == 0


def test_spikes_are_found():
    # fails if a spike is missed, or a good sample beside a spike is taken for it
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=60, h=0.2, noise=0.01, seed=2)
    rows = torch.tensor([10, 30, 45, 80, 150, 200])
    q = data.q.clone()
    q[rows, 0] += torch.tensor([0.5, -0.7, 1.0, -0.4, 0.6, 0.9], dtype=q.dtype)
    assert spikes(replace(data, q=q)).nonzero()[:, 0].tolist() == rows.tolist()


def test_quantisation_is_no_error():
    # fails if a last digit of a sensor at rest is a spike
    t = torch.arange(200, dtype=torch.float64) * 0.01
    q = torch.zeros(200, 1, dtype=torch.float64)
    q[100:] = (torch.sin(t[100:] - 1) * 300).round()[:, None] / 300
    assert int(spikes(Trajectories.of(t, q)).sum()) == 0


def test_what_is_left_out_keeps_its_impulse():
    # fails if the input of a long step is that of its first part alone, or trajectories run into each other
    t = torch.tensor([0.0, 1, 2, 4, 5] * 2, dtype=torch.float64)
    u = torch.tensor([1.0, 2, 3, 4, 9] * 2, dtype=torch.float64)
    data = Trajectories.of(t, t.clone(), (5, 5), u=u)
    dropped = torch.zeros(10, dtype=torch.bool)
    dropped[[2, 8]] = True
    left = data.keep(~dropped)
    assert left.lengths == (4, 4)
    assert left.u is not None
    # 2 over one unit of time and 3 over two; 3 over two units and 4 over one
    torch.testing.assert_close(left.u[:, 0], torch.tensor([1, 8 / 3, 4, 9, 1, 2, 10 / 3, 9], dtype=torch.float64))
    assert data.keep(torch.ones_like(dropped)) is data


def test_every_mth_sample():
    # fails if samples of another trajectory are taken, or the inputs' impulse is lost
    t = torch.tensor([0.0, 1, 2, 4, 5, 7, 8] * 2, dtype=torch.float64)
    u = torch.tensor([1.0, 2, 3, 4, 5, 6, 7] * 2, dtype=torch.float64)
    data = Trajectories.of(t, t.clone(), (7, 7), u=u).thinned(3)
    assert data.lengths == (3, 3)
    assert data.t.tolist() == [0, 4, 8] * 2
    assert data.u is not None
    impulse = data.u[:2, 0] * data.t[:3].diff()
    assert impulse.tolist() == [1 + 2 + 2 * 3, 4 + 2 * 5 + 6]
    for wrong in (0, True, 2.5):
        with pytest.raises(InputError, match=f"whole number >= 1, got {wrong}"):
            data.thinned(wrong)  # type: ignore[arg-type]
    # fails if the recording is blamed, and the remedy is to leave it out
    remedy = "every = 2 leaves 2 of the 3 samples of trajectory 0, at least 3 are needed; every may be at most 1 here"
    with pytest.raises(InputError, match=remedy):
        data.thinned(2)


@pytest.mark.parametrize("width", [0.1, 0.2, 0.3])
def test_a_short_fast_motion_is_none(width):
    # fails if a sample is judged by the noise of the whole record alone, and not by its neighbours: a smooth pulse in
    # slow motion then lost 9 to 24 samples
    t = torch.arange(300, dtype=torch.float64) * 0.05
    data = Trajectories.of(t, torch.sin(t) + torch.exp(-(((t - 7.01) / width) ** 2)))
    assert not spikes(data).any()


def test_a_sensor_that_stuck_is_left_out():
    # fails if 40 equal readings in the midst of a motion are a position, if the sample before or behind them goes, or
    # if another trajectory is cut
    t = torch.arange(300, dtype=torch.float64) * 0.02
    q = torch.stack([torch.sin(4 * t), torch.cos(3 * t)], -1)
    q[100:140, 0] = q[99, 0]
    data = Trajectories.of(torch.cat([t, t]), torch.cat([torch.cos(2 * t)[:, None].expand(300, 2), q]), (300, 300))
    assert spikes(data).nonzero()[:, 0].tolist() == list(range(400, 440))


def test_what_stands_still_by_itself_is_no_error():
    # fails if friction that holds, the dead band of a slow encoder, or a rest at the end of a recording is left out
    t = torch.arange(400, dtype=torch.float64) * 0.02
    held = torch.where(t < 3, torch.sin(t * torch.pi / 6), torch.where(t < 5, 1.0, torch.cos((t - 5) * torch.pi / 6)))
    counts = (20 * torch.sin(0.5 * t)).round() / 20
    rest = torch.where(t < 4, torch.sin(2 * t), torch.tensor(8.0, dtype=torch.float64).sin())
    start = torch.where(t < 2, 1.0, torch.cos(2 * t))  # its first sample would be wrong, and has to stay
    slips = t.clamp_max(0.1) + t // 0.3  # stick and slip, a slip between two samples
    for q in (held, counts, rest, start, slips):
        assert int(spikes(Trajectories.of(t, q[:, None])).sum()) == 0
    later = torch.cat([t[:200], t[200:] + 50])  # it was moved while nothing was recorded
    assert int(spikes(Trajectories.of(later, torch.where(t < 2, torch.sin(t), 0.9)[:, None])).sum()) == 0
    assert int(spikes(Trajectories.of(later, torch.where(t < 3.8, 0.1 * t, 0.38 + 9 * (t > 3.99))[:, None])).sum()) == 0
