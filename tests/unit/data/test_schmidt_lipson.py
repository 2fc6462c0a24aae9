"""Schmidt & Lipson's text format, on small files of our own."""

import pytest

from herglotz.data import read_schmidt_lipson
from herglotz.errors import InputError

ROWS = " 0.0e+000 5.0e+000 1.5 9.0 \r\n 0 5.5 1.25 nan \r\n 0 6.5 1.0 7 \r\n"


def read(folder, text, **options):
    (folder / "real.txt").write_bytes(text.encode())
    return read_schmidt_lipson(folder / "real.txt", **options)


def test_angle_file(tmp_path):  # fails if v is read, the trial is taken for time, or CRLF is refused
    data = read(tmp_path, "%o v\r\n" + ROWS)
    assert (data.names, data.units, data.angles, data.time_unit) == (("theta",), ("rad",), (True,), "1")
    assert data.t.tolist() == [5.0, 5.5, 6.5]
    assert data.q[:, 0].tolist() == [1.5, 1.25, 1.0]
    assert data.source == "real.txt"


def test_position_file_with_trials(tmp_path):  # fails if trials are joined or x is marked as an angle
    second = ROWS.replace(" 0.0e+000", " 1").replace(" 0 ", " 1 ")
    data = read(tmp_path, "% x v\r\n" + ROWS + second)
    assert (data.names, data.units, data.angles, data.time_unit) == (("x",), ("pixel",), (False,), "1")
    assert data.lengths == (3, 3)


def test_two_coordinates(tmp_path):  # fails if the first velocity is read as the second coordinate
    rows = "".join(f"0 {k} {k} {-k} 8 9\n" for k in range(3))
    data = read(tmp_path, "% o1 o2 v1 v2\n" + rows)
    assert data.names == ("theta1", "theta2")
    assert data.q.tolist() == [[0, 0], [1, -1], [2, -2]]


# Each line fails if that check is dropped.
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\r\n", r"real.txt: the first line must be like '% o v' or '% x v', got nothing"),
        ("% temperature v\n" + ROWS, r"the first line must be like .*, got '% temperature v'; is this another format"),
        ("t,q\n0,1\n", r"the first line must be like .*, got 't,q'"),
        ("% o v\n", r"real.txt: there is a header but no samples"),
        ("% o v\n" + ROWS + "0 7 1\n", r"real.txt, row 5: 3 numbers where 4 belong; correct or delete the row"),
        ("% o v\n" + ROWS + "0 7 abc 1\n", r"real.txt, row 5, column 'o': 'abc' is not a number; correct or delete"),
        ("% o v\n" + ROWS + "0 inf 1 1\n", r"real.txt, row 5, column 't': 'inf' is not finite"),
        ("% o v\n" + ROWS + "x 7 1 1\n", r"real.txt, row 5, column 'trial': 'x' is not a number"),
        ("% o v\n" + ROWS + "0 6.25 1 1\n", r"real.txt, row 5, column 't': 6.25 does not increase on 6.5 in row 4"),
        (
            "% o v\n" + ROWS + "3 6.5 1 1\n4 6.5 1 1\n",
            r"row 5, column 'trial': '3' has 1 sample, at least 3 are needed; delete",
        ),
    ],
)
def test_every_mistake_has_its_message(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)
