"""Each erratum: the printed formula's residual is clear, the corrected one's is rounding; the paper's figures."""

import functools
import sys
from pathlib import Path

import mpmath
import pytest
import torch

from herglotz.mechanics import contact_defect, flow_derivative
from herglotz.plots import parachute as figures
from herglotz.scenes import PrintedParachute, scene
from herglotz.scenes.parachute import MAP_START
from herglotz.stepping import Stepper

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "train"))
import errata  # noqa: E402

MADE = {make.__name__: functools.cache(make) for make in errata.ERRATA}


@pytest.mark.parametrize("make", MADE.values(), ids=MADE)
def test_printed_formulas_are_wrong_and_corrected_ones_right(make):
    # fails if a corrected formula carries a wrong sign, index or factor, or a check would accept the printed one
    erratum = make()
    assert erratum.rows
    for row in erratum.rows:
        assert row.corrected <= 1e-10, row
        assert row.printed >= 1e-3, row


def test_the_page_is_the_scripts_output():
    # fails if docs/errata.md was edited by hand or is older than the script (numbers apart: they are rounding)
    page = (ROOT / "docs" / "errata.md").read_text(encoding="utf-8")
    for make in MADE.values():
        e = make()
        assert f"## {e.number}\n" in page
        assert e.printed in page
        assert e.right in page
        for row in e.rows:
            assert f"| {row.setting.replace('|', chr(92) + '|')} | {row.printed:.3g} |" in page
    for name in ("parachute_map.png", "parachute_fall.png"):
        assert f"images/{name}" in page
        assert (ROOT / "docs" / "images" / name).exists()


def printed_orbit(steps, digits=60):
    with mpmath.workdps(digits):
        q, p, s = (mpmath.mpf(x) for x in (100, 1, 1))
        lam = -mpmath.mpf(1) / 100
        points = []
        for _ in range(steps):
            p1 = (1 - 10 * mpmath.e ** (2 * lam * q) / p) / (2 * lam) - 2 * lam * s
            q1 = p1 + 2 * lam * s
            s = s + p1**2 / 2 - 2 * lam**2 * s - 5 / lam * (mpmath.e ** (2 * lam * q) - 1)
            q, p = q1, p1
            points.append((float(q), float(p), float(s)))
    return points


def test_the_printed_map_point_by_point():
    # fails if one of the three printed lines is altered, or an overflow counts as a point
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in MAP_START)
    (q, p, s), last = PrintedParachute().orbit(q[None], p[None], s, steps=12)
    assert last == 8
    for k, point in enumerate(printed_orbit(8), 1):
        # the k-th point has lost about as many digits as the map stretches: 1e-12 at k = 8
        torch.testing.assert_close(
            (q[k, 0], p[k, 0], s[k]), tuple(torch.tensor(x, dtype=torch.float64) for x in point), rtol=2e-12, atol=0
        )
    two = PrintedParachute(squared=True).orbit(q[0], p[0], s[0], steps=2)[0][2][2]
    assert abs(float(two) / 196.40718250753046 - 1) < 2e-14


def test_only_the_square_makes_the_printed_map_a_contact_map():
    # fails if −2λ²s/m is as good as −2λ²s²/m
    x = tuple(torch.tensor(v, dtype=torch.float64) for v in ([30.0], [-12.0], -40.0))
    defects = []
    for squared in (True, False):
        step = PrintedParachute(squared=squared)
        (q1, p1, _), D = flow_derivative(step, *x)
        factor = 1.0 - 2 * step.lam * q1[..., 0]  # 1 − D3H⁺
        defects.append(float(contact_defect(D, x[1], p1, factor).abs().max()))
    assert defects[0] < 1e-11
    assert defects[1] > 1e-3


def landing_reference():
    with mpmath.workdps(40):
        g, lam, q0, v0 = mpmath.mpf(10), mpmath.mpf(1) / 100, mpmath.mpf(100), mpmath.mpf("0.98")
        w = mpmath.sqrt(lam * g)
        time = mpmath.findroot(
            lambda t: mpmath.cosh(w * t) - lam * v0 / w * mpmath.sinh(w * t) - mpmath.e ** (lam * q0), 5
        )
        C, S = mpmath.cosh(w * time), mpmath.sinh(w * time)
        speed = (v0 * C - g / w * S) / (C - lam * v0 / w * S)
        assert mpmath.nstr(time, 18) == "5.34099635306509637"
        assert mpmath.nstr(speed, 18) == "-29.4073918049426436"
        return float(time), float(speed)


def test_the_landing_to_fifteen_digits():
    # fails if the closed form takes the other root, the flow another velocity, or an event another time
    time, speed = landing_reference()
    x, fall = figures.start(), scene("parachute")
    found = figures.landing(100.0, float(fall.velocity(*x)))
    assert abs(found[0] / time - 1) < 1e-15
    assert abs(found[1] / speed - 1) < 1e-15
    event = Stepper(fall.L_d).rollout(*x, h=0.2, steps=27, events=[lambda state: state.q[..., 0]]).events[0]
    assert abs(float(event.t[0]) / time - 1) < 1e-12
    assert abs(float(fall.velocity(*event.state)) / speed - 1) < 1e-14
    state = fall.flow(*x, time)
    assert abs(float(state[0])) < 1e-13  # of 100 m
    assert abs(float(fall.velocity(*state)) / speed - 1) < 1e-15


def test_what_the_figures_draw():
    # fails if a curve starts at another k than its axis, a point is left out, or the fall goes on below the ground
    orbit = figures.printed_map()
    points = printed_orbit(8)
    assert orbit.last == 8
    for k in range(1, 7):
        assert abs(orbit.q[k] / points[k - 1][0] - 1) < 2e-12
        assert abs(orbit.p[k] / points[k - 1][1] - 1) < 2e-12
        assert abs(orbit.dS_squared[k - 1] / orbit.p_squared[k] - 1) < 1e-12
    assert len(orbit.q) == len(orbit.p) == 1 + len(orbit.dS)
    # As printed D2S^3 is not p_3, with s² it is.
    assert 1.0 <= abs(orbit.dS[2] / orbit.p[3] - 1) <= 2.0
    assert abs(orbit.dS_squared[2] / orbit.p_squared[3] - 1) < 1e-13
    fall = figures.physical_fall()
    assert fall.t[0] == 0.0
    assert fall.t[-1] < fall.landing_time < fall.t[-1] + 0.2
    assert fall.q[0] == 100.0
    assert fall.q.min() > 0.0
    assert abs(fall.dS / fall.p[1:] - 1).max() < 1e-12
    assert 0.0 < fall.residual.max() < 1e-14
