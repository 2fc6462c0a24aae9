"""Recorded inputs u drive the fit: both objectives, judgement, files, and clear words where they cannot."""

import json
from dataclasses import replace
from typing import Any

import pytest
import torch

from herglotz.cli import main
from herglotz.data import Trajectories, load, save
from herglotz.errors import InputError
from herglotz.export import compare, export_c, load_exported
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper
from herglotz.training import (
    FitConfig,
    Prior,
    ResidualProblem,
    ShootingProblem,
    fit,
    laplace,
    load_run,
    save_run,
)
from herglotz.training.problems.grid import segment_grid, step_inputs
from herglotz.verify import verify
from tests.compared import assert_gradient

SIZES: dict[str, Any] = {"scale": (1.5,), "speed": (1.5,), "stiffness": (1.0,), "tilt": (0.0,)}
GAIN, ZERO = 0.7, 0.1


def driven_truth() -> Any:
    model: Any = ContactLagrangian(
        ModelConfig(level="forced", inputs=1, input_zero=True, rate=0.05, potential_width=0, **SIZES)
    )
    with torch.no_grad():
        model.friction.viscous.fill_(0.15)
        model.friction.input_map.fill_(GAIN)
        model.friction.input_zero.fill_(ZERO)
    return model


def driven_data(noise=0.0, trajectories=5, steps=40, gaps=False, seed=0):
    """A pendulum under a random torque that is held over each step; steps of unequal length, samples missing."""
    make = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=make, dtype=torch.float64)  # noqa: E731
    h = 0.2 * (1 + 0.2 * (2 * torch.rand(trajectories, steps, generator=make, dtype=torch.float64) - 1))
    u = 0.8 * draw(trajectories, steps, 1)
    if gaps:  # a sample of the next step is missing: its input is the same, so that one longer step is the truth too
        u[:, 1::10] = u[:, 0::10]
    with torch.no_grad():
        out = Stepper(driven_truth()).rollout(draw(trajectories, 1), draw(trajectories, 1), h=h, inputs=u)
    t = torch.cat([h.new_zeros(trajectories, 1), h.cumsum(1)], 1)
    q = out.q + noise * draw(*out.q.shape)
    u = torch.cat([u, torch.zeros_like(u[:, :1])], 1)  # the last input of a trajectory acts on nothing
    keep = torch.ones(steps + 1, dtype=torch.bool)
    if gaps:
        keep[1::10] = False
    lengths = (int(keep.sum()),) * trajectories
    parts = (x[:, keep].flatten(0, 1) for x in (t, q, u))
    t, q, u = parts
    return Trajectories.of(t, q, lengths, angles=(True,), u=u)


@pytest.fixture(scope="module")
def exact_run():
    return fit(driven_data(), FitConfig(objective="residual", iterations=60, correction_width=0), progress=False)


@pytest.mark.parametrize("objective", ["residual", "trajectory"])
def test_gradients_with_inputs_match_finite_differences(objective):
    # fails if an input acts on another step than its own, or the map's derivative is missing
    data = driven_data(noise=0.02, gaps=True)
    model = driven_truth()
    with torch.no_grad():
        for p in model.parameters():
            p += 0.05
    prior = Prior(model, data.q.amin(0), data.q.amax(0), departure=None)
    if objective == "residual":
        problem: Any = ResidualProblem(model, data, sigma=0.1, prior=prior)
        x = problem.start()
    else:
        problem = ShootingProblem(model, data, segment_grid(data, 9, 0.3), sigma=0.1, prior=prior, freedom=4.0)
        i = problem.grid.start_sample
        velocity = (data.q[i + 1] - data.q[i]) / (data.t[i + 1] - data.t[i])[:, None]
        x = problem.pack(problem.parameters.get(), problem.states(data.q[i], velocity))
    assert_gradient(problem, x, 1e-4, torch.Generator().manual_seed(0))


def test_exact_data_give_back_the_map(exact_run):
    # fails if training, the free run or the judgement steps without the recorded input, or with its neighbour's
    friction: Any = exact_run.model.friction
    assert (exact_run.metrics["level"], exact_run.decided.coulomb) == ("forced", True)
    assert friction.input_map.item() == pytest.approx(GAIN, rel=1e-4)
    assert friction.input_zero.item() == pytest.approx(ZERO, abs=1e-4)
    assert exact_run.metrics["extrapolation_rms"] < 1e-4
    without = fit(driven_data(), FitConfig(objective="residual", iterations=60, correction_width=0, use_inputs=False))
    assert without.model.inputs == 0
    assert without.metrics["extrapolation_rms"] > 30 * exact_run.metrics["extrapolation_rms"]


def test_noisy_data_with_gaps():
    # fails if trajectory fitting, its start states or its long steps over gaps lose the inputs
    data = driven_data(noise=0.01, gaps=True, trajectories=3)
    run = fit(data, FitConfig(departures=(2e-3,), coulomb=False, level="forced"), progress=False)
    assert run.metrics["objective"] == "trajectory"
    assert run.metrics["extrapolation_rms"] < 0.05
    friction: Any = run.model.friction
    assert friction.input_map.item() == pytest.approx(GAIN, rel=0.05)
    bands = laplace(run).bands()
    assert 0.7 < float(bands.inside(run.data.q).double().mean()) <= 1.0


def test_a_given_map_is_kept():
    # fails if the given map is trained
    run = fit(driven_data(), FitConfig(objective="residual", iterations=5, input_map=(GAIN,)), progress=False)
    friction: Any = run.model.friction
    assert not friction.input_map.requires_grad
    assert friction.input_map.item() == GAIN


def test_saved_runs_and_the_c_stepper_are_driven(exact_run, tmp_path):
    # fails if the file forgets the map or the inputs' zero, or verify steps without u
    save_run(exact_run, tmp_path / "run")
    run = load_run(tmp_path / "run")
    assert run.data.u is not None
    torch.testing.assert_close(run.data.u, exact_run.data.u)
    export_c(run.model, tmp_path / "driven.h", h=run.h, box=run.box)
    found = compare(load_exported(tmp_path / "driven.h"), run.stepper, batches=(1, 7), steps=60)
    assert max(found[name] for name in "qpsc") < 1e-9
    report = verify(run, samples=8, steps=3)
    follow = {check.name: check for check in report.checks}
    assert follow["one_step"].passed
    assert follow["follow"].passed
    blind = verify(replace(run, data=replace(run.data, u=torch.zeros_like(run.data.u))), samples=8, steps=3)
    assert not {check.name: check for check in blind.checks}["follow"].passed


def test_rollout_of_recorded_inputs(exact_run, tmp_path, capsys):
    # fails if the command steps without the file's inputs or steps
    save_run(exact_run, tmp_path / "run")
    data = exact_run.data[0]
    save(tmp_path / "u.csv", data)
    x = [float(v[0]) for v in exact_run.states[:2]]
    begin = ["--q0", str(x[0]), "--p0", str(x[1]), "--s0", str(float(exact_run.states.s[0]))]
    command = ["rollout", str(tmp_path / "run"), "--steps", "40", *begin, "--out", str(tmp_path / "m.csv")]
    assert main([*command, "--inputs", str(tmp_path / "u.csv")]) == 0
    capsys.readouterr()
    motion = load(tmp_path / "m.csv")
    torch.testing.assert_close(motion.t, data.t - data.t[0], rtol=0, atol=1e-12)
    assert float((motion.q - data.q).abs().max()) < 0.01
    assert main([*command, "--force", "--inputs", str(tmp_path / "u.csv"), "--u", "1"]) == 2
    assert "leave one out" in capsys.readouterr().err
    # from the last fitted state the inputs are those of its time: the rollout is the run's own free run
    first = exact_run.train_lengths[0] - 1
    steps = exact_run.data.lengths[0] - 1 - first
    command[3:] = [str(steps), "--force", "--out", str(tmp_path / "m.csv")]
    assert main([*command, "--inputs", str(tmp_path / "u.csv")]) == 0
    motion = load(tmp_path / "m.csv")
    torch.testing.assert_close(motion.t, data.t[first:], rtol=0, atol=1e-12)
    torch.testing.assert_close(motion.q, exact_run.prediction[first : first + steps + 1], rtol=0, atol=1e-9)
    capsys.readouterr()
    assert main([*command, "--u", "0.1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == steps
    # fails if inputs of longer steps than the fit's leave open what to do about it
    save(tmp_path / "u.csv", data.thinned(2))
    command[3:] = ["9", *begin, "--force", "--out", str(tmp_path / "m.csv"), "--inputs", str(tmp_path / "u.csv")]
    assert main(command) == 0
    assert f"; --h {exact_run.h:g} takes the model's own" in " ".join(capsys.readouterr().err.split())
    assert main([*command, "--h", f"{exact_run.h!r}"]) == 0
    assert "takes the model's own" not in capsys.readouterr().err


def test_figures_of_a_driven_run(exact_run, tmp_path, capsys):
    # fails if a fit of driven data ends in an error, because a figure is of an action that a model with forces has not
    save_run(exact_run, tmp_path / "run")
    assert main(["plot", str(tmp_path / "run")]) == 0
    assert "error" not in capsys.readouterr().err
    drawn = {path.name for path in (tmp_path / "run").glob("*.png")}
    assert drawn == {"trajectory.png", "phase_portrait.png", "learned.png", "training.png", "plan.png"}


@pytest.mark.parametrize(("settings", "message"), [
    ({"level": "linear"}, "holds inputs u, which the level 'linear' cannot take; set level='forced'"),
    ({"input_map": (1.0, 2.0)}, "input_map needs n · m = 1 · 1 numbers, row by row; got 2"),
    ({"input_map": (1.0,), "use_inputs": False}, "leave one of them out"),
    ({"input_map": (1.0,), "level": "affine"}, "are forces; set level='forced'"),
])  # fmt: skip
def test_combinations_that_do_not_fit_are_named(settings, message):
    # fails if inputs are dropped without a word, or a wrong map is found only inside the fit
    with pytest.raises(InputError, match=message):
        fit(driven_data(trajectories=1), FitConfig(**settings))


def test_a_driven_model_wants_its_inputs():
    # fails if a driven model is fitted to data that hold none, or another number of them
    data = driven_data(trajectories=1)
    with pytest.raises(InputError, match="none of these columns is one; name them"):
        step_inputs(driven_truth(), replace(data, u=None))
    assert data.u is not None
    with pytest.raises(InputError, match="2 input\\(s\\) u are recorded, the model takes 1"):
        step_inputs(driven_truth(), replace(data, u=data.u.expand(-1, 2)))
