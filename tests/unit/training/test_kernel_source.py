"""The C of a kernel: sines that follow from one another, and what stands behind a gate."""

import math
import re
from typing import Any

import pytest

from herglotz.codegen.angles import Angles
from herglotz.codegen.gated import Prepared, gated
from herglotz.codegen.program import Program, add, multiply, whole
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training import kernel


def program_of(*names):
    """A program of scalars with these inputs, rows of three numbers."""
    program = Program(loop=math.inf)
    program.angles = Angles(program)
    return program, *(program.given(name, 3) for name in names)


def value(text, **rows):
    """What the C of a function computes, by Python."""
    body = re.sub(r"const REAL (t\d+) = ", r"\1 = ", text.split("{", 1)[1].rsplit("}", 1)[0]).replace(";", "")
    names = {"FN_sin": math.sin, "FN_cos": math.cos, "R": float, "SPREAD": float, **rows}
    exec("\n".join(line.strip() for line in body.splitlines() if "(void)" not in line), names)
    return names


def wave(program, x, k, phase):
    angle = add(program, multiply(program, x, k), phase)
    return program.angles.waves(angle)


@pytest.mark.parametrize("k", [2.0, 7.0, -3.0])
def test_sines_of_multiples_follow_from_one(k):
    # fails if an addition theorem has a wrong sign, or a wave is computed by itself
    program, x = program_of("x")
    size = int(abs(k))
    found = [wave(program, x[0], math.copysign(j, k), math.copysign(0.3 * j, k)) for j in range(1, size + 1)]
    text = whole(program, "static void f(const double *x)", {"out": list(found[-1])})
    assert len(re.findall("FN_sin|FN_cos", text)) == 2
    out = [0.0, 0.0]
    value(text, x=[0.7], out=out)
    angle = k * 0.7 + math.copysign(0.3, k) * size
    assert out == pytest.approx([math.sin(angle), math.cos(angle)], abs=4e-15)


def test_sines_of_multiples_of_a_rate_that_is_no_constant_follow_from_one():
    # fails if the product of a rate and a coordinate is a number of its own for every multiple, or at every point
    program, x, k = program_of("x", "k")
    near = add(program, x[0], multiply(program, x[1], 0.5))
    rates = [multiply(program, k[0], float(j)) for j in (1, 2, 3)]
    found = [program.angles.waves(multiply(program, near, rate)) for rate in rates]
    text = whole(program, "static void f(const double *x, const double *k)", {"out": list(found[-1])})
    assert len(re.findall("FN_sin|FN_cos", text)) == 2
    out = [0.0, 0.0]
    value(text, x=[0.7, 0.4], k=[1.3], out=out)
    assert out == pytest.approx([math.sin(3 * 1.3 * 0.9), math.cos(3 * 1.3 * 0.9)], abs=4e-15)


def test_sines_of_sums_and_differences_follow_from_those_of_the_angles():
    # fails if only multiples of one number are known
    program, x = program_of("x")
    wave(program, x[0], 1.0, 0.0)
    wave(program, x[1], 2.0, 0.0)
    minus = add(program, x[0], multiply(program, x[1], -2.0))
    plus = add(program, multiply(program, x[1], 2.0), x[0])
    row = [*program.angles.waves(minus), *program.angles.waves(plus)]
    text = whole(program, "static void f(const double *x)", {"out": row})
    assert len(re.findall("FN_sin|FN_cos", text)) == 4
    out = [0.0] * 4
    value(text, x=[0.4, 1.1], out=out)
    assert out == pytest.approx([math.sin(-1.8), math.cos(-1.8), math.sin(2.6), math.cos(2.6)], abs=1e-15)


def test_angles_that_are_no_sums_are_evaluated():
    # fails if an angle that is near a multiple is taken for it
    program, x = program_of("x")
    wave(program, x[0], 1.0, 0.0)
    sine, cosine = wave(program, x[0], 2.0000001, 0.0)
    text = whole(program, "static void f(const double *x)", {"out": [sine, cosine]})
    out = [0.0, 0.0]
    value(text, x=[5.0], out=out)
    assert out == pytest.approx([math.sin(10.0000005), math.cos(10.0000005)], abs=4e-15)


def test_what_absent_parameters_alone_need_stands_behind_their_gate():
    # fails if a call is made for a term that is absent, or a number that others need is left out with it
    program, x, theta = program_of("x", "theta")
    call = program.scalar("FN_exp({0})", (x[0],))
    shared = program.scalar("FN_cosh({0})", (x[1],))
    total = add(program, multiply(program, theta[0], call), multiply(program, theta[1], shared))
    prepared = Prepared()
    text = gated(program, "static void f(void)", {"out": [total, shared]}, prepared)
    before, _, after = text.partition("if (gate[0]) {")
    assert "FN_exp" not in before
    assert "FN_exp" in after
    assert "FN_cosh" in re.sub(r"if \(gate\[\d+\]\) \{.*?\}", "", text, flags=re.DOTALL)
    assert "on[0]" in prepared.function()


def test_what_follows_from_parameters_is_computed_once():
    # fails if the exponential of a parameter is taken in every step
    program, x, theta = program_of("x", "theta")
    rate = program.scalar("FN_exp({0})", (theta[0],))
    prepared = Prepared()
    text = gated(program, "static void f(void)", {"out": [multiply(program, rate, x[0])]}, prepared)
    assert "FN_exp" not in text
    assert "fixed[0] * x[0]" in text
    assert "FN_exp(theta[0])" in prepared.function()


def test_derivatives_by_absent_parameters_are_not_written():
    # fails if a column is written whose numbers were left out
    program, x, theta = program_of("x", "theta")
    call = program.scalar("FN_exp({0})", (x[0],))
    prepared = Prepared()
    text = gated(program, "static void f(void)", {"G": [call, x[1], 0.0]}, prepared, {"G": 3})
    assert re.search(r"if \(gate\[\d\]\) \{ G\[0\] = t\d+; \}", text)
    assert not re.search(r"^  G\[", text, flags=re.MULTILINE)
    assert theta


@pytest.mark.parametrize("parts", [
    {"angles": (True, True), "potential_width": 3, "mass_width": 3},
    {"level": "forced", "diagonal": True, "features": ("(q1 - q2)^2", "q1^3"), "coulomb": True, "inputs": 1},
])  # fmt: skip
def test_one_sample_has_the_kernel_of_many(monkeypatch, parts):
    # fails if an axis of the batch's size 1 is taken for another, or for one to be left out. With 431 samples the trace
    # of twenty coordinates with a network took 26 s and 10.7 GB, for 3.0 s and 0.4 GB
    pair: dict[str, Any] = dict.fromkeys(("scale", "speed", "stiffness", "tilt"), (1.0, 1.0))
    model = ContactLagrangian(ModelConfig(**({"angles": (False, False), "potential_width": 0} | pair | parts)))
    one, examples = kernel.source_of(model), kernel._examples

    def many(given):
        return tuple(
            x if name in ("theta", "constants") else x.expand(211, *x.shape[1:]).clone()
            for name, x in zip(given, examples(given), strict=True)
        )

    monkeypatch.setattr(kernel, "_examples", many)
    assert kernel.source_of(model) == one
