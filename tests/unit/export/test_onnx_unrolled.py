"""ONNX files of one step without a loop, for importers that take none."""

import functools

import pytest
import torch
from export_models import model_of, near, states_of, with_terms

from herglotz.errors import InputError
from herglotz.export import compare, export_onnx, load_onnx
from herglotz.export.equation import Equations
from herglotz.export.programs import StepModule
from herglotz.export.step import StepGraphs
from herglotz.stepping import State, Status, Stepper

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
MODELS = {
    "explicit": lambda: model_of(2, "linear"),
    "network": lambda: model_of(1, "affine"),
    "sticking": lambda: with_terms("sticking"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A function of a name in `MODELS`: the model and its file, made once."""

    @functools.cache
    def file(name):
        model = MODELS[name]()
        return model, export_onnx(model, tmp_path_factory.mktemp("unrolled") / "step.onnx", h=0.1, unroll=3)

    return file


@pytest.mark.parametrize("name", MODELS)
def test_there_is_no_loop_and_the_steps_are_those_of_the_eager_stepper(name, written):
    # fails if a loop or a branch is left, an iteration is missing, finished samples go on, rows of h or u are mixed up,
    # or the Jacobian in the metadata has a loop
    model, path = written(name)
    proto = onnx.load(path)
    assert not {node.op_type for node in proto.graph.node} & {"Loop", "Scan", "If"}
    assert [x.name for x in proto.graph.input] == ["q", "p", "s", "h", *(["u"] if model.inputs else [])]
    assert [len(x.type.tensor_type.shape.dim) for x in proto.graph.input][:4] == [2, 2, 1, 1]
    loaded = load_onnx(path)
    found = compare(loaded, Stepper(model), steps=10, batches=(1, 5))
    assert max(found[key] for key in ("q", "p", "s", "c")) <= 1e-12, found
    assert found["status"] == found["failed"] == 0
    state, h = near(model.dof, 3), torch.tensor([[0.1, 0.05], [0.1, 0.02], [0.07, 0.1]], dtype=torch.float64)
    u = torch.tensor([[[0.4], [-0.2]]], dtype=torch.float64).expand(3, 2, 1) if model.inputs else None
    with torch.no_grad():
        ours, theirs = (x.rollout(*state, h=h, inputs=u) for x in (loaded, Stepper(model, tol=1e-15)))
    torch.testing.assert_close(ours.q, theirs.q, rtol=1e-12, atol=1e-12)
    J, of = (x.linearise(state, 0.1, None if u is None else u[:, 0]).by_state for x in (loaded, Stepper(model)))
    torch.testing.assert_close(J, of, rtol=1e-9, atol=1e-9)


def test_too_few_iterations_are_a_status(written, tmp_path):
    # fails if a step that has not converged passes for one, or the number counts one iteration more or less
    model, path = written("network")
    q, p, s = states_of(1, 20)
    # Of 20 samples two iterations lose all, three lose 8, four lose none.
    step = load_onnx(path).step(State(q, p, s), 0.3)
    lost = step.status == Status.MAX_ITERATIONS
    assert lost.any()
    equations = Equations.of(model)
    with torch.no_grad():
        looped = StepModule(equations, StepGraphs(equations.model), 3)(q, p, s, torch.full_like(s, 0.3))
    assert torch.equal(step.status, looped[5])
    assert torch.isnan(step.state.q[lost]).all()
    with pytest.raises(InputError, match="unroll must be a number of iterations of at least 2, got 1"):
        export_onnx(model, tmp_path / "one.onnx", h=0.1, unroll=1)


def test_casadi_reads_the_file(written):
    # fails if CasADi's importer of ONNX finds a loop, or the names of inputs and outputs are others
    ca = pytest.importorskip("casadi", reason="casadi is not installed (extra: control)")
    if not hasattr(ca, "GraphBuilder"):
        pytest.skip("this casadi has no importer of ONNX")
    _, path = written("network")
    read = ca.GraphBuilder(str(path), {})
    assert read.name_in() == ["q", "p", "s", "h"]
    assert read.name_out()[:3] == ["q_out", "p_out", "s_out"]
    assert read.dynamic_params() == ["B"]
