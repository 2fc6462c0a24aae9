"""The judging of the measured benchmarks: windows of a driven pendulum, coverage, and the table."""

import json
from typing import Any

import pytest
import torch

from benchmarks import measured, measured_sets
from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training import Bands


@pytest.fixture(scope="module")
def motor(steps=140, h=0.02):
    """The authors' own motion under a slowly changing torque: what their model must follow and others may not."""
    t = torch.arange(steps + 1, dtype=torch.float64) * h
    u = 0.8 * (2.1 * t).sin() + 0.5 * (3.7 * t).cos()
    q, v = torch.zeros(1, dtype=t.dtype), torch.ones(1, dtype=t.dtype)
    path = measured_sets.authors(q, v, t.diff()[None], u[None, :-1], parts=40)[0]
    return Trajectories.of(t, path[:, None], (steps + 1,), angles=(True,), u=u[:, None])


def own_model(gain):
    """The authors' pendulum as a forced model with the friction's kink as a tanh: their numbers over J."""
    sizes: dict[str, Any] = {
        "scale": (3.0,),
        "speed": (5.0,),
        "stiffness": (measured_sets.MGL / measured_sets.J,),
        "tilt": (0.0,),
    }
    model: Any = ContactLagrangian(
        ModelConfig(level="forced", inputs=1, input_zero=True, rate=1e-6, potential_width=0, coulomb=True, **sizes)
    )
    with torch.no_grad():
        model.friction.viscous.fill_(measured_sets.VISCOUS / measured_sets.J)
        model.friction.coulomb.fill_(measured_sets.COULOMB * torch.pi / 2 / measured_sets.J)
        model.friction.log_smooth.fill_(-4.0)
        model.friction.input_map.fill_(gain / measured_sets.J)
        model.friction.input_zero.fill_(measured_sets.OFFSET)
    return model


def test_windows_of_the_driven_pendulum(motor):
    # fails if a window's torque, truth or start is another sample's, if momenta are not those of the velocities, or if
    # the two models change places
    test = motor
    found = measured_sets.beside_the_authors(own_model(1.0), test, 1.0)
    assert found["authors_rms_1.0s"] < 0.03
    assert found["ours_rms_1.0s"] < 0.05
    assert found["over_authors_1.0s"] == pytest.approx(found["ours_rms_1.0s"] / found["authors_rms_1.0s"])
    wrong = measured_sets.beside_the_authors(own_model(-1.0), test, 1.0)
    assert wrong["ours_rms_1.0s"] > 0.5
    assert wrong["nearer_1.0s"] < 0.1
    assert wrong["authors_rms_1.0s"] == found["authors_rms_1.0s"]


def test_the_authors_model_has_converged(motor):
    # fails if steps of 5 ms are too long for the kink of their friction: they would be judged by our integrator's error
    test = motor
    rows = measured_sets.window_rows(test, 50)
    q, v = measured_sets.starts(test, rows)
    at = rows[:, None] + torch.arange(51)
    assert test.u is not None
    arguments = q[:, 0], v[:, 0], test.t[at].diff(dim=1), test.u[at[:, :-1], 0]
    coarse, fine = measured_sets.authors(*arguments), measured_sets.authors(*arguments, parts=32)
    assert float((coarse - fine).square().mean().sqrt()) < 2e-3


def test_shares_count_what_lies_inside():
    # fails if the level is one-sided, or the noise is counted where the true position is asked for
    make = torch.Generator().manual_seed(0)
    n = 20000
    error = torch.randn(n, 1, generator=make, dtype=torch.float64)
    flat = torch.zeros_like(error)
    bands = Bands(flat, 0.6 * torch.ones_like(error), sigma=torch.tensor([0.8]))
    every = torch.ones(n, dtype=torch.bool)
    assert measured_sets.shares(bands, error, every) == pytest.approx(measured_sets.LEVELS, abs=0.01)
    true = measured_sets.shares(bands, 0.6 * error, every, measured=False)
    assert true == pytest.approx(measured_sets.LEVELS, abs=0.01)


def test_the_command_writes_every_row_itself(tmp_path, monkeypatch):
    # fails if a set's rows reach the table only by hand, an older row is lost, or curves are printed as figures
    curve = list(measured_sets.LEVELS)
    example = {"t": list(range(120)), **{name: [0.01] * 120 for name in ("q", "model", "std")}, "sigma": 0.01}
    covered = measured_sets.curves_row({"laplace_measured": curve, "ensemble_measured": curve}) | {"example": example}
    fake = {
        "outliers": ((), lambda seed, _: {"over_clean": 0.5 + 0.5 * seed}),
        "coverage_simulated": ((), lambda *_: covered),
        "air_track": (("absent.txt",), lambda *_: pytest.fail("run without its data")),
    }
    monkeypatch.setattr(measured, "ROWS", fake)
    out = tmp_path / "measured.json"
    for only in ("outliers", "coverage_simulated,air_track"):
        measured.main(["--seeds", "3", "--only", only, "--out", str(out), "--data", str(tmp_path)])
    rows = json.loads(out.read_text())["rows"]
    assert list(rows) == ["outliers", "coverage_simulated"]
    assert [seed["over_clean"] for seed in rows["outliers"]["seeds"]] == [0.5, 1.0, 1.5]
    text = out.with_suffix(".md").read_text()
    assert "| over_clean | 3 | 1 | 0.5 … 1.5 | ≤ 2 |" in text
    assert "| laplace_measured | 3 | 0.9 | 0.9 … 0.9 | 0.8 … 0.97 |" in text
    assert "curves" not in text
    assert (tmp_path / "coverage.png").stat().st_size > 10000
