"""Rows of `verify` for a time-dependent L_d."""

import pytest
import torch

from herglotz.scenes import ExactForcedOscillator
from herglotz.theory import TimeDependent
from herglotz.verify import verify
from tests.lagrangians import pendulum_of_time

EXACT = ExactForcedOscillator(0.9, 1.7, 0.6, m=1.4, omega0=1.3, gamma=0.4)


@pytest.mark.parametrize("L_d", [EXACT, pendulum_of_time])
def test_verify_has_rows_of_time(L_d):
    # fails if a row is computed at another step's time; measured ≤ 2e-14
    report = verify(TimeDependent(L_d, 0.7), h=0.3, samples=24, steps=5)
    assert report.passed
    assert {"time", "momentum", "D2S", "hamilton_jacobi", "left_hamilton_jacobi"} <= {c.name for c in report.checks}
    assert "η + E dt" in report.table()


class Late(TimeDependent):
    """A family whose members are those of a wrong time."""

    def at(self, u):
        return TimeDependent(self.L_d, 0.9 * u[..., 0])


def test_verify_refuses_a_family_at_wrong_times():
    # fails if the row of time looks at the step alone: this null model's step is that of 0.9 t
    report = verify(Late(pendulum_of_time, 0.7), h=0.3, samples=24, steps=5)
    assert not report["time"].passed
    assert report["contact"].passed  # at a fixed time it is a contact map all the same


class Hidden(TimeDependent):
    """A family at the right times, which autograd does not see."""

    def at(self, u):
        return TimeDependent(self.L_d, u[..., 0].detach())


def test_both_directions_of_time_are_judged():
    # fails if the row looks at dh alone, which is right here
    assert not verify(Hidden(pendulum_of_time, 0.7), h=0.3, samples=24, steps=5)["time"].passed


def test_every_step_has_its_own_time():
    # fails if all steps of a motion begin at t0: from the third step on, at t = 1.3, this L_d is no number
    def until(q0, q1, s0, t0, h):
        return torch.where(t0 > 1.2, torch.nan, pendulum_of_time(q0, q1, s0, t0, h))

    assert verify(TimeDependent(until, 0.7), h=0.3, samples=8, steps=2).passed
    assert not verify(TimeDependent(until, 0.7), h=0.3, samples=8, steps=3).passed


def test_rows_of_time_are_measured():
    # fails if a row says 0 whatever it is given: rounding of 24 motions leaves something
    report = verify(TimeDependent(pendulum_of_time, 0.7), h=0.3, samples=24, steps=5)
    assert all(report[name].value > 0 for name in ("time", "momentum"))
