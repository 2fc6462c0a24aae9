"""What a run offers beside its numbers: rollouts in numpy, pictures, files, words."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from fake_run import fake_run

import herglotz as hz
from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.theory.symmetries import symmetries
from herglotz.training.motion import Motion


def test_a_rollout_is_numpy_without_gradients():
    # fails if a rollout carries a graph of the parameters, starts elsewhere than the free run, or at another time
    run = fake_run(trajectories=2)
    first = run.data.offsets[1] + run.train_lengths[1] - 1
    found = run.rollout(5, trajectory=1)
    assert all(isinstance(x, np.ndarray) for x in (found.t, found.q, found.v, found.p, found.s, found.status))
    np.testing.assert_allclose(found.q, run.prediction[first : first + 6].detach().numpy(), atol=1e-10)
    np.testing.assert_allclose(found.t, run.data.t[first : first + 6], atol=1e-12)
    assert found.ok
    assert repr(found) == f"Motion(t {found.t[0]:g} to {found.t[-1]:g} s, q (6, 1) of theta)"


def test_a_start_may_be_numbers_or_a_batch():  # fails if a number, a list or an array is refused, or s0 is dropped
    run = fake_run()
    one = run.rollout(4, q0=1.0, p0=0.2, s0=0.5, h=0.2, t0=3.0)
    many = run.rollout(4, q0=np.array([[1.0], [0.3]]), p0=[[0.2], [0.0]], h=0.2)
    assert (one.s[0], one.t[-1], many.q.shape) == (0.5, 3.8, (2, 5, 1))
    np.testing.assert_allclose(one.q, many.q[0], atol=1e-12)
    with pytest.raises(InputError, match=r"q0 and v0 .* go together"):
        run.rollout(4, q0=1.0)
    with pytest.raises(InputError, match="q0 and p0 need 1 numbers each"):
        run.rollout(4, q0=[1.0, 2.0], p0=[0.0, 0.0])
    with pytest.raises(InputError, match="there is no trajectory 3"):
        run.rollout(4, trajectory=3)


def test_steps_beyond_those_of_the_fit_are_warned_of():  # fails if Python is silent where the command line is not
    run = fake_run()
    with pytest.warns(UserWarning, match=r"steps of 0.5 s are outside of those that .* fitted to, 0.2 s"):
        run.rollout(2, h=0.5)
    run.rollout(2, h=0.2)  # its own step: warnings are errors here


@pytest.mark.parametrize(("level", "told"), [("linear", True), ("forced", True), ("affine", False), ("full", False)])
def test_a_damping_rate_is_told_where_positions_determine_it(level, told):
    # fails if γ is told at a level where other γ have the same motion, or at no level
    run = fake_run(level=level, steps=20)
    run = replace(run, metrics={**run.metrics, "rate": 0.2})
    assert ("damping rate" in run.summary()) == told
    assert ("γ = 0.2" in str(run.plot("phase_portrait").get_suptitle())) == told
    powers = ModelConfig(angles=(True,), level="forced", rate=0.2, potential_width=0, dissipation=("s^2",))
    of_s = replace(run, model=ContactLagrangian(powers))
    assert "damping rate" not in of_s.summary()
    assert "γ" not in of_s.plot("phase_portrait").get_suptitle()


def test_words_are_short():  # fails if a run, data or a prediction fill the screen again (repr had 64 kB)
    run = replace(fake_run(), metrics={"verdict": "fits to the noise: windows", "train_rms": 0.01, "rate": 0.2})
    assert repr(run).startswith("Run(linear level, theta of simulate(damped_pendulum")
    assert repr(run).endswith("; fits to the noise)")
    assert max(map(len, (repr(run), repr(run.data)))) < 200
    assert "<th style='text-align:left'>training RMS</th>" in run._repr_html_()
    assert "Verdict: fits to the noise" in run.summary()
    degrees = replace(run, data=replace(run.data, columns=(("theta", "coordinate", "deg"),)))
    assert "0.01 rad = 0.573 deg" in degrees.summary()  # fails if data in degrees are told in rad alone
    assert "deg" not in run.summary()
    assert max(map(len, run.summary().splitlines())) <= 80
    data = Trajectories.of(run.data.t, run.data.q, names=("theta",), angles=(True,))
    assert len(repr(run.predict(data))) < 100
    named = replace(run, config=replace(run.config, features=("cos(q1)",)))
    assert "cos(q1)  (q1 is theta)" in named.summary()  # fails if nobody is told which column q1 of a term is


def test_results_are_short():  # fails if what a step, a scene or a symmetry search returns fills the screen
    run = fake_run()
    state, _ = run.last_fitted()
    many = run.stepper.rollout(*(x[None] for x in state), h=0.1, steps=300)
    found = symmetries(run.model, (state.q[None], state.p[None], state.s[None]), h=0.1)
    assert repr(run.stepper.rollout(*state, h=0.1, steps=300)) == "Rollout(300 steps, q (301, 1))"
    assert repr(many) == "Rollout(300 steps, q (1, 301, 1) of a batch (1,), 0 failed)"
    assert repr(replace(many, status=many.status + 1)).endswith("1 failed)")
    assert repr(run.stepper) == "Stepper(ContactLagrangian, 30 iterations)"
    assert repr(hz.scene("kepler")) == "Scene(kepler: x, y)"
    assert repr(found).startswith("Symmetries(")
    assert max(len(repr(x)) for x in (run.equation(), found)) < 200


def test_pictures_files_and_checks(tmp_path, monkeypatch):  # fails if a method of a run does not reach its room
    run, calls = fake_run(), []
    assert run.plot("phase_portrait").axes
    with pytest.raises(InputError, match="no figure 'x'; choose one of trajectory, phase_portrait"):
        run.plot("x")
    with pytest.raises(InputError, match=r"must end in .pt2, .onnx, .h"):
        run.export(tmp_path / "a.txt")
    monkeypatch.setattr(
        "herglotz.export.c_header.export_c",
        lambda *given, **described: calls.append((*given, described["metadata"]["start"])),
    )
    monkeypatch.setattr("herglotz.verify.verify", lambda target, **settings: (target, settings))
    assert run.export(tmp_path / "a.h", h_range=(0.1, 0.3)) == tmp_path / "a.h"
    state, t = run.last_fitted()
    assert calls == [(run.model, tmp_path / "a.h", {**{k: getattr(state, k).tolist() for k in "qps"}, "t": t})]
    assert run.verify(samples=4) == (run, {"samples": 4})
    with pytest.raises(InputError, match=r"steps must be a whole number >= 1, got 2.5"):
        run.rollout(2.5)  # pyright: ignore
    run.save(tmp_path / "run")
    assert hz.load_run(tmp_path / "run").data.digest() == run.data.digest()


def test_settings_by_name():
    # fails if a setting given by name is ignored, a misspelt one is swallowed, or an array is not read
    q = fake_run().data.q.numpy()
    with pytest.raises(InputError, match="unknown level 'afine'"):
        hz.fit(q, h=0.2, level="afine")
    with pytest.raises(InputError, match=r"unknown setting 'levle' of a fit; did you mean level\?"):
        hz.fit(q, h=0.2, levle="affine")
    with pytest.raises(InputError, match="positions without times"):
        hz.fit(q, level="affine")
    assert hz.FitConfig().changed({"features": "cos(q1)", "departures": 0.5}).features == ("cos(q1)",)
    assert torch.get_num_threads() >= 1
    assert isinstance(fake_run().rollout(2), Motion)


def test_velocities_in_and_out():
    # fails if v0 is taken for a momentum, v is not the slope of the motion, or what a rollout lost has one
    run = fake_run(level="affine")
    damping: Any = run.model.damping
    with torch.no_grad():
        damping.drag.fill_(0.3)
    one = run.rollout(40, q0=1.0, v0=0.2, s0=0.5)
    assert one.v[0] == pytest.approx(0.2, rel=1e-12)
    assert abs(one.p[0] - 0.2) > 0.1
    np.testing.assert_allclose(one.v[1:-1], (one.q[2:] - one.q[:-2]) / 0.4, atol=0.02)  # h² q‴/6
    many = run.rollout(4, q0=[[1.0], [0.3]], v0=[[0.2], [0.0]], s0=[0.5, 0.0])
    np.testing.assert_allclose(many.v[0], one.v[:5], atol=1e-12)
    with pytest.raises(InputError, match="v0 and p0 both say how fast the start is"):
        run.rollout(4, q0=1.0, v0=0.2, p0=0.2)
    with pytest.raises(InputError, match="q0 and v0 need 1 numbers each"):
        run.rollout(4, q0=[1.0, 2.0], v0=[0.0, 0.0])
