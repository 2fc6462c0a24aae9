"""The traced derivative of a step: the function that every format is lowered from."""

import pytest
import torch

from herglotz.export.equation import Equations
from herglotz.models import ModelConfig
from herglotz.stepping import State, Stepper
from tests.lagrangians import random_model

CASES = {
    "linear": {"level": "linear", "correction_width": 3},
    "dry, inputs": {"level": "forced", "coulomb": True, "inputs": 1},
    "sticking": {"level": "forced", "coulomb": True, "sticking": True, "inputs": 1},
    "order 4": {"level": "linear", "order": 4, "potential_width": 0, "features": ("q2^4",)},
}


@pytest.mark.parametrize("case", CASES)
def test_the_traced_jacobian_holds_for_any_batch(case):
    # fails if the trace keeps the batch of the example, or torch.func leaves an operation that writes in place
    ones = (1.0, 1.0)
    options = {"potential_width": 3, **CASES[case]}
    config = ModelConfig((True, False), scale=ones, speed=ones, stiffness=ones, tilt=(0.0, 0.0), **options)
    model = random_model(config, spread=0.05)
    graph = Equations.of(model).jacobian
    names = {str(node.target) for node in graph.code.nodes if node.op == "call_function"}
    assert not [name for name in names if name.endswith("_.Tensor") or "copy_" in name or "fill_" in name]
    for batch in (1, 3):
        x = torch.randn(batch, 5, generator=torch.Generator().manual_seed(batch)).double() / 2
        state, h = State(x[:, :2], x[:, 2:4], x[:, 4]), torch.full((batch,), 0.1).double()
        u = x[:, :1].contiguous() if model.inputs else None
        ours = Stepper(model).linearise(state, h, u)
        delta = ours.step.state.q - state.q
        (found,) = graph(*state, h, delta, *(() if u is None else (u,)))
        wanted = [ours.by_state, ours.by_h[..., None], *(() if ours.by_input is None else (ours.by_input,))]
        assert (found - torch.cat(wanted, -1)).abs().max() <= 1e-13
