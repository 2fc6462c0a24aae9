"""Tracked markers of a double pendulum become two angles."""

import math
from pathlib import Path

import pytest
import torch

from benchmarks.ibm_double_pendulum import read_ibm_double_pendulum

MEASURED = Path(__file__).resolve().parents[4] / "shared" / "data" / "ibm_double_pendulum"


def write(path, angles, arms=(590.0, 455.0)):
    """Markers of a pendulum at the given angles, x pointing down."""
    lines = []
    for a, b in angles:
        x, y = 1200 + arms[0] * math.cos(a), 1100 + arms[0] * math.sin(a)
        tip = x + arms[1] * math.cos(b), y + arms[1] * math.sin(b)
        lines.append(",".join(str(round(v)) for v in (1200, 1100, x, y, *tip)))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_angles_are_absolute_from_hanging_down(tmp_path):
    # fails if x and y are swapped, x points up, or the second angle is relative to the first arm
    angles = [(0.0, 0.0), (0.3, -0.2), (0.6, -0.4), (1.5, -2.0)]
    data = read_ibm_double_pendulum(write(tmp_path / "7.csv", angles))
    torch.testing.assert_close(data.q, torch.tensor(angles, dtype=torch.float64), rtol=0, atol=3e-3)
    assert (data.names, data.angles, data.units) == (("theta1", "theta2"), (True, True), ("rad", "rad"))
    torch.testing.assert_close(data.t, torch.arange(4, dtype=torch.float64) / 400)


def test_angles_are_continuous(tmp_path):
    # fails if a turn over the top jumps by 2π
    turns = [(0.2 * k, -0.15 * k) for k in range(60)]
    data = read_ibm_double_pendulum(write(tmp_path / "7.csv", turns))
    torch.testing.assert_close(data.q, torch.tensor(turns, dtype=torch.float64), rtol=0, atol=5e-3)


@pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured double pendulum is not on this machine")
@pytest.mark.parametrize("name", ["2.csv", "3.csv", "4.csv"])
def test_the_measured_runs(name):
    # fails if the published files are not read, frames jump, or the arm comes to rest elsewhere than hanging down
    data = read_ibm_double_pendulum(MEASURED / name)
    assert 17_000 < data.samples < 18_100
    assert float(data.q.diff(dim=0).abs().max()) < 0.4
    assert float(data.q[-2000:, 0].std()) < 0.1 * float(data.q[:2000, 0].std())  # free decay
    assert abs(float(data.q[-2000:, 0].sin().mean())) < 0.1
    assert float(data.q[-2000:, 0].cos().mean()) > 0.8  # it still swings by half a radian
