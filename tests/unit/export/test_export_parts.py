"""Small parts of what is exported: the compensated sum and the range of steps."""

from types import SimpleNamespace

import pytest
import torch

from herglotz.codegen.interpret import MATHEMATICS
from herglotz.codegen.trace import PRIMES, traced
from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.export import export_run
from herglotz.export.compare import draw
from herglotz.export.exported import check_range
from herglotz.export.load import read_header
from herglotz.export.step import ROUNDING_EPSILONS, _added, first_carry, newton_iteration
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.training import fit


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_rounding_takes_from_a_sum_is_kept(dtype):
    # fails if what was lost is not added to the next change: 1000 changes below the rounding of 1 then leave it at 1
    eps = torch.finfo(dtype).eps
    x, lost, change = torch.ones(3, dtype=dtype), (torch.zeros(3, dtype=dtype),), torch.full((3,), eps / 5, dtype=dtype)
    for _ in range(1000):
        x, *lost = _added(x, change, tuple(lost))
    assert (x - 1 + lost[0]).tolist() == pytest.approx([200 * eps] * 3, rel=1e-5, abs=0)
    assert _added(x, change, ())[0].equal(x)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_at_the_ends_of_the_range_are_taken(dtype):
    # fails if the rounding of an end, in float32 say, is refused, or what is beyond it is not
    for span in ((0.1, 0.2), (0.3, 0.7)):
        check_range(torch.tensor(span, dtype=dtype), span)
        for wrong in (span[0] * (1 - 1e-5), span[1] * (1 + 1e-5)):
            with pytest.raises(InputError, match="where the model was fitted; got"):
                check_range(torch.tensor([span[0], wrong, span[1]], dtype=dtype), span)
    check_range(torch.tensor(9.0), None)


@pytest.mark.parametrize("kept", [False, True])
def test_what_a_trace_leaves_out_changes_nothing(kept):
    # fails if another sum or product than x + 0 and 1 x is taken for x; or if these are written down
    a, b = (2.0, -1.0) if kept else (1.0, 0.0)
    x = torch.rand(PRIMES[0], dtype=torch.float64)

    def function(x):
        scale, more = (torch.full((1,), number, dtype=torch.float64) for number in (a, b))
        return torch.sin(a * (scale * x + b) + more)

    graph = traced(function, (x,))
    assert torch.equal(graph(x)[0], function(x))
    written = {str(node.target) for node in graph.code.nodes if node.op == "call_function"}
    assert bool(written & {"aten.add.Tensor", "aten.mul.Tensor"}) == kept


@pytest.mark.parametrize(
    "function",
    [
        lambda x: (x * torch.linspace(0, 1, PRIMES[0]).double()).sum(-1),
        lambda x: (x * torch.linspace(0, 1, 2 * PRIMES[0]).double()[: PRIMES[1]]).sum(-1),
        lambda x: (x.expand(-1, 5000).reshape(5000 * len(x), 1) * 2).reshape(len(x), 5000).sum(-1),
    ],
)
def test_a_graph_holds_for_any_batch(function):
    # fails if a size that the example's batch divides is taken for the batch, or a large multiple of the batch for a
    # fixed size (derivatives of 32 coordinates: files of them stepped one batch size alone)
    graph = traced(function, (torch.rand(PRIMES[0], 1, dtype=torch.float64),))
    x = torch.rand(5, 1, dtype=torch.float64)
    torch.testing.assert_close(graph(x)[0], function(x))


@pytest.mark.parametrize("function", [lambda x: x - x.mean(0), torch.rand_like])
def test_samples_that_depend_on_one_another_are_refused(function):
    # fails if a file is written that holds for one number of samples alone
    with pytest.raises(InputError, match="how many samples are computed with it, or on random numbers"):
        traced(function, (torch.rand(PRIMES[0], 1, dtype=torch.float64),))


@pytest.mark.parametrize(
    ("function", "calls"),
    [
        (lambda x: (x + 2) * (x + 2), 2),
        (lambda x: (x + 2) * (x + 3), 3),  # fails if other arguments are taken for the same ones
        (lambda x: torch.add(x, x, alpha=2) * torch.add(x, x, alpha=3), 3),  # or other options
        (lambda x: torch.where(x > 0.5, x.sum(-1, keepdim=True), x.sum(-1)[:, None]), 5),
        (lambda x: (x / 0.0).atan() + (x / -0.0).atan(), 5),  # fails if -0.0 is 0.0
        (lambda x: torch.rand_like(x) - torch.rand_like(x), 3),  # fails if two draws are one
    ],
)
def test_what_repeats_is_computed_once(function, calls):
    # fails if the same operation is written down twice, or another one is taken for it
    x = torch.rand(1, 1, dtype=torch.float64)
    graph = traced(function, (x,))
    assert sum(node.op == "call_function" for node in graph.code.nodes) == calls
    torch.manual_seed(0)
    wanted = function(x)
    torch.manual_seed(0)
    assert torch.equal(graph(x)[0], wanted)


@pytest.mark.parametrize("boxed", [True, False])
def test_states_to_compare_at_fill_the_box(boxed):
    # fails if an end of the box is lost: a file is then compared with its run at one state, or at half of them
    ends = {"q": ([-3.0, 1.0], [-2.0, 5.0]), "p": ([0.0, -1.0], [2.0, 1.0]), "s": ([4.0], [4.5])}
    box = {f"{name}_{end}": values[k] for name, values in ends.items() for k, end in enumerate(("low", "high"))}
    file = SimpleNamespace(metadata={"box": box if boxed else None}, dof=2, dtype=torch.float64)
    for name, x in zip("qps", draw(file, 2000, torch.Generator().manual_seed(0)), strict=True):
        low, high = torch.tensor(ends[name] if boxed else ([-1.0], [1.0]), dtype=torch.float64)
        share = (x.reshape(2000, -1) - low) / (high - low)
        assert 0 <= float(share.min()) < 0.01 < 0.99 < float(share.max()) <= 1


@pytest.mark.parametrize("name", MATHEMATICS)
def test_functions_of_constants_are_those_of_torch(name):
    # fails if a constant that is computed when C is written is another one than torch computes
    function = {"fabs": torch.abs, "softplus": torch.nn.functional.softplus}.get(name) or getattr(torch, name)
    for x in (-0.7, -0.0, 0.3, 0.9):
        if x >= 0 or name != "sqrt":
            expected = float(function(torch.tensor(x, dtype=torch.float64)))
            assert MATHEMATICS[name](x) == pytest.approx(expected, rel=1e-14, abs=0)


def test_a_run_says_in_the_file_what_it_is_for(tmp_path):
    # fails if the steps of the data or those asked for are lost, or rounding makes the run's own step foreign
    data = simulate(scene("damped_oscillator"), trajectories=1, steps=12, h=0.2, seed=0)
    run = fit(data, level="linear", objective="residual", iterations=2, progress=False)
    entries = read_header(export_run(run, tmp_path / "a.h"))[1]
    assert entries["h_range"] == pytest.approx(run.h_range, rel=2e-6)
    # fails if a step of 0.2 is foreign to a file whose recorded times differ by 0.19999999999999996
    assert entries["h_range"][0] < run.h * (1 - 1e-9) < run.h * (1 + 1e-9) < entries["h_range"][1]
    assert entries["name"] == "a"
    assert entries["start"]["q"] == run.last_fitted()[0].q.tolist()
    asked = read_header(export_run(run, tmp_path / "b.h", h_range=(0.1, run.h * (1 - 1e-7)), name="arm"))[1]
    assert asked["name"] == "arm"
    assert asked["h_range"] == pytest.approx([0.1, run.h], rel=2e-6)
    assert asked["h_range"][1] > run.h
    for path, kind in (("a.txt", None), ("a.h", "fmi")):
        with pytest.raises(InputError, match="the name must end in"):
            export_run(run, tmp_path / path, kind)


def no_decrease(model, held, q, p, s, h, trial):  # noqa: ARG001
    """A step equation whose |F| is 1 everywhere, with a Newton step of the size of q's rounding."""
    return trial, 0 * s, 1 + 0 * s, p, s, s, None


@pytest.mark.parametrize("scale", [0.0, 1.0])
@pytest.mark.parametrize("size", [0.0, 1.0])
@pytest.mark.parametrize("h", [1e-9, 1.0])
def test_what_rounding_leaves_ends_the_iteration(scale, size, h, monkeypatch):
    # fails if rounding is relative to the least of the move, of q and of h times the speed, instead of the largest
    monkeypatch.setattr("herglotz.export.step.step_equation", no_decrease)
    model = ContactLagrangian(ModelConfig(speed=(1.0,)))
    one = torch.ones(1, 1, dtype=torch.float64)
    move = 0.5 * ROUNDING_EPSILONS * torch.finfo(torch.float64).eps * one
    _, _, x, _, _, fraction, _, *values = first_carry(move)
    carry = (torch.tensor(1), torch.tensor([False]), x, move, one[0], fraction, scale * one[0], *values)
    done = newton_iteration(model, size * one, one, one[0], h * one[0], *carry)[1]
    assert done.tolist() == [max(scale, size, h) == 1.0]
