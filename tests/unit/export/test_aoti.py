"""Machine code files: what is refused without compiling, and (slow) what they compute."""

import json

import pytest
import torch
from export_models import model_of, states_of

from herglotz.errors import InputError
from herglotz.export import ExportedStepper, export_aoti
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
    # fails if a stride is passed on: compiled code ignores strides (test_bad_input.py has wrong states and steps)
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
    assert len(seen) == 2
