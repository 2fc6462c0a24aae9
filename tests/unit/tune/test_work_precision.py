"""The benchmark of error against cost, on one scene with few settings: it must measure what it says."""

import importlib.util
import json
import math
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("scipy")  # the benchmark's, not the package's
SCRIPT = Path(__file__).resolve().parents[3] / "benchmarks" / "work_precision.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("work_precision", SCRIPT)
    module = importlib.util.module_from_spec(spec)  # pyright: ignore
    spec.loader.exec_module(module)  # pyright: ignore
    yield module
    sys.modules.pop("work_precision", None)


def test_rules_show_their_orders(benchmark, tmp_path):
    # fails if errors are taken at other times than the truth, or a method's name stands beside another's error
    out = tmp_path / "points.json"
    benchmark.main(["--quick", "--scenes", "damped_oscillator", "--out", str(out)])
    points = json.loads(out.read_text())["scenes"]["damped_oscillator"]
    assert out.with_suffix(".png").stat().st_size > 10_000
    assert {p["order"] for p in points} == {1, 2, 4, 6}
    loose = [p["median"] for p in points if p["kind"].endswith("tol 0.0001")]
    assert loose[1] > loose[0]  # what Newton leaves goes into p divided by h: looser and smaller is worse
    for kind in {p["kind"] for p in points if "tol" not in p["kind"]}:
        coarse, fine = (p for p in points if p["kind"] == kind)
        slope = math.log(coarse["median"] / fine["median"], 4)  # four times as many steps
        if fine["median"] > 1e-11:
            assert slope > coarse["order"] - 0.3, (kind, slope)
        assert fine["evaluations_per_time"] > 2 * coarse["evaluations_per_time"]


def test_dop853_in_c_is_dop853(benchmark, tmp_path):
    # fails if a coefficient is lost on the way into C: the error must follow the tolerance, at order 8's price
    from herglotz.export import export_c
    from herglotz.models import ContactLagrangian, ModelConfig

    header = export_c(ContactLagrangian(ModelConfig(correction_width=4)), tmp_path / "a.h", h=0.1)
    library = benchmark.build(tmp_path, header, 0, 1)
    y = torch.tensor([[1.5, 0.3]], dtype=torch.float64)
    exact, _ = benchmark.motions(library, y, 8.0, 0, 4000)  # RK4 at h = 5e-4
    errors, counts = [], []
    for tol in (1e-4, 1e-7, 1e-10):
        q, count = benchmark.motions(library, y, 8.0, 1, tol)
        errors.append(float((q - exact).abs().max()))
        counts.append(count)
    assert [e < 10 * tol for e, tol in zip(errors, (1e-4, 1e-7, 1e-10), strict=True)] == [True] * 3, errors
    assert counts[2] < 5 * counts[0]  # six decades: 10^(6/8) = 5.6 times the steps, less what the shortest need
