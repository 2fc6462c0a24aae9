"""The C file for CasADi: its step beside Python's, its derivatives, and what it does where there is no step."""

import ctypes
import functools
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from export_models import beside, damped, model_of, near, states_of, with_terms

from herglotz.errors import InputError
from herglotz.export import export_casadi, load_exported
from herglotz.stepping import State
from tests.compilers import CC, needs_compiler, run_compiler

ca = pytest.importorskip("casadi", reason="casadi is not installed (extra: control)")
pytestmark = needs_compiler
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
MODELS = {
    "network": lambda: damped("full", torch.float64),
    "inputs": lambda: damped("forced", torch.float64, inputs=2),
    "mass m(q)": lambda: with_terms("m(q), coupled"),
    "sticking": lambda: with_terms("sticking"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A function of a name in `MODELS`: the model's function of CasADi and its file, made once; read-only."""
    return functools.cache(lambda name: function(MODELS[name](), tmp_path_factory.mktemp("casadi")))


def function(model, folder, flags=(), **settings):
    """The model as a function of CasADi, and the file."""
    path = export_casadi(model, folder / "arm.c", h=0.1, **settings)
    library = path.with_suffix(".so")
    flags = ["-std=c99", "-O0", "-fPIC", "-shared", *WARNINGS, *flags]
    built = run_compiler([str(CC), *flags, str(path), "-o", str(library), "-lm"])
    assert built.returncode == 0, built.stderr[:2000]
    return ca.external("arm_step", str(library)), path


def arguments(model, state, h=0.1):
    """x, u where the model takes inputs, and h of one sample."""
    x = torch.cat([state.q[0], state.p[0], state.s[:1]]).double().numpy()
    u = 0.3 + 0.1 * np.arange(model.inputs)
    return [x, *([u] if model.inputs else []), h]


def eager(model, x, u, h):
    n = model.config.dof
    state = State(*(torch.tensor(part, dtype=torch.float64) for part in (x[None, :n], x[None, n:-1], x[-1:])))
    inputs = None if u is None else torch.tensor(u, dtype=torch.float64)[None]
    with torch.no_grad():
        step = beside(model).step(state, h, u=inputs)
    assert not step.status.any()
    return torch.cat([step.state.q[0], step.state.p[0], step.state.s]).numpy()


@pytest.mark.parametrize("name", MODELS)
def test_the_step_and_its_jacobian(name, written):
    # fails if q, p and s are mixed up, rows and columns of a block are exchanged, u is read from the place of h, or a
    # compiler warns
    model = MODELS[name]()
    step, _ = written(name)
    given = arguments(model, near(model.config.dof, 1))
    u = given[1] if model.inputs else None
    ours, theirs = np.array(step(*given)).ravel(), eager(model, given[0], u, 0.1)
    assert abs(ours - theirs).max() <= 1e-10 * abs(theirs).max()
    assert step.name_in() == ["x", *(["u"] if model.inputs else []), "h"]
    blocks = step.jacobian()(*given, 0)
    blocks = blocks if isinstance(blocks, (tuple, list)) else (blocks,)
    for k, block in enumerate(blocks):
        block = np.array(block)
        for j in range(block.shape[1]):
            ends = []
            for sign in (1, -1):
                moved = [np.array(x, dtype=float, copy=True).reshape(-1) for x in given]
                moved[k][j] += sign * 1e-5
                ends.append(np.array(step(*moved)).ravel())
            slope = (ends[0] - ends[1]) / 2e-5
            assert abs(block[:, j] - slope).max() <= 1e-7 * max(1.0, abs(block).max()), (k, j)


def test_casadi_differentiates_through_many_steps(written):
    # fails if CasADi does not find the Jacobian, its own sparsities do not fit, or a null argument or output is read
    step, _ = written("inputs")
    x, u, h = ca.MX.sym("x", 3), ca.MX.sym("u", 2, 5), ca.MX.sym("h")
    end = x
    for k in range(5):
        end = step(end, u[:, k], h)
    whole = ca.Function("whole", [x, u, h], [ca.jacobian(end, ca.veccat(x, u, h)), end])
    at = [np.array([0.2, 0.3, 0.0]), 0.1 * np.ones((2, 5)), 0.1]
    slopes = np.array(whole(*at)[0])
    moved = [at[0], at[1].copy(), at[2]]
    moved[1][1, 2] += 1e-5
    difference = (np.array(whole(*moved)[1]) - np.array(whole(*at)[1])).ravel() / 1e-5
    assert abs(slopes[:, 3 + 5] - difference).max() <= 1e-5
    assert np.isfinite(slopes).all()
    zero = np.array(step(x=at[0])["x1"])  # no u: zeros; h: that of the model
    assert abs(zero - np.array(step(at[0], [0, 0], 0.1))).max() == 0


def test_null_arguments_are_zeros_and_null_results_are_left_out(written):
    # fails if code that CasADi generated, which passes null for zeros and for what nobody asks for, ends the process
    step, path = written("inputs")
    library, x1 = ctypes.CDLL(str(path.with_suffix(".so"))), (ctypes.c_double * 3)()
    x, h = (ctypes.c_double * 3)(0.2, 0.3, 0.0), (ctypes.c_double * 1)(0.1)
    pointer = ctypes.POINTER(ctypes.c_double)
    given = (pointer * 4)(x, pointer(), h, pointer())
    assert library.arm_step(given, (pointer * 1)(x1), None, None, 0) == 0
    assert list(x1) == np.array(step([0.2, 0.3, 0.0], 0, 0.1)).ravel().tolist()
    assert library.arm_step(given, (pointer * 1)(), None, None, 0) == 0
    assert library.jac_arm_step(given, (pointer * 3)(), None, None, 0) == 0
    assert library.arm_step((pointer * 4)(), (pointer * 1)(), None, None, 0) == 1  # h = 0


def test_a_step_that_does_not_exist_is_an_error(written):
    # fails if a failed step hands out its start, or NaN without a word
    step, _ = written("mass m(q)")
    x = np.ones(5)
    for bad in (-0.1, 0.0, float("nan")):
        with pytest.raises(RuntimeError):
            step(x, bad)
        with pytest.raises(RuntimeError):
            step.jacobian()(x, bad, 0)
    with pytest.raises(RuntimeError):
        step(np.array([1, 1, 1, np.inf, 1]), 0.1)


def test_float32_and_many_coordinates(tmp_path):
    # fails if a header of floats hands floats to CasADi, or one without derivatives has a Jacobian that is none
    model = damped("linear", torch.float32)
    step, _ = function(model, tmp_path, dtype="float32")
    given = arguments(model, states_of(1, 1))
    assert abs(np.array(step(*given)).ravel() - eager(model.double(), given[0], None, 0.1)).max() <= 1e-6
    (tmp_path / "many").mkdir()
    many, _ = function(model_of(9, "linear"), tmp_path / "many")
    assert np.isfinite(np.array(many(0.1 * np.ones(19), 0.1))).all()
    with pytest.raises(RuntimeError):
        many.jacobian()


def test_the_file_is_read_as_a_header_is(written, tmp_path):
    # fails if `herglotz verify arm.c` compiles CasADi's part, finds no metadata, or takes a changed file
    model = MODELS["inputs"]()
    path = Path(shutil.copy(written("inputs")[1], tmp_path))
    state = states_of(1, 3)
    ours = load_exported(path).step(state, 0.1)
    with torch.no_grad():
        theirs = beside(model).step(state, 0.1)
    torch.testing.assert_close(ours.state.p, theirs.state.p, rtol=0, atol=1e-12)
    path.write_bytes(path.read_bytes().replace(b"sz_arg) *sz_arg", b"sz_arg) *sz_res"))
    with pytest.raises(InputError, match="damaged or changed"):
        load_exported(path)


def test_names_that_cannot_be(tmp_path):
    # fails if a name reaches the compiler that is none
    for bad in ("2 arms", "", "a" * 40):
        with pytest.raises(InputError, match="name must be a C identifier of at most 39"):
            export_casadi(MODELS["inputs"](), tmp_path / "a.c", h=0.1, name=bad)
    assert "model_2_arms_step(" in export_casadi(MODELS["inputs"](), tmp_path / "2 arms.c", h=0.1).read_text()


@pytest.mark.parametrize("name", ["inputs", "mass m(q)"])
def test_a_hold_is_the_fewest_steps_that_are_no_longer_than_the_typical_one(name, written):
    # fails if a step is lost or too long, rounding of the time adds one, a step's Jacobian is multiplied from the wrong
    # side or its own derivative by u is left out, or the derivative by the time is that of one step
    model = MODELS[name]()
    step, path = written(name)
    hold = ca.external("arm_hold", str(path.with_suffix(".so")))
    x, *u, _ = given = arguments(model, near(model.config.dof, 1))
    for time, count in ((0.04, 1), (0.3, 3), (0.3 * (1 + 1e-9), 3), (0.31, 4)):
        end = x
        for _ in range(count):
            end = step(end, *u, time / count)
        assert abs(np.array(hold(x, *u, time) - end)).max() <= 1e-13
    symbols = [ca.MX.sym("x", len(x)), *(ca.MX.sym("u", len(y)) for y in u), ca.MX.sym("h")]
    end = symbols[0]
    for _ in range(4):
        end = step(end, *symbols[1:-1], symbols[-1] / 4)
    slopes = ca.Function("slopes", symbols, [ca.jacobian(end, y) for y in symbols])
    theirs, ours = slopes(*given[:-1], 0.31), hold.jacobian()(*given[:-1], 0.31, 0)
    for a, b in zip(ours, theirs, strict=True):
        assert abs(np.array(a - b)).max() <= 1e-12 * max(1.0, abs(np.array(b)).max())
    for bad in (0.0, -0.3, float("nan"), float("inf")):
        with pytest.raises(RuntimeError):
            hold(x, *u, bad)
        with pytest.raises(RuntimeError):
            hold.jacobian()(x, *u, bad, 0)


@pytest.mark.parametrize("name", MODELS)
def test_a_horizon_in_one_call_is_that_of_its_intervals(name, tmp_path):
    # fails if a column of x, u or x1 is that of another interval, a block of the Jacobian is not in its place, a
    # register that is half full is lost, or one interval without a step does not fail the call
    model, count = MODELS[name](), 7
    _, path = function(model, tmp_path, flags=[f"-Darm_HORIZON={count}"])
    hold, shoot = (ca.external(f"arm_{each}", str(path.with_suffix(".so"))) for each in ("hold", "shoot"))
    state, draw = near(model.config.dof, count), np.random.default_rng(0)
    x = torch.cat([state.q, state.p, state.s[:, None]], 1).numpy().T
    u = [0.3 * draw.normal(size=(model.inputs, count))] if model.inputs else []
    assert shoot.size_out(0) == x.shape
    both = [(f, f(x, *u, 0.31), f.jacobian()(x, *u, 0.31, 0)) for f in (hold.map(count), shoot)]
    (_, theirs, slopes), (_, ours, blocks) = both
    assert abs(np.array(ours - theirs)).max() <= 1e-13
    for a, b in zip(blocks, slopes[: len(blocks)], strict=True):
        assert a.shape[0] == x.size
        wanted = np.array(b) if b.shape == a.shape else np.array(b).sum(1, keepdims=True)  # map takes an h for each
        assert abs(np.array(a) - wanted).max() <= 1e-12 * abs(wanted).max()
    assert blocks[0].nnz() == x.size * len(x)
    x[0, 5] = np.inf
    with pytest.raises(RuntimeError):
        shoot(x, *u, 0.31)
    with pytest.raises(RuntimeError):
        shoot.jacobian()(x, *u, 0.31, 0)
