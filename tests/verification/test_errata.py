"""Each erratum: the printed formula's residual is clear, the corrected one's is rounding; the scripts of the paper."""

import importlib.util
import json
import sys
from pathlib import Path

import mpmath
import pytest
import torch

from herglotz.mechanics import contact_defect, flow_derivative
from herglotz.plots import parachute as figures
from herglotz.scenes import PrintedParachute, scene
from herglotz.scenes.parachute import MAP_START

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "train"))  # as for a script that is run there


def script(name):
    spec = importlib.util.spec_from_file_location(f"train_{name}", ROOT / "train" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


errata, parachute = script("errata"), script("parachute")


@pytest.mark.parametrize("make", errata.ERRATA, ids=lambda f: f.__name__)
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
    for make in errata.ERRATA:
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
    # fails if the closed form takes the other root, or the flow another velocity
    time, speed = landing_reference()
    x, fall = figures.start(), scene("parachute")
    found = figures.landing(100.0, float(fall.velocity(*x)))
    assert abs(found[0] / time - 1) < 1e-15
    assert abs(found[1] / speed - 1) < 1e-15
    state = fall.flow(*x, time)
    assert abs(float(state[0])) < 1e-13  # of 100 m
    assert abs(float(fall.velocity(*state)) / speed - 1) < 1e-15


def test_what_the_figures_draw():
    # fails if a curve starts at another k than its axis, a point is left out, or the fall goes on below the ground
    found, orbit = figures.printed_map()
    points = printed_orbit(8)
    assert [len(x["points"]) for x in found.values()] == [9, 10]
    for k in range(1, 7):
        assert abs(orbit.q[k] / points[k - 1][0] - 1) < 2e-12
        assert abs(orbit.p[k] / points[k - 1][1] - 1) < 2e-12
        assert abs(orbit.dS_squared[k - 1] / orbit.p_squared[k] - 1) < 1e-12
    assert len(orbit.q) == len(orbit.p) == 1 + len(orbit.dS)
    numbers, fall = figures.physical_fall()
    assert fall.t[0] == 0.0
    assert fall.t[-1] < fall.landing_time < fall.t[-1] + 0.2
    assert fall.q[0] == 100.0
    assert fall.q.min() > 0.0
    assert numbers["worst_hamilton_jacobi_residual_relative"] == fall.residual.max() > fall.residual.min()


@pytest.fixture(scope="module")
def run_of_the_script(tmp_path_factory):
    out = tmp_path_factory.mktemp("parachute")
    arguments, sys.argv = sys.argv, ["parachute.py", "--out", str(out)]
    threads = torch.get_num_threads()
    try:
        assert parachute.main() == 0
    finally:
        sys.argv = arguments
        torch.set_num_threads(threads)
    return out


def test_the_script_writes_numbers_and_figures(run_of_the_script):
    # fails if D2S^k is compared with itself, or the landing comes from one source only
    numbers = json.loads((run_of_the_script / "parachute.json").read_text(encoding="utf-8"))
    time, speed = landing_reference()
    for value in numbers["fall"]["landing_time"].values():
        assert abs(value / time - 1) < 1e-12
    for value in numbers["fall"]["landing_velocity"].values():
        assert abs(value / speed - 1) < 1e-14
    assert numbers["fall"]["worst_dS_minus_p_relative"] < 1e-12
    assert numbers["fall"]["worst_hamilton_jacobi_residual_relative"] < 1e-14
    for name, smallest, largest in (("printed", 1.0, 2.0), ("squared", 0.0, 1e-13)):
        x = numbers["printed_map"][name]
        worst = abs(x["dS"][2] / x["points"][3]["p"] - 1)
        assert smallest <= worst <= largest
    assert numbers["printed_map"]["printed"]["last_finite_k"] == 8
    for name in ("parachute_map.png", "parachute_fall.png"):
        assert (run_of_the_script / name).read_bytes()[:4] == b"\x89PNG"
