"""h from 1e-8 to 1e2, in float32 and float64, and through the steps at which a rule is not defined."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from extreme_cases import LEVELS, TOLD, assert_nothing_silent, build, starts

from herglotz.export import compile_c
from herglotz.scenes import scene
from herglotz.stepping import Status, Stepper, explain_step
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


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(
    ("rule", "critical", "reason"),
    [
        ("left", 2.0, "SINGULAR: c = 0: FL⁻ is not defined"),  # 1/γ
        ("midpoint", 4.0, "SINGULAR: c = 0: FL⁻ is not defined"),  # 2/γ
        ("trapezoid", 4.0, "SINGULAR: c = 0: FL⁻ is not defined"),  # 2/γ
        ("exact", math.pi / math.sqrt(1 - 0.25**2), "SINGULAR: L_d has a pole at this h (conjugate point)"),
    ],
)
def test_every_h_through_a_critical_one(rule, critical, reason, dtype):
    # fails if the critical step is taken silently, or a step to either side of it is refused
    oscillator = scene("damped_oscillator", gamma=0.5)
    L_d = oscillator.L_d if rule == "exact" else oscillator.L_d_rules[rule]
    start = starts(2, dtype)
    for relative in (-0.3, -1e-3, 0.0, 1e-3, 0.3):
        h = critical * (1 + relative)
        with torch.no_grad():
            step = Stepper(L_d).step(start, h)
        lines = explain_step(L_d, start, h)
        if relative:
            assert step.status.tolist() == [Status.CONVERGED] * 2
            assert (float(step.c[0]) < 0) == (rule != "exact" and relative > 0)  # c has changed sign beyond
            assert lines == []
        else:
            assert len(lines) == 2
            assert all(reason in line for line in lines)
            assert step.status.tolist() == [Status.SINGULAR] * 2
            assert bool(step.state.q.isnan().all())


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_det_M_through_zero(dtype):
    # fails if a step is taken where FL⁻ cannot be inverted, or refused beside it: M = −m cos(q0)/h changes sign at π/2
    def turning(q0, q1, s0, h):
        return (-torch.sin(q0) * q1).sum(-1) / h + 0 * s0

    q = torch.tensor([[math.pi / 2 - 0.1], [math.pi / 2 + 0.1], [0.0]], dtype=dtype)
    start = starts(3, dtype)._replace(q=q)
    with torch.no_grad():
        step = Stepper(turning).step(start, 0.5)
    assert step.status.tolist() == [Status.CONVERGED] * 3
    flat = lambda q0, q1, s0, h: ((q0**2 + q1**2) / 2).sum(-1) + 0 * s0 * h  # noqa: E731  M = 0 everywhere
    with torch.no_grad():
        step = Stepper(flat).step(start, 0.5)
    assert step.status.tolist() == [Status.SINGULAR] * 3
    assert all("det M = 0: FL⁻ and FL⁺ cannot be inverted" in line for line in explain_step(flat, start, 0.5))
