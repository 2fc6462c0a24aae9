"""The generated C header: what it computes, what it says of itself, and what is refused."""

import json
import math
import re
import shutil
import subprocess
from typing import Any

import pytest
import torch

from herglotz.errors import InputError
from herglotz.export import ExportedStepper, compile_c, export_c, load_c, weights_digest
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Status, Stepper
from tests.compared import relative
from tests.compilers import CC, needs_compiler, run_compiler
from tests.lagrangians import even_model, random_model, states as normal_states

CXX = next((c for c in ("c++", "g++", "clang++") if shutil.which(c)), None)
BOX = {"q_low": [-1.0], "q_high": [1.0], "p_low": [-1.0], "p_high": [1.0], "s_low": [-5.0], "s_high": [5.0]}
KINDS = {"linear": ("linear", 0, True), "affine": ("affine", 0, True), "both": ("affine", 3, True)}
KINDS |= {"alone": ("linear", 6, False)}


def damped(n, kind, dtype=torch.float64):
    """A damped model whose every parameter is random; angles and lengths alternate."""
    level, correction, baseline = KINDS[kind]
    size = tuple(1.0 + 0.1 * i for i in range(n))
    config = ModelConfig(
        tuple(i % 2 == 0 for i in range(n)), level, size, size, size, (0.0,) * n, 0.3, 4, 2, 4, correction, 2, baseline
    )
    model = random_model(config, spread=0.05, seed=n)
    with torch.no_grad():
        if not baseline:  # a network that bends enough to have a mixed Hessian
            assert model.correction is not None
            model.correction.network.weights[-1].mul_(3.0)
    return model.to(dtype)


def states_of(n, batch, dtype=torch.float64):
    q, p, s = normal_states(n, batch, 5, dtype)
    return State(0.5 * q, 0.5 * p, s)


def eager_rollout(model, states, **options):
    """Eager, solved to the last digit in float64: its default tolerance leaves 1e-12 after many steps."""
    tol = 4e-16 if states.q.dtype == torch.float64 else None
    with torch.no_grad():
        return Stepper(model, tol=tol).rollout(*states, **options)


@needs_compiler
def test_a_plain_network_agrees_with_the_eager_stepper():
    # fails if the model without a baseline gets a kinetic term, or a failure is not reported as the eager one does
    model, states = damped(1, "alone"), states_of(1, 20)
    eager = eager_rollout(model, states, h=0.5, steps=3)
    ours = compile_c(model).rollout(*states, h=0.5, steps=3)
    both = ours.ok & eager.ok
    assert both.any()
    with torch.no_grad():  # the guesses differ, and so may the root: each must solve the step equation
        assert ours.residual[both].max() <= 1e-12
    assert torch.isfinite(ours.q[ours.ok]).all()
    assert torch.isnan(ours.q[~ours.ok][:, -1]).all()


@needs_compiler
def test_wide_networks():
    # fails if a block of a matrix product is skipped or summed twice: widths of one, several and odd blocks
    for width in (3, 37):
        size = (1.0,)
        config = ModelConfig((True,), "affine", size, size, size, (0.0,), 0.3, width, 3, width, width, 3)
        model = random_model(config, spread=0.05, seed=width)
        compiled = compile_c(model)
        for batch in (1, 2):  # one sample takes the product over units, two take the one over samples
            states = states_of(1, batch)
            eager = eager_rollout(model, states, h=0.1, steps=10)
            assert relative(compiled.rollout(*states, h=0.1, steps=10).q, eager.q) <= 1e-13, width


@needs_compiler
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_no_compiler_warnings(tmp_path, dtype):
    # fails if the header is not clean C99 or C++: unused names, shadowing, implicit conversions of types
    # What depends on the flow of values is the same in both languages, and takes the optimiser.
    tools = [[CC, "-std=c99", "-O1", "-c", "-o", "/dev/null"]]
    if CXX is not None:
        tools.append([CXX, "-x", "c++", "-fsyntax-only", "-o", "/dev/null"])
    source = tmp_path / "use.c"
    source.write_text('#include "stepper.h"\nint main(void) { return 0; }\n')
    models = {kind: damped(2, kind) for kind in (["both"] if dtype == "float64" else ["alone"])}
    options: dict[str, Any] = {"angles": (True, False), "potential_width": 3, "correction_width": 3}
    options |= dict.fromkeys(("scale", "speed", "stiffness", "tilt"), (1.0, 1.0))
    if dtype == "float64":
        models["full"] = ContactLagrangian(ModelConfig(level="full", mass_width=3, **options))
    else:
        models["mass"] = ContactLagrangian(ModelConfig(level="affine", mass_width=3, **options))
        models["viscous"] = ContactLagrangian(
            ModelConfig(level="forced", inputs=1, **{**options, "correction_width": 0})
        )
    for kind, model in models.items():
        export_c(model, tmp_path / "stepper.h", h=0.1, units=["real*/", '"m?"'], dtype=dtype)
        for tool in tools:
            command = [*tool, "-Wall", "-Wextra", "-Wpedantic", "-Werror", str(source)]
            done = run_compiler(command)
            assert done.returncode == 0, (kind, tool, done.stderr[:2000])


def example_of(path):
    """The example in the comment at the top of a header."""
    comment = path.read_text().split("*/")[0]
    return comment[comment.index("#include <stdio.h>") : comment.index("herglotz-metadata")]


def printed(folder, code):
    """The positions that an example prints."""
    (folder / "example.c").write_text(code)
    command = [CC, "-std=c99", "-Wall", "-Wextra", str(folder / "example.c"), "-lm", "-o", str(folder / "example")]
    built = run_compiler(command)
    assert (built.returncode, built.stderr) == (0, "")
    done = subprocess.run([folder / "example"], capture_output=True, text=True, check=True)
    return torch.tensor([float(line.split()[1]) for line in done.stdout.splitlines()], dtype=torch.float64)


@needs_compiler
@pytest.mark.parametrize("start", [{"q": [0.4], "p": [-0.3], "s": 0.1, "t": 6.65}, None], ids=["recorded", "none"])
def test_the_example_in_the_comment_runs(tmp_path, start):
    # fails if the example at the top of the header does not compile, or does not start from the recording's state
    model = damped(1, "linear")
    path = export_c(model, tmp_path / "stepper.h", h=0.1, name="arm", metadata={"start": start, "time_unit": "*/ s"})
    found = printed(tmp_path, example_of(path))
    q, p, s = (start[key] for key in "qps") if start else ([0.0], [0.0], 0.0)
    state = State(*(torch.tensor([x], dtype=torch.float64) for x in (q, p, s)))
    expected = Stepper(model).rollout(*state, h=0.1, steps=100).q[0, 1:, 0]
    assert torch.allclose(found, expected, rtol=1e-5, atol=1e-9)  # %g prints six digits


@needs_compiler
def test_the_example_gives_a_step_inputs_of_the_caller(tmp_path):
    # fails if the example of a model with inputs passes none, the name of an input ends the comment, or the sign of a
    # rate is lost
    size, acting = (1.0,), {"inputs": 2, "input_map": (3.0, -1.0)}
    model = ContactLagrangian(ModelConfig((True,), "forced", size, size, size, (0.0,), potential_width=0, **acting))
    columns = [("motor */ x", "input", "N m"), ("hz_load'", "input", "A/s")]
    metadata = {"columns": columns, "input_low": [0.1, 0.0], "input_high": [0.3, 1.0]}
    path = export_c(model, tmp_path / "stepper.h", h=0.1, name="arm", metadata=metadata)
    code = example_of(path)
    assert (
        "arm_real u[arm_M] = {0.2, 0.5};  // your inputs, set for each step: motor _/ x [N m], hz_load' [A/s]" in code
    )
    found = printed(tmp_path, code)
    state = State(*(torch.zeros(1, *shape, dtype=torch.float64) for shape in ((1,), (1,), ())))
    u = torch.tensor([0.2, 0.5], dtype=torch.float64).expand(1, 100, 2)
    expected = Stepper(model).rollout(*state, h=0.1, steps=100, inputs=u).q[0, 1:, 0]
    assert torch.allclose(found, expected, rtol=1e-5, atol=1e-9)


def test_a_start_of_another_size_is_refused(tmp_path):  # fails if the header holds a state of too few numbers
    start = {"q": [0.4], "p": [0.1], "s": 0.0}
    with pytest.raises(InputError, match=r"start cannot be .* with dof 2; export"):
        export_c(damped(2, "linear"), tmp_path / "stepper.h", h=0.1, metadata={"start": start})


@needs_compiler
def test_a_learned_motion_comes_to_rest():
    # fails if near rest, where the networks' forces are rounding, the solver asks for digits that F has not
    q = torch.linspace(1.0, 0.6, 9, dtype=torch.float64)[:, None]
    stepper = compile_c(even_model())
    for states in (q, q[:1]):
        out = stepper.rollout(states, 0 * states, 0 * states[:, 0], h=1.0, steps=150)
        assert bool(out.ok.all())
        assert float(out.q[:, -1].abs().max()) < 1e-15


@needs_compiler
def test_a_singular_step_is_reported():
    # fails if a zero pivot is divided by: a plain network with a zero last layer has J = 0
    for n in (1, 2):
        model = damped(n, "alone")
        with torch.no_grad():
            assert model.correction is not None
            model.correction.network.weights[-1].zero_()
        states = states_of(n, 1)
        step = compile_c(model).step(states, 0.1)
        with torch.no_grad():
            assert step.status.tolist() == Stepper(model).step(states, 0.1).status.tolist() == [Status.SINGULAR]
        assert torch.isnan(step.state.q).all()


@needs_compiler
def test_coordinates_that_do_not_couple():
    # fails if the smallest entry of a column is the pivot: J is diagonal here, and that entry is 0
    ones = (1.0, 1.0)
    model = ContactLagrangian(ModelConfig((False, False), "linear", ones, ones, ones, (0.0, 0.0), correction_width=3))
    compiled, batch = compile_c(model), states_of(2, 5)
    for states in (batch, State(*(x[0] for x in batch))):
        out = compiled.rollout(*states, h=0.1, steps=3)
        assert bool(out.ok.all())
        assert relative(out.q, eager_rollout(model, states, h=0.1, steps=3).q) <= 1e-13


def test_metadata(tmp_path):
    # fails if the header does not say which weights, number type, box or versions it holds
    model = damped(1, "affine")
    path = export_c(model, tmp_path / "stepper.h", h=0.25, box=BOX, units=["rad"], metadata={"note": "*/ ?"})
    text = path.read_text()
    found = re.search(r"herglotz-metadata: (.*)", text)
    assert found is not None
    entries = json.loads(found[1])
    assert entries["weights_sha256"] == weights_digest(model)
    assert (entries["level"], entries["h"], entries["units"], entries["note"]) == ("affine", 0.25, ["rad"], "*/ ?")
    assert entries["box"] == BOX
    assert f'_weights_sha256[] = "{weights_digest(model)}"' in text
    assert "stepper_q_low[stepper_N] = {-1.0}" in text
    assert "@" not in text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "3d"}, "C identifier"),
        ({"name": "a-b"}, "C identifier"),
        ({"dtype": "float16"}, "dtype must be"),
        ({"path": "missing/stepper.h"}, "cannot be written"),
        ({"path": "."}, "cannot be written"),
    ],
)
def test_unusable_arguments_are_refused(tmp_path, change, message):
    # fails if a wrong argument or an unwritable path ends in another exception, or in a file
    path = tmp_path / change.get("path", "stepper.h")
    options: dict[str, Any] = {"h": 0.1} | {k: v for k, v in change.items() if k != "path"}
    with pytest.raises(InputError, match=message):
        export_c(damped(1, "linear"), path, **options)
    assert not list(tmp_path.iterdir())


def test_weights_that_are_not_finite_are_refused(tmp_path):
    # fails if `nan` or `inf` is written as a C constant, or a float64 weight overflows in float32
    model = damped(1, "linear")
    assert model.damping is not None
    with torch.no_grad():
        model.damping.rate.fill_(1e39)
    with pytest.raises(InputError, match="not finite in float32"):
        export_c(model, tmp_path / "stepper.h", h=0.1, dtype="float32")


def test_no_compiler(monkeypatch):
    # fails if a missing compiler is a stack trace instead of what to install
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match="install one"):
        compile_c(damped(1, "linear"))


@needs_compiler
def test_gradients_and_a_box_that_is_not_there_are_refused(tmp_path):
    # fails if a gradient ends in C without a word, or "no box" reads as "never outside"
    compiled = load_c(export_c(damped(2, "linear"), tmp_path / "stepper.h", h=0.1))
    assert isinstance(compiled, ExportedStepper)
    q, p, s = states_of(2, 3)
    with pytest.raises(InputError, match="without gradient"):
        compiled.step(State(q.clone().requires_grad_(), p, s), 0.1)
    with pytest.raises(InputError, match="records no box"):
        compiled.outside_box(State(q, p, s))


@needs_compiler
@pytest.mark.parametrize(("level", "by_s"), [("linear", False), ("affine", True)])
def test_the_box_of_a_compiled_stepper(level, by_s):
    # fails if angles are not taken modulo a turn, p is not looked at, or s is where no motion depends on it (every free
    # run was told to be outside of its data)
    compiled = compile_c(damped(1, level), box=BOX)
    q = torch.tensor([0.0, 2.0, 2 * math.pi, 0.0, 0.0], dtype=torch.float64)[:, None]
    p = torch.tensor([0.0, 0.0, 0.0, 1.5, 0.0], dtype=torch.float64)[:, None]
    s = torch.tensor([0.0, 0.0, 0.0, 0.0, -6.0], dtype=torch.float64)
    assert compiled.outside_box(State(q, p, s)).tolist() == [False, True, False, True, by_s]
    outside = compiled.step(State(q, 0 * p, s), 0.1).outside
    assert outside is not None
    assert (outside > 0).tolist() == [False, True, False, False, by_s]
