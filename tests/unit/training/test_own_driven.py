"""An L_d of one's own with inputs: its parameters and those of its inputs are found, by batches and in float32 too."""

from typing import Any

import pytest
import torch
from torch import nn

import herglotz as hz
from herglotz.mechanics import Forced, Partials, autograd_partials
from herglotz.models import OwnLagrangian
from herglotz.training.problems.one_step import ResidualProblem

H = 0.1


class Motor(nn.Module):
    """v²/2 − k q²/2 − γs + b u q at both ends of a step; u moves a support, whose height b is learned."""

    def __init__(self, k=1.0, gamma=0.0, b=0.0, dtype=torch.float64):
        super().__init__()
        self.k, self.gamma, self.b = (nn.Parameter(torch.tensor(x, dtype=dtype)) for x in (k, gamma, b))

    def forward(self, q0, q1, s0, h):
        v = (q1 - q0) / h[..., None]
        V = self.k * ((q0 * q0).sum(-1) + (q1 * q1).sum(-1)) / 4
        return h * ((v * v).sum(-1) / 2 - V - self.gamma * s0)

    def at(self, u):
        return lambda q0, q1, s0, h: self(q0, q1, s0, h) + h * self.b * (u * (q0 + q1)).sum(-1) / 2


class ClosedMotor(Motor):
    """The same with its derivatives written out."""

    def at(self, u):
        return ClosedStep(self, u)


class ClosedStep:
    def __init__(self, motor, u):
        self.motor, self.u = motor, u

    def __call__(self, q0, q1, s0, h):
        return self.partials(q0, q1, s0, h).L

    def partials(self, q0, q1, s0, h, order=1):
        m, h = self.motor, torch.as_tensor(h).expand(s0.shape)[..., None]
        v, push = (q1 - q0) / h, h * m.b * self.u / 2
        L = Motor.at(m, self.u)(q0, q1, s0, h[..., 0])
        D1, D2 = -v - h * m.k * q0 / 2 + push, v - h * m.k * q1 / 2 + push
        D3 = -m.gamma * h[..., 0]
        if order == 1:
            return Partials(L, D1, D2, D3)
        one, zero = torch.eye(q0.shape[-1]).to(q0), torch.zeros_like(q0)
        own = (1 / h - h * m.k / 2)[..., None] * one
        return Partials(L, D1, D2, D3, own, -one / h[..., None], own, zero, zero, torch.zeros_like(s0))


class Braked(Motor):
    """The same with viscous friction as a discrete force of each step, beside the input."""

    def at(self, u):
        return BrakedStep(self, u)


class BrakedStep:
    def __init__(self, motor, u):
        self.motor, self.plain = motor, Motor.at(motor, u)

    def __call__(self, q0, q1, s0, h):
        return self.plain(q0, q1, s0, h)

    def forces(self, q0, q1, s0, h):  # noqa: ARG002  one signature for all
        half = -(q1 - q0) * 0.15
        return half, half


def recorded(motor, trajectories=2, steps=40, dtype=torch.float64):
    """Exact motions of a motor under inputs that are drawn."""
    make = torch.Generator().manual_seed(1)
    u = torch.randn(trajectories, steps + 1, 1, generator=make, dtype=torch.float64)
    q = torch.linspace(0.3, 1.0, trajectories, dtype=torch.float64)[:, None]
    with torch.no_grad():
        out = hz.Stepper(motor).rollout(q, 0 * q, h=H, inputs=u[:, :-1])
    t = (H * torch.arange(steps + 1, dtype=torch.float64)).repeat(trajectories)
    lengths = (steps + 1,) * trajectories
    return hz.Trajectories.of(t, out.q.flatten(0, 1), lengths, u=u.flatten(0, 1)).to(dtype=dtype)


TRUE: Any = {"k": 1.7, "gamma": 0.2, "b": 0.6}


@pytest.mark.parametrize("kind", [Motor, ClosedMotor])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_parameters_of_an_l_d_and_of_its_inputs_are_found(kind, dtype):
    # fails if u of another step acts, a parameter inside at(u) is not trained, or float32 is left
    net = kind()
    run = hz.fit(recorded(Motor(**TRUE), dtype=dtype), model=net, dtype=str(dtype)[6:])
    close = 1e-6 if dtype == torch.float64 else 3e-3  # of q at float32, over h² as a force
    for name, value in TRUE.items():
        assert net.get_parameter(name).dtype == dtype
        assert float(net.get_parameter(name).detach()) == pytest.approx(value, rel=close), name
    assert run.metrics["verdict"].startswith("fits")


def test_closed_derivatives_of_a_driven_l_d_are_those_of_autograd():
    # fails if `at` leaves the closed form out, or a sample takes the input of another
    q0, q1, u = torch.randn(3, 5, 1, generator=torch.Generator().manual_seed(0)).double()
    s, h = torch.linspace(-1, 1, 5).double(), torch.linspace(0.05, 0.2, 5).double()
    slow = autograd_partials(Motor(**TRUE).at(u), q0, q1, s, h, 2)
    for kind in (Motor, ClosedMotor):
        fast = OwnLagrangian(kind(**TRUE), 1, inputs=1).at(u).partials(q0, q1, s, h, 2)
        for name in ("L", "D1", "D2", "D3", "D11", "D12", "D22", "D13", "D23", "D33"):
            assert torch.allclose(getattr(fast, name), getattr(slow, name), rtol=1e-12, atol=1e-13), name


def test_forces_of_a_driven_l_d_act():  # fails if F⁻ or F⁺ is lost inside `at`, or the map passes for a contact map
    q0, q1, u = torch.randn(3, 5, 1, generator=torch.Generator().manual_seed(0)).double()
    s, h = torch.zeros(5).double(), torch.tensor(H).double()
    model = OwnLagrangian(Braked(**TRUE), 1, inputs=1)
    L_d = model.at(u)
    assert model.config.level == "forced"
    assert OwnLagrangian(Motor(), 1, inputs=1).config.level == "full"
    found = L_d.forces(q0, q1, s, h)
    assert isinstance(L_d, Forced)
    assert found is not None
    assert torch.equal(found[0], -(q1 - q0) * 0.15)
    assert OwnLagrangian(Motor(), 1, inputs=1).at(u).forces(q0, q1, s, h) is None
    fast, slow = L_d.partials(q0, q1, s, h, 2), autograd_partials(L_d, q0, q1, s, h, 2)
    assert fast.force is not None
    assert slow.force is not None
    assert torch.allclose(fast.force.minus_1, slow.force.minus_1)
    inputs, q = torch.linspace(-1, 1, 20).double()[:, None], torch.ones(1).double()
    braked, free = (hz.Stepper(x(**TRUE)).rollout(q, 0 * q, h=H, inputs=inputs).q for x in (Braked, Motor))
    assert float((braked - free).detach().abs().max()) > 0.05


def test_batches_are_taken(monkeypatch):  # fails if `batch` is accepted and all rows are taken
    sizes, whole = [], ResidualProblem.cost_and_gradient
    monkeypatch.setattr(
        ResidualProblem, "cost_and_gradient",
        lambda problem, x, rows: sizes.append(len(rows)) or whole(problem, x, rows),
    )  # fmt: skip
    net, data = Motor(), recorded(Motor(**TRUE))
    settings = {"optimiser": "adam", "batch": 16, "iterations": 4, "learning_rate": 0.1}
    run = hz.fit(data, model=net, objective="residual", **settings)
    assert max(sizes) == 16
    assert run.history[-1]["cost"] < 0.1 * run.history[0]["cost"]


def test_batches_of_an_l_d_whose_motion_depends_on_s_are_refused():  # fails if s of a batch starts at 0 in silence
    class Bent(Motor):
        def forward(self, q0, q1, s0, h):
            return super().forward(q0, q1, s0, h) - 0.1 * h * s0 * s0

    with pytest.raises(hz.InputError, match=r"depends on s.*leave batch out"):
        hz.fit(recorded(Motor(**TRUE)), model=Bent(), optimiser="adam", batch=16, objective="residual")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no GPU")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_fit_on_a_gpu_is_that_of_the_cpu(dtype):  # fails if a tensor of the fit stays on the other device
    nets = Motor(), Motor()
    data = recorded(Motor(**TRUE), dtype=dtype)
    runs = [
        hz.fit(data, model=net, dtype=str(dtype)[6:], device=device, objective="trajectory")
        for net, device in zip(nets, ("cpu", "cuda"), strict=True)
    ]
    close = 1e-7 if dtype == torch.float64 else 3e-3
    for a, b in zip(*(net.parameters() for net in nets), strict=True):
        assert b.device.type == "cpu"
        assert float(b.detach()) == pytest.approx(float(a.detach()), rel=close)
    assert all(run.rollout(10).ok for run in runs)
