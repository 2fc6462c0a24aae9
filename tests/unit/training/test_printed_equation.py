"""What is printed, integrated by an integrator that knows the text alone, is the free run of the model."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from printed_check import compared

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.training import FitConfig, Run, laplace
from herglotz.training.equation import equation_of
from herglotz.training.equation_notes import notes_of
from herglotz.training.identifiability import joint_of
from herglotz.training.recorded_range import box_of

NOISE, H = 1e-3, 0.02
TWICE = 3**0.5  # of the misfit: a motion that is so far from the model's is twice as far from the data

# Every kind of term: settings of the model, and the numbers of its parameters. Each number moves the motion by far more
# than the noise, so that a text without it, or with another one in its place, fails.
MODELS: dict[str, tuple[dict[str, Any], dict[str, list[float]]]] = {
    "springs": (
        {"angles": (False,), "stiffness": (1.0,), "tilt": (0.2,), "features": ("q1^4", "|q1| q1", "0.5 q1^3")},
        {"potential.features.sum.coefficient": [0.3, 0.2, 0.15]},
    ),
    "waves": (
        {"angles": (True,), "stiffness": (1.0,), "tilt": (0.3,), "features": ("cos(2q1)", "sin(3*q1)")},
        {"potential.features.sum.coefficient": [0.3, -0.1]},
    ),
    "order 4": (
        {"angles": (True, False), "stiffness": (1.0, 2.0), "tilt": (0.1, 0.2), "order": 4,
         "features": ("cos(q1) v1 v2",)},
        {"potential.features.sum.coefficient": [-1.0, 0.1, 1.0, 0.2], "kinetic.sum.coefficient": [0.3]},
    ),
    "distance": (
        {"angles": (False, False), "alike": True, "stiffness": (0.0, 0.0),
         "features": ("r^-1", "r^2", "q1 v2 - q2 v1", "(q1 - q2)^4 + q1^4")},
        {"potential.features.sum.coefficient": [0.2, 0.4, 0.1], "kinetic.sum.coefficient": [0.4]},
    ),
    "central force": (
        {"angles": (False, False), "alike": True, "stiffness": (0.0, 0.0), "features": ("r^-1", "r^2", "(q1 - 2q2)^4")},
        {"potential.features.sum.coefficient": [0.2, 0.4, 0.02]},
    ),
    "two masses": (
        {"angles": (False, False), "stiffness": (1.0, 0.5), "diagonal": True, "known": ("0.4 (q1 - q2)^2",),
         "coulomb": True, "level": "forced", "drag": ("(v1 - v2)", "|v1| v1", "q2^2 v2", "q1^2 sgn(v1)", "|v| v")},
        {"kinetic.log_diagonal": [0.3], "friction.viscous": [0.05, 0.1], "friction.coulomb": [0.05, 0.1],
         "friction.breakaway": [0.1, 0.05], "friction.log_smooth": [-1.5, -1.2], "friction.log_stribeck": [-1.0, -0.8],
         "drag.coefficient": [0.1, 0.15, 0.2, 0.1, 0.1]},
    ),
    "a joint that sticks": (
        {"angles": (True,), "level": "forced", "coulomb": True, "sticking": True, "inputs": 1, "input_zero": True,
         "drag": ("cos(q1) sgn(v1)", "load 1")},
        {"friction.coulomb": [0.15], "friction.breakaway": [0.1], "friction.log_stribeck": [-1.0],
         "friction.input_map": [0.9], "friction.input_zero": [0.3], "drag.coefficient": [0.05, 0.1]},
    ),
    "joints": (
        {"angles": (True, True), "level": "forced", "coupled": True, "inputs": 2, "input_map": (1.0, 0.2, -0.3, 0.8),
         "features": ("cos(q1 - q2) v1 v2",), "stiffness": (1.0, 0.7)},
        {"kinetic.base.off_diagonal": [0.2], "coupling.viscous": [-0.1], "friction.viscous": [0.2, 0.15],
         "kinetic.sum.coefficient": [0.3]},
    ),
    "translations": (
        {"angles": (False, False), "alike": True, "translations": ("q1 + 3q2",), "stiffness": (1.0, 2.0)}, {},
    ),
    "damping by position": (
        {"angles": (True,), "level": "affine", "damping_width": 0, "stiffness": (1.0,), "tilt": (0.2,), "rate": 0.05},
        {"damping.drag": [0.1]},
    ),
}  # fmt: skip
LONG = ("springs", "waves", "order 4", "joints", "damping by position")  # in steps that show in the motion


def run_of(settings, numbers, *, h=H, count=3, steps=160, hold="zero"):
    """A run whose model made its data."""
    n, make = len(settings["angles"]), torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=make, dtype=torch.float64)  # noqa: E731
    one = {"scale": (1.0,) * n, "speed": (1.0,) * n, "stiffness": (1.0,) * n, "tilt": (0.0,) * n, "rate": 0.1}
    model: Any = ContactLagrangian(ModelConfig(**{**one, "potential_width": 0, **settings}))
    with torch.no_grad():
        for name, values in numbers.items():
            model.get_parameter(name).copy_(torch.tensor(values).reshape(model.get_parameter(name).shape))
    t = (h * torch.arange(steps + 1, dtype=torch.float64)).repeat(count)
    u = None
    if model.inputs:
        u = torch.stack([((1 + j) * t + 0.3).sin() for j in range(model.inputs)], 1)
    data = Trajectories.of(t, t.new_zeros(len(t), n), (steps + 1,) * count, names=("x", "theta")[:n], u=u, hold=hold,
                           angles=settings["angles"])  # fmt: skip
    v = 0.8 * draw(count, n)
    q0, p0 = 0.8 + 0.2 * draw(count, n), v
    used = data.inputs_of_steps()
    inputs = None if used is None else used.reshape(count, steps + 1, -1)[:, :-1]
    with torch.no_grad():
        x = Stepper(model).rollout(q0, p0, h=h, steps=steps, inputs=inputs)
    assert bool(x.ok.all())
    states = State(x.q.flatten(0, 1), x.p.flatten(0, 1), x.s.flatten())
    data = replace(data, q=states.q + NOISE * draw(*states.q.shape))
    metrics = {"sigma": NOISE, "departure": None, "follows_data": True}
    run = Run(model, FitConfig(level=model.config.level), metrics, data, data.lengths, states, h, box_of(*states), [])
    run.metrics["equation"] = equation_of(run, joint_of(laplace(run), 0.0), notes_of(run)).as_dict()
    return run


def text_of(run):
    return " ".join(str(run.equation()).split())


@pytest.mark.parametrize("name", MODELS)
def test_the_printed_equation_is_the_model(name):
    # fails if a number of the model is not in the text, or not with its sign, factor or width, or rounded too coarsely
    sticks = "sticks" in name
    run = run_of(*MODELS[name], h=0.004 if sticks else H, count=1 if sticks else 3, steps=120)
    missed, moved = compared(run, parts=1 if sticks else 2)
    assert "step it as" not in text_of(run)
    assert moved < TWICE * missed


@pytest.mark.parametrize("name", LONG)
def test_a_model_of_long_steps_is_printed_with_its_rule(name):
    # fails if exact integration of the text is another motion, and the text does not say so, or has another rule
    run = run_of(*MODELS[name], h=0.5, count=2, steps=12)
    missed, moved = compared(run)
    assert "step it as the model does" in text_of(run)
    assert moved < 0.1 * missed
