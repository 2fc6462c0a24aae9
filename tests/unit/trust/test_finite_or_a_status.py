"""A number that is not finite has a status, eager and exported; every wrong start is refused at one door."""

import itertools

import pytest
import torch

from herglotz.errors import InputError
from herglotz.export import ExportedStepper, compile_c, export_onnx, load_exported
from herglotz.export.metadata import describe
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, StepError, Stepper
from tests.compilers import CC, needs_compiler

LARGEST = {torch.float32: 3.3e38, torch.float64: 1.7e308}


def steppers(model):
    return [Stepper(model), *([compile_c(model)] if CC else [])]


def silent(out):
    """Whether a number that is not finite has no status."""
    bad = ~torch.isfinite(torch.cat([out.q, out.p, out.s[..., None], out.sigma[..., None]], -1)).all(-1)[..., 1:]
    return bool((bad & (out.status == 0)).any())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", ["conservative", "linear", "affine", "full"])
def test_sizes_at_the_end_of_the_numbers(level, dtype):
    # fails if a step is CONVERGED with NaN, or one sample raises where three have a status
    model = ContactLagrangian(ModelConfig(level=level, angles=(False,))).to(dtype)
    big = LARGEST[dtype]
    for stepper in steppers(model):
        for batch in (1, 3):
            zero = torch.zeros(batch, 1, dtype=dtype)
            for q, p, s in ((big, 0.3, 0.0), (-big, 0.3, 0.0), (0.3, big, 0.0), (0.3, 0.3, big), (big, big, big)):
                assert not silent(stepper.rollout(zero + q, zero + p, zero[:, 0] + s, h=0.1, steps=3)), (q, p, s)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", ["linear", "affine"])
def test_growth_of_s_and_of_the_conformal_factor(level, dtype):
    # fails if σ or s overflows in silence: c = e^60 a step, at rest, where q and p stay 0
    model = ContactLagrangian(ModelConfig(level=level, rate=-60.0, potential_width=0)).to(dtype)
    steps = {torch.float32: 2, torch.float64: 12}[dtype]  # e^60 ^ steps is the first beyond the largest number
    for stepper in steppers(model):
        for batch in (1, 3):
            zero = torch.zeros(batch, 1, dtype=dtype)
            still = stepper.rollout(zero, zero, h=1.0, steps=20)
            assert not silent(still)
            assert still.status[0].tolist() == [0] * (steps - 1) + [3] * (21 - steps)
            assert bool(still.q[:, steps:].isnan().all())
            moved = stepper.rollout(zero, zero, zero[:, 0] + 1e30, h=1.0, steps=20)
            assert not silent(moved)


def test_the_factor_of_an_exported_file(model):
    # fails if a file's σ, which Python multiplies, overflows in silence
    factor = torch.full((400, 1), 10.0, dtype=torch.float64)
    zero = torch.zeros(400, 1, dtype=torch.float64)
    said = (zero[..., None], zero[..., None], zero, factor, zero, zero.byte())
    program = ExportedStepper({"rollout": lambda *_: said}, describe(model, 0.1, None, (), 30, {}))
    out = program.rollout(zero[:1], zero[:1], h=0.1, steps=400)
    assert not silent(out)
    assert int((out.status == 0).sum()) == 308


@pytest.mark.parametrize("level", ["conservative", "linear", "full", "forced"])
def test_what_is_not_finite_is_the_loss_of_one_sample(level, files):
    # fails if a file refuses a batch of which the eager stepper loses one sample, or loses another, or with another
    # status; s = NaN moves nothing at the conservative level
    driven = int(level == "forced")
    model = ContactLagrangian(ModelConfig(level=level, inputs=driven))
    named = steppers(model) + ([load_exported(files("onnx"))] if level == "linear" else [])
    fine = [torch.full((3, 1), 0.3).double(), torch.full((3, 1), 0.2).double(), torch.full((3,), 0.1).double()]
    for stepper, k, value in itertools.product(named, range(4 if driven else 3), (float("nan"), float("inf"))):
        start, u = [x.clone() for x in fine], torch.zeros(3, 2, 1).double() if driven else None
        (start[k] if k < 3 else u)[1] = value  # pyright: ignore[reportOptionalSubscript]
        with torch.no_grad():
            out = stepper.rollout(*start, h=0.1, inputs=u, steps=2)
            step, slopes = (f(State(*start), 0.1, u=None if u is None else u[:, 0])
                            for f in (stepper.step, stepper.linearise))  # fmt: skip
            alone = stepper.rollout(*(x[:1] for x in fine), h=0.1, steps=2)
        assert out.status.tolist() == [[0, 0], [3, 3], [0, 0]]
        assert step.status.tolist() == slopes.step.status.tolist() == [0, 3, 0]
        assert bool(out.q[1, 1:].isnan().all() & step.state.s[1].isnan() & slopes.by_state[1].isnan().all())
        torch.testing.assert_close(out.q[0], alone.q[0], rtol=1e-13, atol=0)
        with pytest.raises(InputError, match="q1 must be finite"):
            stepper.init(fine[0], fine[1] * value, fine[2], 0.1)


@pytest.mark.usefixtures("registered_once")
def test_a_momentum_at_the_end_of_the_numbers_moves_a_file(tmp_path):
    # fails if a file calls a guess that it gave up CONVERGED: q stayed where it was for p > 1.63e308, where the size of
    # the equation and of its first move are numbers, and their sum is none
    pytest.importorskip("onnxruntime")
    # It iterates.
    model = ContactLagrangian(
        ModelConfig(level="linear", angles=(False,), potential_width=0, correction_width=2, correction_depth=1)
    )
    file = load_exported(export_onnx(model, tmp_path / "model.onnx", h=0.1))
    p = torch.linspace(1.5e308, 1.79e308, 30, dtype=torch.float64)[:, None]
    out = file.rollout(torch.zeros_like(p), p, h=0.1, steps=1)
    moved = (out.q[:, 1] / p - 0.1).abs() < 0.01
    assert bool((moved[:, 0] | (out.status[:, 0] != 0)).all())


def test_s_that_is_no_number_where_nothing_depends_on_it():
    # fails if the state of an L_d without s is not looked at
    stepper = Stepper(lambda q0, q1, s0, h: ((q1 - q0) ** 2).sum(-1) / h)  # noqa: ARG005
    x = torch.ones(2, 1, dtype=torch.float64)
    step = stepper.step(State(x, x, torch.tensor([0.0, float("nan")], dtype=torch.float64)), 0.1)
    assert step.status.tolist() == [0, 3]
    assert stepper.step(State(x[:1], x[:1] * 1e300, x[:1, 0] * 1.7e308), 0.1).status.tolist() == [3]


@needs_compiler
@pytest.mark.parametrize("h", [1e-7, 1e-9, 1e-12])
def test_short_steps_keep_the_momentum(h):
    # fails if p = D2 L_d is made of a difference of positions: errors of 1e-3 at h = 1e-12; measured now: 3e-16
    model = ContactLagrangian(ModelConfig(level="affine"))
    start = torch.tensor([[0.7]], dtype=torch.float64)
    with torch.no_grad():
        eager = Stepper(model).rollout(start, start, h=h, steps=10)
    compiled = compile_c(model).rollout(start, start, h=h, steps=10)
    assert float((eager.p - compiled.p).abs().max()) < 1e-13


def test_the_door(model):
    # fails if eager `init` and `step` take what exported files refuse
    one = torch.ones(3, 1, dtype=torch.float64)
    stepper, s = Stepper(model), torch.zeros(3, dtype=torch.float64)
    wrong = [
        (one.repeat(1, 2), one.repeat(1, 2), s, 0.1, "the model 1"), (one, one[:2], s, 0.1, "need shapes"),
        (one, one.float(), s, 0.1, "one dtype"), (one, one, s, 0.0, "h must be > 0"),
        (one, one, s, float("inf"), "h must be finite, got inf"), (one, one, s, float("nan"), "got nan"),
        (one.long(), one.long(), s.long(), 0.1, "floating point"), (one[0, 0], one[0, 0], s[0], 0.1, "needs shape"),
    ]  # fmt: skip
    for q, p, action, h, message in wrong:
        for call in (lambda q, p, s, h: stepper.step(State(q, p, s), h), stepper.init):
            with pytest.raises(InputError, match=message):
                call(q, p, action, h)
    with pytest.raises(InputError, match="q1 must be finite, got 1"):
        stepper.init(one[:1], one[:1] * float("nan"), s[:1], 0.1)


def test_a_start_that_is_too_fast_is_said(model, files):
    # fails if `init`, which has no status, gives NaN in silence
    far = torch.tensor([[0.0], [1e300]], dtype=torch.float64)
    named = {"eager": Stepper(model), "onnx": load_exported(files("onnx"))}
    named |= {"c": compile_c(model)} if CC else {}
    for stepper in named.values():
        with pytest.raises(StepError, match=r"init failed at sample \(1,\)"):
            stepper.init(torch.zeros_like(far), far, h=1e-20)
