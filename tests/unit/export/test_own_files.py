"""An L_d of one's own as C, `.pt2` and ONNX: the motion of the module, and words where it cannot be traced."""

import pytest
import torch
from torch import nn

import herglotz as hz
from herglotz.export import compare, compile_c, export_onnx, export_pt2, load_onnx, load_pt2
from herglotz.models import OwnLagrangian
from tests.compilers import CC

H = 0.1


class Arm(nn.Module):
    """Two coordinates: a mass that depends on position, a network for V, and a term in s² that makes s enter."""

    def __init__(self):
        super().__init__()
        make = torch.Generator().manual_seed(0)
        self.V = nn.Sequential(nn.Linear(2, 6), nn.Tanh(), nn.Linear(6, 1)).double()
        self.rate = nn.Parameter(torch.tensor([0.1, 0.05], dtype=torch.float64))
        with torch.no_grad():
            for x in self.V.parameters():
                x.copy_(torch.randn(x.shape, generator=make).double() / 2)

    def forward(self, q0, q1, s0, h):
        v = (q1 - q0) / h[..., None]
        mean = (q0 + q1) / 2
        K = (v * v).sum(-1) / 2 + 0.3 * torch.cos(mean[..., 0] - mean[..., 1]) * v[..., 0] * v[..., 1]
        V = (self.V(q0) + self.V(q1))[..., 0] / 2 + (q0 * q0).sum(-1)
        return h * (K - V - self.rate[0] * s0 - self.rate[1] * s0 * s0)


class DrivenArm(Arm):
    """The same with three inputs: more than coordinates, and one of them acts through s."""

    def at(self, u):
        return lambda q0, q1, s0, h: self(q0, q1, s0, h) + h * self.power(u, q0, q1, s0)

    @staticmethod
    def power(u, q0, q1, s0):
        return u[..., 0] * q0[..., 0] + u[..., 1] * q1[..., 1] * q0[..., 0] + 0.1 * u[..., 2] * s0


def loaded(kind, model, tmp_path):
    """The stepper of a file of one kind."""
    if kind == "c":
        if CC is None:
            pytest.skip("no C compiler in the PATH")
        return compile_c(model, h=H)
    if kind == "pt2":
        export_pt2(model, tmp_path / "own.pt2", h=H)
        return load_pt2(tmp_path / "own.pt2")
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    export_onnx(model, tmp_path / "own.onnx", h=H)
    return load_onnx(tmp_path / "own.onnx")


# slow: 20 s; test_pt2 has the same of models, and the other files the same of modules
@pytest.mark.parametrize("kind", ["c", pytest.param("pt2", marks=pytest.mark.slow), "onnx"])
def test_a_file_steps_as_the_module(kind, tmp_path):
    # fails if a file has another derivative, rounds its weights, or takes the input of another step
    model = OwnLagrangian(DrivenArm(), 2, inputs=3)
    found = compare(loaded(kind, model, tmp_path), hz.Stepper(model), steps=20, batches=(1, 7), h=H)
    assert found["status"] == found["failed"] == 0
    assert max(found[x] for x in "qpsc") < 4e-14, found


@pytest.mark.parametrize("kind", ["c", "pt2", "onnx"])
def test_a_branch_that_a_file_would_freeze_is_refused(kind, tmp_path):  # fails if one sample's branch serves all
    class Branching(Arm):
        def forward(self, q0, q1, s0, h):
            L = super().forward(q0, q1, s0, h)
            return L if float(q0.detach().abs().max()) < 1 else 2 * L

    with pytest.raises(hz.InputError, match=r"while the step is traced.*torch\.where"):
        loaded(kind, OwnLagrangian(Branching(), 2), tmp_path)


def test_c_derivatives_by_inputs_of_a_module_are_those_of_eager():
    # fails if a column by an input stands where that of another, or of h, belongs
    if CC is None:
        pytest.skip("no C compiler in the PATH")
    model, make = OwnLagrangian(DrivenArm(), 2, inputs=3), torch.Generator().manual_seed(0)
    q, p = torch.randn(2, 5, 2, generator=make).double()
    state = hz.State(q, p, torch.linspace(-1, 1, 5).double())
    u = torch.randn(5, 3, generator=make).double()
    ours, eager = (x.linearise(state, H, u) for x in (compile_c(model, h=H), hz.Stepper(model)))
    for name in ("by_state", "by_h", "by_input"):
        assert torch.allclose(getattr(ours, name), getattr(eager, name).detach(), rtol=1e-11, atol=1e-12), name


def test_an_operation_that_no_c_is_known_of_is_named():  # fails if the message names no operation
    class Odd(Arm):
        def forward(self, q0, q1, s0, h):
            return super().forward(q0, q1, s0, h) + h * torch.special.bessel_j0(q0).sum(-1)

    with pytest.raises(hz.InputError, match="bessel_j0"):
        compile_c(OwnLagrangian(Odd(), 2), h=H)
