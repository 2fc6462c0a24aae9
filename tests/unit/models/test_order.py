"""The order of the terms' splitting, measured on a nonlinear damped problem with irregular steps."""

import pytest
import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.terms import AffineDamping
from herglotz.scenes import scene
from herglotz.stepping import Stepper


def pendulum_model(gamma):
    return ContactLagrangian(ModelConfig(rate=gamma, potential_width=0))


def error(model, flow, steps):
    """Position error at t = 2 with steps that alternate 1 : 2."""
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in ([[1.2]], [[0.7]], [0.3]))
    h = torch.tensor([1.0, 2.0], dtype=torch.float64).repeat(steps // 2)
    h = h * 2 / h.sum()
    with torch.no_grad():
        end = Stepper(model).rollout(q, p, s, h=h).final
    exact = flow(q, p, s, 2.0)
    return torch.stack([(end.q - exact[0]).abs().max(), (end.p - exact[1]).abs().max(), (end.s - exact[2]).abs().max()])


def test_linear_level_is_second_order_on_irregular_steps():
    # fails if √c or c is missing from the kinetic or potential weight: order 1 then (trap 1)
    slope = torch.log2(error(pendulum_model(0.6), scene("damped_pendulum", gamma=0.6).flow, 40) /
                       error(pendulum_model(0.6), scene("damped_pendulum", gamma=0.6).flow, 80))  # fmt: skip
    assert slope.tolist() == pytest.approx([2, 2, 2], abs=0.1)


def test_affine_level_is_second_order_on_the_parachute():
    # fails if the drag λ enters c with the wrong factor: c = e^{2λΔ}
    lam = 0.05
    model = ContactLagrangian(
        ModelConfig(angles=(False,), level="affine", rate=0.0, damping_width=0, potential_width=0, stiffness=(0.0,))
    )
    # V = (mg/2λ)(e^{2λq} − 1) is no polynomial: check the drag alone, g = 0
    assert isinstance(model.damping, AffineDamping)
    with torch.no_grad():
        model.damping.drag.fill_(2 * lam)
    flow = scene("parachute", g=0.0, lam=lam).flow
    errors = [error(model, flow, steps)[:1] for steps in (40, 80)]
    assert float(torch.log2(errors[0] / errors[1])) == pytest.approx(2, abs=0.1)
