"""Files that are too large, never end, or hold numbers that double precision has not."""

import os
import signal
import zipfile

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, load, npz_format as npz, sheet
from herglotz.data.checks import check_sizes
from herglotz.data.csv_format import read_csv
from herglotz.data.npz_format import read_npz
from herglotz.errors import InputError
from herglotz.training import fit


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_what_is_no_file_is_not_waited_for(tmp_path, kind, suffix):
    # fails if a pipe without a writer blocks for ever, or a device without an end is read into memory
    path = tmp_path / f"motion.{suffix}"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits"))
    signal.alarm(10)
    try:
        with pytest.raises(InputError, match="is a pipe or a device, not a file"):
            load(path)
        if suffix == "csv":
            with pytest.raises(InputError, match="is a pipe or a device, not a file"):
                read_csv(path)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def test_an_archive_says_its_size_before_it_is_inflated(tmp_path, monkeypatch):
    # fails if memory is spent on what a small archive inflates to, or an array that nobody uses is inflated at all
    path, t = tmp_path / "bomb.npz", np.arange(5.0)
    np.savez_compressed(path, t=t, q=t, junk=np.zeros(200_000))
    monkeypatch.setattr(npz, "MAX_BYTES", 100_000)
    monkeypatch.setattr(zipfile.ZipExtFile, "MAX_N", 1 << 20)
    assert read_npz(path).samples == 5
    np.savez_compressed(path, t=t, q=np.zeros(200_000))
    with pytest.raises(InputError, match=r"bomb.npz: its arrays take 0.0 GB of memory, more than 0"):
        read_npz(path)
    damaged = tmp_path / "damaged.npz"
    np.savez(damaged, t=t, q=t, junk=np.full(9, 7.25))
    content = damaged.read_bytes()
    damaged.write_bytes(content.replace(np.full(9, 7.25).tobytes(), np.full(9, 8.25).tobytes()))
    assert read_npz(damaged).samples == 5  # its check sum is wrong, which only who inflates it would know


@pytest.mark.parametrize(("size", "remedy"), [(1e80, "use a larger unit"), (1e-100, "use a smaller unit")])
def test_sizes_whose_squares_are_no_numbers(size, remedy):
    # fails if 1e80 m reaches the fit, which overflowed, or 1e-100 m, whose error was "RMS 0.0, ok"
    t = np.arange(20.0)
    with pytest.raises(InputError, match=remedy):
        fit(Trajectories.of(t, size * np.cos(t), source="motion.csv"))
    check_sizes("data", torch.zeros(3, 1), ("q",))


def test_integers_that_double_precision_has_not(tmp_path):
    # fails if nanoseconds since 1970, or other large integers, are rounded in silence
    t = np.int64(1_763_820_000_000_000_001) + np.arange(4)
    np.savez(tmp_path / "a.npz", t=t, q=np.arange(4.0))
    (tmp_path / "a.csv").write_text("t,q\n" + "".join(f"{k},1\n" for k in t))
    (tmp_path / "b.csv").write_text("t,q\n" + "".join(f"{k},{x}\n" for k, x in enumerate(t)))
    with pytest.raises(InputError, match=r"array 't' has integers above 2\^53"):
        read_npz(tmp_path / "a.npz")
    with pytest.raises(InputError, match=r"row 2, column 'q': '1763820000000000001' is above 2\^53"):
        read_csv(tmp_path / "b.csv")
    assert read_csv(tmp_path / "a.csv").t.tolist() == [0.0, 1.0, 2.0, 3.0]
    np.savez(tmp_path / "b.npz", t=t - t[0], q=np.arange(4))
    assert read_npz(tmp_path / "b.npz").t.tolist() == [0.0, 1.0, 2.0, 3.0]


TABLES = {
    "plain": "t[s],q[rad],u\n0,1.25,3\n0.1,-2e-3,4\n 0.30000000000000004 ,7,5\n",
    "grouped": "# hold: zero\ntrial,t,x,y\n2,0,1,2\n1,0,3,4\n2,1,5,6\n1,1,7,8\n\n2,2,9,1\n1,2,2,3\n# hold: first\n",
    "blanks": "t,x,u\n0,1,\n1,,2\n2,3,\n,,\n3,4,5\n4,5,\n",
    "blanks at the start of rows": "x,t\n1,0\n,1\n2,2\n3,3\n",
    "a text that nobody needs": "t,q,status\n0,1,ok\n1,2,\n2,3,late\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_numbers_are_parsed_as_cell_by_cell(tmp_path, monkeypatch, name):
    # fails if numpy's parser mixes up columns, trajectories or their order, misreads a blank cell, or is never used
    path = tmp_path / "motion.csv"
    path.write_bytes(TABLES[name].encode())
    with monkeypatch.context() as patch:
        patch.setattr(sheet, "number", lambda *_: pytest.fail("parses cell by cell"))
        fast = read_csv(path)
    monkeypatch.setattr(sheet, "EXACT", 0)
    careful = read_csv(path)
    assert fast.digest() == careful.digest()
    assert (fast.columns, fast.hold, fast.lengths) == (careful.columns, careful.hold, careful.lengths)
    assert fast.notes == careful.notes
