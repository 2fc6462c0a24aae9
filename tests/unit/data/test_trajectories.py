"""Ragged sets: validation, windows, splits, angles, digests."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories
from herglotz.data.splits import cuts_of, enough
from herglotz.errors import InputError


def ragged() -> Trajectories:
    """Three trajectories of 4, 3 and 6 samples with irregular steps; q encodes (trajectory, sample)."""
    t = torch.tensor([0.0, 0.1, 0.2, 0.5, 7.0, 7.1, 7.2, 1.0, 1.1, 1.2, 1.3, 1.4, 1.9], dtype=torch.float64)
    b = torch.tensor([0] * 4 + [1] * 3 + [2] * 6, dtype=torch.float64)
    k = torch.tensor([*range(4), *range(3), *range(6)], dtype=torch.float64)
    return Trajectories.of(t, torch.stack([10 * b + k, -k], 1), (4, 3, 6), names=("x", "y"), source="set")


def full() -> Trajectories:
    """A ragged set with s, p and u."""
    base = ragged()
    rows = torch.arange(13, dtype=torch.float64)
    return replace(base, s=rows, p=torch.stack([rows, 2 * rows], 1), u=rows[:, None] + 0.5)


def build(**changes):
    fields = {
        "t": [0.0, 1.0, 2.0, 0.0, 1.0, 2.0],
        "q": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
        "lengths": (3, 3),
        "source": "f",
    }
    return Trajectories.of(**{**fields, **changes})


INF, NAN = math.inf, math.nan
SIX = torch.zeros(6, dtype=torch.float64)


# Each line fails if that check is dropped or its message loses the place, the value or the remedy.
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"t": torch.arange(6)}, r"f: t has dtype torch.int64; convert it to torch.float64"),
        ({"q": SIX.to(torch.complex128)}, r"f: q has dtype torch.complex128; convert"),
        ({"q": SIX.float()}, r"f: q is torch.float32 on cpu but t is torch.float64 on cpu; use the same"),
        ({"q": [[0.0, 1.0], [2.0]]}, r"q is not an array of numbers .*; give a tensor"),
        ({"t": SIX[:, None]}, r"f: t must have shape \(N,\), got \(6, 1\); flatten it"),
        ({"q": [0.0] * 5}, r"f: q must have shape \(6, n\), .*got \(5, 1\)"),
        ({"q": torch.zeros(6, 0, dtype=torch.float64)}, r"f: q must have shape \(6, n\), .*got \(6, 0\)"),
        ({"s": SIX[:5]}, r"f: s must have shape \(6,\), got \(5,\)"),
        ({"p": torch.zeros(6, 2, dtype=torch.float64)}, r"f: p must have shape \(6, 1\), got \(6, 2\)"),
        ({"u": SIX[:5]}, r"f: u must have shape \(6, m\), got \(5, 1\)"),
        ({"lengths": ()}, r"f: there is no trajectory; give at least one of 3 samples"),
        ({"recordings": ("a",)}, r"f: recordings has 1 names for 2 trajectories; give one a trajectory, or none"),
        ({"lengths": (5, 1)}, r"f: trajectory 1 has 1 sample, at least 3 are needed; leave it out"),
        ({"lengths": (2, 4)}, r"f: trajectory 0 has 2 samples, at least 3 are needed"),
        ({"lengths": (3, 4)}, r"f: lengths add up to 7 but t has 6 samples; correct the lengths"),
        ({"lengths": (3, 3.0)}, r"f: lengths\[1\] is 3.0, not an int"),
        ({"names": ("a", "b")}, r"f: names has 2 entries for 1 coordinates"),
        ({"units": ("",)}, r"f: a unit is empty \(\('',\), 's'\); write '1' for none"),
        ({"time_unit": ""}, r"f: a unit is empty \(\('1',\), ''\); write '1'"),
        ({"names": ("a\ud800",)}, r"f: 'a.ud800' has control characters or half a character; rename it"),
        ({"time_unit": "s\n"}, r"f: 's.n' has control characters"),
        ({"names": ("",)}, r"f: names \(''\,\) must differ and not be empty; rename"),
        ({"angles": (True,), "units": ("deg",)}, r"f: the angle 'q' is in 'deg'; convert it to radians"),
        ({"q": [0.0, 1.0, 2.0, 3.0, NAN, 5.0]}, r"f: q\[0\] of trajectory 1, sample 1, is nan; delete that sample"),
        ({"t": [0.0, 1.0, INF, 0.0, 1.0, 2.0]}, r"f: t of trajectory 0, sample 2, is inf; delete that sample"),
        ({"u": SIX * NAN}, r"f: u\[0\] of trajectory 0, sample 0, is nan"),
        (
            {"t": [0.0, 1.0, 2.0, 0.0, 1.0, 1.0]},
            r"f: t of trajectory 1 does not increase from sample 1 to 2 \(1.0 then 1.0\); sort the samples or delete",
        ),
    ],
)
def test_every_mistake_has_its_message(changes, message):
    with pytest.raises(InputError, match=message) as caught:
        build(**changes)
    assert "\n" not in str(caught.value)


def test_constructor_wants_tensors():  # fails if an array slips through to torch operations
    with pytest.raises(InputError, match=r"s: q must be a torch.Tensor, got ndarray; use Trajectories.of"):
        replace(ragged(), q=np.zeros((13, 2)), source="s")  # pyright: ignore[reportArgumentType]


def test_defaults():  # fails if lists become float32 or an angle keeps the unit 1
    one = Trajectories.of([0, 1, 2], [0, 1, 2])
    assert (one.names, one.units, one.angles, one.lengths) == (("q",), ("1",), (False,), (3,))
    assert one.t.dtype == one.q.dtype == torch.float64
    assert one.q.shape == (3, 1)
    two = Trajectories.of(SIX[:3] + torch.arange(3), torch.zeros(3, 2, dtype=torch.float64), angles=(False, True))
    assert (two.names, two.units) == (("q1", "q2"), ("1", "rad"))
    assert Trajectories.of([0, 1, 2], [0, 1, 2], np.array([3])).lengths == (3,)  # fails if numpy integers are refused


def test_scalars_are_refused_as_one_sample():  # fails if a 0-d input escapes as a TypeError
    with pytest.raises(InputError, match="trajectory 0 has 1 sample"):
        Trajectories.of(1.0, 2.0)  # pyright: ignore[reportArgumentType]


def test_counts_and_indexing():  # fails if offsets are off by a trajectory or optional arrays are not cut along
    data = full()
    assert (len(data), data.dof, data.samples, data.offsets) == (3, 2, 13, (0, 4, 7))
    assert data.trajectory.tolist() == [0] * 4 + [1] * 3 + [2] * 6
    last = data[-1]
    assert last.lengths == (6,)
    assert last.q[:, 0].tolist() == [20, 21, 22, 23, 24, 25]
    assert last.s is not None
    assert last.u is not None
    assert last.s.tolist() == [7, 8, 9, 10, 11, 12]
    assert last.u[:, 0].tolist() == [7.5, 8.5, 9.5, 10.5, 11.5, 12.5]
    assert [one.samples for one in data] == [4, 3, 6]
    with pytest.raises(IndexError):
        data[3]


def test_steps_stay_inside_trajectories():  # fails if a step joins two trajectories
    steps = ragged().steps()
    assert len(steps.h) == 13 - 3
    torch.testing.assert_close(
        steps.h, torch.tensor([0.1, 0.1, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.5], dtype=torch.float64)
    )
    assert steps.index.tolist() == [0, 1, 2, 4, 5, 7, 8, 9, 10, 11]
    assert steps.trajectory.tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 2, 2]


def test_triples():  # fails if a window crosses a border, if h0 and h1 are exchanged, or q's are shifted
    data = ragged()
    triples = data.triples()
    assert triples.index.tolist() == [0, 1, 4, 7, 8, 9, 10]
    assert triples.q0[:, 0].tolist() == [0, 1, 10, 20, 21, 22, 23]
    assert triples.q1[:, 0].tolist() == [1, 2, 11, 21, 22, 23, 24]
    assert triples.q2[:, 1].tolist() == [-2, -3, -2, -2, -3, -4, -5]
    assert triples.h0[1].item() == pytest.approx(0.1)
    assert triples.h1[1].item() == pytest.approx(0.3)


def test_triples_leave_out_long_steps():  # fails if only h0 or only h1 is looked at
    data = Trajectories.of([0, 1, 2, 5, 6, 7.0], [0, 1, 2, 3, 4, 5.0])
    assert data.triples(1.5).index.tolist() == [0, 3]
    assert data.triples(3.0).index.tolist() == [0, 1, 2, 3]  # a step equal to the limit stays
    assert len(data.triples(0.5)) == 0
    for bad in (0.0, -1.0, NAN):
        with pytest.raises(InputError, match="max_step must be finite and > 0"):
            data.triples(bad)


def test_split_time():  # fails if the cut is not per trajectory, or a sample is lost or seen twice
    data = full().select([0, 2])  # 4 and 6 samples
    with pytest.raises(
        InputError, match=r"set: fraction 0.4 cuts the 6 samples of trajectory 1 into 2 and 4, each part needs 3"
    ):
        data.split_time(0.4)
    train, test = data.split_time(0.5)
    assert (train.lengths, test.lengths) == ((4, 3), (3,))  # one recording too short is no reason to refuse the others
    assert torch.equal(test.q, data.q[7:])
    long = Trajectories.of(
        torch.arange(20.0).double(), torch.arange(20.0).double(), (8, 12), s=torch.arange(20).double()
    )
    assert long.split_time(0.7)[0].lengths == (8, 8)
    with pytest.raises(InputError, match=r"fraction 0.2 cuts the 12 samples of trajectory 1 into 2 and 10"):
        long.split_time(0.2)
    train, test = long.split_time(0.6)
    assert (train.lengths, test.lengths) == ((5, 7), (3, 5))
    assert train.q[:, 0].tolist() == [0, 1, 2, 3, 4, 8, 9, 10, 11, 12, 13, 14]
    assert test.q[:, 0].tolist() == [5, 6, 7, 15, 16, 17, 18, 19]
    assert test.s is not None
    assert test.s.tolist() == test.q[:, 0].tolist()
    for bad in (0.0, 1.0, -0.5, 2.0, NAN):
        with pytest.raises(InputError, match="fraction must lie between 0 and 1"):
            long.split_time(bad)


def test_whole_short_trajectories_are_held_out():
    # fails if short ones are cut in time, long ones are not, or one too short to be judged is held out
    assert cuts_of((13, 12, 11, 5, 10, 9), 2 / 3) == (13, 3, 11, 5, 10, 3)
    assert cuts_of((13, 12, 27), 2 / 3) == (9, 8, 18)
    assert cuts_of((13, 12), 2 / 3) == (9, 8)
    assert cuts_of((4, 5, 5), 2 / 3) == (4, 5, 5)


def test_select():  # fails if order or repetition is lost, or a wrong index wraps round
    data = ragged()
    assert data.select([2, 0, 2]).lengths == (6, 4, 6)
    assert data.select([2, 0, 2]).q[:, 0].tolist()[6:10] == [0, 1, 2, 3]
    assert data.select(torch.tensor([1])).q[:, 0].tolist() == [10, 11, 12]
    for bad in (3, -1):
        with pytest.raises(InputError, match=rf"set: there is no trajectory {bad}; select from 0 to 2"):
            data.select([bad])
    with pytest.raises(InputError, match="there is no trajectory; give at least one"):
        data.select([])


def test_cat():  # fails if the lengths or an optional array of the second set are lost
    data = full()
    both = Trajectories.cat([data.select([2]), data.select([0, 1])])
    assert both.lengths == (6, 4, 3)
    assert both.digest() == data.select([2, 0, 1]).digest()
    with pytest.raises(InputError, match=r"1 of the 2 sets to join have s; drop it or add it to all"):
        Trajectories.cat([data, ragged()])
    with pytest.raises(InputError, match=r"different names cannot be joined: \('x', 'y'\) and \('a', 'y'\)"):
        Trajectories.cat([data, replace(data, names=("a", "y"))])
    with pytest.raises(InputError, match="different time_unit"):
        Trajectories.cat([data, replace(data, time_unit="ms")])
    with pytest.raises(InputError, match="differ in the dtype, device or width of t"):
        Trajectories.cat([data, data.to(torch.float32)])
    with pytest.raises(InputError, match="at least one set"):
        Trajectories.cat([])


def test_names_of_recordings_follow_their_samples():
    # fails if a set that is cut, chosen or joined calls a recording by the name of another
    data = replace(ragged(), recordings=("a.csv", "b.csv", "trajectory 2"))
    assert [data.label(b) for b in range(3)] == ["trajectory 0 (a.csv)", "trajectory 1 (b.csv)", "trajectory 2"]
    assert ragged().label(1) == "trajectory 1"
    assert data.select([2, 1, 1]).recordings == ("trajectory 2", "b.csv", "b.csv")
    assert data.rows(torch.tensor([1, 2, 3, 8, 9, 10, 10, 11, 12]), (3, 3, 3)).recordings[1:] == ("trajectory 2",) * 2
    kept = torch.arange(13) >= 5
    kept[4:7] = False
    assert data.keep(kept).recordings == ("trajectory 2",)
    assert data.split_time(0.5)[1].recordings == ("trajectory 2",)
    assert Trajectories.cat([data, ragged()]).recordings == (*data.recordings, "set", "set", "set")
    both = Trajectories.cat([replace(ragged(), source=""), replace(ragged(), source="other")])
    assert both.label(4) == "trajectory 4 (other)"
    assert both.label(0) == "trajectory 0"  # no empty brackets where a set has no source
    assert Trajectories.cat([ragged(), ragged()]).recordings == ()


def test_to():  # fails if an array is left in the old dtype
    small = full().to(torch.float32)
    assert small.s is not None
    assert small.p is not None
    assert small.u is not None
    assert {x.dtype for x in (small.t, small.q, small.s, small.p, small.u)} == {torch.float32}
    assert small.to(torch.float64).lengths == (4, 3, 6)
    assert full().to(device="cpu").t.dtype == torch.float64  # fails if a device alone changes the dtype
    with pytest.raises(InputError, match=r"dtype must be torch.float32 or torch.float64, got torch.int32"):
        full().to(torch.int32)


def test_times_that_float32_cannot_tell_apart():  # fails if a unix time stamp silently gives h = 0
    with pytest.raises(InputError, match=r"does not increase .*times may coincide in float32: use float64"):
        Trajectories.of([1.7e9, 1.7e9 + 0.01, 1.7e9 + 0.02], [0, 1, 2]).to(torch.float32)


def test_unwrapped():  # fails if turns leak into the next trajectory or another column, or the sign is wrong
    angle = torch.linspace(0, 20, 41, dtype=torch.float64)
    true = torch.cat([angle, -angle])
    wrapped = torch.atan2(true.sin(), true.cos())
    t = torch.cat([angle, angle])
    data = Trajectories.of(
        t, torch.stack([wrapped, wrapped], 1), (41, 41), names=("theta", "x"), units=("rad", "m"), angles=(True, False)
    )
    smooth = data.unwrapped()
    torch.testing.assert_close(smooth.q[:, 0], true, rtol=0, atol=1e-13)
    assert torch.equal(smooth.q[:, 1], wrapped)
    np.testing.assert_allclose(smooth.q[:41, 0].numpy(), np.unwrap(wrapped[:41].numpy()), atol=1e-13)
    assert torch.equal(smooth.unwrapped().q, smooth.q)  # fails if it is not idempotent
    steady = Trajectories.of([0, 1, 2], [0, 3, 6], angles=(True,))
    assert torch.equal(steady.unwrapped().q, steady.q)  # fails if jumps of less than π are touched


def test_each_trajectory_keeps_its_first_angle():  # fails if unwrapping starts at 0 or at the last trajectory's end
    data = Trajectories.of([0, 1, 2, 0, 1, 2.0], [9.0, 9.1, 9.2, 0.1, 0.2, 0.3], (3, 3), angles=(True,))
    assert torch.equal(data.unwrapped().q, data.q)


def test_huge_values_in_other_columns_survive_unwrapping():  # fails if inf · False = nan reaches a plain column
    big = [[0.0, 1e308], [0.1, -1e308], [0.2, 1e308]]
    data = Trajectories.of([0, 1, 2], big, angles=(True, False))
    assert torch.equal(data.unwrapped().q, data.q)


def test_with_angles():  # fails if the unit or the other flags are not updated
    data = ragged().with_angles("y")
    assert (data.angles, data.units) == ((False, True), ("1", "rad"))
    assert data.with_angles(()).angles == (False, False)
    with pytest.raises(InputError, match=r"set: angles names 'z', but the coordinates are x, y"):
        data.with_angles(["z"])
    with pytest.raises(InputError, match="the angle 'y' is in 'deg'; convert it to radians"):
        replace(ragged(), units=("1", "deg")).with_angles(["y"])


def test_digest_sees_contents_only():  # fails if a field does not enter the digest, or the source does
    data = full()
    assert data.digest() == replace(data, source="elsewhere").digest() == full().digest()
    assert data.s is not None
    assert data.p is not None
    assert data.u is not None
    others = [
        replace(data, t=data.t + 1e-9),
        replace(data, q=data.q + 1e-9),
        replace(data, s=None),
        replace(data, s=data.s + 1),
        replace(data, p=data.p + 1),
        replace(data, u=data.u + 1),
        replace(data, u=torch.cat([data.u, data.u], 1)),
        replace(data, s=None, p=None, u=data.s[:, None]),
        replace(data, p=None, u=None),
        replace(data, names=("x", "z")),
        replace(data, units=("1", "m")),
        replace(data, time_unit="ms"),
        data.with_angles("x"),
        data.to(torch.float32),
        data.select([0, 2, 1]),
        Trajectories.cat([data.select([0, 1]), data.select([2])]),  # the same set again
    ]
    digests = [other.digest() for other in others]
    assert digests.pop() == data.digest()
    assert len({data.digest(), *digests}) == len(digests) + 1


def test_summary():  # fails if a count, a unit or the gaps are missing
    assert full().summary() == "set: 3 trajectories, 13 samples of x [1], y [1], s, p, input u; step 0.1 s, 2 gaps"
    one = Trajectories.of([0, 1, 2], [0, 1, 2], time_unit="1", names=("x",), units=("m",))
    assert one.summary() == "trajectories: 1 trajectory, 3 samples of x [m]; step 1"


def test_inputs_before_the_first_sample_that_is_kept_act_on_none():
    # fails if the first sample cannot be left out, or the input beside it acts at the end of the trajectory before
    t = torch.arange(5.0).repeat(2)
    data = Trajectories.of(t, t[:, None], (5, 5), u=torch.arange(10.0)[:, None])
    kept = data.keep(torch.tensor([False, True, False, True, True, False, True, True, True, True]))
    assert kept.u is not None
    assert kept.u.flatten().tolist() == [1.5, 3.0, 4.0, 6.0, 7.0, 8.0, 9.0]


def test_a_trajectory_without_enough_samples_is_left_out():
    # fails if a recording of which 2 samples are left ends a fit, or one without a sample has a length of 0
    t = torch.arange(5.0).repeat(3)
    data = Trajectories.of(t, t[:, None], (5, 5, 5), u=torch.arange(15.0)[:, None])
    good = torch.tensor([True, True, False, True, True, False, True, True, False, False, True, True, True, True, False])
    kept = data.keep(enough(good, data.lengths))
    assert kept.u is not None
    assert (kept.lengths, kept.t.tolist()) == ((4, 4), [0.0, 1.0, 3.0, 4.0, 0.0, 1.0, 2.0, 3.0])
    assert kept.u.flatten().tolist() == [0.0, 1.5, 3.0, 4.0, 10.0, 11.0, 12.0, 13.0]


@pytest.mark.parametrize(("way", "every"), [(4, 1), (-4, 1), (17, 4)])
@pytest.mark.parametrize("place", [0.05, 0.5, 0.95])
def test_a_turn_between_two_steps_is_not_lost(way, every, place):
    # fails if a sample between both ends of a jump, as resampling leaves one, makes two steps of less than π, and the
    # turn is lost; if the turn is looked for across two recordings; or if a second pass counts it twice
    t = torch.arange(200).double() * 0.1
    true = way * t + 0.3 * torch.sin(2 * t)
    q = torch.remainder(true + torch.pi, 2 * torch.pi) - torch.pi
    jumps = (q.diff().abs() > torch.pi).nonzero()[:, 0]
    wrong = jumps[(jumps > 3) & (jumps < 190)][
        ::every
    ]  # the last sample before each jump is somewhere between its neighbours
    before, after = q[wrong - 1].clone(), q[wrong + 1].clone()
    q[wrong] = before + place * (after - before)
    data = Trajectories.of(torch.cat([t, t]), torch.cat([q, q]), (200, 200), angles=(True,), units=("rad",)).unwrapped()
    good = torch.ones(200, dtype=torch.bool)
    good[wrong] = False
    assert len(wrong) >= 11
    for own in data.q[:, 0].split(200):
        assert torch.allclose(own[good] - own[0], true[good] - true[0], atol=1e-9)
    assert torch.equal(data.unwrapped().q, data.q)


def test_counted_turns_are_kept():
    # fails if an angle of many turns, which moves by more than π a sample, is unwrapped, or stops another trajectory
    t = torch.arange(100).double() * 0.1
    q = torch.cat([40 * torch.cos(1.1 * t), torch.remainder(20 * t, 2 * torch.pi)])
    data = Trajectories.of(torch.cat([t, t]), q, (100, 100), angles=(True,), units=("rad",)).unwrapped()
    assert torch.equal(data.q[:100, 0], q[:100])
    assert torch.allclose(data.q[100:, 0], 20 * t, atol=1e-9)


@pytest.mark.parametrize("size", [1.7, 2.4, 3.1, -3.1, 3.14159])
@pytest.mark.parametrize("row", [3, 20, 56])
def test_a_wrong_sample_is_no_turn(size, row):
    # fails if a gross error beside a step is taken for a share of a turn, and all samples behind it move by 2π
    t = torch.arange(60).double() * 0.1
    q = 0.3 * torch.sin(2 * t)
    wrong = q.clone()
    wrong[row] += size
    found = Trajectories.of(t, wrong, angles=(True,), units=("rad",)).unwrapped().q[:, 0]
    good = torch.arange(60) != row
    assert torch.allclose(found[good], q[good], atol=1e-12)
