"""Exported files: what they compute, what they say of themselves, and what is refused."""

import json
import re
import subprocess
import sys
import zipfile

import pytest
import torch
import torch.export.pt2_archive._package
from export_models import BOX, SMALL, model_of, states_of

import herglotz.export.lower.pt2
from herglotz.data.files import sealed_zip
from herglotz.errors import InputError
from herglotz.export import compare, export_pt2, load_pt2, weights_digest
from herglotz.export.metadata import FORMAT
from herglotz.export.step import StepGraphs, status_of, unfinished
from herglotz.mechanics import flow_derivative, partials, step_derivative
from herglotz.models import ModelConfig
from herglotz.stepping import State, Stepper


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """(model, path, loaded) in two coordinates, where every step is a Newton solve of a 2 × 2 system."""
    model = model_of(2, "affine")
    path = tmp_path_factory.mktemp("pt2") / "affine.pt2"
    export_pt2(model, path, h=0.1, box=BOX, units=["rad", "m"], metadata={"data": "none", "h_range": [0.01, 0.5]})
    return model, path, load_pt2(path)


def test_a_file_matches_the_eager_stepper_at_every_batch_size(written):
    # fails if the graph is specialised to a batch, stops iterating too early or mixes samples
    model, _, exported = written
    result = compare(exported, Stepper(model), steps=10, batches=(1, 7, 1009))
    assert set(result["per_batch"]) == {1, 7, 1009}
    assert max(result[key] for key in ("q", "p", "s", "c")) <= 1e-12, result
    assert result["status"] == result["failed"] == 0
    assert result["same_weights"] is True


def test_the_derivative_of_a_file_is_that_of_the_implicit_function_theorem(written):
    # fails if the solve is detached without the move −J⁻¹dF, or p1, s1 or c do not follow that move
    model, _, exported = written
    q, p, s = states_of(2, 6)
    (q1, _, _), D = flow_derivative(lambda *x: exported.step(State(*x), 0.1).state, q, p, s)
    with torch.no_grad():
        exact = step_derivative(partials(model, q, q1, s, 0.1, 2), p)
    torch.testing.assert_close(D, exact, rtol=1e-10, atol=1e-10)


def test_a_file_steps_without_herglotz(written, tmp_path):
    # fails if the graph or the archive needs this package to be read
    model, whole, _ = written
    path = tmp_path / "step.pt2"
    with zipfile.ZipFile(whole) as every, zipfile.ZipFile(path, "w") as step:
        for name in every.namelist():  # the other programs are left out: torch takes a second or two to read each
            if not re.search(r"/models/(?!model\.json)", name):
                step.writestr(name, every.read(name))
    script = """
import sys, torch
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "herglotz":
            raise ImportError("herglotz is not installed here")
sys.meta_path.insert(0, Blocked())
try:
    import herglotz
except ImportError:
    pass
else:
    raise SystemExit("herglotz was importable")
step = torch.export.load(sys.argv[1]).module()
q, p, s = torch.tensor([[0.25, 0.5]]).double(), torch.tensor([[-0.125, 0.25]]).double(), torch.zeros(1).double()
h = torch.full((1,), 0.1, dtype=torch.float64)
for _ in range(10):
    q, p, s, c, residual, status, outside = step(q, p, s, h)
assert int(status) == 0
rest = 0 * q, 0 * p, 0 * s
assert int(step(*rest, h)[6]) == 0
assert int(step(rest[0], rest[1] + 2, rest[2], h)[6]) == 1
print(*q[0].tolist(), *p[0].tolist(), float(s))
"""
    (tmp_path / "alone.py").write_text(script)
    command = [sys.executable, "-I", str(tmp_path / "alone.py"), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    alone = torch.tensor([float(x) for x in done.stdout.split()], dtype=torch.float64)
    start = (torch.tensor([x], dtype=torch.float64) for x in ([0.25, 0.5], [-0.125, 0.25]))
    with torch.no_grad():
        final = Stepper(model).rollout(*start, h=0.1, steps=10).final
    torch.testing.assert_close(alone, torch.cat([x.reshape(-1) for x in final]), rtol=1e-12, atol=1e-12)


def test_a_program_is_read_at_its_first_call(written, monkeypatch):
    # fails if opening a file reads all its programs, a second or more each, or a call reads its program again
    package, read = torch.export.pt2_archive._package, []
    reader = package._load_exported_programs
    monkeypatch.setattr(package, "_load_exported_programs", lambda *x: (read.append(x[1]), reader(*x))[1])
    exported = load_pt2(written[1])
    assert read == []
    q, _, s = states_of(2, 3)
    once, again = (exported.init(q, q + 0.01, s, 0.1) for _ in range(2))
    assert read == [["models/init.json"]]
    assert torch.equal(once.p, again.p)


def test_metadata_describes_the_file(written):
    # fails if an entry is missing or wrong, or if the hash does not depend on the weights
    model, _, exported = written
    known = exported.metadata
    assert (known["format"], known["level"], known["dof"], known["dtype"], known["h"]) == (
        FORMAT,
        "affine",
        2,
        "float64",
        0.1,
    )
    assert (known["units"], known["angles"], known["box"], known["data"]) == (["rad", "m"], [True, False], BOX, "none")
    assert known["torch_version"] == str(torch.__version__)
    assert ModelConfig.from_dict(known["model"]) == model.config
    assert known["weights_sha256"] == weights_digest(model) != weights_digest(model_of(1, "affine"))
    assert (known["inputs"], known["newton_iterations"]) == (0, 30)


def test_a_file_names_no_local_path(written):
    # fails if torch's stack traces, which name the author's folders, are shipped
    path = written[1]
    with zipfile.ZipFile(path) as archive:
        content = b"".join(archive.read(name) for name in archive.namelist())
    assert b"site-packages" not in content
    assert b"src/herglotz" not in content


def newton(model, iterations, q, p, s, h):
    """The loop of the exported graphs, turned by hand."""
    graphs, h = StepGraphs(model), torch.full_like(s, h)
    state, here, (trail,), _ = graphs.layout.split(graphs.start(q, p, s))
    carry = graphs.begin(h, trail)
    while bool(unfinished(carry[0], carry[1], iterations)):
        carry = graphs.iterate(*state, h, *carry, *here)
    _, done, x, delta, merit, _, _, _, L, c = carry
    return q + x, status_of(h, merit, delta.abs().amax(-1), done, L, c), delta.abs().amax(-1)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_loop_solves_what_the_eager_stepper_solves(n):
    # fails if a sign, a row exchange of the elimination, the backtracking or the tolerance is wrong
    model = model_of(n, "affine", correction=4)
    q, p, s = states_of(n, 64)
    with torch.no_grad():
        q1, status, _ = newton(model, 30, q, p, s, 0.3)
        eager = Stepper(model).step(State(q, p, s), 0.3)
    assert (status == 0).float().mean() > 0.9
    both = (status == 0) & (eager.status == 0)
    torch.testing.assert_close(q1[both], eager.state.q[both], rtol=1e-9, atol=1e-9)


def test_files_of_others_are_refused(tmp_path):
    # fails if a .pt2 file without our metadata, or of a later format, is stepped all the same
    class Double(torch.nn.Module):
        def forward(self, x):
            return 2 * x

    program = torch.export.export(Double(), (torch.ones(3),))
    torch.export.save(program, tmp_path / "other.pt2")
    with pytest.raises(InputError, match="does not end with its sha256"):
        load_pt2(tmp_path / "other.pt2")
    (tmp_path / "other.pt2").write_bytes(sealed_zip((tmp_path / "other.pt2").read_bytes()))
    with pytest.raises(InputError, match="no herglotz metadata"):
        load_pt2(tmp_path / "other.pt2", trust_code=True)
    later = {"format": 99, "dof": 1, "dtype": "float64", "h": 0.1, "box": None}
    later |= {"newton_iterations": 2, "newton_tolerance": 0.0}
    torch.export.save(program, tmp_path / "later.pt2", extra_files={"metadata.json": json.dumps(later)})
    (tmp_path / "later.pt2").write_bytes(sealed_zip((tmp_path / "later.pt2").read_bytes()))
    with pytest.raises(InputError, match="format 99, this herglotz reads 3"):
        load_pt2(tmp_path / "later.pt2", trust_code=True)


def test_what_cannot_be_exported_is_refused(tmp_path):
    # fails if a mistake is found only after the file was written
    model, path = model_of(1, "linear"), tmp_path / "a.pt2"
    for h in (0.0, float("nan")):
        with pytest.raises(InputError, match="h must be a finite number > 0"):
            export_pt2(model, path, h=h)
    with pytest.raises(InputError, match="units needs one entry"):
        export_pt2(model, path, h=0.1, units=["rad", "m"])
    with pytest.raises(InputError, match="box needs exactly the keys"):
        export_pt2(model, path, h=0.1, box={"q_low": [0.0]})
    with pytest.raises(InputError, match="p_low needs 1 numbers"):
        export_pt2(model, path, h=0.1, box={**SMALL, "p_low": [0.0, 1.0]})
    with pytest.raises(InputError, match="q_low must not exceed q_high"):
        export_pt2(model, path, h=0.1, box={**SMALL, "q_low": [2.0]})
    with pytest.raises(InputError, match="may not replace dof"):
        export_pt2(model, path, h=0.1, metadata={"dof": 7})
    with pytest.raises(InputError, match="h_range must be"):
        export_pt2(model, path, h=0.1, metadata={"h_range": [0.2, 0.3]})
    with pytest.raises(InputError, match="cannot be written as JSON"):
        export_pt2(model, path, h=0.1, metadata={"data": torch.ones(1)})
    with pytest.raises(InputError, match="at least 2"):
        export_pt2(model, path, h=0.1, newton_iterations=1)
    with pytest.raises(InputError, match="float32 or float64 model"):
        export_pt2(model_of(1, "linear", dtype=torch.float16), path, h=0.1)
    assert not list(tmp_path.iterdir())


def test_an_unwritable_path_is_refused(tmp_path, monkeypatch):
    # fails if torch's error reaches the user or a partial file stays behind
    monkeypatch.setattr(herglotz.export.lower.pt2, "programs_of", lambda *_: {})  # what is written does not matter here
    monkeypatch.setattr(
        torch.export.pt2_archive._package, "package_pt2", lambda f, **_: zipfile.ZipFile(f, "w").close()
    )
    with pytest.raises(InputError, match="cannot be written"):
        export_pt2(model_of(1, "linear"), tmp_path / "nowhere" / "a.pt2", h=0.1)
    assert not list(tmp_path.iterdir())


def test_the_model_is_left_as_it_was(written):
    # fails if export freezes or converts the caller's own parameters
    model = written[0]
    assert all(x.requires_grad for x in model.parameters())
