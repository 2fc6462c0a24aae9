"""A million steps in C: σ against e^{−γt}, decay to rest, and no step slower than the first."""

import pytest
import torch
from extreme_cases import build, state

import herglotz
from herglotz.stepping import Stepper
from tests.compilers import needs_compiler

STEPS, H = 1_000_000, 0.1
pytestmark = needs_compiler


def run(steps=STEPS, **settings):
    start = (x[0] for x in state([0.9], [0.4]))
    return herglotz.compile(build(potential_width=0, **settings)).rollout(*start, h=H, steps=steps)


@pytest.mark.parametrize(
    "settings",
    [
        {"rate": 0.01},
        {"rate": -0.001},
        {"rate": 0.01, "correction_width": 4},
        {"rate": 0.01, "level": "affine", "damping_width": 4},
    ],
    ids=lambda x: "-".join(f"{k}={v}" for k, v in x.items()),
)
def test_long_rollout_keeps_sigma(settings):
    # fails if σ_k drifts from e^{−γt} over many steps: ε a step at the most, and far less when c − 1 is summed
    out = run(**settings)
    assert bool(out.ok)
    exact = torch.exp(-settings["rate"] * H * torch.arange(STEPS + 1, dtype=torch.float64))
    kept = exact > 1e-290  # below it C sets what would become denormal to 0
    assert float((out.sigma / exact - 1)[kept].abs().max()) < 1e-12
    assert bool((out.sigma[~kept] < 1e-289).all())
    assert bool(torch.isfinite(out.q).all())


@pytest.mark.parametrize(
    "settings",
    [{"rate": 0.1}, {"rate": 0.1, "correction_width": 4}, {"rate": 0.1, "level": "forced", "coulomb": True}],
    ids=lambda x: "-".join(f"{k}={v}" for k, v in x.items()),
)
def test_decay_to_rest_ends_at_rest(settings):
    # fails if what decays past the smallest number ends in NaN, a failed solve, or a number that no longer falls
    out = run(300_000, **settings)
    assert bool(out.ok)
    assert out.q[-1].abs() < 1e-289
    assert out.s[-1].abs() < 1e-289
    assert out.sigma[-1] < 1e-289


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("settings", [{"correction_width": 4}, {"level": "full"}], ids=["linear", "full"])
def test_newton_follows_a_motion_to_rest(settings, dtype):
    # fails if Newton's tolerance becomes denormal with the motion: then no step near rest ever converges
    tiny = torch.finfo(dtype).tiny
    model = build(dtype=dtype, **settings)
    for size in (0.0, 1e-6 * tiny, 1e-2 * tiny, tiny, 1e3 * tiny):
        with torch.no_grad():
            out = Stepper(model, explicit=False).rollout(*state([size], [size], dtype=dtype), h=H, steps=10)
        assert bool(out.ok.all())
        assert float(out.q.abs().max()) <= 3 * size
