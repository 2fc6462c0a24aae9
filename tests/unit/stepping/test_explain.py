"""At the exact critical values of section 4 the library says which condition failed, and where (E4)."""

import math
import re

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import regularity
from herglotz.scenes import scene
from herglotz.stepping import State, Status, StepError, Stepper, explain_step
from herglotz.stepping.explain import longest_step
from herglotz.theory import LeftHamiltonian, RightHamiltonian
from herglotz.verify import verify
from tests.lagrangians import cubic, states

# m = Ω = 1, γ = 0.2
OSCILLATOR = scene("damped_oscillator")
CONJUGATE = 3.15741941699827646


def trapezoid(q0, q1, s0, h):
    """Implicit trapezoid of the oscillator: L_d = (h/2)[L(q0, v, s0) + L(q1, v, s0 + L_d)], solved for L_d."""
    v = (q1 - q0) / h[..., None]
    both = OSCILLATOR.lagrangian(q0, v, s0) + OSCILLATOR.lagrangian(q1, v, s0)
    return 0.5 * h * both / (1 + 0.1 * h)


def sum_of_squares(q0, q1, s0, h):
    return 0.5 * (q0 * q0 + q1 * q1).sum(-1) + 0 * s0 * h


def product(q0, q1, s0, h):
    return (q0 * q1).sum(-1) + 0 * s0 * h


LEFT, MIDPOINT = (OSCILLATOR.L_d_rules[rule] for rule in ("left", "midpoint"))

# L_d, critical h, and the conditions that fail at this h only
CRITICAL = {
    "left rule, h = 1/γ": (LEFT, 5.0, {"c"}),
    "implicit midpoint, h = 2/γ": (MIDPOINT, 10.0, {"c"}),
    "implicit midpoint, h = 2/Ω": (MIDPOINT, 2.0, {"H_plus", "H_minus"}),
    "implicit trapezoid, h = √2/Ω": (trapezoid, math.sqrt(2), {"H_plus", "H_minus"}),
    "exact, h = π/ω": (OSCILLATOR.L_d, CONJUGATE, {"pole"}),
}
NAMES = {
    "c": "c = 0: FL⁻ is not defined",
    "pole": r"L_d has a pole at this h \(conjugate point\)",
    "H_plus": "det D2D2 L_d = 0: H⁺ does not exist",
    "H_minus": "det D1D1 L⁻ = 0: H⁻ does not exist",
}


def lost(at):
    return {name for name in ("finite", "c", "M", "pole", "H_plus", "H_minus") if bool(at.lost(name).any())}


@pytest.mark.parametrize("case", CRITICAL)
def test_the_condition_that_fails_is_named_where_it_fails(case):
    # fails if a condition is missed at its exact critical h, mistaken for another one, or reported for a neighbour
    L_d, critical, names = CRITICAL[case]
    q, _, s = states(count=3)
    h = torch.tensor([0.1, critical, critical * (1 + 1e-3)], dtype=torch.float64)
    at = regularity(L_d, q, q + 0.1, s, h)
    assert lost(at) == names
    for name in names:
        assert at.lost(name).tolist() == [False, True, False]
        assert any(re.match(rf"sample \(1,\), h = {critical!r}: {NAMES[name]}", line) for line in at.report())
    assert len(at.report()) == len(names)


@pytest.mark.parametrize("case", ["left rule, h = 1/γ", "implicit midpoint, h = 2/γ"])
def test_a_step_where_c_vanishes_is_singular_and_explained(case):
    # fails if c = 0 gives a number, a status without a reason, or takes its neighbour down
    L_d, critical, _ = CRITICAL[case]
    start, h = states(count=2), torch.tensor([0.1, critical], dtype=torch.float64)
    step = Stepper(L_d).step(start, h)
    assert step.status.tolist() == [Status.CONVERGED, Status.SINGULAR]
    assert step.state.q.isnan().flatten().tolist() == [False, True]
    (line,) = explain_step(L_d, start, h)
    assert line.startswith(f"sample (1,), h = {critical}: SINGULAR: c = 0: FL⁻ is not defined")


@pytest.mark.parametrize("beside", [-1, 0, 1])
def test_a_step_at_a_conjugate_point_is_singular_and_explained(beside):
    # fails if a momentum lost to rounding is returned as a number: q1 converges there, p1 and s1 do not
    critical = math.nextafter(CONJUGATE, math.copysign(9.0, beside)) if beside else CONJUGATE
    start = states(count=200)
    h = torch.full((200,), critical, dtype=torch.float64)
    h[0] = 0.1
    step, exact = Stepper(OSCILLATOR.L_d).step(start, h), OSCILLATOR.flow(*start, h)
    assert int(step.status[0]) == Status.CONVERGED
    lost = step.status == Status.SINGULAR
    assert float(lost.double().mean()) > 0.98
    error = (step.state.p - exact[1]).abs()[~lost] / (1 + exact[1].abs()[~lost])
    # The samples that are kept have q0 near 0, where p1 loses few digits.
    assert float(error.max()) < 1e-2
    alone = State(*(x[:2] for x in start))
    (line,) = explain_step(OSCILLATOR.L_d, alone, h[:2])
    assert line.startswith(f"sample (1,), h = {critical!r}: SINGULAR: L_d has a pole at this h (conjugate point)")
    assert not verify(OSCILLATOR, h=critical, steps=2, samples=8).passed


def test_beside_a_conjugate_point_and_at_rest_steps_go_on():
    # fails if a good momentum is thrown away, or a body at rest away from 0, whose momentum is rounding, is stopped
    h = CONJUGATE * (1 + 1e-8)
    step, exact = Stepper(OSCILLATOR.L_d).step(states(count=200), h), OSCILLATOR.flow(*states(count=200), h)
    assert step.status.tolist() == [Status.CONVERGED] * 200
    assert float((step.state.p - exact[1]).abs().max()) < 1e-6

    def tilted(q0, q1, s0, h):
        return h * (((q1 - q0) / h).square().sum(-1) / 2 - ((q1 - 1.3) ** 2).sum(-1) / 2 - 0.2 * s0)

    q = torch.tensor([[1.3], [1.3]], dtype=torch.float64)
    p = torch.tensor([[0.0], [1e-17]], dtype=torch.float64)
    for h in (1e-6, 0.1):
        assert bool(Stepper(tilted).rollout(q, p, h=h, steps=5).ok.all())


def test_the_error_names_the_condition():
    # fails if `throw` says SINGULAR without the sample, the remedy and the reason
    h = torch.tensor([0.1, 5.0], dtype=torch.float64)
    words = r"sample \(1,\): SINGULAR, residual .*; try a smaller h; sample \(1,\), h = 5.0: SINGULAR: c = 0"
    with pytest.raises(StepError, match=words):
        Stepper(LEFT, throw=True).step(states(count=2), h)
    with pytest.raises(StepError, match=r"step 0: .*; sample \(0,\), h = 3.157\d*: SINGULAR: L_d has a pole at this h"):
        Stepper(OSCILLATOR.L_d, throw=True).rollout(*states(count=2), h=CONJUGATE, steps=3)


def test_both_hamiltonians_are_nan_where_they_are_lost():
    # fails if the inverse of a block of size 1e-16 is trusted
    for case in ("implicit midpoint, h = 2/Ω", "implicit trapezoid, h = √2/Ω"):
        L_d, critical, _ = CRITICAL[case]
        q, p, s = states(count=2)
        h = torch.tensor([0.1, critical], dtype=torch.float64)
        assert RightHamiltonian(L_d)(q, p, s, h).isnan().tolist() == [False, True]
        assert LeftHamiltonian(L_d)(p, q, s, h).isnan().tolist() == [False, True]
        # A step needs neither H⁺ nor H⁻.
        assert Stepper(L_d).step(states(count=2), h).status.tolist() == [0, 0]
        assert explain_step(L_d, states(count=2), h) == []


def test_regularity_is_det_M_and_not_D2D2():
    # fails if the paper's condition is used (E4), which calls the first L_d regular and the second singular
    q, p, s = states(count=3)
    assert lost(regularity(sum_of_squares, q, q + 0.1, s, 0.1)) == {"M"}
    assert lost(regularity(product, q, q + 0.1, s, 0.1)) == {"H_plus", "H_minus"}
    assert Stepper(product).step(State(q, p, s), 0.1).status.tolist() == [Status.CONVERGED] * 3
    lines = explain_step(sum_of_squares, State(q, p, s), 0.1)
    assert len(lines) == 3
    assert "SINGULAR: det M = 0: FL⁻ and FL⁺ cannot be inverted" in lines[2]


def test_either_hamiltonian_may_be_lost_alone():
    # fails if H⁺ is judged by D11 or H⁻ by D22
    def bent(a, b):
        return lambda q0, q1, s0, h: (a * q0**2 + b * q1**2 - q0 * q1).sum(-1) / h - 0.1 * h * s0

    q = states(count=3)[0]
    s = torch.zeros_like(q[:, 0])
    assert lost(regularity(bent(0.5, 0.0), q, q + 0.1, s, 0.1)) == {"H_plus"}
    assert lost(regularity(bent(0.0, 0.5), q, q + 0.1, s, 0.1)) == {"H_minus"}


def test_the_parachute_pole():
    # fails if a motion that escapes before h has a status without a reason: λ v0 sinh(ωh)/ω = cosh(ωh)
    parachute, h = scene("parachute"), 0.1
    omega = math.sqrt(0.1)
    pole = omega * math.cosh(omega * h) / (0.01 * math.sinh(omega * h))
    v = torch.tensor([[pole * (1 + 1e-6)], [-20.0], [pole]], dtype=torch.float64)
    q, s = torch.zeros(3, 1, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    start = State(q, parachute.momentum(q, v, s), s)
    step = Stepper(parachute.L_d).step(start, h)
    assert (step.status == Status.CONVERGED).tolist() == [False, True, False]
    lines = explain_step(parachute.L_d, start, h)
    assert [line.split(",)")[0] for line in lines] == ["sample (0", "sample (2"]
    for line in lines:
        assert ", h = 0.1: SINGULAR: the motion escapes: q1 grows without bound as h → 0.0999" in line


@pytest.mark.parametrize("factor", [pytest.param(2.0, marks=pytest.mark.slow), 10.0])
def test_the_escape_is_found_at_its_time(factor):
    # fails if the pole inside the step is not found: λ v0 tanh(ωh*)/ω = 1
    parachute, omega = scene("parachute"), math.sqrt(0.1)
    v0 = factor * omega / (0.01 * math.tanh(omega * 0.1))
    pole = math.atanh(omega / (0.01 * v0)) / omega
    q, s = torch.zeros(1, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    state = State(q, parachute.momentum(q, q + v0, s), s)
    reach, escapes = longest_step(parachute.L_d, state, torch.tensor(0.1, dtype=torch.float64))
    assert abs(reach.item() / pole - 1) < 1e-6
    assert bool(escapes)
    # fails if a step that exists counts as an escape, or a failure of Newton counts as an escape
    reach, escapes = longest_step(parachute.L_d, state, torch.tensor(0.99 * pole, dtype=torch.float64))
    assert reach.item() == 0.99 * pole
    assert not bool(escapes)
    (line,) = explain_step(parachute.L_d, state, 0.99 * pole)
    assert "SINGULAR: a solution exists, continued from smaller h, but Newton does not reach it from q0" in line


def test_a_step_without_a_solution_is_explained():
    # fails if a status comes without a reason where no condition is lost: F = q1 − q1³/3 − p0 turns at 2/3
    q = torch.zeros(2, 1, dtype=torch.float64)
    p = torch.tensor([[0.1], [5.0]], dtype=torch.float64)
    (line,) = explain_step(cubic, State(q, p, q[:, 0]), 1.0, max_iterations=8)
    assert line.startswith("sample (1,), h = 1.0: MAX_ITERATIONS: no q1 was found with FL⁻(q0, q1, s0) = p0")


def test_values_that_overflow_are_named():
    # fails if inf is reported as a lost determinant
    def blown(q0, q1, s0, h):
        return torch.exp(1e6 + (q1 * q0).sum(-1)) + 0 * s0 * h

    assert "DIVERGED: L_d or a derivative is not finite" in explain_step(blown, states(count=1), 0.1)[0]


def test_scale_and_precision():
    # fails if a margin depends on units, or the bound is that of float64 for float32
    q, _, s = states(count=3)
    plain = regularity(OSCILLATOR.L_d, q, q + 0.1, s, 0.1)

    def scaled(q0, q1, s0, h):
        return 1e-9 * OSCILLATOR.L_d(1e4 * q0, 1e4 * q1, 1e9 * s0, h)

    other = regularity(scaled, 1e-4 * q, 1e-4 * (q + 0.1), 1e-9 * s, 0.1)
    for name in ("c", "M", "H_plus", "H_minus", "pole"):
        torch.testing.assert_close(getattr(other, name), getattr(plain, name), rtol=1e-6, atol=1e-9)
    single = regularity(MIDPOINT, q.float(), q.float() + 0.1, s.float(), 2.0)
    assert lost(single) == {"H_plus", "H_minus"}
    assert lost(regularity(OSCILLATOR.L_d, q.float(), q.float() + 0.1, s.float(), 0.1)) == set()


def test_wrong_h_is_named():
    # fails if h = 0 reaches the solver
    with pytest.raises(InputError, match="h must be > 0, got 0"):
        explain_step(OSCILLATOR.L_d, states(count=3), 0.0)
