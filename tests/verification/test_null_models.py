"""Null models must fail: a check that accepts these checks nothing."""

from dataclasses import replace

import torch

from herglotz.scenes import scene
from herglotz.stepping import State, Step, Stepper
from herglotz.verify import verify
from herglotz.verify.action import fan, hamilton_jacobi
from herglotz.verify.subject import subject
from tests.compared import failed
from tests.lagrangians import states

H = 0.1
OSCILLATOR = scene("damped_oscillator").L_d


class Altered:
    """The oscillator's stepper with its result changed; the L_d it claims is the true one."""

    L_d = OSCILLATOR

    def __init__(self, change):
        self.change = change

    def step(self, state, h):
        return self.change(state, Stepper(self.L_d).step(state, h))


def with_state(step, **parts):
    return replace(step, state=step.state._replace(**parts))


def test_the_unaltered_stepper_passes():
    # fails if the harness of this file itself makes checks fail
    assert verify((Altered(lambda _, step: step), states()), h=H).passed


def test_a_constant_L_d_fails():
    # fails if regularity or convergence accepts M = 0, which every residual accepts
    report = verify((lambda q0, q1, s0, h: 0.3 + 0 * (q0 + q1).sum(-1) + 0 * s0 + 0 * h, states()), h=H)
    assert {"converged", "regularity"} <= failed(report)
    # fails if checks with no sample left pass vacuously
    assert {"contact", "volume", "momentum", "D2S", "hamilton_jacobi"} <= failed(report)


def test_an_L_d_blind_to_s_fails_against_a_claim_of_damping():
    # fails if c is taken from the map that it is compared with, instead of from the claim
    def blind(q0, q1, s0, h):
        return ((q1 - q0) ** 2).sum(-1) / (2 * h) - h / 2 * (q0**2).sum(-1) + 0 * s0

    class Claims:
        def step(self, state, h) -> Step:
            step = Stepper(blind).step(state, h)
            return replace(step, c=step.c * torch.exp(torch.tensor(-0.2 * h, dtype=torch.float64)))

    assert verify((blind, states()), h=H).passed
    assert {"contact", "volume", "D3S"} <= failed(verify((Claims(), states()), h=H))


def test_a_degenerate_model_fails():
    # fails if regularity accepts b(q1) − c·b(q0) + (c − 1)s, whose Herglotz residual is zero for every motion (trap 2)
    def degenerate(q0, q1, s0, h):  # noqa: ARG001
        c = 0.9
        b0, b1 = (torch.sin(q).sum(-1) + (q**2).sum(-1) for q in (q0, q1))
        return b1 - c * b0 + (c - 1) * s0

    assert "regularity" in failed(verify((degenerate, states()), h=H))


def test_a_nearly_degenerate_model_fails_regularity_alone():
    # fails if the margin is not scale-free: here M is 1e-5 everywhere, every step converges, and D11, D22 are of size 1
    def collapsed(q0, q1, s0, h):  # noqa: ARG001
        return (q1**2 - 0.9 * q0**2).sum(-1) + 1e-5 * (q0 * q1).sum(-1) - 0.1 * s0

    q, p, s = states()
    start = State(q, -2 * q + 1e-6 * p, s)  # momenta that lead to q1 of size 1
    assert "regularity" in failed(verify((collapsed, start), h=H, steps=2))


def test_a_change_of_sign_of_det_M_fails():
    # fails if only |det M| at the samples is looked at
    def folded(q0, q1, s0, h):
        return ((q1 - q0) ** 2).sum(-1) / (2 * h) * torch.tanh(5 * q0).sum(-1) + 0 * s0

    q, p, s = states()
    report = verify((folded, State(torch.where(q > 0, q + 1, q - 1), 0.1 * p, s)), h=H, steps=2)
    assert "sign" in report["regularity"].note
    assert "regularity" in failed(report)


def test_an_orientation_that_turns_over_fails():
    # fails if the row of c reports the largest c, or its size: here c = tanh(5 q0)/2 has both signs
    def turning(q0, q1, s0, h):
        return ((q1 - q0) ** 2).sum(-1) / (2 * h) + (0.5 * torch.tanh(5 * q0).sum(-1) - 1) * s0

    report = verify((turning, states()), h=H, steps=2)
    assert "positive_c" in failed(report)
    assert -0.5 <= report["positive_c"].value < 0


def test_an_L_d_without_discrete_Hamiltonians_is_verified_and_says_so():
    # fails if a regular L_d with D11 = D22 = 0 (E4), which has no H±, is refused, or its missing rows go unsaid
    def product(q0, q1, s0, h):
        return -(q0 * q1).sum(-1) / h - 0.05 * s0

    report = verify((product, states()), h=1.0, steps=3)
    assert report.passed, report.table()
    for name in ("hamilton_jacobi", "left_equations", "left_hamilton_jacobi"):
        assert not report[name].applies
        assert "does not exist: det D" in report[name].note
    assert report.table().count("n/a") == 3
    whole = verify((OSCILLATOR, states()), h=H, steps=3)
    assert all(check.applies for check in whole.checks)


def test_a_map_with_a_caustic_every_other_step_says_so():
    # fails if Hamilton–Jacobi rows without a sample fail: of −q0·q1/h + V two steps are nearly q2 = −q0, whatever p is
    def product(q0, q1, s0, h):
        return -(q0 * q1).sum(-1) / h - 0.3 * h * torch.cos(q0).sum(-1) - 0.1 * h * s0

    report = verify((product, states()), h=H, steps=8)
    assert report.passed, report.table()
    assert not report["left_hamilton_jacobi"].applies
    assert report["left_equations"].applies
    assert "beside a caustic" in report.table()


def test_positions_far_from_their_origin_are_verified():
    # fails if p of size 1 beside q of size 1e5, which rounds it by 2e-10, is held to 1e-11, or differences are taken
    # over a share of q instead of its spread; a wrong p still fails
    def far(q0, q1, s0, h):
        q0, q1 = q0 - 1e5, q1 - 1e5
        return OSCILLATOR(q0, q1, s0, h) - 0.1 * h * torch.cos(3 * q0).sum(-1)

    q, p, s = states()
    assert verify((far, State(q + 1e5, p, s)), h=H, steps=3).passed

    class Wrong:
        L_d = staticmethod(far)

        def step(self, state, h):
            step = Stepper(far).step(state, h)
            return with_state(step, p=1.001 * step.state.p)

    assert {"contact", "D2S"} <= failed(verify((Wrong(), State(q + 1e5, p, s)), h=H, steps=3))


def test_the_table_says_what_it_does_not_judge():
    # fails if a reader may take the table of a lambda for a statement about a physical system
    table = verify((OSCILLATOR, states()), h=H, steps=2).table()
    last = " ".join(table[table.index("Not judged") :].split())
    assert last.startswith("Not judged: whether the motion is that of the physical system")
    assert "at this h alone" in last


def test_a_momentum_scaled_wrongly_fails():
    # fails if the contact defect or the momentum check compares p with itself, or the left rows look at L_d alone
    report = verify((Altered(lambda _, step: with_state(step, p=1.01 * step.state.p)), states()), h=H)
    assert {"contact", "volume", "momentum", "D2S", "left_equations"} <= failed(report)


def test_a_momentum_divided_by_c_fails():
    # fails if FL⁺ is divided by c and nobody notices
    report = verify((Altered(lambda _, step: with_state(step, p=step.state.p / step.c[:, None])), states()), h=H)
    assert {"contact", "momentum", "D2S"} <= failed(report)


def test_an_action_that_is_not_the_sum_of_L_d_fails():
    # fails if the Hamilton–Jacobi check takes S from somewhere else than the flow's s
    def half(state, step):
        return with_state(step, s=(state.s + step.state.s) / 2)

    assert {"contact", "D2S", "D3S", "hamilton_jacobi"} <= failed(verify((Altered(half), states()), h=H))


def test_a_position_that_misses_the_solution_fails_momentum_matching():
    # fails if momentum matching is measured on the stepper's own p instead of on q by the Herglotz residual
    report = verify((Altered(lambda _, step: with_state(step, q=step.state.q + 1e-6)), states()), h=H)
    assert "momentum" in failed(report)


def test_all_samples_at_a_caustic_fail():
    # fails if a check whose every sample is left out passes: at ωh = π all solutions of the oscillator meet again
    oscillator = scene("damped_oscillator")
    report = verify(oscillator, h=3.15741941699827646 / 2, steps=2)
    assert report["D2S"].passed  # k = 1 is kept
    assert report["D2S"].note
    known = subject((oscillator.L_d, states()), H, 16, 0)
    f = fan(known, 4, 0)
    nowhere = replace(f, keep={k: torch.zeros_like(x) for k, x in f.keep.items()})
    assert not hamilton_jacobi(known, nowhere, 1e-10).passed
