"""float64, float32 and weights of bfloat16; increments against positions at h = 1e-6."""

from typing import Any

import pytest
import torch
from extreme_cases import build, starts

from herglotz.stepping import Stepper

SETTINGS: dict[str, dict[str, Any]] = {
    "explicit": {"rate": 0.4},
    "correction": {"rate": 0.4, "correction_width": 8},
    "affine": {"rate": 0.4, "level": "affine"},
    "full": {"rate": 0.4, "level": "full"},
}


def errors(model, reference, dtype, steps=60):
    """Relative errors of the positions against the reference, (20, steps + 1); 20 starts below the separatrix."""
    q, p, s = starts(20)
    x = (q.clamp(-1.5, 1.5), p.clamp(-0.7, 0.7), s)
    with torch.no_grad():
        exact = Stepper(reference).rollout(*(y.to(dtype).double() for y in x), h=0.125, steps=steps)
        out = Stepper(model).rollout(*(y.to(dtype) for y in x), h=0.125, steps=steps)
    assert bool(exact.ok.all())
    assert bool(out.ok.all())
    return ((out.q.double() - exact.q).abs() / (1 + exact.q.abs()))[..., 0]


@pytest.mark.parametrize("name", SETTINGS)
def test_float32_follows_float64(name):
    # fails if float32 loses more than rounding over 60 damped steps: (q1 − q0)/h would lose 1e-5 a step (trap 6)
    single = build(0.1, dtype=torch.float32, **SETTINGS[name])
    error = errors(single, build(0.1, **SETTINGS[name]).float().double(), torch.float32)
    eps = torch.finfo(torch.float32).eps
    assert float(error.max()) < 60 * eps
    assert float(error.amax(-1).median()) < 20 * eps


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_bfloat16_weights_change_the_model_and_not_the_arithmetic(name, dtype):
    # fails if weights of 8 bits cost more than their own rounding, 2⁻⁹ relative, or the step loses structure
    coarse = build(0.1, **SETTINGS[name]).to(torch.bfloat16).to(dtype)
    error = errors(coarse, build(0.1, **SETTINGS[name]), dtype, steps=20)
    twin = errors(coarse, build(0.1, **SETTINGS[name]).to(torch.bfloat16).double(), dtype, steps=20)
    assert 1e-5 < float(error.max()) < 0.05
    if dtype == torch.float64:
        assert float(twin.max()) < 1e-12
    assert float(twin.max()) < 1e-2 * float(error.max())


@pytest.mark.parametrize(("name", "steps"), [("explicit", 512), ("correction", 256)])
def test_errors_grow_with_the_steps_and_no_faster(name, steps):
    # fails if rounding adds up with a sign, or is amplified: more than a fifth of an ε a step
    settings = {**SETTINGS[name], "rate": 0.01}
    single = build(0.1, dtype=torch.float32, **settings)
    error = errors(single, build(0.1, **settings).float().double(), torch.float32, steps=steps)
    growth = error.cummax(-1).values.median(0).values
    k = torch.arange(1, steps + 2, dtype=torch.float64)
    assert bool((growth < 0.2 * torch.finfo(torch.float32).eps * k).all())
