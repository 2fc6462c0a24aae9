"""h from 1e-8 to 1e2, in float32 and float64, and through the steps at which a rule is not defined."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from extreme_cases import LEVELS, TOLD, assert_nothing_silent, build, starts

from herglotz.export import compile_c
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from tests.compilers import needs_compiler

DTYPES = [torch.float32, torch.float64]


def test_the_guard_ends_what_hangs(bounded):
    # fails if a test of this folder may run for ever
    def hang():
        with bounded(0.1):
            while True:
                pass

    with pytest.raises(TimeoutError, match=r"still running after 0.1 s of processor time"):
        hang()


def test_the_guard_ends_what_hangs_in_c():
    # fails if a loop that never comes back to Python, where a signal would be heard, may run for ever
    program = """
import itertools, sys
sys.path.insert(0, sys.argv[1])
from conftest import _bounded
with _bounded(0.1, wall=0.3):
    sum(itertools.repeat(0))
"""
    command = [sys.executable, "-c", program, str(Path(__file__).parent)]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 1
    assert "Timeout" in ended.stderr
    assert "line 6 in <module>" in ended.stderr


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("h", [1e-8, 1e-2, 1.0, 1e2])
@pytest.mark.parametrize("level", [*LEVELS, *TOLD])
def test_any_step_is_solved_or_says_why(level, h, dtype):
    # fails if a step without a solution is returned as a number, a small one is not solved, or the solver hangs
    model = build(0.3, dtype=dtype, **{**LEVELS, **TOLD}[level])
    with torch.no_grad():
        out = Stepper(model).rollout(*starts(12, dtype, model.dof), h=h, steps=3)
    assert_nothing_silent(out)
    if h <= 1e-2:
        assert bool(out.ok.all())


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("level", ["explicit", "affine", "mass"])
@needs_compiler
def test_any_step_of_the_compiled_stepper_is_solved_or_says_why(level, dtype):
    # fails if C, whose iterations and lanes are its own, returns what is not finite, or loses a small step
    model = build(0.3, **LEVELS[level])
    stepper, start = compile_c(model, dtype=dtype), starts(12)
    for h in (1e-8, 1e-5, 1e-2, 1.0, 1e2):
        out = stepper.rollout(*(x.to(stepper.dtype) for x in start), h=h, steps=3)
        assert_nothing_silent(out)
        if h <= 1e-2:
            with torch.no_grad():
                exact = Stepper(model).rollout(*start, h=float(torch.tensor(h, dtype=stepper.dtype)), steps=3)
            assert bool(out.ok.all())
            eps = torch.finfo(stepper.dtype).eps
            bound = 64 * 3 * 3 * eps * (1 if dtype == "float32" else 1 + 1 / h)  # float32 steps in increments
            assert float((out.p.double() - exact.p).abs().max()) < bound


@pytest.mark.parametrize("h", [1e-8, 1e-6, 1e-4, 1e-2])
def test_the_error_of_a_small_float64_step_is_rounding_over_h(h):
    # fails if p loses more than what is left of q1 − q0 after rounding and Newton's tolerance: 64 ε |q| / h a step
    oscillator, steps, start = scene("damped_oscillator"), 10, starts(20)
    with torch.no_grad():
        out = Stepper(oscillator.L_d).rollout(*start, h=h, steps=steps)
    q, p, s = oscillator.flow(*start, steps * h)
    eps = torch.finfo(torch.float64).eps
    bound = steps * 64 * eps * float(start.q.abs().max()) * (1 + 1 / h)
    assert float((out.final.p - p).abs().max()) < bound
    assert float((out.final.q - q).abs().max()) < steps**2 * 64 * eps * float(start.q.abs().max())
    assert float((out.final.s - s).abs().max()) < steps**2 * 64 * eps * float(start.p.abs().max())
