"""The text files of Schmidt & Lipson, on small files of our own."""

import numpy as np
import pytest

from benchmarks.schmidt_lipson import read_schmidt_lipson


@pytest.mark.parametrize(
    ("first", "name", "unit", "q"),
    [("%o v", "theta", "rad", [3, 2 * np.pi - 3, 2 * np.pi - 2.5]), ("% x v", "x", "pixel", [3, -3, -2.5])],
)
def test_angles_and_positions(tmp_path, first, name, unit, q):
    # fails if the trial is taken for the time, v for the coordinate, or positions in pixels are unwrapped
    (tmp_path / "a.txt").write_text(f"{first}\r\n 0 5 3.0e+000 9 \r\n 0 5.5 -3 7 \r\n 0 7 -2.5 8 \r\n")
    data = read_schmidt_lipson(tmp_path / "a.txt")
    assert (data.names, data.units, data.time_unit, data.source) == ((name,), (unit,), "1", "a.txt")
    assert (data.t.tolist(), data.q[:, 0].tolist()) == ([5, 5.5, 7], pytest.approx(q, abs=1e-15))
