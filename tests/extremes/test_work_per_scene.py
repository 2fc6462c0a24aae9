"""Only what a scene requires: what its terms do not name is neither stored, nor evaluated, nor solved for."""

from collections import Counter
from typing import Any

import pytest
import torch
from extreme_cases import build, starts
from torch.utils._python_dispatch import TorchDispatchMode

import herglotz.mechanics.newton as newton
import herglotz.stepping.single_step as engine
from herglotz.models.action import ActionFlow
from herglotz.models.feature_potential import FeaturePotential
from herglotz.models.network import Network
from herglotz.models.terms import FeatureKinetic
from herglotz.stepping import Stepper
from herglotz.stepping.explicit import FieldOf

# What each scene names, and the parameters that this brings.
BASE = {"kinetic", "potential"}
SCENES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "pendulum, no friction": ({"level": "conservative"}, BASE),
    "pendulum, one rate": ({"level": "linear"}, BASE | {"damping.rate"}),
    "oscillator": ({"potential_width": 0, "angles": (False,)}, BASE | {"damping.rate"}),
    "parachute": (
        {"level": "affine", "damping_width": 0, "angles": (False,)},
        BASE | {"damping.rate", "damping.drag"},
    ),
    "drag by position and speed": ({"level": "affine"}, BASE | {"damping.rate", "damping.drag", "damping.network"}),
    "damping by s": ({"level": "full"}, BASE | {"damping.rate", "damping.drag", "action"}),
    "joints with viscous friction": ({"level": "forced"}, BASE | {"damping.rate", "friction"}),
    "joints with dry friction": ({"level": "forced", "coulomb": True}, BASE | {"damping.rate", "friction"}),
    "big steps": ({"correction_width": 4}, BASE | {"damping.rate", "correction"}),
    "mass that depends on position": ({"mass_width": 4}, BASE | {"damping.rate"}),
    "chain of ten": ({"dof": 10, "potential_width": 0, "angles": (False,) * 10}, BASE | {"damping.rate"}),
    "driven pendulum": ({"level": "forced", "inputs": 1}, BASE | {"damping.rate", "friction"}),
    "rigid body": ({"dof": 3, "mass_width": 4}, BASE | {"damping.rate"}),
    # told as features: their coefficients, and no network
    "planet": (
        {"dof": 2, "angles": (False, False), "features": ("central",), "alike": True, "potential_width": 0},
        {"potential.features", "damping.rate"},
    ),
    "planet, big steps": (
        {"dof": 2, "angles": (False, False), "features": ("central",), "alike": True, "potential_width": 0,
         "correction_width": 4},
        {"potential.features", "damping.rate", "correction"},
    ),
    "springs between ten": (
        {"dof": 10, "angles": (False,) * 10, "features": ("chain",), "alike": True, "potential_width": 0},
        {"potential.features", "damping.rate"},
    ),
    "two links": (
        {"dof": 2, "features": ("pendulums",), "potential_width": 0},
        BASE | {"kinetic.sum", "damping.rate"},
    ),
    "two links, no friction": (
        {"dof": 2, "features": ("pendulums",), "potential_width": 0, "level": "conservative"},
        BASE | {"kinetic.sum"},
    ),
    "two links, order 4": (
        {"dof": 2, "features": ("pendulums",), "potential_width": 0, "order": 4},
        {"kinetic", "kinetic.sum", "potential.features", "damping.rate"},
    ),
    "two links, known": (
        {"dof": 2, "known": ("cos(q1 - q2) v1 v2",), "potential_width": 0},
        BASE | {"damping.rate"},
    ),
}  # fmt: skip
EXPLICIT = {"pendulum, no friction", "pendulum, one rate", "oscillator", "joints with viscous friction", "chain of ten",
            "driven pendulum", "planet", "springs between ten"}  # fmt: skip
# How many numbers are fitted where nothing but features is: a coefficient each, γ, and what the mass and V start from.
COUNTS = {
    "planet": 6 + 1,  # powers −3 … 3 of r
    "springs between ten": 3 + 1,  # powers 2, 3, 4 of the stretches, all alike
    "two links": 1 + 2 + 4 + 1,  # cos(q1 − q2) v1 v2; the mass up to its scale; k and b of both angles
    "two links, no friction": 1 + 2 + 4,
    "two links, order 4": 1 + 2 + 4 + 1,
    "two links, known": 2 + 4 + 1,
}


class Operations(TorchDispatchMode):
    """Counts every tensor operation by name."""

    def __init__(self):
        super().__init__()
        self.count = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count[func.overloadpacket.__name__] += 1
        return func(*args, **(kwargs or {}))


def count_calls(monkeypatch, *places):
    """How often each (owner, name) is called from now on."""
    calls = Counter()
    for owner, name in places:
        plain = getattr(owner, name)

        def counted(*args, plain=plain, name=name, **kwargs):
            calls[name] += 1
            return plain(*args, **kwargs)

        monkeypatch.setattr(owner, name, counted)
    return calls


def operations(settings, steps=10):
    """Tensor operations of a step of a rollout, after the first."""
    stepper, found = Stepper(build(0.1, **settings)), []
    for k in (1, steps + 1):
        with torch.no_grad(), Operations() as counter:
            stepper.rollout(*starts(3), h=0.1, steps=k)
        found.append(counter.count)
    return {name: (found[1][name] - found[0][name]) / steps for name in found[1]}


@pytest.mark.parametrize("name", SCENES)
def test_a_model_holds_the_parameters_that_its_scene_names(name):
    # fails if a term that the scene does not name is built, stored and fitted
    settings, wanted = SCENES[name]
    model = build(**settings)
    held = {p for p, value in model.named_parameters() if value.numel()}
    assert all(any(p == w or p.startswith(w + ".") for w in wanted) for p in held)
    assert all(any(p == w or p.startswith(w + ".") for p in held) for w in wanted - {"kinetic"})  # n = 1: m = 1
    assert name not in COUNTS or sum(x.numel() for x in model.parameters()) == COUNTS[name]
    networks = {m for m, module in model.named_modules() if isinstance(module, Network)}
    with_width = {"potential.network": "potential_width", "damping.network": "damping_width",
                  "correction.network": "correction_width", "kinetic.network": "mass_width"}  # fmt: skip
    for place, width in with_width.items():
        has_term = place.startswith("potential") or any(w.startswith(place.split(".")[0]) for w in wanted)
        if place == "damping.network":
            has_term = place in wanted
        assert (place in networks) == (has_term and getattr(model.config, width) > 0)


@pytest.mark.parametrize("name", SCENES)
def test_a_separable_scene_solves_nothing(name, monkeypatch):
    # fails if Newton or a linear solve runs for a scene whose step is explicit, or a jet where a sweep is enough
    settings, _ = SCENES[name]
    model = build(0.1, **settings)
    calls = count_calls(
        monkeypatch,
        (engine, "find_root"),
        (newton, "solve"),
        (torch.linalg, "solve_ex"),
        (Network, "forward"),
        (ActionFlow, "forward"),
        (FieldOf, "__call__"),
    )
    with torch.no_grad():
        Stepper(model).rollout(*starts(3, dof=model.dof), h=0.1, steps=10)
    solves = calls["find_root"]
    if name in EXPLICIT:
        assert solves == calls["solve"] == calls["solve_ex"] == calls["forward"] == 0
        assert calls["__call__"] == 11  # the force at q0, then once a step
    else:
        assert solves == 10
        assert model.dof > 1 or calls["solve_ex"] == 0  # n = 1: a division


def test_the_conservative_level_computes_no_damping():
    # fails if c = e^{−γh} is made where there is no γ, or s enters an operation beside its own sum
    conservative, linear = (operations({"level": level}) for level in ("conservative", "linear"))
    for name in ("exp", "expm1"):
        assert conservative.get(name, 0) == 0
    assert sum(conservative.values()) <= sum(linear.values())
    with torch.no_grad():
        P = build(0.1, level="conservative").partials(*starts(3)[:2], starts(3).s, 0.1, 2)
    for zero in (P.D3, P.D13, P.D23, P.D33):
        assert not bool(zero.any())


def test_the_action_flow_is_evaluated_at_the_full_level_only(monkeypatch):
    # fails if units of s, and jets over 2n + 1 variables, are carried where s enters linearly or not at all
    calls = count_calls(monkeypatch, (ActionFlow, "forward"), (ActionFlow, "offsets"))
    for name, (settings, _) in SCENES.items():
        calls.clear()
        with torch.no_grad():
            Stepper(build(0.1, **settings)).rollout(*starts(2, dof=settings.get("dof", 1)), h=0.1, steps=2)
        assert bool(calls) == (name == "damping by s")


def test_features_are_evaluated_as_often_as_they_must(monkeypatch):
    # fails if an explicit step takes a jet of its features or asks for them twice, features of speed are evaluated
    # without a new position, or those of one term stand for those of the other
    places = ((FeaturePotential, "forward"), (FeaturePotential, "value_and_slope"), (FeatureKinetic, "forward"),
              (Network, "forward"), (newton, "solve"), (engine, "find_root"))  # fmt: skip
    calls = count_calls(monkeypatch, *places[1:3], *places[4:])
    jets = count_calls(monkeypatch, places[0])
    for name in COUNTS:
        calls.clear()
        jets.clear()
        model = build(0.02, **SCENES[name][0])
        state, iterations = starts(1, dof=model.dof), 0
        with torch.no_grad():
            if name in EXPLICIT:
                Stepper(model).rollout(*state, h=0.05, steps=5)
                assert calls == {"value_and_slope": 6}  # at q0, then once a step
                assert not jets
                continue
            for _ in range(5):
                step = Stepper(model).step(state, 0.05)
                state, iterations = step.state, iterations + step.iterations
        assert calls["find_root"] == 5
        assert calls["forward"] == iterations + 5  # of the features of speed: the guess, then once an iteration
        assert bool(jets) == (name == "two links, order 4")


def test_a_step_of_kicks_solves_nothing_and_evaluates_each_potential_once(monkeypatch):
    # fails if the large step goes through Newton, or a kick is evaluated twice
    from herglotz.tune import KickStepper

    calls = count_calls(monkeypatch, (newton, "solve"), (torch.linalg, "solve_ex"), (KickStepper, "kick"))
    d, a = torch.full((5,), 0.2, dtype=torch.float64), torch.full((4, 3), -0.1, dtype=torch.float64)
    out = KickStepper(1.0, 0.2, True, 0.0, 1.0, d, a, 0 * a).rollout(*starts(3), h=1.0, steps=10)
    assert bool(out.ok.all())
    assert calls == {"kick": 40}
