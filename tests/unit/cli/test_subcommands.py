"""Each subcommand end to end on tiny data."""

import argparse
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import herglotz
import herglotz.cli
import herglotz.cli.flags
import herglotz.cli.plot
import herglotz.cli.simulate
from herglotz.cli import main
from herglotz.cli.parser import build_parser
from herglotz.data import load
from herglotz.scenes import scene_names
from herglotz.training import FitConfig, levenberg_marquardt, load_run, save_run


def run_json(capsys, *arguments: object) -> tuple[int, dict]:
    """Exit code and the JSON that must be all of stdout."""
    capsys.readouterr()
    code = main([*map(str, arguments), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_version(capsys):  # fails if the version is not the package's
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"herglotz {herglotz.__version__}\n"


COMMANDS = ("simulate", "fit", "select", "predict", "rollout", "export", "verify", "trust", "report", "tune", "plot")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_every_option(capsys, command, monkeypatch):
    # fails if an option has no help, there is no example, or a line is longer than a terminal as it opens
    monkeypatch.setenv("COLUMNS", "80")
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"example:\n  herglotz {command}" in text or f"examples:\n  herglotz {command}" in text
    subparser = herglotz.cli.build_parser()._subparsers._group_actions[0].choices[command]  # pyright: ignore
    for action in subparser._actions:
        assert action.help, action.dest
    assert max(map(len, text.splitlines())) <= 80


def test_help_does_not_import_torch():  # fails if a heavy import moves to the top of a module (help takes seconds)
    code = "import sys; from herglotz.cli import main; main(['fit', '--help']); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_python_dash_m(tmp_path):  # fails if __main__ does not pass the exit code on
    command = [sys.executable, "-m", "herglotz", "fit", str(tmp_path / "no.csv"), "--out", str(tmp_path)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert found.stderr.startswith("herglotz: error: ")
    assert found.stderr.count("\n") == 1


def test_help_names_every_scene():  # fails if a scene is added that the help does not name
    for name in scene_names():
        assert name in herglotz.cli.simulate.description()


def test_the_help_of_fit_tells_the_packages_defaults():  # fails if a default changes and the help has the old one
    parser = build_parser()._subparsers._group_actions[0].choices["fit"]  # pyright: ignore
    settings = [action for action in parser._actions if action.default == argparse.SUPPRESS and action.dest != "help"]
    told = {a.dest: m[1] for a in settings if (m := re.search(r"\(default ([\w.]+)\)", a.help or ""))}
    assert {"level", "train_fraction", "seed", "iterations", "order", "dtype"} <= set(told)
    assert {name: str(getattr(FitConfig(), name)) for name in told} == told
    assert {action.dest for action in settings} <= set(FitConfig().to_dict())  # else a flag would set nothing


def test_settings_of_another_run(tmp_path):
    # fails if --config is ignored, a flag that was not given overrides it, or one that was given does not
    other = FitConfig(level="affine", seed=5, known=("-9.81 cos(q1)",), potential_width=3, use_inputs=False)
    (tmp_path / "config.json").write_text(json.dumps(other.to_dict()))

    def settings(*flags):
        return herglotz.cli.flags.settings_of(build_parser().parse_args(["fit", str(tmp_path), "--out", "b", *flags]))

    assert settings() == FitConfig()
    assert settings("--config", str(tmp_path)) == other
    found = settings("--config", str(tmp_path / "config.json"), "--seed", "0", "--feature", "q1^4", "--feature", "q1^3")
    assert (found.level, found.seed, found.features) == ("affine", 0, ("q1^4", "q1^3"))
    assert settings("--ignore-inputs", "--term", "x", "--departures", "1e-3") == FitConfig(
        use_inputs=False, terms=("x",), departures=(1e-3,)
    )
    for text, message in (("[]", "config.json"), ('{"levle": 1}', "levle"), ("{", "config.json")):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(herglotz.InputError, match=message):
            settings("--config", str(tmp_path))


def test_simulate(tmp_path, capsys):  # fails if an option does not reach the data, or the seed does not decide them
    arguments = ["simulate", "damped_oscillator", "--trajectories", 2, "--steps", 20, "--h", 0.25, "--noise", 0.01]
    arguments += ["--gaps", 1, "--seed", 7, "--param", "gamma=0.5"]
    code, found = run_json(capsys, *arguments, "--out", tmp_path / "a.csv")
    assert code == 0
    assert found["parameters"]["gamma"] == 0.5
    data = load(tmp_path / "a.csv")
    assert (len(data), data.gaps, data.typical_step, found["samples"]) == (2, 2, 0.25, data.samples)
    assert main([*map(str, arguments), "--out", str(tmp_path / "b.npz")]) == 0
    assert load(tmp_path / "b.npz").digest() == data.digest() == found["sha256"]
    assert main([*map(str, arguments), "--seed", "8", "--out", str(tmp_path / "c.csv")]) == 0
    assert load(tmp_path / "c.csv").digest() != data.digest()


def test_fit_reports_and_says_what_next(tiny_csv, tmp_path, capsys):  # fails if files, figures or the table go missing
    folder = tmp_path / "new" / "run"
    assert main(["fit", str(tiny_csv), "--out", str(folder), "--train-fraction", "0.8", "--seed", "3"]) == 0
    out, err = capsys.readouterr()
    assert "extrapolation RMS" in out
    # fails if what the fit found with nothing told stays hidden
    assert "cos(q1)" in next(line for line in out.splitlines() if line.strip().startswith("named terms"))
    assert f"Next: herglotz report {folder}" in out
    assert err.startswith("tiny.csv:\n  column")
    assert "\r" not in err  # no bar where there is no terminal, but a line a stage
    assert re.search(r"^segments of \d+: \d+ iterations?, [\d.]+ s$", err, re.M)
    assert {"model.pt", "metrics.json", "config.json", "fit.npz"} <= {x.name for x in folder.iterdir()}
    assert len(list(folder.glob("*.png"))) == 6
    run = load_run(folder)
    assert (run.config.train_fraction, run.config.seed, run.train_lengths) == (0.8, 3, (49,))


def test_what_is_told_reaches_the_model(tmp_path):
    # fails if --diagonal does not
    csv = tmp_path / "two.csv"
    made = ["simulate", "chain", "--param", "masses=2", "--trajectories", "4", "--steps", "24", "--h", "0.1"]
    assert main([*made, "--out", str(csv)]) == 0
    told = ["--level", "forced", "--diagonal", "--feature", "(q1 - q2)^2", "--out", str(tmp_path / "told")]
    assert main(["fit", str(csv), *told, "--no-plots", "--order", "4", "--iterations", "2"]) in (0, 3)
    assert "kinetic.off_diagonal" not in dict(load_run(tmp_path / "told").model.named_parameters())


def test_fit_json_options_and_resume(tiny_csv, tmp_path, capsys, monkeypatch):
    # fails if an option is dropped, or resume fits again
    folder = tmp_path / "run"
    arguments = ["fit", tiny_csv, "--out", folder, "--no-plots", "--dtype", "float32", "--angles", "none"]
    arguments += ["--objective", "trajectory", "--level", "conservative"]  # the cheapest that is no default
    searched = []  # one entry a search

    def counted(*of, **options):
        searched.append(of)
        return levenberg_marquardt(*of, **options)

    monkeypatch.setattr("herglotz.training.trajectory_fit.levenberg_marquardt", counted)
    code, found = run_json(capsys, *arguments)
    assert (found["level"], found["objective"]) == ("conservative", "trajectory")
    assert code == (3 if found["verdict"].startswith("does not fit") else 0)  # rounding decides, in float32
    run = load_run(folder)
    assert next(run.model.parameters()).dtype == torch.float32
    assert run.data.angles == (False,)
    assert not list(folder.glob("*.png"))
    first = len(searched)
    code_again, again = run_json(capsys, *arguments, "--resume")
    assert code_again == code
    assert again["train_rms"] == pytest.approx(found["train_rms"], abs=1e-4)
    assert len(searched) - first < first


def test_rollout_goes_on_where_training_ended(tiny_run, tmp_path, capsys):
    # fails if the rollout starts at another sample or time, or steps with another h than the free run
    run = load_run(tiny_run)
    first = run.train_lengths[0] - 1
    each = round(run.data.typical_step / run.h)  # model steps in a recorded one
    steps = each * (run.data.samples - 1 - first)
    rollout = ("rollout", tiny_run, "--steps", steps, "--out", tmp_path / "a.csv")
    code, found = run_json(capsys, *rollout, "--momenta")
    assert (code, found["steps"]) == (0, steps)
    assert found["outside_from_step"] is None  # fails if s, which moves nothing here, is held to the training part's
    motion = load(tmp_path / "a.csv")
    torch.testing.assert_close(motion.t[::each], run.data.t[first:], rtol=0, atol=1e-12)
    torch.testing.assert_close(motion.q[::each], run.prediction[first:], rtol=0, atol=1e-10)
    assert motion.p is not None
    assert motion.s is not None
    # fails if what nobody asked for is written, or a velocity is not that of the model: here its momentum
    rows = (tmp_path / "a.csv").read_text().splitlines()
    assert rows[0] == "trajectory,t[s],theta[rad],theta_dot[rad/s],s,p_theta"
    assert all(float(row.split(",")[3]) == pytest.approx(float(row.split(",")[5]), abs=1e-12) for row in rows[1:])
    assert run_json(capsys, *rollout, "--force")[1]["final"]["v"] == pytest.approx([float(rows[-1].split(",")[3])])
    assert (tmp_path / "a.csv").read_text().startswith("trajectory,t[s],theta[rad],theta_dot[rad/s]\n")


# A file takes the steps of its data.
@pytest.mark.parametrize(("kind", "h"), [("tiny_run", 0.05), ("tiny_onnx", 0.2)])
def test_rollout_from_given_state(kind, h, request, tmp_path):
    # fails if -1e-1 is taken for an option, or h is ignored
    source = str(request.getfixturevalue(kind))
    state = ["--q0", "-1e-1", "--p0", "0.5", "--s0", "0.25", "--h", str(h), "--momenta"]
    assert main(["rollout", source, "--steps", "3", *state, "--out", str(tmp_path / "a.csv")]) == 0
    motion = load(tmp_path / "a.csv")
    assert motion.p is not None
    assert motion.s is not None
    assert (float(motion.q[0]), float(motion.p[0]), float(motion.s[0])) == (-0.1, 0.5, 0.25)
    torch.testing.assert_close(motion.t, h * torch.arange(4, dtype=torch.float64))
    # fails if --v0 starts with another velocity, or a file does not know its velocities
    state[2] = "--v0"
    assert main(["rollout", source, "--steps", "3", *state, "--out", str(tmp_path / "a.npz")]) == 0
    motion = load(tmp_path / "a.npz")
    assert motion.v is not None
    assert float(motion.v[0]) == pytest.approx(0.5, rel=1e-12)


def test_export(exported):
    # fails if the report lacks the box or the names (that the file loads without herglotz: test_pt2.py)
    _, report = exported
    assert report["metadata"]["names"] == ["theta"]
    assert report["metadata"]["box"] is not None


def test_verify_each_kind_of_target(tiny_run, capsys):
    # fails if a target is misread or the code is not 0 (a file: test_export_formats.py)
    for target in ("damped_oscillator", tiny_run):
        code, found = run_json(capsys, "verify", target, "--samples", 8, "--steps", 3)
        assert (code, found["passed"]) == (0, True), target
        assert main(["verify", str(target), "--samples", "8", "--steps", "3"]) == 0
        assert re.search(
            r"^[\w ./-]+: verified$", capsys.readouterr().out, re.MULTILINE
        )  # and not "not verified", of a file


def test_verify_fails_with_1(monkeypatch, capsys):  # fails if a failed check still exits with 0
    class Failed:
        passed = False

        def table(self, _verdict: str = "") -> str:
            return "NOT verified"

    import herglotz.verify

    monkeypatch.setattr(herglotz.verify, "verify", lambda *_, **__: Failed())
    assert main(["verify", "damped_oscillator"]) == 1
    assert capsys.readouterr().out == "NOT verified\n"


def test_plot(tiny_csv, tiny_run, tmp_path, capsys):  # fails if a figure is missing or its path is not printed
    assert main(["plot", str(tiny_csv), "--out", str(tmp_path)]) == 0
    assert main(["plot", str(tiny_run), "--out", str(tmp_path / "figures")]) == 0
    written = capsys.readouterr().out.split()
    assert len(written) == 7
    for path in written:
        assert Path(path).read_bytes().startswith(b"\x89PNG")


def test_animate(monkeypatch, tiny_csv, tiny_run, tmp_path, capsys):  # fails if the flag draws nothing, or takes data
    monkeypatch.setattr("herglotz.plots.animation.FRAMES", 2)
    assert main(["plot", str(tiny_run), "--animate", "--out", str(tmp_path)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["animation.gif"]
    assert main(["plot", str(tiny_csv), "--animate", "--out", str(tmp_path)]) == 2
    assert "--animate draws a run" in capsys.readouterr().err


def test_identities_are_drawn_by_verify(tiny_run, tmp_path):  # fails if they are lost, or nothing is verified then
    few = ["--samples", "4", "--steps", "2"]
    assert main(["verify", str(tiny_run), *few, "--plots", str(tmp_path)]) in (0, 1)
    assert sorted(x.name for x in tmp_path.iterdir()) == ["hj_residual.png", "momentum_vs_dS.png"]


def test_interrupt(monkeypatch, tiny_csv, tmp_path, capsys):  # fails if Ctrl-C prints a traceback or leaves a folder
    import herglotz.training

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(herglotz.training, "fit", interrupted)
    assert main(["fit", str(tiny_csv), "--out", str(tmp_path / "run")]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "herglotz: interrupted"
    assert not (tmp_path / "run").exists()


def test_interrupt_with_a_checkpoint(monkeypatch, tiny_csv, tmp_path, capsys):  # fails if nobody is told about --resume
    import herglotz.training

    def interrupted(*_, out, **__):
        (out / "checkpoint.pt").write_text("")
        raise KeyboardInterrupt

    monkeypatch.setattr(herglotz.training, "fit", interrupted)
    assert main(["fit", str(tiny_csv), "--out", str(tmp_path / "run")]) == 130
    assert "--resume" in capsys.readouterr().err
    assert main(["fit", str(tiny_csv), "--out", str(tmp_path / "run")]) == 2  # fails if the work done is overwritten
    assert "holds a fit that was interrupted; add --resume" in capsys.readouterr().err


def test_select(capsys, tiny_csv, tmp_path):  # fails if run, table or figure is missing, or --dtype does not arrive
    out = tmp_path / "selected"
    arguments = ["select", tiny_csv, "--out", out, "--levels", "linear", "--seeds", 1, "--dtype", "float32"]
    code, found = run_json(capsys, *arguments)
    assert code == 0
    assert found["chosen"] == "linear"
    assert load_run(out).config.dtype == "float32"
    assert found["levels"][0]["held_out_rms"] == pytest.approx(load_run(out).metrics["extrapolation_rms"], rel=0.05)
    assert (out / "selection.png").stat().st_size > 10_000


def test_trust(capsys, tiny_run, tmp_path):  # fails if a number is missing, or the figure is written into the run
    code, found = run_json(capsys, "trust", tiny_run, "--out", tmp_path)
    assert code == 0
    assert 0.5 <= found["inside_training"] <= 1.0
    value, std = found["parameters"]["damping.rate"][0]
    assert 0 < std < 1
    assert value == load_run(tiny_run).metrics["rate"]
    assert found["traded"] == []
    assert 1 < found["effective_parameters"] < found["all_parameters"]
    assert main(["trust", str(tiny_run), "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "none of these parameters can be traded for another of them" in out.lower()
    assert re.search(r"^  the damping rate γ: [\d.e-]+ ± [\d.e-]+ 1/s$", out, re.M)  # fails if names are the program's
    assert max(len(line) for line in out.splitlines() if not line.startswith("Figure")) <= 80
    assert "warning" not in err
    assert (tmp_path / "bands.png").stat().st_size > 10_000


def test_commands_warn_of_a_run_that_does_not_fit(capsys, tiny_run, tmp_path):  # fails if such numbers pass for results
    shutil.copytree(tiny_run, tmp_path / "run")
    result = load_run(tmp_path / "run")
    result.metrics["verdict"] = "does not fit: it misses 1"
    save_run(result, tmp_path / "run")
    assert main(["trust", str(tmp_path / "run"), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert "warning: the run does not fit its data" in said
    assert max(map(len, said.splitlines())) <= 80
    assert main(["export", str(tmp_path / "run"), "--out", str(tmp_path / "a.h")]) == 0
    assert "warning: the run does not fit its data" in capsys.readouterr().err  # fails if such a file looks like others
    from herglotz.cli.fit import report

    report(result, tmp_path / "run", [])
    assert "herglotz export" not in capsys.readouterr().out  # fails if such a model is recommended for use


@pytest.mark.parametrize("command", ["report", "trust", "predict", "export", "rollout"])
def test_data_is_no_run(command, tiny_csv, capsys):  # fails if a csv file is called a folder without a model
    more = {"predict": [str(tiny_csv)], "export": ["--out", "a.h"], "rollout": ["--steps", "5", "--out", "a.csv"]}
    assert main([command, str(tiny_csv), *more.get(command, [])]) == 2
    remedy = f"{tiny_csv}: is a file, and no run; fit data first: herglotz fit {tiny_csv} --out RUN"
    assert remedy in capsys.readouterr().err


def test_the_page_says_why_fit_chose_a_model(tiny_run, capsys):
    # fails if docs/choosing.md reads the reasons of a plan, or the models that were compared, where they are not
    page = (Path(__file__).resolve().parents[3] / "docs" / "choosing.md").read_text(encoding="utf-8")
    code = page.split("## Why did `fit` choose this?")[1].split("```python\n")[1].split("```")[0]
    exec(code.replace('"RUN"', repr(str(tiny_run))), {})
    said = capsys.readouterr().out
    assert "terms of the model: cos(q1)" in said
    assert "mass, damping, cos(q1) miss the data by" in " ".join(said.split())
    assert re.search(r"^2 0\.00\d+ \['cos\(q1\)'\] taken$", said, re.M)
