"""Any state at every public door of every stepper: refused where it must be, and nowhere else; never silently wrong.

Scenes, levels, C and files are given states of any shape, dtype, layout in memory and size of their numbers, and steps
h of any kind.
"""

import random
from typing import Any

import pytest
import torch

from herglotz.errors import InputError
from herglotz.export import compile_c, load_exported, load_pt2
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene, scene_names
from herglotz.stepping import State, StepError, Stepper
from tests.compilers import CC

LEVELS = ("conservative", "linear", "affine", "full", "forced")
SINGLE = ("eager affine float32", "c forced float32")
KINDS = [
    *(f"scene {name}" for name in scene_names()),
    *(f"{how} {level} float64" for how in ("eager", "c") for level in LEVELS),
    *SINGLE,
    "file onnx",
    pytest.param("file pt2", marks=pytest.mark.slow),  # 10 s to write
]
TRIALS = 25
NAN, INF = float("nan"), float("inf")
EXTREMES = (0.0, -0.0, 1e-320, -1e-30, 1e8, -1e30, 1e300, NAN, INF, -INF)
SHAPES = ((), (1,), (3,), (5,), (2, 3), (3, 1), (0,))
OTHER = (torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.complex128)
# Steps h that are taken, at whatever status,
LENGTHS = {torch.float64: (0.1, 0.05, 1e-9, 1e-300, 1e300, 1), torch.float32: (0.1, 0.05, 1e-9, 1e-30, 1e30, 1)}
WRONG = (0.0, -0.1, NAN, INF, -INF, 0)  # and those that are not
# The same sample in a batch and alone, relative to 1 + its size: the same bits on the processor that it was written on.
# 1e4 and 100 roundings are left to those whose single and wide registers round differently.
ALONE = {torch.float64: 1e-12, torch.float32: 1e-5}


@pytest.fixture(params=KINDS, scope="module")
def kind(request, files) -> tuple[Any, int, torch.dtype]:
    """A stepper, its number of coordinates, and its precision."""
    how, name, *single = request.param.split()
    dtype = torch.float32 if "float32" in single else torch.float64
    if how == "scene":
        return Stepper(scene(name).L_d), scene(name).dof, dtype
    if how == "file":
        return load_pt2(files(name)) if name == "pt2" else load_exported(files(name)), 1, dtype
    if how == "c" and CC is None:
        pytest.skip("no C compiler in the PATH")
    return {"eager": Stepper, "c": compile_c}[how](ContactLagrangian(ModelConfig(level=name)).to(dtype)), 1, dtype


def laid_out(make, x):
    """The same numbers, otherwise in memory: with gaps, or with the last axis first."""
    match make.randrange(3):
        case 0:
            return torch.stack([x, x], -1)[..., 0]
        case 1 if x.dim() > 1:
            return x.mT.contiguous().mT
    return x


def drawn(make, n, dtype):
    """A state: most of its numbers are ordinary."""
    lead = make.choice(SHAPES)
    each = [make.choice(EXTREMES) if make.random() < 0.04 else make.uniform(-1, 1) for _ in range(1000)]
    numbers = torch.tensor(each, dtype=torch.float64).to(dtype)
    starts, shapes = (0, 300, 700), ((*lead, n), (*lead, n), lead)
    q, p, s = (numbers[k : k + torch.Size(x).numel()].reshape(x) for k, x in zip(starts, shapes, strict=True))
    return State(laid_out(make, q), laid_out(make, p), laid_out(make, s))


def spoilt(make, state):
    """The same state with one thing that no stepper takes."""
    q, p, s = state
    k = make.randrange(6)
    if k == 0:
        return State(*(x.to(make.choice(OTHER)) for x in state))
    return [
        State(q, p.to(torch.float32 if p.dtype == torch.float64 else torch.float64), s),
        State(torch.cat([q, q], -1), p, s),
        State(q, p, s[..., None]),
        State(q[None], p, s),
        State(q.numpy(), p.numpy(), s.numpy()),
    ][k - 1]


def doors(stepper, state, h):
    """Every way to step from a state once."""
    yield "step", lambda: stepper.step(state, h)
    yield "rollout", lambda: stepper.rollout(*state, h=h, steps=1)
    yield "linearise", lambda: stepper.linearise(state, h).step
    yield "init", lambda: stepper.init(*state, h=h)


def shown(name, found):
    """The next state and its status, as tensors; `init` has none: it raises."""
    if name == "init":
        return found, torch.zeros_like(found.s, dtype=torch.uint8)
    if name == "rollout":
        return State(found.q[..., 1, :], found.p[..., 1, :], found.s[..., 1]), found.status[..., 0]
    return found.state, found.status


def assert_sound(name, found, state):
    """Shapes and dtype are those of the state; a sample that has status 0 is finite, and any other NaN."""
    new, status = shown(name, found)
    for a, b in zip(new, state, strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype), name
    good = status == 0
    finite = torch.isfinite(new.q).all(-1) & torch.isfinite(new.p).all(-1) & torch.isfinite(new.s)
    assert torch.equal(finite, good), name
    assert bool(new.q[~good].isnan().all()), name


def test_a_door_takes_what_it_can_and_nothing_else(kind):
    # fails if a door refuses a layout in memory, takes what is no state or step, raises something else, changes a shape
    # or a dtype, or gives a number that is not finite without a status
    make, (stepper, n, dtype) = random.Random(0), kind
    eager = isinstance(stepper, Stepper)
    taken = 0
    for trial in range(TRIALS):
        state, h = drawn(make, n, dtype), make.choice(LENGTHS[dtype])
        wrong = trial % 3
        state = spoilt(make, state) if wrong == 1 else state
        h = make.choice(WRONG) if wrong == 2 else h
        for name, door in doors(stepper, state, h):
            if wrong:
                with pytest.raises(InputError):
                    door()
                continue
            refused = (not eager and state.s.numel() == 0) or (
                name == "init" and not all(bool(torch.isfinite(x).all()) for x in state)
            )
            if refused:
                with pytest.raises(InputError, match=r"no samples|must be finite"):
                    door()
                continue
            try:
                found = door()
            except StepError:
                assert name == "init", name  # p1 or s1 of two positions far apart is too large
                continue
            assert_sound(name, found, state)
            taken += 1
    assert taken > TRIALS // 2


def test_alone_equals_batch(kind):
    # fails if samples of a batch, one of them lost, act on one another, or a leading axis is taken for another
    make, (stepper, n, dtype) = random.Random(1), kind
    q, p = (torch.tensor([make.uniform(0.2, 0.8) for _ in range(6 * n)], dtype=dtype).reshape(2, 3, n) for _ in "qp")
    s = torch.linspace(-1, 1, 6, dtype=dtype).reshape(2, 3)
    p[0, 1, 0], s[1, 2] = NAN, INF
    for name, door in doors(stepper, State(q, p, s), 0.05):
        if name == "init":
            continue
        new, status = shown(name, door())
        for at in ((a, b) for a in range(2) for b in range(3)):
            alone, own = next(shown(k, f()) for k, f in doors(stepper, State(q[at], p[at], s[at]), 0.05) if k == name)
            assert int(own) == int(status[at]), name
            for a, b in zip(alone, new, strict=True):
                torch.testing.assert_close(a, b[at], rtol=ALONE[dtype], atol=ALONE[dtype], equal_nan=True)
        assert status.tolist() == [[0, 3, 0], [0, 0, 3]], name
