"""Features, order 4, m(q) and coupled friction in the files that hold every model: `.pt2` and ONNX."""

from typing import Any

import pytest
import torch
from test_pt2 import beside, states_of

from herglotz.export import compare, export_onnx, export_pt2, load_onnx, load_pt2
from herglotz.export.attempt import Plan, best_plan
from herglotz.export.metadata import describe
from herglotz.export.pt2 import quiet, rollout_program
from herglotz.models import ContactLagrangian, ModelConfig

CASES: dict[str, tuple[int, dict[str, Any]]] = {
    "order 4": (1, {"order": 4}),
    "order 4, features": (2, {"order": 4, "features": ("cos(q1 - q2) v1 v2", "q2 v1")}),
    "order 4, three coordinates": (3, {"order": 4, "features": ("r^-1", "q3 v1 v2")}),
    "features": (2, {"features": ("cos(q1 - q2)", "sin(q1) v2^2", "q2^3")}),
    "m(q)": (2, {"mass_width": 3}),
    "m(q), coupled": (2, {"mass_width": 3, "level": "forced", "coupled": True}),
    "coupled": (2, {"level": "forced", "coupled": True, "coulomb": True}),
}


def model_of(case) -> Any:
    n, settings = CASES[case]
    ones = (1.0,) * n
    config = {"potential_width": 0, "rate": 0.3, "level": "linear"} | settings
    angles = tuple(i == 0 and n < 3 for i in range(n))
    model = ContactLagrangian(
        ModelConfig(angles=angles, scale=ones, speed=ones, stiffness=ones, tilt=(0.0,) * n, **config)
    )
    make = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=make, dtype=torch.float64)
    return model


def near(n, batch):
    """Starts at which every case has a step; for powers of r, away from r = 0."""
    q, p, s = states_of(n, batch)
    return type(states_of(n, 1))(1.0 + 0.2 * q, 0.3 * p, s)


def agree(model, exported, steps, batches):
    found = compare(exported, beside(model), steps=steps, batches=batches, states=near(model.dof, 64))
    assert max(found[key] for key in "qpsc") <= 1e-12, found
    assert found["status"] == found["failed"] == 0


@pytest.mark.parametrize(
    "case", [x if x == "order 4" else pytest.param(x, marks=pytest.mark.slow) for x in CASES]
)  # fmt: skip
def test_onnx_holds_it(case, tmp_path):
    # fails if an operation of the term has no ONNX, or onnxruntime makes a factor of float64 one of 32 bits (5e-12)
    model = model_of(case)
    exported = load_onnx(export_onnx(model, tmp_path / "a.onnx", h=0.1))
    agree(model, exported, 60, (1, 7))
    q, p, s = near(model.dof, 3)
    with torch.no_grad():
        for ours, eager in zip(exported.init(q, q + p, s, 0.1), beside(model).init(q, q + p, s, 0.1), strict=True):
            torch.testing.assert_close(ours, eager, rtol=1e-14, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_pt2_holds_it(case, tmp_path):
    # fails if a term is traced wrongly, or a loop starts from layouts that its turns do not give
    model = model_of(case)
    agree(model, load_pt2(export_pt2(model, tmp_path / "a.pt2", h=0.1)), 60, (1, 7))


def test_the_loop_starts_from_standard_layouts():
    # fails if what Newton's loop starts from is transposed: export then refuses m(q) with coupled friction at n = 2
    model = model_of("m(q), coupled")
    with quiet():
        program = rollout_program(model, describe(model, 0.1, None, (), 30, {})).module(check_guards=False)
    q, p, s = near(2, 3)
    with torch.no_grad():
        ours, eager = program(q, p, s, torch.full((4, 3), 0.1, dtype=torch.float64)), beside(model)
        expected = eager.rollout(q, p, s, h=0.1, steps=4)
    torch.testing.assert_close(ours[0].movedim(0, 1), expected.q[:, 1:], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(ours[1].movedim(0, 1), expected.p[:, 1:], rtol=1e-12, atol=1e-12)


def test_order_4_is_left_to_newton():
    # fails if an evaluation of a thousand operations is written several times, and export takes minutes
    assert best_plan(model_of("order 4"), 0.1, None) == Plan(False, 0) == Plan(False, 0).patient
