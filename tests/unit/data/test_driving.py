"""Times and recorded inputs of a rollout."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, save
from herglotz.data.driving import START_TOLERANCE, driven, even_times, input_recording
from herglotz.errors import InputError

T = torch.tensor([0.0, 0.1, 0.2, 0.4, 0.5], dtype=torch.float64)
RECORDING = Trajectories.of(T, T, u=torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0]).double(), source="drive.csv")


def test_times_print_as_written():  # fails if rounding of sums shows: 10.7 + 0.1 is 10.799999999999999 in floats
    assert even_times(10.7, 0.09999999999999787, 3).tolist() == [10.7, 10.8, 10.9, 11.0]
    assert even_times(0.0, 1 / 3, 3).tolist()[-1] == pytest.approx(1.0, abs=1e-11)


def test_inputs_act_when_they_were_recorded():  # fails if the first K inputs are taken wherever the run starts
    u, t = driven(RECORDING, 0.2, 2, None)
    assert (u[:, 0].tolist(), t.tolist()) == ([4, 8], [0.2, 0.4, 0.5])
    u, t = driven(RECORDING, 0.1, 2, 0.15)  # 0.1–0.25: 2 for 0.1, 4 for 0.05; 0.25–0.4: 4
    torch.testing.assert_close(u[:, 0], torch.tensor([2 * 2 / 3 + 4 / 3, 4.0]).double())
    torch.testing.assert_close(t, torch.tensor([0.1, 0.25, 0.4]).double())
    u, _ = driven(RECORDING, 0.0, 5, 0.1)  # the whole recording, both ends included
    torch.testing.assert_close(u[:, 0], torch.tensor([1.0, 2, 4, 4, 8]).double())


def test_the_last_input_acts_in_no_step():
    # fails if a run that ends a rounding after the last sample takes its input, which holds for a step never recorded
    found = replace(RECORDING, u=torch.tensor([1.0, 2.0, 4.0, 8.0, 1e12], dtype=torch.float64)[:, None])
    u, _ = driven(found, 0.4, 1, 0.1 * (1 + START_TOLERANCE / 2))
    assert u.item() == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("t0", "steps", "h", "message"),
    [
        (0.3, 1, None, "no sample at the start t = 0.3; the recording spans 0 to 0.5: give t0"),
        (0.2, 3, None, r"3 steps from t = 0.2 need 6 samples, it has 5"),
        (0.2, 4, 0.1, r"the rollout lasts from 0.2 to 0.6, but the recording spans 0 to 0.5"),
        (-0.1, 2, 0.1, r"the rollout lasts from -0.1 to 0.1, but"),
    ],
)
def test_a_rollout_beyond_the_recording_is_refused(t0, steps, h, message):  # fails if inputs of another time are taken
    with pytest.raises(InputError, match=message):
        driven(RECORDING, t0, steps, h)


def test_times_and_inputs_suffice(tmp_path):
    # fails if a file that drives a model must hold positions, or an input is known by the names of inputs alone
    path = tmp_path / "drive.csv"
    path.write_text("t[ms],volts\n0,1\n100,2\n200,4\n")
    found = input_recording(path, 0, "s", known=[["t", "time", "s"], ["volts", "input", ""]])
    assert (found.t.tolist(), found.u.tolist()) == ([0, 0.1, 0.2], [[1], [2], [4]])  # type: ignore[union-attr]
    path.write_text("t,torque\n0,1\n1,2\n2,4\n")
    assert input_recording(path, 0, "s").u.tolist() == [[1], [2], [4]]  # type: ignore[union-attr]
    path.write_text("t,x\n0,1\n1,2\n2,4\n")
    with pytest.raises(InputError, match="holds no inputs, only t, x; name their columns u, u_\\*, force or torque"):
        input_recording(path, 0, "s")


def test_the_recording_of_the_trajectory(tmp_path):  # fails if trajectory 0 drives all, or minutes are read as seconds
    second = Trajectories.of(T, T, u=2 * torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0]).double())
    save(tmp_path / "u.npz", Trajectories.cat([RECORDING, second]))
    assert float(input_recording(tmp_path / "u.npz", 1, "s").u[0]) == 2  # type: ignore[index]
    with pytest.raises(InputError, match="there is no trajectory 2; choose one from 0 to 1"):
        input_recording(tmp_path / "u.npz", 2, "s")
    with pytest.raises(InputError, match="time is in s, the model's in h; convert it"):
        input_recording(tmp_path / "u.npz", 0, "h")
    save(tmp_path / "none.npz", Trajectories.of(T, T))
    with pytest.raises(InputError, match="holds no inputs"):
        input_recording(tmp_path / "none.npz", 0, "s")
