"""Averages of inputs, the liveliest samples, seals and hints: small parts of the readers and of smoothing."""

import io

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories
from herglotz.data.files import DIGITS, ONNX_ENTRY, check_seal, sealed_bytes, sealed_onnx, sealed_text, sealed_zip
from herglotz.data.smoothing import _quality, local_polynomials, smooth_triples
from herglotz.data.splits import MIN_ROW, liveliest_rows
from herglotz.errors import InputError

F64 = torch.float64


def test_inputs_are_averaged_over_the_window():
    # fails if the weights do not divide out, or the input of another step than each own is taken: one that grows with
    # time averages to the middle, half a step back, as an input holds for the step that it begins
    t = torch.arange(60, dtype=torch.float64) * 0.1
    data = Trajectories.of(t, t.sin()[:, None], (60,), u=t[:, None])
    local = local_polynomials(data)
    assert local is not None
    triples, u = smooth_triples(data, local)
    assert u is not None
    torch.testing.assert_close(u[:, 0], t[local.centred] - 0.05, rtol=0, atol=1e-12)
    assert len(triples) == int(local.centred.sum())


def test_the_liveliest_run_is_taken_whole():
    # fails if the run starts where less moves, or ends before it began
    q = torch.zeros(4 * MIN_ROW, 1, dtype=torch.float64)
    q[3 * MIN_ROW - 60 : 3 * MIN_ROW - 40, 0] = torch.arange(20, dtype=torch.float64)
    rows, kept = liveliest_rows(q, (4 * MIN_ROW,), MIN_ROW)
    first = int(rows[0])
    assert kept == (MIN_ROW,)
    assert rows.tolist() == list(range(first, first + MIN_ROW))
    assert first <= 3 * MIN_ROW - 60 < 3 * MIN_ROW - 40 <= first + MIN_ROW


def test_the_length_of_the_seal_of_onnx():
    # fails if the message's length is not that of the bytes which follow it: another reader then sees no entry
    assert ONNX_ENTRY[1] == len(ONNX_ENTRY) - 2 + DIGITS


def table_of(names, units, *columns):
    """Lines of the table of columns, for lengths of these names and units."""
    q = torch.zeros(3, len(names), dtype=F64)
    data = Trajectories.of([0.0, 1.0, 2.0], q, names=names, units=units, source="a.csv", columns=columns)
    return data.table().splitlines()


def test_only_an_angular_name_without_a_unit_gets_the_hint():
    # fails if a length is asked whether it is an angle
    said = table_of(("x", "theta"), ("m", "1"), ("x", "coordinate", "m"), ("theta", "coordinate", ""))
    assert "an angle" not in next(line for line in said if line.split()[0] == "x")
    assert "--angles theta" in next(line for line in said if line.split()[0] == "theta")


def test_a_column_that_was_left_out_keeps_its_unit():
    # fails if what a coordinate was made of is looked up for a column that is none
    said = table_of(("x",), ("m",), ("x", "coordinate", "mm"), ("y", "coordinate", "cm"))
    assert [line.split()[2:] for line in said[-2:]] == [["mm,", "converted", "to", "m"], ["cm"]]


@pytest.mark.parametrize("degree", [4, 6])
def test_the_residual_is_divided_by_its_degrees_of_freedom(degree):
    # fails if a window of nine samples leaves (9 - d - 1)/9 of the noise, and not all of it. Over 20 seeds the variance
    # of 3000 samples came out 6 % below to 12 % above the noise's.
    t, noise = (
        torch.arange(3000, dtype=F64),
        torch.randn(3000, 1, generator=torch.Generator().manual_seed(0), dtype=F64),
    )
    left, _ = _quality(Trajectories.of(t, noise), 9, degree)
    assert left == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("since", [0.0, 1e6])
def test_windows_of_one_clock_share_their_matrices(monkeypatch, since):
    # fails if the matrix that most windows share is that of the end of a recording, or times late on a clock are told
    # apart by their rounding: a matrix of its own for each of 166 500 windows took 8 s
    t = since + 0.02 * torch.arange(401, dtype=F64).repeat(4)
    data = Trajectories.of(t, t.sin(), (401,) * 4)
    made, plain = [], torch.linalg.qr
    monkeypatch.setattr(torch.linalg, "qr", lambda A: made.append(len(A)) or plain(A))
    local = local_polynomials(data)
    assert local is not None
    # One for all of 1604 windows but those near an end.
    assert made[-1] <= 1 + 4 * local.width < 500
    rows = local.start[:, None] + torch.arange(local.width)
    x = (t[rows] - t[:, None]) / local.half[:, None]
    exact = torch.linalg.lstsq(torch.stack([x**k for k in range(local.coefficients.shape[1])], -1), data.q[rows])
    assert float((local.at(0.0) - exact.solution[:, 0]).abs().max()) < 1e-9


def test_no_window_is_wider_than_half_the_recording():
    # fails if a window of nearly all samples is tried, which noise without motion then asks for
    noise = torch.randn(20, 1, generator=torch.Generator().manual_seed(0), dtype=F64)
    local = local_polynomials(Trajectories.of(torch.arange(20, dtype=F64), noise))
    assert local is not None
    assert local.width == 9


def test_every_seal_is_of_all_bytes_before_it():
    # fails if a sealed archive no longer opens, a changed byte passes, or a line end counts as a change
    content = io.BytesIO()
    np.savez(content, q=np.arange(3.0))
    archive = sealed_zip(content.getvalue())
    assert np.load(io.BytesIO(archive))["q"].tolist() == [0, 1, 2]
    for sealed in (archive, sealed_onnx(b"message"), sealed_bytes(b"library")):
        check_seal(sealed, "a")
        with pytest.raises(InputError, match="a: its sha256 is not the one it was written with: it was damaged"):
            check_seal(bytes([sealed[0] ^ 1]) + sealed[1:], "a")
        with pytest.raises(InputError, match="a: does not end with its sha256: it was cut off"):
            check_seal(sealed[:-1], "a")
    header = sealed_text("int x;\n").encode()
    check_seal(header, "a.h", text=True)
    check_seal(header.replace(b"\n", b"\r\n"), "a.h", text=True)
    for other in (archive, b"PK\5\6" + bytes(18)[:-1] + b"\1"):
        with pytest.raises(ValueError, match="not a zip archive without a comment"):
            sealed_zip(other)
