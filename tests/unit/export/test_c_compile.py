"""`hz.compile` and `load_c`: a drop-in for the eager stepper, or the eager stepper itself with one warning."""

import warnings
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import herglotz as hz
from herglotz.codegen import c_compiler
from herglotz.errors import InputError
from herglotz.export import ExportedStepper, compile_c, export_c, load_c
from herglotz.stepping import State, Stepper
from tests.compilers import needs_compiler


@pytest.fixture(autouse=True, scope="module")
def _cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def model(**options):
    return hz.ContactLagrangian(hz.ModelConfig(potential_width=4, **options))


def states(batch=3):
    x = torch.linspace(-1, 1, 3 * batch, dtype=torch.float64).reshape(batch, 3)
    return State(x[:, :1], x[:, 1:2], x[:, 2])


@needs_compiler
def test_whatever_holds_a_model_compiles(tmp_path):
    # fails if one of the sources is not understood, or steps differently from the others
    m = model()
    path = export_c(m, tmp_path / "stepper.h", h=0.1)
    box = {f"{x}_{end}": [v] for x in "qps" for end, v in (("low", -2.0), ("high", 2.0))}
    run = SimpleNamespace(model=m, h=0.1, box=box, data=SimpleNamespace(units=("rad",)))
    out = []
    for source in (m, Stepper(m), run, path, str(path)):
        compiled = hz.compile(source)
        assert isinstance(compiled, ExportedStepper)
        out.append(compiled.rollout(*states(), h=0.1, steps=5).q)
    assert all(torch.equal(out[0], q) for q in out)
    recorded = hz.compile(run)
    assert isinstance(recorded, ExportedStepper)
    assert recorded.metadata["box"] == box


@needs_compiler
def test_the_interface_is_that_of_the_stepper():
    # fails if a field, a shape or an option of `Stepper` is missing
    m, (q, p, s) = model(), states()
    h = torch.tensor([0.1, 0.2, 0.1, 0.05], dtype=torch.float64)
    compiled, eager = hz.compile(m), Stepper(m)
    with torch.no_grad():
        options: dict[str, Any]
        for options in ({"h": h}, {"h": h.expand(3, 4)}, {"h": 0.1, "steps": 4}, {"h": h, "every": 2}):
            a, b = compiled.rollout(q, p, s, **options), eager.rollout(q, p, s, **options)
            for name in ("q", "p", "s", "sigma", "status", "residual"):
                x, y = getattr(a, name), getattr(b, name)
                assert x.shape == y.shape, (name, options)
                assert x.dtype == y.dtype
                assert torch.allclose(x, y, rtol=1e-12, atol=1e-14)
        a, b = compiled.step(State(q, p, s), 0.1, q), eager.step(State(q, p, s), 0.1, q)
    assert torch.allclose(a.state.q, b.state.q, rtol=1e-13)
    with pytest.raises(hz.InputError, match="no events"):
        compiled.rollout(q, p, s, h=0.1, steps=2, events=[lambda x: x.q[..., 0]])
    with pytest.raises(hz.InputError, match="divide"):
        compiled.rollout(q, p, s, h=0.1, steps=3, every=2)


def test_without_a_compiler_one_warning_and_the_eager_stepper(monkeypatch):
    # fails if a missing compiler stops the user, or is passed over in silence
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")
    eager = Stepper(model())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert hz.compile(eager) is eager
    assert len(caught) == 1
    assert "install one" in str(caught[0].message)
    assert "\n" not in str(caught[0].message)


@needs_compiler
def test_what_has_no_c_comes_back_eager():
    # fails if a scene or `throw=True` ends in an exception
    oscillator = Stepper(lambda q0, q1, s0, h: ((q1 - q0) ** 2).sum(-1) / 2 / h - 0.1 * s0 * h)
    for stepper in (oscillator, Stepper(model(), throw=True)):
        with pytest.warns(RuntimeWarning, match="PyTorch instead of C"):
            assert hz.compile(stepper) is stepper


def test_what_is_no_model_is_refused():
    # fails if anything is taken for a model
    with pytest.raises(hz.InputError, match="compile needs a model"):
        hz.compile(3.0)


@needs_compiler
def test_a_header_is_loaded_with_what_it_says(tmp_path):
    # fails if dtype, h or the range of steps is not read, or a step outside the range is taken without a word
    path = export_c(model(), tmp_path / "stepper.h", h=0.1, h_range=(0.05, 0.2), dtype="float32", units=["rad"])
    loaded = load_c(path)
    assert (loaded.dtype, loaded.h, loaded.metadata["units"]) == (torch.float32, 0.1, ["rad"])
    start = State(*(x.float() for x in states()))
    assert loaded.rollout(*start, h=0.2, steps=3).ok.all()
    with pytest.raises(hz.InputError, match="where the model was fitted"):
        loaded.step(start, 0.5)


@needs_compiler
def test_a_cached_library_is_not_built_again(monkeypatch):
    # fails if every call compiles
    from herglotz.codegen import c_compiler

    m = model()
    compile_c(m)
    monkeypatch.setattr(c_compiler, "_compile", lambda *_: pytest.fail("compiled again"))
    hz.compile(m)


@pytest.mark.parametrize("level", [(), ("-O1",)], ids=str)
@needs_compiler
def test_a_level_of_optimisation_stands_after_the_flags(level, monkeypatch):
    # fails if the flags are not those of the package, which the tests replace by flags without optimisation, or another
    # flag than the level given has the last word
    seen = []

    def refused(_words, _sources, flags):
        seen.append(tuple(flags))
        raise InputError("seen")

    monkeypatch.setattr(c_compiler, "_compile", refused)
    with pytest.raises(InputError, match="seen"):
        c_compiler.built(f"no library {level}", dict, level)
    assert seen == [(*c_compiler.FLAGS, *level)]
