"""Features of many coordinates in C, in loops and in registers; test_every_term.py has every function."""

from typing import Any

import pytest
import torch

from herglotz.export import compile_c
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper
from tests.compilers import needs_compiler


def model_of(n, angles, features, **settings) -> Any:
    sizes: dict[str, Any] = {name: (1.0,) * n for name in ("scale", "speed", "stiffness", "tilt")}
    model: Any = ContactLagrangian(
        ModelConfig(angles=(angles,) * n, features=features, potential_width=0, **(sizes | settings))
    )
    make = torch.Generator().manual_seed(0)
    with torch.no_grad():
        theta = model.potential.features.sum.coefficient
        theta += 0.2 * torch.rand(theta.shape, generator=make, dtype=torch.float64)
    return model


CASES = {
    "nine angles, in loops": model_of(9, True, ("cos(q1 - q9)",)),
    "chain of 32": model_of(32, False, ("chain",), alike=True, stiffness=(0.0,) * 32, tilt=(0.0,) * 32),
}


@needs_compiler
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_features_step_in_c_as_they_do_in_eager(name, dtype):
    # fails if a slope or a coordinate's number differs in C, for one sample or a register of them
    model = CASES[name].to(dtype)
    make = torch.Generator().manual_seed(1)
    q = (0.6 + 0.3 * torch.randn(5, model.dof, generator=make, dtype=torch.float64)).to(dtype)
    p, s = 0.3 * q.flip(-1), torch.zeros(5, dtype=dtype)
    with torch.no_grad():
        expected = Stepper(model).rollout(q, p, s, h=0.05, steps=20)
    assert bool(expected.ok.all())
    out = compile_c(model, h=0.05).rollout(q, p, s, h=0.05, steps=20)
    tol = 1e-12 if dtype == torch.float64 else 2e-4
    torch.testing.assert_close(out.q, expected.q, rtol=tol, atol=tol)
    torch.testing.assert_close(out.p, expected.p, rtol=tol, atol=tol)
    torch.testing.assert_close(out.s, expected.s, rtol=tol, atol=10 * tol)
    CASES[name].double()
