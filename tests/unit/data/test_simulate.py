"""Simulated sets: the flow, noise, gaps, seeds and arguments."""

import math
from dataclasses import dataclass, replace
from itertools import groupby

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.errors import InputError
from herglotz.scenes import scene


@dataclass(frozen=True)
class Rotation:
    """Harmonic oscillator q̈ = −q: the flow is an exact rotation; s grows by h so that it can be told apart."""

    name: str = "rotation"
    dof: int = 2
    coordinates: tuple[str, ...] = ("a", "x")
    units: tuple[str, ...] = ("rad", "m")
    time_unit: str = "ms"
    angles: tuple[bool, ...] = (True, False)
    q_range: tuple[float, float] = (-1.0, 1.0)
    v_range: tuple[float, float] = (-0.5, 0.5)
    blow_up: bool = False
    lose: int | None = None  # the coordinate that becomes NaN

    def momentum(self, q, v, s):  # noqa: ARG002
        return v

    def flow(self, q, p, s, h):
        assert h.ndim == 0
        assert h.dtype == q.dtype == torch.float64
        if self.blow_up:
            return q * 1e200, p, s
        if self.lose is not None:
            return q.index_fill(-1, torch.tensor(self.lose), math.nan), p, s
        return h.cos() * q + h.sin() * p, -h.sin() * q + h.cos() * p, s + h


def run(**changes) -> Trajectories:
    return simulate(**{"scene": Rotation(), "trajectories": 5, "steps": 30, "h": 0.1, "keep_state": True, **changes})


def test_samples_lie_on_the_flow():  # fails if a step is missed, h is wrong, or t is not k·h
    data = run()
    assert data.lengths == (31,) * 5
    for one in data:
        assert one.s is not None
        assert one.p is not None
        t = one.t[:, None]
        torch.testing.assert_close(one.t, 0.1 * torch.arange(31, dtype=torch.float64))
        torch.testing.assert_close(one.q, t.cos() * one.q[0] + t.sin() * one.p[0], rtol=0, atol=1e-13)
        torch.testing.assert_close(one.p, -t.sin() * one.q[0] + t.cos() * one.p[0], rtol=0, atol=1e-13)
        torch.testing.assert_close(one.s, one.t)


def test_labels():  # fails if the scene's names, units, time unit or angles are not taken over
    data = run()
    assert (data.names, data.units, data.angles, data.time_unit) == (("a", "x"), ("rad", "m"), (True, False), "ms")
    assert data.source == "simulate(rotation, h=0.1, seed=0)"


def test_starts_fill_the_ranges():  # fails if a range is ignored, or q and v are the same draw
    data = run(trajectories=400, steps=2)
    q0, v0 = data.q[::3], data.p[::3]  # pyright: ignore[reportOptionalSubscript]
    assert 0.95 < q0.abs().max() <= 1.0
    assert 0.45 < v0.abs().max() <= 0.5
    assert abs(torch.corrcoef(torch.stack([q0[:, 0], v0[:, 0]]))[0, 1]) < 0.2
    own = run(trajectories=50, steps=2, q_range=([2.0, 5.0], [3.0, 5.0]), v_range=(0.0, 0.0))
    assert ((own.q[::3, 0] >= 2) & (own.q[::3, 0] <= 3)).all()
    assert (own.q[::3, 1] == 5).all()
    assert (own.p[::3] == 0).all()  # pyright: ignore[reportOptionalSubscript]


def test_seed_decides_everything():  # fails if the seed is ignored or the global generator is drawn from
    torch.manual_seed(0)
    state = torch.get_rng_state()
    one, two, other = (run(noise=0.1, gaps=2, seed=seed) for seed in (7, 7, 8))
    assert torch.equal(state, torch.get_rng_state())
    assert one.digest() == two.digest() != replace(other, source=one.source).digest()


def test_noise():  # fails if its size is wrong, it is not white, or it reaches t, s or p
    clean, noisy = run(trajectories=50, steps=100), run(trajectories=50, steps=100, noise=0.02)
    error = noisy.q - clean.q
    assert error.std() == pytest.approx(0.02, rel=0.03)
    assert abs(error.mean()) < 0.001
    assert abs((error[1:] * error[:-1]).mean()) < 0.05 * 0.02**2
    assert clean.p is not None
    assert noisy.p is not None
    assert torch.equal(noisy.t, clean.t)
    assert torch.equal(noisy.p, clean.p)


def test_gaps_are_separate_interior_runs():  # fails if an end is deleted, runs merge, or kept samples are altered
    whole, data = run(trajectories=200, steps=20), run(trajectories=200, steps=20, gaps=3)
    seen = set()
    for one, full in zip(data, whole, strict=True):
        k = (one.t / 0.1).round().long()
        assert torch.equal(one.q, full.q[k])
        assert (k[0], k[-1]) == (0, 20)
        missing = [j for j in range(21) if j not in k.tolist()]
        runs = [len(list(run)) for _, run in groupby(enumerate(missing), lambda x: x[1] - x[0])]
        assert len(runs) == 3
        seen.update(runs)
    assert seen == {1, 2, 3}


def test_gaps_never_leave_fewer_than_three_samples():  # fails if the check is off by one
    assert min(run(trajectories=300, steps=5, gaps=1).lengths) == 3
    with pytest.raises(InputError, match=r"1 gaps of up to 3 samples do not fit into 5 samples; take fewer gaps"):
        run(steps=4, gaps=1)
    crowded = run(steps=16, gaps=4, trajectories=300)  # 17 samples, at worst 5 left with 4 places between them
    assert min(crowded.lengths) == 5
    with pytest.raises(InputError, match="4 gaps of up to 3 samples do not fit into 16"):
        run(steps=15, gaps=4)


def test_positions_only_by_default():  # fails if hidden state leaks into the data
    data = run(keep_state=False)
    assert data.s is None
    assert data.p is None


def test_float32_is_the_float64_set_rounded():  # fails if dtype changes the draw
    assert run(dtype=torch.float32, noise=0.1).digest() == run(noise=0.1).to(torch.float32).digest()


# Each line fails if that argument is not checked.
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"h": 0.0}, r"h must be finite and > 0, got 0.0"),
        ({"h": -0.1}, r"h must be finite and > 0, got -0.1"),
        ({"h": math.nan}, r"h must be finite and > 0, got nan"),
        ({"noise": -1.0}, r"noise must be finite and >= 0, got -1.0"),
        ({"noise": math.inf}, r"noise must be finite and >= 0, got inf"),
        ({"steps": 1}, r"steps must be a whole number >= 2, got 1"),
        ({"steps": 2.5}, r"steps must be a whole number >= 2, got 2.5"),
        ({"trajectories": 0}, r"trajectories must be a whole number >= 1, got 0"),
        ({"gaps": -1}, r"gaps must be a whole number >= 0, got -1"),
        ({"seed": -1}, r"seed must be a whole number >= 0, got -1"),
        ({"dtype": torch.int64}, r"dtype must be torch.float32 or torch.float64, got torch.int64"),
        ({"q_range": (1.0, -1.0)}, r"q_range must be finite with low <= high, got \(1.0, -1.0\)"),
        ({"v_range": (0.0, math.inf)}, r"v_range must be finite with low <= high"),
        ({"q_range": (1.0,)}, r"q_range must be \(low, high\), numbers or 2 numbers each, got \(1.0,\)"),
        ({"q_range": ([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])}, r"q_range must be \(low, high\), numbers or 2 numbers each"),
        ({"scene": Rotation(blow_up=True)}, r"rotation: trajectory \d is not finite after step 2 of h=0.1; narrow"),
        ({"scene": Rotation(lose=1)}, r"rotation: trajectory 0 is not finite after step 1"),
    ],
)
def test_every_mistake_has_its_message(changes, message):
    with pytest.raises(InputError, match=message) as caught:
        run(**changes)
    assert "\n" not in str(caught.value)


def test_the_name_of_a_scene_is_enough():  # fails if a name is refused, or the numbers are not those of the command
    data = simulate("duffing")
    assert (data.lengths, data.typical_step) == ((101,) * 4, pytest.approx(0.1))
    assert data.digest() == simulate(scene("duffing"), trajectories=4, steps=100, h=0.1).digest()
    with pytest.raises(InputError, match="unknown scene 'duff'"):
        simulate("duff")
