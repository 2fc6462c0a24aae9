"""The npz format: exact round trips, messages, damaged files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_csv_format import rich

from herglotz.data import Trajectories, read_npz, write_npz
from herglotz.errors import InputError

T3, Q3 = np.arange(3.0), np.zeros((3, 1))


def read(folder: Path, **arrays) -> Trajectories:
    np.savez(folder / "d.npz", **arrays)
    return read_npz(folder / "d.npz")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_round_trip_is_exact(tmp_path, dtype):  # fails if an array, a label or the dtype is lost
    data = replace(rich().select([0]).to(dtype), recordings=("run 7",))
    write_npz(tmp_path / "a.npz", data)
    back = read_npz(tmp_path / "a.npz")
    assert back.digest() == data.digest()
    assert back.recordings == ("run 7",)
    assert [x.name for x in tmp_path.iterdir()] == ["a.npz"]


def test_source_comes_along(tmp_path):  # fails if the provenance is dropped
    write_npz(tmp_path / "a.npz", Trajectories.of(T3, Q3, source="lab 7"))
    assert read_npz(tmp_path / "a.npz").source == "lab 7"


def test_arrays_alone_are_enough(tmp_path):  # fails if metadata or lengths are demanded, or integers refused
    data = read(tmp_path, t=np.array([0, 1, 2, 0, 1, 2]), q=np.arange(6), lengths=np.array([3, 3], dtype=np.uint8))
    assert (data.lengths, data.names, data.source, data.q.dtype) == ((3, 3), ("q",), "d.npz", torch.float64)
    big = read(tmp_path, t=T3.astype(">f8"), q=Q3.astype(">f8"))  # fails if another byte order is refused
    assert big.t.tolist() == [0, 1, 2]


# Each line fails if that check is dropped.
@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"q": Q3}, r"d.npz: there is no array 't', only q; add it: numpy.savez"),
        ({"t": T3}, r"d.npz: there is no array 'q', only t;"),
        ({}, r"d.npz: there is no array 't', only none"),
        ({"\n": T3}, r"d.npz: there is no array 't', only '.n';"),  # else the message has two lines
        ({"t": T3, "q": np.array([{}, 1, 2])}, r"d.npz: array 'q' holds Python objects, which are never loaded"),
        ({"t": T3, "q": Q3 + 1j}, r"d.npz: array 'q' has dtype complex128; save it as float64"),
        ({"t": T3, "q": np.array([-(2**60), 0, 1])}, r"d.npz: array 'q' has integers above 2\^53"),
        ({"t": T3, "q": np.array(["a", "b", "c"])}, r"d.npz: array 'q' has dtype <U1; save it as float64"),
        ({"t": T3, "q": Q3, "lengths": np.array([3.0])}, r"array 'lengths' must hold integers in one row, got float64"),
        ({"t": T3, "q": Q3, "lengths": np.array(3)}, r"array 'lengths' must hold integers in one row, got int64 \(\)"),
        ({"t": T3, "q": Q3, "lengths": np.array([4])}, r"d.npz: lengths add up to 4 but t has 3 samples"),
        ({"t": T3, "q": Q3, "metadata": np.array("{")}, "must hold named entries"),
        ({"t": T3, "q": Q3, "metadata": np.array("[]")}, "must hold named entries"),
        ({"t": T3, "q": Q3, "metadata": np.array([0x110000], "<u4").view("<U1")}, "must hold named entries"),
        (
            {"t": T3, "q": Q3, "metadata": np.array('{"names": "q"}')},
            r"'metadata'.*: names must be list.str., got 'q' .*drop it",
        ),
        ({"t": T3, "q": Q3, "metadata": np.array('{"angles": [1]}')}, r"'metadata'.*: angles must be list.bool., got"),
        (
            {"t": T3, "q": Q3, "metadata": np.array('{"columns": [["q", "coordinate"]]}')},
            "d.npz: 'metadata'.*: columns",
        ),
        ({"t": T3[:1], "q": Q3[:1]}, r"d.npz: trajectory 0 has 1 sample, at least 3 are needed"),
        ({"t": T3[::-1], "q": Q3}, r"d.npz: t of trajectory 0 does not increase from sample 0 to 1"),
        ({"t": T3, "q": Q3 * np.nan}, r"d.npz: q\[0\] of trajectory 0, sample 0, is nan"),
    ],
)
def test_every_mistake_has_its_message(tmp_path, arrays, message):
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, **arrays)
    assert "\n" not in str(caught.value)


def test_not_an_archive(tmp_path):  # fails if numpy's advice to allow pickle reaches the user
    (tmp_path / "a.npz").write_bytes(b"hello")
    with pytest.raises(InputError, match=r"a.npz: is not a .npz archive; write it with numpy.savez"):
        read_npz(tmp_path / "a.npz")
    with pytest.raises(InputError, match="there is no such file"):
        read_npz(tmp_path / "b.npz")


def test_unknown_labels_are_ignored(tmp_path):  # fails if a newer file with more metadata is refused
    data = read(tmp_path, t=T3, q=Q3, metadata=np.array(json.dumps({"names": ["z"], "camera": "red"})))
    assert data.names == ("z",)
    # fails if the order of bytes, or the zeros that numpy fills a text up with, are not looked at
    swapped = np.array('{"names": ["größe"]}', dtype=">U40")
    assert read(tmp_path, t=T3, q=Q3, metadata=swapped).names == ("größe",)
