"""Verification of joints that dry friction can hold: the map is judged on its branches, what is held by its own row."""

import pytest
import torch

from herglotz.export import ExportedStepper, compile_c
from herglotz.export.differences import central_differences
from herglotz.export.metadata import describe
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.verify import verify
from herglotz.verify.legendre import _one_sign
from tests.compared import failed
from tests.compilers import needs_compiler

H = 0.05


def held(n=1, dtype=torch.float64, coulomb=2.0):
    """Joints without an angle that stand still in a good part of the steps from the box."""
    ones = (1.0,) * n
    config = ModelConfig(
        (False,) * n, "forced", ones, ones, ones, (0.0,) * n, rate=0.1, potential_width=0, coulomb=True, sticking=True,
        coupled=n > 1,
    )  # fmt: skip
    model = ContactLagrangian(config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05
        model.get_parameter("friction.coulomb").fill_(coulomb)
        model.get_parameter("friction.breakaway").mul_(coulomb > 0)
    return model.to(dtype)


def box(n):
    return {name + end: [sign] * (1 if name == "s" else n) for name in "qps" for end, sign in
            (("_low", -1.0), ("_high", 1.0))}  # fmt: skip


class Stepped:
    """The programs of a file, by the eager stepper of the model."""

    def __init__(self, model):
        self.stepper = Stepper(model)

    def model(self, q, p, s, h):
        """One step."""
        found = self.stepper.step(State(q, p, s), h)
        return *found.state, found.c, found.residual, found.status

    def linearise(self, q, p, s, h):
        """One step and its derivative."""
        found = self.stepper.linearise(State(q, p, s), h)
        return *self.model(q, p, s, h), torch.cat([found.by_state, found.by_h[..., None]], -1)

    def rollout(self, q, p, s, h):
        """A step a row of h."""
        assert len(h) == 1
        with torch.no_grad():
            return tuple(x[None] for x in self.model(q, p, s, h[0]))


def file_of(model, kind, programs=None) -> ExportedStepper:
    """A file of this kind with the programs that it has, by the eager stepper."""
    programs = programs or Stepped(model)
    names = {"pt2": ("model", "rollout"), "onnx": ("linearise", "rollout"), "aoti": ("rollout",)}[kind]
    metadata = describe(model, H, box(model.dof), (), 30, {})
    return ExportedStepper({name: getattr(programs, name) for name in names}, metadata, kind=kind)


@pytest.mark.parametrize(
    ("kind", "n", "dtype"),
    [
        ("pt2", 1, torch.float64), ("onnx", 2, torch.float64), ("aoti", 2, torch.float32), ("run", 2, torch.float64),
        ("run", 1, torch.float32),
    ],
)  # fmt: skip
def test_what_friction_holds_verifies(kind, n, dtype):
    # fails if M is asked of a coordinate that stands still, differences are taken across the edge of what is held, or
    # coordinates of different sets that slide are asked for one sign of det M
    model = held(n, dtype)
    report = verify(model, h=H) if kind == "run" else verify(file_of(model, kind), model=model)
    assert report.passed, report.table()
    assert report["holding"].applies
    assert report["contact"].value <= (1e-12 if dtype == torch.float64 and kind != "aoti" else report["contact"].bound)
    assert ("derivative" in {check.name for check in report.checks}) == (kind != "aoti")
    if kind != "run":
        assert verify(file_of(model, kind)).missing == ("contact", "momentum", "holding")


@needs_compiler
def test_a_header_verifies():
    # fails if C's map is differentiated across the edge of what friction holds, and not by the header's own Jacobian
    model = held()
    report = verify(compile_c(model, h=H, box=box(1)), model=model)
    assert report.passed, report.table()
    assert report["derivative"].statement.startswith("the file's DΦ̃")


def test_friction_that_is_too_weak_to_hold_fails():
    # fails if any impulse may hold a coordinate
    model = held()
    report = verify(file_of(model, "onnx"), model=held(coulomb=1.0))
    assert {"holding", "contact", "momentum"} <= failed(report)
    assert report["holding"].value > 0.1


def test_what_slides_needs_no_bound():
    # fails if a row without a step to judge counts as one that holds, or as one that fails
    row = verify(held(coulomb=0.0), h=H)["holding"]
    assert not row.applies
    assert row.passed
    assert "no coordinate stands still" in row.note


class Creeping(Stepped):
    """A stuck coordinate moves by 1e-9."""

    def model(self, q, p, s, h):
        q1, *rest = super().model(q, p, s, h)
        return q1 + torch.where(q1 == q, 1e-9, 0.0), *rest


class Dead(Stepped):
    """Nothing moves."""

    def model(self, q, p, s, h):
        _, *rest = super().model(q, p, s, h)
        return q, *rest


class Unmoved(Stepped):
    """What slides does so without regard to its momentum."""

    def linearise(self, q, p, s, h):
        *found, J = super().linearise(q, p, s, h)
        return *found, torch.cat([J[:, :1] * torch.tensor([1.0, 0.0, 1.0, 1.0]).double(), J[:, 1:]], 1)


class Sliding(Stepped):
    """The derivative of a step that is stuck is that of one that slides."""

    def linearise(self, q, p, s, h):
        q1, *rest, J = super().linearise(q, p, s, h)
        stuck = torch.zeros_like(J)
        stuck[:, 0, 1] = torch.where(q1 == q, H, torch.zeros_like(q))[:, 0]
        return q1, *rest, J + stuck


@pytest.mark.parametrize(
    ("null", "rows"),
    [
        (Creeping, {"regularity", "contact", "momentum"}),
        (Dead, {"regularity", "contact", "holding"}),
        (Unmoved, {"regularity", "derivative", "contact"}),
        (Sliding, {"derivative", "contact"}),
    ],
)
def test_a_null_model_fails(null, rows):
    # fails if what stands still is judged by nothing, or what slides is left out with it: a file that creeps, one that
    # never moves, one whose derivative is wrong where it slides, one where it sticks (fewer than half of the samples)
    model = held(coulomb=2.0 if null is not Sliding else 1.0)
    report = verify(file_of(model, "onnx", null(model)), model=model)
    assert rows <= failed(report), report.table()


def test_a_sample_at_the_edge_of_what_is_held_is_left_out():
    # fails if a stencil that meets two branches, however narrow, is compared with a derivative: there is none
    model = held()
    step, x = Stepper(model).step, torch.randn(32, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    low, high = torch.zeros(32, 1, dtype=torch.float64), torch.ones(32, 1, dtype=torch.float64)
    q, s = 0.1 * x[:, :1], x[:, 2]
    for _ in range(40):  # p between standing still and sliding
        p = (low + high) / 2
        moves = step(State(q, p, s), H).state.q != q
        low, high = torch.where(moves, low, p), torch.where(moves, p, high)
    few = torch.arange(32)[:, None] < 4
    row = verify((model, State(q, torch.where(few, high, x[:, 1:2]), s)), h=H, steps=2)["derivative"]
    assert row.passed, row
    assert "changes between sliding and standing still" in row.note


def test_differences_stay_on_one_branch():
    # fails if a stencil with points on two branches gives a number: q1 = q0 + soft(p0), with edges at ±1
    def step(x):
        q, p, s = x.unbind(-1)
        return torch.stack([q + p - p.clamp(-1, 1), p.clamp(-1, 1), s], -1)

    x = torch.tensor([[0.0, p, 0.0] for p in (-3.0, -1.01, 0.0, 0.99, 1.5)]).double()
    found = central_differences(step, x, torch.full((3,), 0.01).double(), sticks=True)
    assert found.isnan().all(-1).all(-1).tolist() == [False, True, False, True, False]
    assert found[0, 0, 1] == pytest.approx(1.0)
    assert found[2, 0].tolist() == [1.0, 0.0, 0.0]
    assert not central_differences(step, x, torch.full((3,), 0.01).double()).isnan().any()


def test_the_sign_of_det_M_is_one_for_each_set_that_slides():
    # fails if −1 of one coordinate and 1 of two are taken for a sign that changes, or a change within a set is not seen
    M = torch.stack([torch.diag(torch.tensor(x)) for x in ((-1.0, -1.0), (-2.0, -1.0), (-1.0, 1.0))])
    slides = torch.tensor([[True, True], [True, True], [True, False]])
    assert _one_sign(M, slides)
    assert not _one_sign(M, torch.ones_like(slides))
    assert not _one_sign(0 * M, slides)
    assert not _one_sign(M[:0], slides[:0])
