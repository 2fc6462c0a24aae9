"""Inputs that act later than they were recorded: values, files, and the delay and lag that explain a recording."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import herglotz as hz
from herglotz.cli import main
from herglotz.data import Trajectories, load, save
from herglotz.data.driving import InputPieces, acting
from herglotz.data.holds import Arrival, interpolated_input
from herglotz.errors import InputError
from herglotz.training import FitConfig
from herglotz.training.fit import told_arrival
from herglotz.training.hold import with_arrival

H, FINE = 0.15, 10  # step of the oscillator below, and parts of a step in which it is moved


def recorded(**said) -> Any:
    """Two trajectories at uneven times with rough inputs."""
    make = torch.Generator().manual_seed(0)
    t = torch.rand(21, generator=make, dtype=torch.float64).add_(0.3).cumsum(0)
    t[9:] -= t[9] - 0.7
    u = torch.randn(21, 2, generator=make, dtype=torch.float64)
    return Trajectories.of(t, torch.sin(t), (9, 12), u=u, **said)


def stepped_finely(t, u, hold, delay, lag, fine=2000):
    """u_f at the ends of many fine steps of one trajectory, and the samples' places among them."""
    part = torch.arange(fine, dtype=t.dtype) / fine
    grid = torch.cat([(t[:-1, None] + part * t.diff()[:, None]).flatten(), t[-1:]])
    late = ((grid[1:] + grid[:-1]) / 2 - delay).clamp_min(float(t[0]))
    row = (torch.searchsorted(t, late, right=True) - 1).clamp(0, len(t) - 2)
    source = interpolated_input(hold, t, u, [len(t)], row, (late - t[row]) / (t[row + 1] - t[row])).numpy()
    decay, values = torch.exp(-grid.diff() / lag).tolist(), [u[0].numpy()]
    for wanted, left in zip(source, decay, strict=True):
        values.append(wanted + (values[-1] - wanted) * left)
    return torch.from_numpy(np.stack(values)), fine


@pytest.mark.parametrize("hold", ["zero", "first", "smooth"])
def test_means_within_steps_add_up(hold):
    # fails if the mean of a part of a step is that of another part, if a linear input is constant in it, or if two
    # recordings share an axis of time
    make = torch.Generator().manual_seed(0)
    u = torch.randn(40, 1, generator=make, dtype=torch.float64)
    t = torch.cat([torch.arange(20, dtype=torch.float64).square() / 20, torch.arange(20, dtype=torch.float64)])
    pieces, row = InputPieces.of(hold, t, u, (20, 20)), torch.tensor([3, 25])
    h, then = t[row + 1] - t[row], t[row + 2] - t[row + 1]
    whole = pieces.means(row, 0 * h, h)
    if hold != "smooth":
        middle = interpolated_input(hold, t, u, (20, 20), row, torch.full_like(h, 0.5))
        assert torch.allclose(whole, middle, atol=1e-12)
        within = interpolated_input(hold, t, u, (20, 20), row, torch.full_like(h, 0.15))
        assert torch.allclose(pieces.means(row, 0 * h, 0.3 * h), within, atol=1e-12)
    parts = pieces.means(row, 0 * h, 0.3 * h) * 0.3 + pieces.means(row, 0.3 * h, 0.7 * h) * 0.7
    assert torch.allclose(parts, whole, atol=1e-12)
    weight = (h / (h + then))[:, None]
    both = weight * whole + (1 - weight) * pieces.means(row + 1, 0 * then, then)
    assert torch.allclose(pieces.means(row, 0 * h, h + then), both, atol=1e-12)
    start = pieces.means(row, 0 * h, 1e-6 * h)
    assert torch.allclose(start, interpolated_input(hold, t, u, (20, 20), row, 0 * h), atol=1e-4)


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize(("delay", "lag"), [(0.3, 0.2), (1.7, 0.9), (0.0, 0.5)])
def test_inputs_act_late_and_lagged(hold, delay, lag):
    # fails if a piece starts from the wrong value, a trajectory remembers the one before, or means are samples
    data = recorded(hold=hold, delay=delay, lag=lag)
    acts: Any = acting(data)
    for first, length in zip(data.offsets, data.lengths, strict=True):
        rows = slice(first, first + length)
        fine, every = stepped_finely(data.t[rows].contiguous(), data.u[rows], hold, delay, lag)
        middle = ((fine[1:] + fine[:-1]) / 2).reshape(length - 1, every, 2)
        wanted = torch.cat([middle.mean(1), fine[-1:]]) if hold == "zero" else fine[::every]
        # fine steps of 1/2000 meet a jump of 2 by half a fine step: below 1e-3
        torch.testing.assert_close(acts.u[rows], wanted, rtol=0, atol=2e-3)
    assert acts.arrival == (hold, 0.0, 0.0)
    again: Any = acting(acts, Arrival("first", 1.0, 1.0))
    assert torch.equal(again.u, acts.u)


def test_a_delayed_mean_is_split_at_the_jump():
    # fails if a jump inside a step is rounded to one of its ends
    u = torch.tensor([0.0, 1.0, 3.0, 0.0], dtype=torch.float64)[:, None]
    acts = InputPieces.of("zero", torch.arange(4.0), u, (4,)).acting(0.25, 0.0)
    torch.testing.assert_close(acts[:, 0], torch.tensor([0.0, 0.75, 2.5, 3.0], dtype=torch.float64))


def test_polynomials_are_delayed():
    # fails if smooth inputs are taken for straight lines between samples, which miss a wave by 0.04 of its size
    t = torch.arange(60, dtype=torch.float64)
    u = torch.sin(0.6 * t)[:, None]
    acts = InputPieces.of("smooth", t, u, (60,)).acting(0.5, 0.0)
    assert float((acts[10:, 0] - torch.sin(0.6 * (t[10:] - 0.5))).abs().max()) < 1e-3


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_files_say_delay_and_lag(tmp_path, suffix):
    # fails if a file loses the hold, the delay or the lag, takes "0" for "not said", or the digest does not see them
    for said in ({}, {"hold": "smooth"}, {"hold": "first", "delay": 0.25, "lag": 0.0}):
        save(tmp_path / f"a.{suffix}", recorded(**said))
        again = load(tmp_path / f"a.{suffix}", show=False)
        assert again.arrival == recorded(**said).arrival
        assert again.digest() == recorded(**said).digest()
    assert recorded(lag=0.25).digest() != recorded(delay=0.25).digest()


def test_a_delay_has_the_unit_of_its_file(tmp_path):
    # fails if times become seconds and the delay stays in milliseconds
    (tmp_path / "a.csv").write_text("# delay: 4\n# lag: 20\nt[ms],x[m],u\n0,0,1\n5,1,1\n10,2,1\n")
    assert load(tmp_path / "a.csv", show=False).arrival == ("", 0.004, 0.02)


@pytest.mark.parametrize(
    ("text", "message"), [("-1", "delay of the inputs must be a time >= 0"), ("4 ms", "# delay: 4 ms")]
)
def test_wrong_delays_are_refused(tmp_path, text, message):
    # fails if a delay that cannot be is taken for "not said"
    (tmp_path / "a.csv").write_text(f"# delay: {text}\nt,x,u\n0,0,1\n1,1,1\n2,2,1\n")
    with pytest.raises(InputError, match=message):
        load(tmp_path / "a.csv")


def oscillator(delay=0.0, lag=0.0, *, seed=0, noise=0.01, count=400) -> Trajectories:
    """x'' = u_f − 0.2 x' − x, moved in closed form with a u of random levels; delay and lag in steps."""
    make = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=make, dtype=torch.float64)  # noqa: E731
    u, dt = draw(count // 6 + 1).repeat_interleave(6)[:count], H / FINE
    # x, x', u_f and its source, which a fine step holds
    A = torch.tensor([[0, 1, 0, 0], [-1, -0.2, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=torch.float64)
    if lag:
        A[2, 2:] = torch.tensor([-1.0, 1.0]) / (lag * H)
    step, x = torch.linalg.matrix_exp(A * dt), torch.cat([draw(2) / 3, u[:1], u[:1]])
    found = []
    for k in range(count * FINE):
        x[3] = u[max(0, int((k + 0.5) / FINE - delay))]
        x[2] = x[2] if lag else x[3]
        if k % FINE == 0:
            found.append(x[0].clone())
        x = step @ x
    q = torch.stack(found)
    return Trajectories.of(
        torch.arange(count).double() * H, q + noise * q.std() * draw(count), u=u, hold="zero", units=("m",)
    )


@pytest.mark.parametrize(
    ("delay", "lag", "close"),
    # spread over eight seeds: 0.39 … 0.43, 2.27 … 2.33, 1.44 … 1.53 steps
    [(0.4, 0.0, 0.05), (2.3, 0.0, 0.06), (0.0, 1.5, 0.1)],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_delay_or_a_lag_is_found(delay, lag, close, seed):
    # fails if the search ends on its grid, takes a lag for a delay, or noise biases it
    data = oscillator(delay, lag, seed=seed)
    found = with_arrival(data, data)[1]
    assert found.delay is not None
    assert found.lag is not None
    assert abs(found.delay / H - delay) < close
    assert abs(found.lag / H - lag) < close


def test_a_delay_and_a_lag_are_told_apart():
    # fails if a sum of both is given to one of them
    data = oscillator(1.0, 1.5, noise=0.003)
    _, delay, lag = with_arrival(data, data)[1]
    assert delay is not None
    assert lag is not None
    assert delay > 0.7 * H
    assert lag > 1.1 * H
    assert abs((delay + lag) / H - 2.5) < 0.1


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1, 1.0])
def test_nothing_is_found_where_there_is_nothing(noise):
    # fails if a gain that chance or the linear model's own error makes is taken for a delay
    data = oscillator(noise=noise, seed=3)
    assert with_arrival(data, data)[1] == ("zero", 0.0, 0.0)


def test_what_is_said_is_not_searched_for():
    # fails if the search overrules the user, or leaves the lag to the delay that was named
    data = oscillator(0.0, 1.5)
    assert with_arrival(replace(data, delay=0.0, lag=0.0), data)[1] == ("zero", 0.0, 0.0)
    _, delay, lag = with_arrival(named := replace(data, delay=0.2 * H), named)[1]
    assert delay == 0.2 * H
    assert lag is not None
    assert abs(lag / H - 1.3) < 0.1


def test_a_delayed_fit_meets_the_noise_and_other_recordings(tmp_path):
    # fails if the free run, another recording, a saved run or `rollout --inputs` takes inputs as recorded
    data, other = oscillator(2.3), oscillator(2.3, seed=8)
    noise = 0.01 * float(other.q.std())
    run = hz.fit(data, progress=False)
    assert abs(run.arrival.late[0] / H - 2.3) < 0.06
    assert run.metrics["plan"]["delay"] == run.arrival.delay
    # 1.02 to 1.16 over five seeds; inputs as recorded: above 20
    assert run.metrics["extrapolation_rms"] < 1.4 * noise
    assert (run.predict(other).rms or torch.inf) < 1.4 * noise
    hz.save_run(run, tmp_path / "run")
    again = hz.load_run(tmp_path / "run")
    assert again.arrival == run.arrival
    assert again.predict(other).rms == run.predict(other).rms
    assert (again.predict(again.data).rms or torch.inf) < 1.4 * noise  # its inputs are those that act already
    save(tmp_path / "data.csv", data)
    flags = ["--inputs", str(tmp_path / "data.csv"), "--steps", "100", "--out", str(tmp_path / "out.csv")]
    assert main(["rollout", str(tmp_path / "run"), *flags]) == 0
    motion = load(tmp_path / "out.csv", show=False)
    rows = slice(run.train_lengths[0], run.train_lengths[0] + 100)
    assert float((motion.q[1:] - data.q[rows]).square().mean().sqrt()) < 1.4 * noise
    header = run.export(tmp_path / "model.h").read_text()
    assert f"u(t - {run.arrival.delay:.6g} s)" in header


def test_settings_stand_over_the_file_and_the_file_over_a_plan():
    # fails if a flag, "0" in a flag, or the delay of a plan that is followed again is lost
    data = oscillator(count=40)
    plan = Arrival("first", 0.3, 0.4)
    config = FitConfig(input_delay=0.0)
    assert told_arrival(replace(data, delay=0.1), config, plan).arrival == ("zero", 0.0, 0.4)
    assert told_arrival(replace(data, hold="", lag=0.2), FitConfig(), plan).arrival == ("first", 0.3, 0.2)
    assert told_arrival(replace(data, hold=""), FitConfig(), None).arrival == ("", None, None)
