"""The rows of `verify` for the left formalism, and the wrong formulas that they must reject."""

from dataclasses import replace

import pytest

import herglotz.verify.legendre as rows
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.verify import verify
from herglotz.verify.action import fan, hamilton_jacobi, left_hamilton_jacobi
from herglotz.verify.legendre import left_formalism
from herglotz.verify.sampled_rollout import sampled_rollout
from herglotz.verify.subject import subject
from tests.lagrangians import nonlinear, states

H = 0.1


@pytest.mark.parametrize("check", [hamilton_jacobi, left_hamilton_jacobi])
def test_both_Hamilton_Jacobi_rows_reject_a_wrong_S(check):
    # fails if the residual is zero for any S, e.g. because H is built from the same S
    known = subject((nonlinear, states(2)), H, 16, 0)
    f = fan(known, 4, 0)
    assert check(known, f, 1e-10).passed
    odd = 1 if check is left_hamilton_jacobi else 0  # the left equation has dS^k, the right one dS^{k+1}
    for name, change in {
        "scaled": lambda g: replace(g, S=1.1 * g.S, D2=1.1 * g.D2),
        "shifted": lambda g: replace(g, S=g.S + 0.01 * g.q[..., 0], D2=g.D2 + 0.01),
        "slope": lambda g: replace(g, D2=g.D2 + 0.01),
    }.items():
        broken = replace(f, S={k: change(g) if k % 2 == odd else g for k, g in f.S.items()})
        assert not check(known, broken, 1e-10).passed, name


def printed(P, p0, s1):
    """The left equations as the paper prints them."""
    return -P.D1, P.D2, s1 + P.L - (p0 * P.D1).sum(-1)


def sign_only(P, p0, s1):
    """Only the sign of the printed p1 mended."""
    return -P.D1, -P.D2, s1 + P.L - (p0 * P.D1).sum(-1)


def test_the_left_equations_row_rejects_the_printed_formula(monkeypatch):
    # fails if the row compares p1 with itself (E5)
    known = subject((nonlinear, states(2)), H, 16, 0)
    w = sampled_rollout(known, 3)
    assert left_formalism(known, w, 1e-10).passed
    for wrong, least in ((printed, 1.0), (sign_only, 0.01)):
        monkeypatch.setattr(rows, "left_equations", wrong)
        check = left_formalism(known, w, 1e-10)
        assert not check.passed
        assert check.value > least


def test_the_left_rows_have_no_sample_where_c_vanishes():
    # fails if a check that is left with nothing passes: left rule at h = 1/γ, where L⁻ does not exist
    report = verify((scene("damped_oscillator").L_d_rules["left"], states()), h=5.0, steps=2)
    for name in ("left_equations", "left_hamilton_jacobi"):
        assert not report[name].passed
        assert report[name].value != report[name].value


class Pushed:
    """The 2-dof system with a force against each velocity, on either side of the step."""

    def __call__(self, q0, q1, s0, h):
        return nonlinear(q0, q1, s0, h)

    def forces(self, q0, q1, s0, h):
        drag = -0.3 * (q1 - q0) + 0 * (s0 + h)[..., None]
        return 0.5 * drag, 0.5 * drag


def test_forces_are_verified_by_their_own_identity():
    # fails if a forced model is held to a contact map's identities, or its defect has a wrong sign
    report = verify((Pushed(), states(2)), h=H, steps=3)
    assert report.passed, report.table()
    rows = {"converged", "positive_c", "regularity", "derivative", "contact", "momentum"}
    assert {check.name for check in report.checks} == rows

    class Silent:  # null model: the forced steps, with the L_d alone as the claim
        L_d = staticmethod(nonlinear)
        step = Stepper(Pushed()).step

    failing = {check.name for check in verify((Silent(), states(2)), h=H, steps=3).checks if not check.passed}
    assert {"contact", "volume", "momentum", "left_equations", "left_hamilton_jacobi"} <= failing
