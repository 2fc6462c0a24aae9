"""Files of every format beside the eager stepper: steps, rollouts, starts, inputs and derivatives.

test_every_term.py has the terms that a model may be made of.
"""

import functools
from typing import Any

import pytest
import torch
from export_models import SMALL, beside, damped, near, states_of, with_terms

from herglotz.errors import InputError
from herglotz.export import compare, export_aoti, export_onnx, export_pt2, load_exported
from herglotz.export.metadata import describe
from herglotz.export.programs import programs_of, quiet
from herglotz.models import LEVELS
from herglotz.stepping import State, Status

WRITE = {"pt2": export_pt2, "onnx": export_onnx, "aoti": export_aoti}
SUFFIX = {"pt2": "pt2", "onnx": "onnx", "aoti": "pt2"}
# A closed form, and what sticks; test_pt2.py and test_onnx.py have Newton's iteration by jets at the affine level:
# rollouts of every batch size, starts and derivatives. test_every_term.py has the steps of order 4.
FILES = {
    "pt2": ("forced",),
    "onnx": ("forced", "sticking"),
    "aoti": ("affine", "forced", "order 4", "sticking"),  # a compiler run of 20–60 s for each
}
MATRIX = [
    pytest.param(form, name, marks=pytest.mark.slow if form == "aoti" else [])
    for form, names in FILES.items()
    for name in names
]


def model_named(name, dtype=torch.float64) -> Any:
    """A level with random parameters (two inputs at the forced one), or a model with further terms."""
    model = damped(name, dtype, inputs=2 if name == "forced" else 0) if name in LEVELS else with_terms(name)
    return model.to(dtype)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A function of (form, name, dtype) that exports a model, once for all tests."""
    return functools.cache(lambda *case: exported_to(tmp_path_factory.mktemp("matrix"), *case))


def exported_to(folder, form, name, dtype=torch.float64) -> tuple[Any, Any]:
    if form == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    model = model_named(name, dtype)
    box = SMALL if model.dof == 1 else None
    path = WRITE[form](model, folder / f"a.{SUFFIX[form]}", h=0.1, box=box)
    return model, load_exported(path)


def starts(model, batch):
    return near(model.dof, batch) if model.config.level in ("linear", "forced") else states_of(model.dof, batch)


def inputs_of(model, *shape):
    m = model.config.inputs
    total = torch.Size((*shape, m)).numel()
    return torch.linspace(-1, 1, total, dtype=torch.float64).reshape(*shape, m) if m else None


def close(a, b, tol=1e-12):
    torch.testing.assert_close(a, b, rtol=tol, atol=tol)


@pytest.mark.parametrize(("form", "name"), MATRIX)
def test_a_file_does_what_the_eager_stepper_does(form, name, written):
    # fails if an operation or a term is lowered wrongly (onnxruntime makes a factor of float64 one of 32 bits: 5e-12),
    # the guess assumes equal steps, the loop reads another row of h or u than its own, leading dimensions are lost, a
    # single step differs from the loop, init gives the momentum of FL⁻ or s0 for s1, or a column of the Jacobian is
    # another's
    model, exported = written(form, name)
    assert exported.kind == form
    eager = beside(model)
    q, p, s = (x.reshape(2, 3, *x.shape[1:]) for x in starts(model, 6))
    h = torch.tensor([0.1, 0.15, 0.05, 0.05, 0.1, 0.1], dtype=torch.float64)
    u = inputs_of(model, 2, 3, 6)
    first = None if u is None else u[..., 0, :]
    with torch.no_grad():
        ours, other = (x.rollout(q, p, s, h=h, inputs=u) for x in (exported, eager))
        one, alone = exported.step(State(q, p, s), 0.1, u=first), eager.step(State(q, p, s), 0.1, u=first)
        begun, begin = (x.init(q, q + 0.1 * p, s, 0.1, first) for x in (exported, eager))
    assert ours.ok.all()
    for key in ("q", "p", "s", "sigma"):
        close(getattr(ours, key), getattr(other, key))
    for a, b in zip((*one.state, one.c, *begun), (*alone.state, alone.c, *begin), strict=True):
        close(a, b)
    close(ours.q[..., 1, :], one.state.q, 1e-13)
    if form == "aoti":
        with pytest.raises(InputError, match="holds no derivative"):
            exported.linearise(State(q, p, s), 0.1)
        return
    slopes, exact = (x.linearise(State(q, p, s), 0.1, first) for x in (exported, eager))
    close(slopes.step.state.p, alone.state.p)
    for a, b in zip(slopes[1:], exact[1:], strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert float((a - b).abs().max()) <= 1e-10 * float(b.abs().max())


@pytest.mark.parametrize("form", ["pt2", "onnx", pytest.param("aoti", marks=pytest.mark.slow)])
def test_inputs_reach_their_own_step(form, written):
    # fails if u is lost in the file, or reaches another sample or step than its own, or 0 stands for no input: the zero
    # of a sensor is another number
    model, exported = written(form, "forced")
    q, p, s = states_of(1, 3)
    u = inputs_of(model, 3, 4)
    assert u is not None
    ours = exported.rollout(q, p, s, h=0.1, inputs=u)
    assert bool((exported.rollout(q, p, s, h=0.1, inputs=u * torch.nan).status == Status.DIVERGED).all())
    for bad in (u[..., :1], u.float(), u[:2], u[0, 0]):
        with pytest.raises(InputError, match=r"input|u needs"):
            exported.rollout(q, p, s, h=0.1, steps=4, inputs=bad)
    shared = exported.rollout(q, p, s, h=0.1, inputs=u[1], every=2)
    close(shared.q[1], ours.q[1, ::2], 1e-14)
    with torch.no_grad():
        close(exported.rollout(q, p, s, h=0.1, steps=4).q, beside(model).rollout(q, p, s, h=0.1, steps=4).q)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("name", [*LEVELS, "order 4", "sticking", "drag"])
@pytest.mark.parametrize("form", ["pt2", "onnx"])
def test_a_thousand_steps_at_every_batch_size(form, name, dtype, written):
    # fails if a graph is specialised to a batch or mixes samples, a float64 constant turns a float32 graph into a mixed
    # one, or a rounding adds up
    model, exported = written(form, name, dtype)
    batches = (1, 7) if name in ("full", "order 4") else (1, 1009, 4096)
    found = compare(exported, beside(model), batches=batches, steps=1000)
    assert max(found[key] for key in "qpsc") <= (1e-12 if dtype == torch.float64 else 1e-5), found
    assert found["status"] == found["failed"] == 0


@pytest.mark.slow  # a compiler run of 20–60 s for each
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("name", ["affine", "forced"])
def test_compiled_code_over_a_thousand_steps(name, dtype, written):
    # fails if the code is specialised to a batch, loses an input u, or a loop inside it is miscompiled
    model, exported = written("aoti", name, dtype)
    found = compare(exported, beside(model), batches=(1, 7, 1009, 4096), steps=1000)
    assert max(found[key] for key in "qpsc") <= (1e-12 if dtype == torch.float64 else 1e-5), found
    assert found["status"] == found["failed"] == 0
    q, p, s = states_of(1, 3, dtype)
    u = inputs_of(model, 1, 3)
    outside = exported.programs["rollout"](
        q + 100, p, s, torch.full((1, 3), 0.1).to(q), *(() if u is None else (u.to(q),))
    )
    assert outside[6].tolist() == exported.outside_box(State(q + 100, p, s))[None].to(torch.uint8).tolist()


def test_loops_start_from_standard_layouts():
    # fails if what Newton's loop starts from is transposed: export then refuses m(q) with coupled friction at n = 2
    model = with_terms("m(q), coupled")
    with quiet():
        programs = programs_of(model, describe(model, 0.1, None, (), 30, {}), ("rollout",))
    q, p, s = near(2, 3)
    with torch.no_grad():
        ours = programs["rollout"].module(check_guards=False)(q, p, s, torch.full((4, 3), 0.1, dtype=torch.float64))
        expected = beside(model).rollout(q, p, s, h=0.1, steps=4)
    close(ours[0].movedim(0, 1), expected.q[:, 1:])
    close(ours[1].movedim(0, 1), expected.p[:, 1:])
