"""A payload as one number: in a header as in the model, and found online by the filter."""

import math

import pytest
import torch
from test_c_parameters import COMPILER

from herglotz.errors import InputError
from herglotz.export import compile_c, export_c, load_c
from herglotz.export.load import _is_of, read_header
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.numbers import chosen, combined, values_of, with_values
from herglotz.stepping import State, Stepper
from herglotz.stepping.filter import KalmanFilter, Noise

pytestmark = pytest.mark.skipif(COMPILER is None, reason="neither gcc nor clang in the PATH")
H, SENSOR, CHANGE, AHEAD = 0.02, 1e-3, 50, 50
NAMES = ["kinetic.base.log_diagonal", "kinetic.sum.coefficient", "potential.stiffness", "friction.viscous",
         "friction.input_map"]  # fmt: skip


def arm(second):
    """Two links of point masses, 0.3 m each, of 1 kg and `second`, with motors."""
    ones = (1.0, 1.0)
    config = ModelConfig((True, True), "forced", ones, (3.0, 3.0), (9.0, 9.0), (0.0, 0.0), rate=0.0, potential_width=0,
                         features=("cos(q1 - q2) v1 v2",), inputs=2, diagonal=True)  # fmt: skip
    whole, tip = (1.0 + second) * 0.09, second * 0.09
    numbers = (0.5 * math.log(tip / whole), tip / whole, 32.7, 2.943 * second / whole, 0.05 / whole, 0.03 / whole,
               1 / whole, -1 / whole, 0.0, 1 / whole)  # fmt: skip
    model = ContactLagrangian(config).requires_grad_(False).double()
    return with_values(model, dict(zip(chosen(model, NAMES), numbers, strict=True)))


def with_payload(model):
    """The arm with a number `payload`: 1 doubles the second link."""
    names = chosen(model, NAMES)
    return combined(model, "payload", dict(zip(names, values_of(arm(1.6), names), strict=True)))


def test_a_header_moves_all_numbers(tmp_path):
    # fails if a number does not follow in a step, a momentum, the map of inputs or a derivative, or the header cannot
    # be generated again from the model and its own metadata
    model = with_payload(arm(0.8))
    path = export_c(model, tmp_path / "arm.h", h=H, parameters={"payload": (-0.3, 2.0)})
    text, _ = read_header(path)
    assert _is_of(text, path, arm(0.8))
    assert not _is_of(text, path, arm(0.9))
    values = {"payload": 0.4}
    ours, eager = load_c(path).with_parameters(values), Stepper(with_values(model, values), tol=4e-16)
    x = 0.7 * torch.randn(3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    state, u = State(x[:, :2], x[:, 2:], x[:, 0]), torch.tensor([[0.2, -0.1]], dtype=torch.float64).expand(3, 2)
    found, wanted = ours.linearise(state, H, u), eager.linearise(state, H, u, ["payload"])
    for a, b in ((found.step.state, wanted.step.state), (found.by_parameters, wanted.by_parameters)):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)
    with torch.no_grad():
        torch.testing.assert_close(ours.init_qv(*state, h=H).p, eager.init_qv(*state, H).p, rtol=1e-12, atol=1e-12)
    with pytest.raises(InputError, match=r"payload is 0\.4 in the model; export the model at 0"):
        export_c(with_values(model, values), tmp_path / "x.h", h=H, parameters=["payload"])


def test_a_changed_payload_is_found_in_five_seconds():
    # fails if the filter does not follow θ, or takes it for another number: 5 s after the second link got 30 % heavier
    # what is predicted a second ahead errs by at most 1.2 times what the true numbers, known all the time, leave
    old, new = arm(0.8), arm(1.04)
    make = torch.Generator().manual_seed(1)
    rest = State(*(torch.zeros(size, dtype=torch.float64) for size in (2, 2, ())))
    t = H * torch.arange(CHANGE + 250 + 2 * AHEAD, dtype=torch.float64)
    u = torch.stack([0.6 * (5.0 * t).sin() + 0.4 * (2.3 * t).sin(), 0.3 * (7.1 * t).sin()], -1)
    with torch.no_grad():
        first = Stepper(old).rollout(*rest, h=H, steps=CHANGE,
                                     inputs=u[:CHANGE])  # fmt: skip
        there = State(first.q[-1], first.p[-1], first.s[-1])
        start = Stepper(new).init_qv(there.q, Stepper(old).velocity(there, H), there.s, H)
        then = Stepper(new).rollout(*start, h=H, steps=len(t) - CHANGE - 1, inputs=u[CHANGE:-1])
    q = torch.cat([first.q[:-1], then.q])
    y = q + SENSOR * torch.randn(q.shape, generator=make, dtype=torch.float64)
    rows = range(CHANGE + 250, CHANGE + 250 + AHEAD, 5)

    def followed(model, names, wander, std):
        kalman = KalmanFilter(model, Noise([SENSOR] * 2, [0.01] * 2, wander), names,
                              stepper=compile_c(model, h=H, parameters=names))  # fmt: skip
        belief = kalman.start(rest, t.new_tensor([1e-3] * 2 + [0.05] * 2 + std))
        misses, theta = [], []
        for k in range(1, rows[-1] + 1):
            belief, _ = kalman.update(kalman.predict(belief, H, u[k - 1]), y[k])
            theta.append(belief.theta)
            if k in rows:
                ahead = kalman.stepper.with_parameters(dict(zip(names, belief.theta.tolist(), strict=True)))
                found = ahead.rollout(*belief.state, h=H, steps=AHEAD, inputs=u[k : k + AHEAD])
                misses.append(found.q[-1] - q[k + AHEAD])
        return float(torch.stack(misses).square().mean().sqrt()), torch.stack(theta)

    best, _ = followed(new, [], [], [])
    ours, theta = followed(with_payload(old), ["payload"], [0.005], [0.05])
    (tip, now, double) = (values_of(x, ["kinetic.sum.coefficient"])[0] for x in (old, new, arm(1.6)))
    print(f"a second ahead: {ours:.2g} rad, {best:.2g} with the true numbers")
    assert theta[CHANGE - 10].abs() < 0.02
    assert abs(float(theta[-1]) - (now - tip) / (double - tip)) < 0.02
    assert ours <= 1.2 * best
