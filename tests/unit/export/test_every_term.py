"""Every kind of term that a fit can find steps in C, `.pt2` and ONNX as in PyTorch, with its derivative.

A case is a small model: one step and its Jacobian, traced once and lowered to each format. What surrounds a step (loops
over steps, batches, starts, files) does not depend on its terms; test_matrix.py, test_pt2.py, test_onnx.py and
test_c_levels.py have it.
"""

from collections.abc import Iterator
from dataclasses import fields
from itertools import pairwise
from typing import Any

import pytest
import torch
from export_models import randomise

from herglotz.data import Trajectories
from herglotz.export import ExportedStepper
from herglotz.export.c_header import c_source, described
from herglotz.export.equation import Equations, example
from herglotz.export.inline import inlined
from herglotz.export.load import compiled
from herglotz.export.lower.onnx import OUTPUTS, graph_of
from herglotz.export.metadata import describe
from herglotz.export.programs import LegendreModule, StepModule, _program, quiet
from herglotz.export.step import StepGraphs
from herglotz.models import LEVELS, ContactLagrangian, ModelConfig
from herglotz.models.drag import parse_drag
from herglotz.models.features import expand, parse
from herglotz.models.network import ACTIVATIONS
from herglotz.stepping import State, Stepper
from herglotz.training.named_terms import candidates
from tests.compilers import needs_compiler

H, STEPS = 0.1, 3
Setting = dict[str, Any]
# Angles ("a") and lengths ("l") of a case, and its settings. Terms of one function stand alone in one case and beside
# others in another one: a sum of one product has shapes of its own.
CASES: dict[str, tuple[str, Setting]] = {
    "order 4": ("al", {
        "level": "forced", "order": 4, "features": ("cos(q1)", "cos(q1) v1 v2"), "drag": ("load 1",),
    }),
    "powers and functions": ("l", {
        "level": "forced", "alike": True,
        "drag": ("|v1| v1", "q1 v1", "q1^2 v1", "sin(0.7 q1) v1", "cos(1.4 q1) v1", "sin(0.9 v1)", "cos(1.8 v1)"),
        "features": ("q1", *(f"q1^{k}" for k in range(2, 7)), "sin(1.3 q1 + 0.4)", "cos(2.6 q1 - 1) v1^2",
                     "cos(q1 + 1) - cos(2 q1 - 0.5)"),
    }),
    "bent springs that stick": ("l", {
        "level": "forced", "alike": True, "features": ("|q1| q1", "|q1|^3", "q1^4"), "coulomb": True, "sticking": True,
        "order": 4, "inputs": 2, "input_zero": True, "absent": ("friction.viscous",),
    }),
    "joints": ("aa", {
        "level": "forced", "coupled": True, "coulomb": True, "features": ("revolute", "spherical"), "inputs": 1,
        "input_map": (1.0, 0.0),
    }),
    "cart and pole that slides, inputs by position": ("la", {
        "level": "forced", "diagonal": True, "features": ("slides", "q1^3"), "coulomb": True,
        "inputs": 2, "input_zero": True,
        "drag": ("load 2", "|v2| v2", "q1 sgn(v2)", "sin(q2) sgn(v1)", "u1 sin(q2) on q1", "u2 cos(q2)", "u1 q1"),
    }),
    "lengths": ("ll", {
        "level": "forced", "diagonal": True, "coulomb": True, "sticking": True, "features": ("lengths", "q1 v1^2 v2"),
        "drag": ("|v| v", "(v1 - v2)", "|v1 - v2| (v1 - v2)", "q2^2 v2", "(v1 - v2)^3", "|v2|", "sin(0.8 (v1 - v2))",
                 "(0.4 v1 - v2)"),
    }),
    "one distance and one field": ("ll", {
        "level": "conservative", "alike": True, "features": ("r^-1", "q1 v2 - q2 v1"), "known": ("0.3 q1^2",),
    }),
    "three joints": ("aaa", {"features": ("cos(q1 - q2) v1 v2", "sin(q1 + q2 + q3)", "sin(q3) v3^2")}),
    "sticking by position": ("al", {
        "level": "forced", "coulomb": True, "sticking": True, "coupled": True, "features": ("q2^4",),
        "drag": ("q2^2 sgn(v2)", "cos(q1) sgn(v1)", "v2^3"), "inputs": 1,
    }),
    "translations": ("ll", {
        "level": "conservative", "translations": ("q1 + q2",), "features": ("(q1 - q2)^2", "(q1 - q2)^4"),
    }),
    "networks": ("al", {
        "level": "affine", "potential_width": 3, "damping_width": 3, "correction_width": 3, "activation": "softplus",
        "features": ("1", "q2^2"),
    }),
    "full, waves": ("a", {
        "level": "full", "potential_width": 3, "potential_depth": 2, "mass_width": 2, "action_width": 2,
        "correction_width": 3, "correction_depth": 1, "activation": "silu",
        "features": ("cos(q1)", "sin(q1)", "cos(2q1)"),
    }),
    "mass, powers of s, forces": ("al", {
        "level": "forced", "potential_width": 3, "mass_width": 3, "mass_depth": 2, "coupled": True, "coulomb": True,
        "inputs": 3, "dissipation": ("s^3", "s^2"), "drag": ("q2^2 v2",),
    }),
}  # fmt: skip


def model_of(case: str) -> Any:
    """The model of a case with random parameters."""
    kinds, settings = CASES[case]
    ones, zeros, angles = (1.0,) * len(kinds), (0.0,) * len(kinds), tuple(x == "a" for x in kinds)
    given = {"potential_width": 0, "rate": 0.3, "scale": ones, "speed": ones, "stiffness": ones, "tilt": zeros}
    model = ContactLagrangian(ModelConfig(angles, **given | settings))
    with torch.no_grad():
        randomise(model, 0.05, seed=2)
        model._leave_out(model.config.absent)
        # So large that a missing force is seen, and that joints stop.
        if model.drag is not None:
            model.drag.coefficient.abs_().add_(0.2)
        if model.friction is not None and model.friction.sticking:
            model.friction.coulomb.abs_().add_(0.5)
    return model


def problem(model) -> tuple[State, list[Any]]:
    """Three states, on both sides of 0 and away from r = 0, and the inputs of every step."""
    n, make = model.dof, torch.Generator().manual_seed(0)
    x = torch.randn(3, 2 * n + 1, generator=make, dtype=torch.float64)
    side = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)[:, None]
    u = 0.3 * torch.randn(STEPS, 3, model.inputs, generator=make, dtype=torch.float64)
    state = State(side * (1 + 0.2 * x[:, :n]), 0.3 * x[:, n : 2 * n], x[:, -1])
    return state, list(u) if model.inputs else [None] * STEPS


class StepAndLegendre(torch.nn.Module):
    """(q, p, s, h[, u]) → a step and its Jacobian, then L_v, L_vv and the terms of dry friction at v = p."""

    def __init__(self, model, entries):
        super().__init__()
        equations = Equations.of(model)
        graphs = StepGraphs(equations.model, entries["box"])
        self.step = StepModule(equations, graphs, entries["newton_iterations"], linearised=True)
        self.legendre = LegendreModule(equations)

    def forward(self, q, p, s, h, *u):
        """At (B, n), (B, n), (B,), (B,) and (B, m)."""
        return *self.step(q, p, s, h, *u), *self.legendre(q, p, s, h)


def formats_of(model) -> dict[str, ExportedStepper]:
    """One program of a step, its Jacobian and velocities, as `.pt2` holds it and as ONNX, and a compiled header."""
    ort = pytest.importorskip("onnxruntime")
    entries = describe(model, H, None, (), 30, {"h_range": None})
    names = ("q", "p", "s", "h", *(("u",) if model.inputs else ()))
    steps = (*OUTPUTS[:-1], "jacobian")
    with quiet():
        program = _program(StepAndLegendre(model, entries), example(model, H), stacked=False, inlines=False)
        friction = ("grip", "grip_by_v") if model.capabilities.sticking else ()
        content = graph_of(program, names, (*steps, "L_v", "L_vv", *friction), {})
        pt2 = inlined(program).module(check_guards=False)
    options = ort.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def onnx(*x):
        feeds = {name: y.numpy() for name, y in zip(names, x, strict=True)}
        return tuple(torch.from_numpy(y) for y in session.run(None, feeds))

    def file(kind, run):
        def linearise(*x):
            return run(*x)[: len(steps)]

        def legendre(q, *x):
            return run(q, *x, *((q.new_zeros(len(q), model.inputs),) if model.inputs else ()))[len(steps) :]

        return ExportedStepper({"rollout": linearise, "linearise": linearise, "legendre": legendre}, entries, kind=kind)

    header = c_source(model, described(model, entries, "model", "float64", None), "stepper.h")
    return {"c": compiled(header), "pt2": file("pt2", pt2), "onnx": file("onnx", onnx)}


@pytest.fixture
def _made_once(monkeypatch):
    """One trace of a model's equations for all formats, and one session of a graph: the export opens one to check it.

    Where there are inputs, C has another model.
    """
    of, made = Equations.of, {}

    def once(model, _=None):
        if model.inputs:
            return of(model)
        return made.get(model.config) or made.setdefault(model.config, of(model))

    monkeypatch.setattr(Equations, "of", once)
    monkeypatch.setattr("herglotz.export.lower.onnx._runnable", lambda content: content)


@needs_compiler
@pytest.mark.parametrize("case", CASES)
@pytest.mark.usefixtures("_made_once")
def test_a_term_steps_in_every_format(case):
    # fails if a format refuses a term, leaves it out of a step, has another derivative of it, or another velocity
    pytest.importorskip("onnx")
    model = model_of(case)
    state, inputs = problem(model)
    # To rounding: at its own tolerance the eager stepper is itself 1e-12 off.
    eager = Stepper(model, tol=1e-15)
    exact, path = eager.linearise(state, H, inputs[0]), [state]
    with torch.no_grad():
        for u in inputs:
            path.append(eager.step(path[-1], H, u=u).state)
    stuck = [bool((a.q == b.q).any()) for a, b in pairwise(path)]
    assert any(stuck) == model.capabilities.sticking
    for form, file in formats_of(model).items():
        state = path[0]
        for u, wanted in zip(inputs, path[1:], strict=True):
            found = file.linearise(state, H, u)
            assert not found.step.status.any(), form
            for a, b in zip(found.step.state, wanted, strict=True):
                torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12, msg=lambda text, form=form: f"{form}: {text}")
            if state is path[0]:
                torch.testing.assert_close(found.step.c, exact.step.c, rtol=1e-14, atol=0)
                for a, b in zip(found[1:], exact[1:], strict=True):
                    assert (a is None) == (b is None), form
                    if a is not None and b is not None:
                        assert float((a - b).abs().max()) <= 1e-11 * float(b.abs().max()), form
            state = found.step.state
        # p stands for a velocity here, and then for a momentum.
        q, p, s = path[0]
        torch.testing.assert_close(
            file.init_qv(q, p, s, H).p, eager.init_qv(q, p, s, H).p.detach(), rtol=1e-12, atol=1e-12
        )
        torch.testing.assert_close(
            file.velocity(path[0], H), eager.velocity(path[0], H).detach(), rtol=1e-12, atol=1e-12
        )


def kinds(config: ModelConfig) -> Iterator[tuple]:
    """What a lowering can tell of the terms that a model names: functions, powers of velocities, forms of friction."""
    for text in expand((*config.features, *config.known), config.angles):
        for x in parse(text, config.angles):
            yield "feature", x.function, x.power < 0, len(x.velocities), len(set(x.velocities))
    for text in config.drag:
        f = parse_drag(text, config.angles)
        yield "drag", f.dry, f.wave, f.of_speed, f.air, f.a > 0, f.b, min(f.c, 2), f.of is None, f.input is None


def recordings() -> Iterator[Trajectories]:
    """Motions of one to three coordinates that turn round or, of angles, only one way, around r = 0."""
    t = torch.linspace(0.0, 6.0, 61, dtype=torch.float64)
    for which in ("a", "l", "aa", "al", "ll", "aaa", "lll"):
        angles = [x == "a" for x in which]
        there = torch.stack([(t + i).cos() for i in range(len(which))], -1)
        yield Trajectories.of(t, there, angles=angles)
        yield Trajectories.of(t, torch.where(torch.tensor(angles), 3 * t[:, None], there), angles=angles)


def test_a_case_has_every_kind_of_term_that_a_fit_can_find():
    # fails if a term joins the candidates of a fit, or another function a name of a term, and no case exports it
    exported = {kind for case in CASES for kind in kinds(model_of(case).config)}
    for data in recordings():
        terms = candidates(data)
        drag = terms.drag
        ones, zeros = (1.0,) * data.dof, (0.0,) * data.dof
        found = ModelConfig(
            data.angles, "forced", ones, ones, ones, zeros, features=terms.features, drag=drag, coulomb=terms.dry
        )
        missing = set(kinds(found)) - exported
        assert not missing, f"{data.angles}: {missing}"


def test_a_case_has_every_setting_of_a_model():
    # fails if a model can be made of something that no case exports. Left out: a user's own terms, which
    # test_terms_by_name.py has; the seed of the weights; and no baseline, which shows why one is needed (trap 2)
    configs = [model_of(case).config for case in CASES]
    default = ModelConfig()
    for name in {x.name for x in fields(ModelConfig)} - {"terms", "seed", "baseline"}:
        assert any(getattr(config, name) != getattr(default, name) for config in configs), name
    assert {config.level for config in configs} == set(LEVELS)
    assert {config.activation for config in configs} == set(ACTIVATIONS)
    assert {(config.order, config.sticking) for config in configs} == {(2, False), (2, True), (4, False), (4, True)}
