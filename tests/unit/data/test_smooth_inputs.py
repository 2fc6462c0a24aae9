"""Averages of inputs, the liveliest samples, seals and hints: small parts of the readers and of smoothing."""

import torch

from herglotz.data import Trajectories
from herglotz.data.checks import Labels
from herglotz.data.column_table import column_table
from herglotz.data.seal import ONNX_ENTRY, SIZE
from herglotz.data.smoothing import local_polynomials, smooth_triples
from herglotz.data.splits import RUN, liveliest_rows


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
    q = torch.zeros(4 * RUN, 1, dtype=torch.float64)
    q[3 * RUN - 60 : 3 * RUN - 40, 0] = torch.arange(20, dtype=torch.float64)
    rows, kept = liveliest_rows(q, (4 * RUN,), RUN)
    first = int(rows[0])
    assert kept == (RUN,)
    assert rows.tolist() == list(range(first, first + RUN))
    assert first <= 3 * RUN - 60 < 3 * RUN - 40 <= first + RUN


def test_the_length_of_the_seal_of_onnx():
    # fails if the message's length is not that of the bytes which follow it: another reader then sees no entry
    assert ONNX_ENTRY[1] == len(ONNX_ENTRY) - 2 + SIZE


def test_only_an_angular_name_without_a_unit_gets_the_hint():
    # fails if a length is asked whether it is an angle
    labels = Labels(("x", "theta"), ("m", "1"), (False, False), "s")
    said = column_table([("x", "coordinate", "m"), ("theta", "coordinate", "")], labels, "a.csv").splitlines()
    assert "an angle" not in next(line for line in said if line.split()[0] == "x")
    assert "--angles theta" in next(line for line in said if line.split()[0] == "theta")
