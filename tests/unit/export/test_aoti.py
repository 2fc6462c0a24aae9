"""Machine code files: what is refused without compiling, and (slow) what they compute."""

import json

import pytest
import torch
from test_pt2 import SMALL, beside, damped, model_of, states_of

from herglotz.errors import InputError
from herglotz.export import ExportedStepper, compare, export_aoti, load_pt2
from herglotz.export.metadata import describe
from herglotz.stepping import State


def test_a_missing_compiler_is_one_line(tmp_path, monkeypatch):
    # fails if inductor's traceback is what a user without g++ sees
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(InputError, match=r"no C\+\+ compiler .* apt install g\+\+"):
        export_aoti(model_of(1, "linear"), tmp_path / "a.pt2", h=0.1)
    monkeypatch.setenv("CXX", "nothing-of-the-kind")
    with pytest.raises(InputError, match=r"\$CXX names 'nothing-of-the-kind'"):
        export_aoti(model_of(1, "linear"), tmp_path / "a.pt2", h=0.1)
    assert not list(tmp_path.iterdir())


def test_only_what_the_code_can_read_reaches_it():
    # fails if a stride, a dtype, a NaN or h <= 0 is passed on: compiled code reads memory as it comes
    seen = []

    def rollout(*x):
        seen.append(x)
        q, p, s, h = x
        rows = (q[None], p[None], s[None], h, h, torch.zeros_like(h, dtype=torch.uint8))
        return tuple(y.expand(h.shape[0], *y.shape[1:]) for y in rows)

    known = json.loads(json.dumps(describe(model_of(2, "linear"), 0.1, None, (), 30, {})))
    exported = ExportedStepper({"rollout": rollout}, known, kind="aoti")
    q, p, s = states_of(2, 4)
    exported.step(State(q.T.contiguous().T, p[:, [1, 0]], s), torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))
    exported.rollout(q[:1], p[:1], s[:1], h=0.1, steps=3)
    for arguments in seen:
        assert all(x.is_contiguous() and x.dtype == torch.float64 for x in arguments)
        assert len({x.data_ptr() for x in arguments}) == 4
    assert seen[0][0].stride() == (2, 1)
    assert seen[1][3].shape == (3, 1)
    for bad in (State(q.float(), p, s), State(q, p * torch.nan, s), State(q, p[:2], s), State(q, p, s[:, None])):
        with pytest.raises(InputError):
            exported.step(bad, 0.1)
    for h in (0.0, -1.0, float("nan"), torch.tensor([0.1, 0.1])):
        with pytest.raises(InputError):
            exported.step(State(q, p, s), h)
    assert len(seen) == 2


@pytest.mark.slow  # a compiler run of 20–60 s for each
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("level", ["affine", "forced"])
def test_a_file_matches_the_eager_stepper(level, dtype, tmp_path):
    # fails if the code is specialised to a batch, loses an input u, or a loop inside it is miscompiled
    inputs = 2 if level == "forced" else 0
    model = damped(level, dtype, inputs)
    exported = load_pt2(export_aoti(model, tmp_path / "code.pt2", h=0.1, box=SMALL))
    assert exported.kind == "aoti"
    result = compare(exported, beside(model), batches=(1, 7, 1009, 4096), steps=1000)
    assert max(result[key] for key in ("q", "p", "s", "c")) <= (1e-12 if dtype == torch.float64 else 1e-5), result
    assert result["status"] == result["failed"] == 0
    q, p, s = states_of(1, 3, dtype)
    u = (torch.linspace(-1, 1, 6).reshape(3, 2).to(q),) if inputs else ()
    ours = exported.init(q, q + 0.1 * p, s, 0.1, *u)
    with torch.no_grad():
        eager = beside(model).init(q, q + 0.1 * p, s, 0.1, *u)
    for a, b in zip(ours, eager, strict=True):
        torch.testing.assert_close(a, b)
    outside = exported.programs["rollout"](q + 100, p, s, torch.full((1, 3), 0.1).to(q), *(x[None] for x in u))
    assert outside[6].tolist() == exported.outside_box(State(q + 100, p, s))[None].to(torch.uint8).tolist()
