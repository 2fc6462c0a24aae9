"""Random weights a hundred times too large: Newton fails for some samples, says for which, and harms no other."""

import pytest
import torch
from extreme_cases import LEVELS, TOLD, assert_nothing_silent, build, starts

import herglotz
from herglotz.stepping import Stepper
from tests.compilers import needs_compiler

WILD = {
    "mass": (100.0, {"mass_width": 6}),
    "forced": (100.0, {"level": "forced", "coulomb": True, "correction_width": 8}),
    "correction": (30.0, {"correction_width": 8}),  # at 100 eager Newton solves none of these
}


def wild(name):
    noise, settings = WILD[name]
    return build(noise, draw=1, **settings)


@pytest.mark.parametrize("h", [1e-3, 0.5])
@pytest.mark.parametrize("name", [*LEVELS, *TOLD])
def test_every_kind_of_model_with_weights_a_hundred_times_too_large(name, h):
    # fails if a level or a term has a way to a number that is not finite, or to a sum over the batch, of its own
    model = build(100.0, draw=2, **{**LEVELS, **TOLD}[name])
    start = starts(12, dof=model.dof)
    with torch.no_grad():
        out = Stepper(model, max_iterations=12).rollout(*start, h=h, steps=2)
        assert_nothing_silent(out)
        keep = [7, 2, 11, 5]  # other neighbours
        alone = Stepper(model, max_iterations=12).rollout(*(x[keep] for x in start), h=h, steps=2)
    assert torch.equal(alone.status, out.status[keep])
    torch.testing.assert_close(alone.q, out.q[keep], rtol=0, atol=0, equal_nan=True)
    if h == 1e-3 and name not in ("full", "order 4"):  # those find no way through; the others must
        assert bool(out.ok.any())


@pytest.mark.parametrize("level", ["affine", "full"])
def test_weights_that_overflow_end_with_a_status(level):
    # fails if e^g = inf, or inf · 0, comes out as a number
    with torch.no_grad():
        out = Stepper(build(1e4, draw=1, level=level)).rollout(*starts(10), h=0.5, steps=2)
    assert_nothing_silent(out)
    assert not bool(out.ok.all())


@pytest.mark.parametrize("name", ["forced", "correction"])
@needs_compiler
def test_lanes_of_the_compiled_step_are_apart(name):
    # fails if the samples that C steps side by side, in the registers of the processor, share a failure
    stepper, start = herglotz.compile(wild(name)), starts(60)
    out = stepper.rollout(*start, h=0.5, steps=1)
    assert_nothing_silent(out)
    assert 0 < int(out.ok.sum()) < 60
    keep = torch.randperm(60, generator=torch.Generator().manual_seed(0))[:23]  # other neighbours, other lanes
    alone = stepper.rollout(*(x[keep] for x in start), h=0.5, steps=1)
    assert torch.equal(alone.status, out.status[keep])
    torch.testing.assert_close(alone.q, out.q[keep], rtol=0, atol=0, equal_nan=True)
