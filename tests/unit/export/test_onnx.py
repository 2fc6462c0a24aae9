"""ONNX files: the same motion as the eager stepper, on onnxruntime and numpy alone, with a status for every failure."""

import subprocess
import sys

import pytest
import torch
from export_models import BOX, model_of, states_of

from herglotz.errors import InputError
from herglotz.export import compare, export_onnx, load_onnx, weights_digest
from herglotz.export.differences import differenced
from herglotz.mechanics import flow_derivative, partials, step_derivative
from herglotz.stepping import State, Status, Stepper

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """(model, path, loaded) in two coordinates, where every step is a Newton solve of a 2 × 2 system."""
    model = model_of(2, "affine")
    path = tmp_path_factory.mktemp("onnx") / "affine.onnx"
    export_onnx(model, path, h=0.1, box=BOX, units=["rad", "m"], metadata={"data": "none"})
    return model, path, load_onnx(path)


def test_a_file_matches_the_eager_stepper_at_every_batch_size(written):
    # fails if the graph is specialised to a batch or to a number of steps, or mixes samples
    model, _, exported = written
    result = compare(exported, Stepper(model), steps=20, batches=(1, 7, 4096))
    assert max(result[key] for key in ("q", "p", "s", "c")) <= 1e-12, result
    assert result["status"] == result["failed"] == 0


def test_a_file_steps_without_torch_and_herglotz(written, tmp_path):
    # fails if the graph needs a custom operator, or bad input gives numbers without a status
    script = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "herglotz", "onnx"):
            raise ImportError(name + " is not installed here")
sys.meta_path.insert(0, Blocked())
import numpy as np, onnxruntime as ort, json
session = ort.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
known = json.loads(session.get_modelmeta().custom_metadata_map["herglotz"])
assert (known["dof"], known["dtype"], known["level"]) == (2, "float64", "affine")
names = [x.name for x in session.get_outputs()]
def roll(q, p, s, h, dtype=float):
    feeds = {k: np.asarray(x, dtype) for k, x in zip(("q", "p", "s", "h"), (q, p, s, h))}
    return dict(zip(names, session.run(None, feeds)))
good = roll([[0.25, 0.5]], [[-0.125, 0.25]], [0.0], [[0.1]] * 50)
assert not good["status"].any() and good["q_out"].shape == (50, 1, 2)
print(*good["q_out"][-1, 0], *good["p_out"][-1, 0], good["s_out"][-1, 0])
# Bad values: a status in that sample, NaN behind it, and nothing in its neighbour.
for h in (0.0, -0.1, np.nan, np.inf):
    found = roll([[0.1, 0.1]] * 2, [[0.1, 0.1]] * 2, [0, 0], [[h, 0.1]])
    assert found["status"][0, 0] != 0 and found["status"][0, 1] == 0, h
    assert np.isnan(found["q_out"][0, 0]).all() and np.isfinite(found["q_out"][0, 1]).all()
found = roll([[np.nan, 0.1]], [[0.1, 0.1]], [0], [[0.1]] * 2)
assert (found["status"] != 0).all() and np.isnan(found["q_out"]).all() and (found["outside"] == 1).all()
assert roll([[3.0, 0.0]], [[0.0, 0.0]], [0.0], [[0.1]])["outside"].all()
# Bad shapes and dtypes: an error.
for arguments in (([[0.1]], [[0.1, 0.1]], [0], [[0.1]]), ([[0.1, 0.1]] * 3, [[0.1, 0.1]] * 2, [0, 0], [[0.1, 0.1]])):
    try:
        roll(*arguments)
    except Exception:
        continue
    raise SystemExit("accepted " + repr(arguments))
try:
    roll([[0.1, 0.1]], [[0.1, 0.1]], [0], [[0.1]], np.float32)
except Exception:
    sys.exit(0)
raise SystemExit("accepted float32")
"""
    (tmp_path / "alone.py").write_text(script)
    command = [sys.executable, "-I", str(tmp_path / "alone.py"), str(written[1])]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    alone = torch.tensor([float(x) for x in done.stdout.split()], dtype=torch.float64)
    start = (torch.tensor([x], dtype=torch.float64) for x in ([0.25, 0.5], [-0.125, 0.25]))
    with torch.no_grad():
        final = Stepper(written[0]).rollout(*start, h=0.1, steps=50).final
    torch.testing.assert_close(alone, torch.cat([x.reshape(-1) for x in final]), rtol=1e-12, atol=1e-12)


def test_the_file_is_small_and_says_what_it_is(written):
    # fails if weights are stored twice, local paths are shipped, or the metadata is lost
    model, path, exported = written
    content = path.read_bytes()
    proto = onnx.load(path)
    real = onnx.TensorProto.DOUBLE
    constants = sum(len(x.raw_data) for x in proto.graph.initializer if x.data_type == real)
    assert constants < 8 * sum(x.numel() * x.element_size() for x in model.parameters())
    assert not any(node.op_type == "Constant" for node in proto.graph.node)
    assert len(content) < 250_000
    assert b"site-packages" not in content
    assert b"src/herglotz" not in content
    known = exported.metadata
    assert (known["box"], known["units"], known["data"]) == (BOX, ["rad", "m"], "none")
    assert known["weights_sha256"] == weights_digest(model)
    assert exported.kind == "onnx"


def test_differences_are_the_derivative(written):
    # fails if a weight of the difference formula, an offset or the order of the columns is wrong
    model, _, exported = written
    q, p, s = states_of(2, 5)
    (q1, _, _), D = flow_derivative(lambda *x: differenced(exported)(State(*x), 0.1).state, q, p, s)
    with torch.no_grad():
        exact = step_derivative(partials(model, q, q1, s, 0.1, 2), p)
    torch.testing.assert_close(D, exact, rtol=1e-9, atol=1e-9)


def test_gradients_and_wrong_starts_are_refused(written):
    # fails if the loader leaves the checks to onnxruntime; wrong states are in test_bad_input.py
    exported = written[2]
    q, p, s = states_of(2, 4)
    with pytest.raises(InputError, match="has no derivatives"):
        exported.step(State(q.requires_grad_(), p, s), 0.1)
    with pytest.raises(InputError, match="q0 must be finite"):
        exported.init(q.detach() * torch.nan, p, s, 0.1)
    with pytest.raises(InputError, match="takes no inputs"):
        exported.init(q.detach(), p, s, 0.1, u=p)


def test_a_file_starts_from_positions(written):
    # fails if init returns the momentum of FL⁻, or s0 in place of s1, or is not in the file
    import base64

    import onnxruntime as ort

    model, _, exported = written
    q0, delta, s0 = states_of(2, 5)
    ours = exported.init(q0, q0 + 0.1 * delta, s0, 0.1)
    with torch.no_grad():
        eager = Stepper(model).init(q0, q0 + 0.1 * delta, s0, 0.1)
    for a, b in zip(ours, eager, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    found = ort.InferenceSession(str(written[1]), providers=["CPUExecutionProvider"]).get_modelmeta()
    second = base64.b64decode(found.custom_metadata_map["herglotz_init"])
    session = ort.InferenceSession(second, providers=["CPUExecutionProvider"])
    names = [x.name for x in session.get_inputs()]
    assert names == ["q0", "q1", "s0", "h"]
    h = torch.full((5,), 0.1, dtype=torch.float64)
    p, _ = session.run(None, {k: x.numpy() for k, x in zip(names, (q0, q0 + 0.1 * delta, s0, h), strict=True)})
    torch.testing.assert_close(torch.as_tensor(p), eager.p, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("correction", [0, 4], ids=["explicit", "newton"])
def test_explicit_and_iterated_steps_agree_with_eager_in_float32(correction, tmp_path):
    # fails if a single precision sum, the guess of a first step or a lost neighbour changes a step, if one h for each
    # sample is read as one for all, or a step without c has another status than the eager one; float64 has its own
    # files: those of the affine level above, and the closed form of test_matrix.py
    dtype, tol = torch.float32, 1e-4
    model = model_of(2, "linear", correction, dtype)
    exported = load_onnx(export_onnx(model, tmp_path / "linear.onnx", h=0.1))
    q, p, s = (0.5 * x for x in states_of(2, 6, dtype))
    own = torch.linspace(0.05, 0.15, 6, dtype=dtype)[:, None].expand(6, 35)
    for h in (torch.full((35,), 0.1, dtype=dtype), own, torch.linspace(0.05, 0.15, 35, dtype=dtype)):
        with torch.no_grad():
            ours, eager = exported.rollout(q, p, s, h=h), Stepper(model).rollout(q, p, s, h=h)
        for name in ("q", "p", "s", "sigma"):
            torch.testing.assert_close(getattr(ours, name), getattr(eager, name), rtol=tol, atol=tol)
        assert not ours.status.any()
        assert float(ours.residual.max()) <= 1e-6
    if correction == 0:
        own = own.clone()
        own[1, 20] = 1e4
        with torch.no_grad():
            ours, eager = (x.rollout(q, p, s, h=own) for x in (exported, Stepper(model)))
        assert int(ours.status[1, 20]) == Status.SINGULAR
        assert torch.equal(ours.status, eager.status)
    p[2] = torch.finfo(dtype).max / 4
    with torch.no_grad():
        lost, alone = exported.rollout(q, p, s, h=0.1, steps=35), exported.rollout(q[:2], p[:2], s[:2], h=0.1, steps=35)
    assert lost.ok.tolist() == [True, True, False, True, True, True]
    first = int((lost.status[2] != 0).int().argmax())
    assert torch.isnan(lost.q[2, first + 1 :]).all()
    assert (lost.status[2, first:] != 0).all()
    torch.testing.assert_close(lost.q[:2], alone.q, rtol=tol, atol=tol)


def test_unreadable_files_and_missing_packages(written, tmp_path, monkeypatch):
    # fails if onnxruntime's own exceptions reach the user, or a missing package is a traceback
    with pytest.raises(InputError, match="no such file"):
        load_onnx(tmp_path / "nothing.onnx")
    (tmp_path / "half.onnx").write_bytes(written[1].read_bytes()[:1000])
    with pytest.raises(InputError, match="does not end with its sha256"):
        load_onnx(tmp_path / "half.onnx")
    other = onnx.load(written[1])
    del other.metadata_props[:]
    onnx.save(other, tmp_path / "other.onnx")
    with pytest.raises(InputError, match="does not end with its sha256"):
        load_onnx(tmp_path / "other.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match="pip install onnxruntime"):
        load_onnx(written[1])
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(InputError, match=r"pip install 'herglotz\[export\]'"):
        export_onnx(written[0], tmp_path / "a.onnx", h=0.1)
