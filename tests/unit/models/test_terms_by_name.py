"""A term that is one class and one line in `TERMS`: it steps, fits, verifies, is saved and exported like any other."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.export import compile_c, export_c, export_onnx, export_pt2, load_exported
from herglotz.models import TERMS, ContactLagrangian, ModelConfig, Term
from herglotz.stepping import State, Stepper
from herglotz.training import FitConfig, fit, load_run, save_run
from herglotz.verify import verify
from tests.compilers import CC

TWO = (1.0, 1.0)
FILES = (("onnx", torch.float32), ("pt2", torch.float64), ("pt2", torch.float32))
PLAIN = ModelConfig((False, False), "forced", TWO, TWO, TWO, (0.0, 0.0), rate=0.0, potential_width=0)


class CouplingSpring(Term):
    """V = k (q₁ − q₂)⁴ / 4 and R = d (v₁ − v₂)² / 2: a spring with cubic stiffness and a damper of its own."""

    spread = 3.0

    def __init__(self, config):
        super().__init__(config)
        self.stiffness = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.damper = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def potential(self, q):
        x = q.select(0) - q.select(1)
        return x * x * x * x * (self.stiffness / 4)

    def dissipation(self, v):
        x = v.select(0) - v.select(1)
        return x * x * (self.damper / 2)


class Spring(Term):
    """V = (q₁ − q₂)⁴ / 2, without a number to learn."""

    def potential(self, q):
        x = q.select(0) - q.select(1)
        return x * x * x * x * 0.5


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setitem(TERMS, "coupling_spring", CouplingSpring)
    monkeypatch.setitem(TERMS, "spring", Spring)


def spring(dtype=torch.float64):
    """Two oscillators with a spring of stiffness 2 and a damper of 0.3 between them."""
    model = ContactLagrangian(replace(PLAIN, terms=("coupling_spring",)))
    with torch.no_grad():
        model.get_parameter("more.0.stiffness").fill_(2.0)
        model.get_parameter("more.0.damper").fill_(0.3)
    return model.to(dtype)


def starts(batch, dtype=torch.float64):
    x = torch.randn(2, batch, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)
    return State(x[0], x[1], torch.zeros(batch, dtype=dtype))


@pytest.fixture(scope="module")
def recorded():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TERMS, "coupling_spring", CouplingSpring)
        with torch.no_grad():
            q = Stepper(spring()).rollout(*starts(4), h=0.1, steps=40).q
    t = 0.1 * torch.arange(41, dtype=torch.float64)
    return Trajectories(
        t.repeat(4), q.reshape(-1, 2), (41,) * 4, names=("a", "b"), units=("m", "m"), angles=(False, False)
    )


@pytest.mark.parametrize("explicit", [False, True])
def test_the_force_is_that_of_the_formula(explicit):
    # fails if the potential or the dissipation is left out of a step, explicit or not, or acts once, not in halves
    q, p, s = starts(5)
    h, k, d = 1e-5, 2.0, 0.0 if explicit else 0.3
    model = ContactLagrangian(replace(PLAIN, level="conservative", terms=("spring",))) if explicit else spring()
    assert model.capabilities.explicit == explicit
    with torch.no_grad():
        step = Stepper(model).step(State(q, p, s), h).state
    x, v = q[:, :1] - q[:, 1:], p[:, :1] - p[:, 1:]
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64)
    force = -q - (k * x**3 + d * v) * sign
    torch.testing.assert_close((step.p - p) / h, force, rtol=0, atol=2e-3)  # h f′ / 2: measured 3e-4


def test_a_fit_finds_it(recorded, tmp_path):
    # fails if `build_model` or the prior does not know the term, or a saved run loses it
    settings = FitConfig(terms=("coupling_spring",), train_fraction=0.8, objective="residual", correction_width=0)
    run = fit(recorded, settings, progress=False)
    found = {name: x.detach() for name, x in run.model.named_parameters()}
    assert run.decided.level == "forced"
    assert float(found["more.0.stiffness"]) == pytest.approx(2.0, abs=1e-3)
    assert float(found["more.0.damper"]) == pytest.approx(0.3, abs=1e-3)
    save_run(run, tmp_path / "run")
    again = load_run(tmp_path / "run")
    assert torch.equal(again.prediction, run.prediction)
    assert again.model.config.terms == ("coupling_spring",)
    del TERMS["coupling_spring"]
    with pytest.raises(InputError, match="unknown term 'coupling_spring'"):
        load_run(tmp_path / "run")


def test_it_is_verified():
    # fails if the term's derivatives are not those of its value, or its force is no part of the forced contact map
    report = verify((spring(), starts(6)), h=0.1, steps=4)
    assert report.passed, report.table()


@pytest.mark.parametrize(  # ONNX and .pt2 in the other precision take 4 to 10 s each
    ("form", "dtype"),
    [("c", torch.float64), ("c", torch.float32), ("onnx", torch.float64)]
    + [pytest.param(*x, marks=pytest.mark.slow) for x in FILES],
)
def test_files_step_as_eager_does(form, dtype, tmp_path, request):
    # fails if a file leaves the potential or the force out
    if form == "c" and CC is None:
        pytest.skip("no C compiler in the PATH")
    model, states = spring(dtype), starts(3, dtype)
    if form == "c":
        other = compile_c(model)
    else:
        pytest.importorskip("onnxruntime")
        request.getfixturevalue("registered_once")
        write = export_onnx if form == "onnx" else export_pt2
        other = load_exported(write(model, tmp_path / f"a.{form}", h=0.1))
    with torch.no_grad():
        eager = Stepper(model).rollout(*states, h=0.1, steps=20)
    ours = other.rollout(*states, h=0.1, steps=20)
    tol = 1e-12 if dtype == torch.float64 else 1e-5
    for name in ("q", "p", "s"):
        torch.testing.assert_close(getattr(ours, name), getattr(eager, name), rtol=tol, atol=tol)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"terms": ("sprung",)}, "unknown term 'sprung'"),
        ({"level": "linear"}, "set level='forced', not 'linear'"),
        ({"order": 4}, "terms need order 2"),
    ],
)
def test_what_cannot_be_is_refused(change, words):
    # fails if a name is misspelt in silence, or a term is left out where it cannot act
    with pytest.raises(InputError, match=words):
        replace(PLAIN, **{"terms": ("coupling_spring",), **change})


def test_a_term_that_cannot_be_stepped_is_named(monkeypatch, tmp_path):
    # fails if a user's class without a dissipation function, or with an operation in place, ends in a traceback of ours
    class Silent(Term):
        def dissipation(self, v):  # noqa: ARG002
            return None

    class InPlace(Term):
        def potential(self, q):
            x = q.select(0)
            x.value.add_(1.0)
            return x

    monkeypatch.setitem(TERMS, "silent", Silent)
    monkeypatch.setitem(TERMS, "in place", InPlace)
    one = torch.ones(1, 2, dtype=torch.float64)
    with pytest.raises(InputError, match=r"Silent.dissipation returned None; return a jet"):
        Stepper(ContactLagrangian(replace(PLAIN, terms=("silent",)))).step(State(one, one, one[:, 0]), 0.1)
    with pytest.raises(InputError, match="writes in place"):
        export_c(ContactLagrangian(replace(PLAIN, terms=("in place",))), tmp_path / "a.h", h=0.1)
