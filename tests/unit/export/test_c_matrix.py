"""C against eager after 1000 steps for every level × activation × mass, in float64 and in float32."""

import shutil
from typing import Any

import pytest
import torch
from export_models import randomise

from herglotz.export import compile_c
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.mass import PositionKinetic
from herglotz.stepping import State, Stepper

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not any(shutil.which(c) for c in ("cc", "gcc", "clang")), reason="no C compiler in the PATH"),
]
H, STEPS = 0.125, 1000  # H is a number of float32 too
UNDAMPED = 300  # without damping nothing forgets rounding: the difference grows with the square of the steps
LEVELS: dict[str, dict[str, Any]] = {
    "conservative": {"level": "conservative"},
    "linear": {"level": "linear"},
    "affine": {"level": "affine", "damping_width": 3},
    "full": {"level": "full", "action_width": 2},
    "viscous": {"level": "forced"},
    "dry": {"level": "forced", "coulomb": True, "inputs": 1},
}


def problem(level, activation, mass, batch):
    """A damped model of an angle and a length whose weights are float32 numbers, all random; states and inputs."""
    sizes = (1.0, 1.1)
    config = ModelConfig(
        (True, False), scale=sizes, speed=sizes, stiffness=sizes, tilt=(0.0, 0.0), potential_width=3,
        correction_width=3, activation=activation, mass_width=mass, **LEVELS[level],
    )  # fmt: skip
    model: Any = ContactLagrangian(config)
    with torch.no_grad():
        randomise(model, 0.05, seed=3)
        if model.friction is not None:
            model.friction.viscous.abs_()
        if model.action is not None:
            model.action.rate.mul_(4)
        if isinstance(model.kinetic, PositionKinetic):
            model.kinetic.network.weights[-1].mul_(4)
    x = torch.randn(batch, 5, generator=torch.Generator().manual_seed(5)).double() / 2
    options: dict[str, Any] = {"h": H, "steps": UNDAMPED if level == "conservative" else STEPS}
    if model.inputs:
        options["inputs"] = 0.1 * torch.randn(STEPS, 1, generator=torch.Generator().manual_seed(1)).double()
        options["inputs"] = options["inputs"].float().double()
    return model.float().double(), State(x[:, :2], x[:, 2:4], x[:, 4]), options


def worst(a, b):
    return max(
        float((x.double() - y).abs().max() / y.abs().max())
        for x, y in ((getattr(a, name), getattr(b, name)) for name in ("q", "p", "s"))
    )


def in_float32(states, options):
    inputs = {"inputs": options["inputs"].float()} if "inputs" in options else {}
    return State(*(x.float() for x in states)), {**options, **inputs}


@pytest.mark.parametrize("mass", [0, 3], ids=["constant", "of q"])
@pytest.mark.parametrize("activation", ["tanh", "softplus", "silu"])
@pytest.mark.parametrize("level", LEVELS)
def test_a_thousand_steps_agree(level, activation, mass):
    # fails if any combination of terms loses a derivative or a digit, alone (B = 1) or in registers (a prime B)
    model, states, options = problem(level, activation, mass, 3)
    with torch.no_grad():
        eager = Stepper(model, tol=4e-16).rollout(*states, **options)
    ours = compile_c(model)
    assert eager.ok.all()
    assert worst(ours.rollout(*states, **options), eager) <= 1e-12
    small, small_options = in_float32(states, options)
    single = compile_c(model.float())
    assert worst(single.rollout(*small, **small_options), eager) <= 1e-5
    first = State(*(x[0] for x in (eager.q, eager.p, eager.s)))
    assert worst(ours.rollout(*(x[0] for x in states), **options), first) <= 1e-12
    assert worst(single.rollout(*(x[0] for x in small), **small_options), first) <= 1e-5


def test_a_thousand_steps_of_a_large_batch():
    # fails if a register of a large batch is another sample's
    model, states, options = problem("affine", "tanh", 0, 4096)
    with torch.no_grad():
        eager = Stepper(model, tol=4e-16).rollout(*states, **options)
    assert worst(compile_c(model).rollout(*states, **options), eager) <= 1e-12
