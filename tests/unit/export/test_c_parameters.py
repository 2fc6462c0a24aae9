"""Numbers of a model that a C program sets between steps: steps, derivatives and bounds."""

import ctypes
import shutil
import subprocess
from typing import Any

import pytest
import torch
from export_models import randomise

from herglotz.errors import InputError
from herglotz.export import export_c, load_c
from herglotz.export.c_header import c_source, described
from herglotz.export.load import compiled
from herglotz.export.metadata import describe
from herglotz.export.parameters import described_parameters, parsed
from herglotz.models import ContactLagrangian, ModelConfig, numbers_of
from herglotz.models.numbers import WithNumbers, chosen, values_of, with_values
from herglotz.stepping import State, Stepper
from tests.compilers import run_compiler

COMPILER = next((c for c in ("gcc", "clang") if shutil.which(c)), None)
pytestmark = pytest.mark.skipif(COMPILER is None, reason="neither gcc nor clang in the PATH")
H = 0.1
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
# One to three coordinates, every level; a case has numbers in every term that a level can have.
CASES: dict[str, tuple[int, dict[str, Any]]] = {
    "conservative": (1, {"level": "conservative"}),
    "linear, mass": (3, {"level": "linear", "features": ("cos(q1 - q2) v1 v2",)}),
    "affine": (1, {"level": "affine", "damping_width": 2}),
    "full": (1, {"level": "full", "action_width": 1}),
    "viscous, motors": (2, {"level": "forced", "inputs": 2, "input_zero": True, "coupled": True}),
    "inputs by position": (1, {"level": "forced", "inputs": 1, "input_zero": True, "drag": ("u1 cos(q1)",)}),
    "dry, drag": (2, {"level": "forced", "inputs": 1, "coulomb": True, "drag": ("|v1| v1", "load 2")}),
    "sticking": (1, {"level": "forced", "coulomb": True, "sticking": True, "inputs": 1}),
}
# The others take 5 s and more each.
QUICK = ("conservative", "affine", "viscous, motors", "inputs by position", "sticking")


def address(x):
    return ctypes.c_void_p(None if x is None else x.data_ptr())


def model_of(case):
    n, settings = CASES[case]
    ones = tuple(1.0 + 0.1 * i for i in range(n))
    config = ModelConfig(
        (True,) * n, scale=ones, speed=ones, stiffness=ones, tilt=(0.0,) * n, rate=0.2,
        **{"potential_width": 0, "damping_width": 0, **settings},
    )  # fmt: skip
    model = ContactLagrangian(config)
    with torch.no_grad():
        randomise(model, 0.05, seed=4)
        if model.friction is not None and model.friction.dry:
            model.friction.coulomb.abs_().add_(0.05)
            model.friction.breakaway.abs_()
    return model


def problem(case, steps=4):
    model = model_of(case)
    make = torch.Generator().manual_seed(1)
    x = 0.5 * torch.randn(3, 2 * model.dof + 1, generator=make, dtype=torch.float64)
    u = 0.3 * torch.randn(3, steps, model.inputs, generator=make, dtype=torch.float64) if model.inputs else None
    return model, State(x[:, : model.dof], x[:, model.dof : -1], x[:, -1]), u


def named(model):
    return [name for name in numbers_of(model) if ".network." not in name]


def blocks(found):
    parts = [found.by_state, found.by_h[..., None], found.by_input, found.by_parameters]
    return torch.cat([x for x in parts if x is not None], -1)


@pytest.mark.parametrize("case", [pytest.param(x, marks=[] if x in QUICK else pytest.mark.slow) for x in CASES])
def test_steps_at_other_numbers_are_those_of_the_model_with_them(case):
    # fails if a number stays what it was when the header was written, in a step, a guess, a start, the map of inputs,
    # a momentum, V at q0 or a derivative; if lanes have other numbers than a sample by itself; or a derivative is
    # another number's
    model, states, u = problem(case)
    names = named(model)
    entries = describe(model, H, None, (), 30, {"h_range": None, "parameters": described_parameters(model, names)})
    stepper = compiled(c_source(model, described(model, entries, "model", "float64", None), "stepper.h"))
    values = {name: x + 0.02 * (1 + i % 3) for i, (name, x) in enumerate(stepper.parameters.items())}
    ours, eager = stepper.with_parameters(values), Stepper(with_values(model, values), tol=4e-16)
    inputs: dict[str, Any] = {} if u is None else {"inputs": u}
    single: dict[str, Any] = {} if u is None else {"inputs": u[0]}
    first = None if u is None else u[:, 0]
    with torch.no_grad():
        wanted = eager.rollout(*states, h=H, steps=4, **inputs)
        begin = eager.init(states.q, states.q + 0.05, states.s, H, first)
        moving = eager.init_qv(*states, H)  # p stands for a velocity
        v = eager.velocity(moving, H)
    found = ours.rollout(*states, h=H, steps=4, **inputs)
    alone = ours.rollout(*(x[0] for x in states), h=H, steps=4, **single)
    for name in ("q", "p", "s"):
        size = getattr(wanted, name).abs().max()
        assert (getattr(found, name) - getattr(wanted, name)).abs().max() <= 1e-12 * size, name
        assert (getattr(alone, name) - getattr(wanted, name)[0]).abs().max() <= 1e-12 * size, name
    assert (ours.init(states.q, states.q + 0.05, states.s, H, first).p - begin.p).abs().max() <= 1e-12
    assert (stepper.rollout(*states, h=H, steps=4, **inputs).q - wanted.q).abs().max() > 1e-4
    torch.testing.assert_close(ours.init_qv(*states, h=H).p, moving.p, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(ours.velocity(moving, H), v, rtol=1e-12, atol=1e-12)
    if model.dof > 1:  # one coordinate has the mass 1
        assert (stepper.init_qv(*states, h=H).p - moving.p).abs().max() > 1e-4
    slopes = blocks(eager.linearise(states, H, first, names))
    assert (blocks(ours.linearise(states, H, first)) - slopes).abs().max() <= 1e-10 * slopes.abs().max()


@pytest.mark.parametrize("case", CASES)
def test_derivatives_by_numbers_are_those_of_autograd_through_the_step(case):
    # fails if the implicit-function theorem leaves out how a number moves q1, or a number's column is another one's
    model, states, u = problem(case)
    names = named(model)
    state, first = State(*(x[0] for x in states)), None if u is None else u[0, 0]
    at = WithNumbers(model, lambda: torch.cat(join(Stepper(model, tol=4e-16).step(state, H, u=first).state)), names).at
    theta = torch.tensor(values_of(model, names), dtype=torch.float64)
    wanted = torch.autograd.functional.jacobian(at, theta)
    found = Stepper(model, tol=4e-16).linearise(state, H, first, names).by_parameters
    assert wanted.abs().max() > 1e-3
    assert (found - wanted).abs().max() <= 1e-10 * wanted.abs().max()


def join(state):
    return state.q, state.p, state.s[None]


PROGRAM = """
#include <stdio.h>
#include <stdlib.h>
#include "stepper.h"
int main(void) {
  const double nan = strtod("nan", 0), u[2] = {0.3, -0.2};
  arm_state x = arm_start, y = arm_start, z = arm_start;
  arm_parameters theta = arm_defaults, bad = arm_defaults;
  double a[25], b[10], c[5 * arm_P], d[5];
  int i;
  printf("%d ", arm_set_parameter(&theta, arm_damping_rate, 0.5));
  printf("%d ", arm_set_parameter(&theta, arm_damping_rate, 2.5));
  printf("%d ", arm_set_parameter(&theta, arm_damping_rate, -0.1));
  printf("%d ", arm_set_parameter(&theta, arm_damping_rate, nan));
  printf("%d ", arm_set_parameter(&theta, arm_P, 0.5));
  printf("%d ", arm_set_parameter(&theta, -1, 0.5));
  printf("%d ", theta.value[arm_damping_rate] == 0.5);
  printf("%s ", arm_parameter_names[arm_friction_input_map_1]);
  bad.value[arm_friction_input_map_0] = nan;
  printf("%d %d ", arm_step(&x, 0.1, u, &bad, 0), arm_rollout(&x, 0.1, 0, &bad, 3, 1, 0, 0, 0));
  printf("%d ", arm_init(x.q, x.q, 0.0, 0.1, u, &bad, &x));
  bad = arm_defaults;
  bad.value[arm_damping_rate] = 3.0;
  printf("%d ", arm_step_jacobian(&x, 0.1, u, &bad, 0, a, b, c, d));
  printf("%d ", x.q[0] == arm_start.q[0] && x.p[1] == arm_start.p[1]);
  x.p[0] = y.p[0] = z.p[0] = 0.7;
  for (i = 0; i < 3; i++) {
    arm_step(&x, 0.1, u, 0, 0);
    arm_step(&y, 0.1, u, &arm_defaults, 0);
    arm_step_jacobian(&z, 0.1, u, &theta, 0, a, b, c, d);
  }
  printf("%d %d %g\\n", x.q[0] == y.q[0] && x.p[0] == y.p[0], x.p[0] != z.p[0], z.p[0]);
  return 0;
}
"""


def test_bounds_and_defaults_in_c(tmp_path):
    # fails if a value out of bounds, a NaN or a number that is none is taken, changes something or makes a step; if
    # null is not the defaults; or the header is not clean under the warnings and sanitizers
    model = model_of("viscous, motors")
    bounds = {"damping.rate": (0.0, 2.0), "friction.input_map": None, "friction.input_zero": (None, 1.0)}
    export_c(model, tmp_path / "stepper.h", h=H, name="arm", parameters=bounds)
    (tmp_path / "use.c").write_text(PROGRAM)
    safe = ("-O0", "-fno-sanitize-recover=all", "-fsanitize=address,undefined")
    command = [str(COMPILER), "-std=c99", *WARNINGS, *safe, str(tmp_path / "use.c"), "-o", str(tmp_path / "use"), "-lm"]
    built = run_compiler(command)
    assert built.returncode == 0, built.stderr[:2000]
    words = subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout.split()
    assert words[:-1] == ["0", "5", "5", "5", "5", "5", "1", "friction.input_map[1]", "5", "5", "5", "5", "1", "1", "1"]
    other = Stepper(with_values(model, {"damping.rate": 0.5}))
    state, u = State(*(torch.tensor(x, dtype=torch.float64) for x in ([0.0, 0.0], [0.7, 0.0], 0.0))), [[0.3, -0.2]] * 3
    with torch.no_grad():
        p = other.rollout(*state, h=H, inputs=torch.tensor(u, dtype=torch.float64)).p[-1, 0]
    assert abs(float(words[-1]) - float(p)) <= 1e-5 * abs(float(p))


def test_the_twin_in_python_refuses_what_c_refuses(tmp_path):
    # fails if a number that is not set at run time, one out of bounds or a NaN is taken, or a file forgets its bounds
    model = model_of("viscous, motors")
    path = export_c(model, tmp_path / "stepper.h", h=H, parameters={"damping.rate": (0.0, 2.0)})
    stepper = load_c(path)
    assert stepper.parameters == {"damping.rate": values_of(model, ["damping.rate"])[0]}
    for values, said in (
        ({"damping.rate": 2.5}, ">= 0 and <= 2, got 2.5"),
        ({"damping.rate": float("nan")}, "finite"),
        ({"friction.viscous[0]": 0.1}, "those that are: damping.rate"),
    ):
        with pytest.raises(InputError, match=said):
            stepper.with_parameters(values)
    for wrong, said in (
        (["friction.viscous", "friction.viscous[1]"], "named twice"),
        (["friction.mass"], "no number 'friction.mass'"),
        ({"damping.rate": (0.5, 2.0)}, "outside its bounds"),
        ({"damping.rate": (float("nan"), 2.0)}, "outside its bounds"),
        ("damping.rate", "a list of names"),
    ):
        with pytest.raises(InputError, match=said):
            export_c(model, tmp_path / "bad.h", h=H, parameters=wrong)
    with pytest.raises(InputError, match="finite"):
        with_values(model, {"damping.rate": float("inf")})
    with pytest.raises(InputError, match="several"):
        with_values(model, {"friction.viscous": 0.1})


def test_words_of_the_command_line():
    # fails if a bound is lost, one side is taken for the other, or a text is taken for a bound
    assert parsed(["a[0]", "b=0:2", "c=:1", "d=-1:"]) == {
        "a[0]": (None, None), "b": (0.0, 2.0), "c": (None, 1.0), "d": (-1.0, None),
    }  # fmt: skip
    for wrong, said in ((["a=x:2"], "numbers"), (["a", "a=0:1"], "twice")):
        with pytest.raises(InputError, match=said):
            parsed(wrong)
    assert chosen(model_of("viscous, motors"), ["friction.viscous", "damping.rate"]) == [
        "friction.viscous[0]", "friction.viscous[1]", "damping.rate",
    ]  # fmt: skip
