"""The row that compares autograd's DΦ̃ with differences: what hides from autograd passes every other row."""

import numpy as np
import pytest
import torch

from herglotz.export import differences
from herglotz.scenes import scene
from herglotz.stepping import State
from herglotz.verify import verify
from tests.compared import failed
from tests.lagrangians import states


def kinetic(q0, q1, s0, h):
    return ((q1 - q0) ** 2).sum(-1) / (2 * h) - 0.02 * s0


def detached(q0, q1, s0, h):
    return kinetic(q0, q1, s0, h) - h / 2 * (torch.cos(q0) + torch.cos(q1)).detach().sum(-1)


GRID = np.linspace(-20, 20, 400)


def table(q0, q1, s0, h):
    V = torch.as_tensor(np.interp(q0.detach().numpy(), GRID, np.cos(GRID)))
    return kinetic(q0, q1, s0, h) - h * V.sum(-1)


def jump(q0, q1, s0, h):
    return kinetic(q0, q1, s0, h) - 0.1 * h * (q0 > 0.3).double().sum(-1)


@pytest.mark.parametrize("hidden", [detached, table, jump])
def test_what_autograd_does_not_see_fails_this_row_alone(hidden):
    # fails if DΦ̃ is compared with itself: p, c and DΦ̃ share one autograd, and all other identities hold
    report = verify((hidden, states(count=32)), h=0.1)
    assert failed(report) == {"derivative"}, report.table()
    assert report["derivative"].value > 3e-5  # the jump 6e-5, the others 0.1


def test_the_scale_of_the_sample_does_not_matter():
    # fails if offsets are absolute: here q is of size 1e-6, p of 1e16 and s of 1e10
    q, p, s = states(count=32)

    def scaled(q0, q1, s0, h):
        return 1e10 * kinetic(q0 * 1e6, q1 * 1e6, s0 / 1e10, h) + 1e10 * h * torch.cos(1e6 * q0).sum(-1)

    start = State(q * 1e-6, p * 1e16, s * 1e10)
    assert verify((scaled, start), h=0.1, steps=2)["derivative"].value < 1e-10


def test_a_kink_inside_a_stencil_is_met_by_a_narrower_one():
    # fails if one of the two narrower widths is left out: 1.6e-4 at eight points 2e-4 and less from the kink
    def hard(q0, q1, s0, h):
        return kinetic(q0, q1, s0, h) - h * ((0.5 * (q0 + q1)).abs() ** 3).sum(-1)

    q, p, s = states(count=32)
    near = 2e-4 * torch.linspace(-1, 1, 8, dtype=torch.float64)[:, None] - 0.05 * p[:8]  # half a step before
    start = State(torch.cat([near, q[8:]]), p, s)
    assert verify((hard, start), h=0.1, steps=2)["derivative"].passed  # 9e-8, bound 1e-6


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_sound_maps_pass(dtype):
    # fails if the bound is below the rounding of differences, or a stencil is not that of order 8
    start = State(*(x.to(dtype) for x in states(2, 32)))
    report = verify((scene("double_pendulum").L_d, start), h=0.05, steps=3)
    assert report["derivative"].value < (1e-9 if dtype == torch.float64 else 1e-3), report.table()


class Kinked:
    """A force with a kink at q = 0."""

    def __call__(self, q0, q1, s0, h):
        return kinetic(q0, q1, s0, h)

    def forces(self, q0, q1, s0, h):  # noqa: ARG002
        return -0.5 * h * q0.abs(), -0.5 * h * q1.abs()


def test_forces_with_kinks_are_judged_by_the_median():
    # fails if a sample beside a kink, where no derivative exists, is taken for an error
    row = verify((Kinked(), states(count=32)), h=0.1)["derivative"]
    assert row.passed
    assert "median" in row.statement


def test_a_sample_beside_a_failed_step_is_left_out_and_counted():
    # fails if a stencil that leaves the domain of L_d counts as an error, or a row with no sample passes
    def walled(q0, q1, s0, h):
        return kinetic(q0, q1, s0, h) + h * torch.log(q0).sum(-1)

    q, p, s = states(count=32)
    report = verify((walled, State(q.abs() + 0.01, 0.1 * p, s)), h=0.001, steps=2)
    assert "left out: a step beside them failed" in report["derivative"].note
    assert report["derivative"].passed


def test_points_of_many_coordinates_step_in_small_batches(monkeypatch):
    # fails if all points step at once (32 coordinates: 14 GB), or if pieces are put together in another order
    sizes = []

    def f(y):
        sizes.append(len(y))
        return torch.stack([y[:, 0] * y[:, 1], y[:, 1].sin(), y[:, 2] + y[:, 0] ** 3], -1)

    x = torch.rand(5, 3, dtype=torch.float64)
    whole = differences.central_differences(f, x, torch.full((3,), 0.01).double())
    monkeypatch.setattr(differences, "BATCH", 64)
    torch.testing.assert_close(differences.central_differences(f, x, torch.full((3,), 0.01).double()), whole)
    assert sizes == [120, *17 * [7], 1]
