"""Arguments that no format steps from: an error in one line, whatever file they are given to (states: unit/trust)."""

from typing import Any

import pytest
import torch
from export_models import BOX, model_of, states_of

import herglotz
from herglotz.errors import InputError
from herglotz.export import export_aoti, export_c, export_onnx, export_pt2, load_exported
from herglotz.stepping import State
from tests.compilers import needs_compiler

FORMATS = [
    pytest.param("pt2", marks=pytest.mark.slow),  # 10 s to write
    "onnx",
    pytest.param("h", marks=needs_compiler),
    pytest.param("compile", marks=needs_compiler),
    pytest.param("aoti", marks=pytest.mark.slow),
]
NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module", params=FORMATS)
def stepper(request, tmp_path_factory) -> Any:
    """The same explicit model, through each format."""
    form, folder, model = request.param, tmp_path_factory.mktemp("bad"), model_of(2, "linear")
    more: dict[str, Any] = {"h": 0.1, "box": BOX, "metadata": {"h_range": [0.01, 0.5]}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        if form == "compile":
            yield herglotz.compile(model)
        elif form == "h":
            yield load_exported(export_c(model, folder / "a.h", **more))
        elif form == "onnx":
            pytest.importorskip("onnx")
            pytest.importorskip("onnxruntime")
            yield load_exported(export_onnx(model, folder / "a.onnx", **more))
        else:
            yield load_exported({"pt2": export_pt2, "aoti": export_aoti}[form](model, folder / "a.pt2", **more))


q, p, s = states_of(2, 3)


def test_other_arguments_are_refused(stepper):
    # fails if a file steps where it was not fitted, loses a step, or takes an input for one that it has not
    if "h_range" in stepper.metadata and stepper.metadata["h_range"] is not None:
        with pytest.raises(InputError, match="h must lie in"):
            stepper.step(State(q, p, s), 0.6)
    with pytest.raises(InputError, match="match the batch"):
        stepper.step(State(q, p, s), torch.full((2,), 0.1, dtype=torch.float64))
    with pytest.raises(InputError, match="takes no inputs"):
        stepper.rollout(q, p, s, h=0.1, steps=2, inputs=torch.zeros(3, 2, 1, dtype=torch.float64))
    for steps in (0, None):
        with pytest.raises(InputError):
            stepper.rollout(q, p, s, h=0.1, steps=steps)
    with pytest.raises(InputError):
        stepper.rollout(q, p, s, h=torch.full((3,), 0.1, dtype=torch.float64), steps=2)


def test_strides_are_no_error(stepper):
    # fails if memory is read in the order in which it lies: transposed, reversed, repeated and overlapping states
    rows = torch.arange(12, dtype=torch.float64).reshape(2, 6)[:, ::2] / 12
    views = State(rows.T, torch.full((1, 1), 0.2, dtype=torch.float64).expand(3, 2), rows[0].flip(0))
    plain = State(*(x.clone(memory_format=torch.contiguous_format) for x in views))
    for a, b in zip(stepper.step(views, 0.1).state, stepper.step(plain, 0.1).state, strict=True):
        assert torch.equal(a, b)
    ours, other = (stepper.rollout(*x, h=0.1, steps=3) for x in (views, plain))
    assert torch.equal(ours.q, other.q)
    assert torch.equal(ours.s, other.s)


def test_what_leaves_the_box_is_flagged(stepper):
    # fails if a format forgets that it was fitted to some states only, or tells it of another step or sample
    if stepper.metadata["box"] is None:
        assert stepper.rollout(q, p, s, h=0.1, steps=2).outside is None
        return
    inside = State(0.3 * q / q.abs().max(), 0.3 * p / p.abs().max(), 0 * s)
    out = stepper.rollout(*inside._replace(s=inside.s + 100), h=0.1, steps=3)  # s moves nothing at this level
    assert not bool(out.outside.any())
    far = inside._replace(p=inside.p.clone().index_fill_(0, torch.tensor(1), 1.5))
    out = stepper.rollout(*far, h=0.1, steps=4, every=2)
    assert out.outside.tolist() == [[0, 0], [1, 1], [0, 0]]
    assert stepper.step(far, 0.1).outside.tolist() == [0, 1, 0]
    # a step that starts outside and ends inside is flagged too, and no other
    high = torch.tensor(stepper.metadata["box"]["q_high"], dtype=torch.float64)
    back = State(0 * q + 0.999 * high, 0 * p - 0.3, 0 * s)
    back = back._replace(q=back.q.clone().index_fill_(0, torch.tensor(2), 1.04 * float(high[0])))
    out = stepper.rollout(*back, h=0.1, steps=3)
    there = stepper.outside_box(out.states)
    assert there.tolist() == [[False] * 4, [False] * 4, [True, True, False, False]]
    assert out.outside.tolist() == [[0, 0, 0], [0, 0, 0], [1, 1, 0]]


def test_a_file_by_itself_has_a_status_for_what_is_no_number(stepper):
    # fails if a NaN passes a file's own loop with status 0, or spreads to its neighbours, or a step h that is not of
    # the range has no flag
    programs = stepper.programs
    if "rollout" not in programs:
        pytest.skip("C is tested by programs in C: test_c_program.py")
    h = torch.full((2, 3), 0.1, dtype=torch.float64)
    fine = programs["rollout"](q, p, s, h)
    h_bad = h.clone()
    h_bad[:, 2] = NAN
    found = programs["rollout"](q, p.clone().index_fill_(0, torch.tensor(1), NAN), s, h_bad)
    assert (found[5][:, 1:] != 0).all()
    assert found[6].tolist() == [[2 * (i == 2) + (i > 0 or bool(y)) for i, y in enumerate(row)] for row in fine[6]]
    assert torch.equal(programs["rollout"](q, p, s, 6 * h)[6] & 2, torch.full((2, 3), 2, dtype=torch.uint8))
    assert found[0][:, 1:].isnan().all()
    assert torch.equal(found[0][:, 0], fine[0][:, 0])
    assert not found[5][:, 0].any()
