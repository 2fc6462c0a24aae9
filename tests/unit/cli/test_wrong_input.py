"""Every mistake is one line on stderr with exit code 2, and leaves nothing behind."""

import hashlib
import json
import shutil
from functools import reduce
from pathlib import Path

import pytest

from herglotz.cli import main
from herglotz.training.run_folder import FORMAT

GOOD = "t[s],theta[rad]\n" + "".join(f"{k / 10},{1 - k / 50}\n" for k in range(30))


def mistake(capsys, folder: Path, *arguments: object) -> str:
    """Run, demand exit code 2, one line and no new file; return the line."""
    before = sorted(folder.rglob("*"))
    capsys.readouterr()
    code = main([*map(str, arguments)])
    out, err = capsys.readouterr()
    assert code == 2
    assert out == ""
    assert err.startswith("herglotz: error: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert sorted(folder.rglob("*")) == before
    return err


@pytest.mark.parametrize("command", ["fit", "plot"])
def test_bad_data(tmp_path, capsys, command):  # fails if a bad file reaches the fit, or a folder is left behind
    (tmp_path / "bad.csv").write_text(GOOD.replace("0.5,0.9", "0.5,high"))
    said = mistake(capsys, tmp_path, command, tmp_path / "bad.csv", "--out", tmp_path / "a" / "out")
    assert "'high' is not a number" in said


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--level", "quadratic", "invalid choice: 'quadratic'"),
        ("--dtype", "float16", "invalid choice: 'float16'"),
        ("--objective", "x", "invalid choice"),
        ("--optimiser", "adam", "adam fits the objectives"),
        ("--train-fraction", "1.5", "train fraction"),
        ("--train-fraction", "nan", "finite"),
        ("--seed", "-1", "whole number"),
        ("--seed", str(2**63), "below 2^63"),
        ("--config", "nowhere", "no such file"),
        ("--config", "/dev/zero", "/dev/zero: is a pipe or a device"),
        ("--frequency", "-1", "must be > 0"),
        ("--device", "tpu9", "unknown device"),
        ("--angles", "phi", "phi"),
        ("--nonsense", "1", "unrecognized arguments: --nonsense 1; see 'herglotz fit --help'"),
    ],
)
def test_bad_options_of_fit(tmp_path, capsys, option, value, message):  # fails if an option is checked after the work
    (tmp_path / "good.csv").write_text(GOOD)
    assert message in mistake(capsys, tmp_path, "fit", tmp_path / "good.csv", "--out", tmp_path / "run", option, value)


def test_unwritable_output_is_found_before_training(tmp_path, capsys, monkeypatch):
    # fails if a fit of an hour ends in "cannot be written"
    import herglotz.training

    monkeypatch.setattr(herglotz.training, "fit", lambda *_, **__: pytest.fail("trained"))
    (tmp_path / "good.csv").write_text(GOOD)
    (tmp_path / "file").write_text("in the way")
    for out in (tmp_path / "file", tmp_path / "file" / "run", "/proc/herglotz/run"):
        assert "--out" in mistake(capsys, tmp_path, "fit", tmp_path / "good.csv", "--out", out)


def test_an_old_run_is_not_overwritten(tmp_path, capsys):  # fails if a finished fit is lost without a word
    (tmp_path / "good.csv").write_text(GOOD)
    (tmp_path / "model.pt").write_text("old")
    assert "already holds a run" in mistake(capsys, tmp_path, "fit", tmp_path / "good.csv", "--out", tmp_path)


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (["simulate", "damped_pendulum"], "a.csv"),
        (["export", "RUN"], "a.h"),
        (["rollout", "RUN", "--steps", "5"], "a.csv"),
        (["predict", "RUN", "DATA"], "a.csv"),
    ],
)
def test_a_file_is_not_overwritten(tmp_path, capsys, tiny_run, tiny_csv, command, name):
    # fails if what a user has made goes without a word
    (tmp_path / name).write_text("mine")
    words = [{"RUN": tiny_run, "DATA": tiny_csv}.get(word, word) for word in command]
    said = mistake(capsys, tmp_path, *words, "--out", tmp_path / name)
    assert "exists already; choose another name, or overwrite it with --force" in said
    assert (tmp_path / name).read_text() == "mine"


@pytest.mark.parametrize(
    "out", ["no_folder/a.csv", "a.txt", ".", "/proc/a.csv"], ids=["no folder", "extension", "a folder", "unwritable"]
)
@pytest.mark.parametrize("command", [["simulate", "damped_pendulum"], ["rollout", "nothing", "--steps", "9"]])
def test_bad_output_file(tmp_path, capsys, command, out):  # fails if an output is checked after the work
    assert "--out" in mistake(capsys, tmp_path, *command, "--out", tmp_path / out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulate", "triple_pendulum", "--out", "OUT.csv"], "unknown scene 'triple_pendulum'"),
        (["simulate", "parachute", "--out", "OUT.csv", "--param", "wind=3"], "no parameter 'wind'"),
        (["simulate", "parachute", "--out", "OUT.csv", "--param", "m"], "not NAME=VALUE"),
        (["simulate", "parachute", "--out", "OUT.csv", "--h", "0"], "must be > 0"),
        (["simulate", "parachute", "--out", "OUT.csv", "--noise", "-1"], "noise"),
        (["simulate", "parachute", "--out", "OUT.csv", "--trajectories", "0"], "trajectories"),
        (["verify", "triple_pendulum"], "triple_pendulum"),
        (["verify", "missing.pt2"], "no such file"),
        (["verify", "damped_oscillator", "--samples", "0"], "--samples must be >= 1, got 0"),
        (["fit", "missing.csv"], "no such file"),
        (["select", "missing.csv"], "no such file"),
        (["plot", "missing.csv", "--out", "OUT"], "no such file"),
        (["plot", "OUT", "--out", "OUT2"], "OUT"),
        (["rollout", "missing.pt2", "--steps", "5", "--out", "OUT.csv"], "no such file"),
        (["export", "missing", "--out", "OUT.pt2"], "no such folder"),
        (["export", "missing", "--out", "OUT.txt"], "must end in .pt2"),
        (["fit"], "required"),
        (["train"], "invalid choice"),
        (["ftt", "a.csv"], "'plot'); did you mean fit? See 'herglotz --help'"),
        (
            ["fit", "OUT.csv", "--out", "OUT", "--level", "afine"],
            "'forced'); did you mean affine? See 'herglotz fit --help'",
        ),
        (["fit", "OUT.csv", "--out", "OUT", "--levle", "full"], "--levle full; did you mean --level?"),
        (["fit", "OUT.cvs", "--out", "OUT"], "the folder; did you mean OUT.csv?"),
        (["select", "OUT.csv", "--out", "OUT", "--levels", "linear,afine"], "auto; did you mean affine?"),
        (["simulate", "dufing", "--out", "OUT.csv"], "van_der_pol; did you mean duffing?"),
        (["verify", "kepller"], ".fmu file; did you mean kepler?"),
    ],
)
def test_wrong_names(tmp_path, capsys, monkeypatch, arguments, message):  # fails if one of them ends in a traceback
    monkeypatch.chdir(tmp_path)
    (tmp_path / "OUT.csv").write_text(GOOD)
    said = mistake(capsys, tmp_path, *arguments, *(["--force"] if arguments[:1] in (["simulate"], ["rollout"]) else []))
    assert message in said


@pytest.mark.parametrize("asked", [[], ["help"], ["help", "fit"]])
def test_help_is_asked_for_in_words(capsys, asked):  # fails if a newcomer who types the name alone is told off
    assert main(asked) == 0
    assert capsys.readouterr().out.startswith("usage: herglotz fit" if asked[1:] else "usage: herglotz [-h]")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--steps", "1"], "at least 2"),
        (["--steps", "5", "--q0", "1"], "go together"),
        (["--steps", "5", "--q0", "1", "2", "--p0", "0"], "--q0 needs 1 number"),
        (["--steps", "5", "--q0", "inf", "--p0", "0"], "finite"),
        (["--steps", "5", "--v0", "1"], "--q0 and --v0 (or --p0, the momentum) go together"),
        (["--steps", "5", "--q0", "1", "--v0", "1", "--p0", "0"], "--v0 and --p0 both say how fast the start is"),
        (["--steps", "5", "--q0", "1", "--v0", "1", "2"], "--v0 needs 1 number"),
        (["--steps", "5", "--trajectory", "7"], "there is no trajectory 7"),
        (["--steps", "-5"], "whole number"),
        (["--steps", "5", "--u", "1"], "--u needs no number(s)"),
    ],
)
def test_bad_rollouts(tmp_path, capsys, tiny_run, options, message):  # fails if a bad start is stepped
    assert message in mistake(capsys, tmp_path, "rollout", tiny_run, *options, "--out", tmp_path / "a.csv")


def test_a_damaged_run_and_file(tmp_path, capsys):  # fails if torch's own error gets through
    (tmp_path / "model.pt").write_bytes(b"junk")
    (tmp_path / "a.pt2").write_bytes(b"junk")
    assert "has no manifest.json" in mistake(capsys, tmp_path, "verify", tmp_path)
    assert "does not end with its sha256" in mistake(capsys, tmp_path, "verify", tmp_path / "a.pt2")


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("sigma",), None, "sigma"),
        (("sigma",), 0.0, "sigma 0, and it must be a size > 0"),
        (("sigma",), 1e200, "sigma 1e+200, and it must be a size > 0"),
        (("outlier_samples",), [61], "outlier_samples or the plan's zeros are not those of the run's data"),
        (("plan",), {}, "plan: lacks continues_probe"),
        (("plan", "start"), {"rate": "x"}, "plan: start must be dict"),
        (("plan", "zeros"), [0.0, 0.1], "outlier_samples or the plan's zeros are not those of the run's data"),
        (("equation",), {"terms": []}, "equation: lacks lefts, network, units"),
        (("equation", "terms", 0), {"left": "x"}, "equation: terms must be tuple"),
        (("equation", "units"), 3, "equation: units must be str, got 3"),
    ],
)
def test_wrong_entries_of_a_run(tmp_path, capsys, tiny_run, where, value, message):
    # fails if a wrong entry of metrics.json is met later than at the door, by Python's own error (exit code 70)
    run = shutil.copytree(tiny_run, tmp_path / "run")
    metrics, manifest = (json.loads((run / name).read_text()) for name in ("metrics.json", "manifest.json"))
    reduce(lambda x, key: x[key], where[:-1], metrics)[where[-1]] = value
    (run / "metrics.json").write_text(json.dumps(metrics))
    manifest["files"]["metrics.json"] = hashlib.sha256((run / "metrics.json").read_bytes()).hexdigest()
    (run / "manifest.json").write_text(json.dumps(manifest))
    assert message in mistake(capsys, tmp_path, "trust", run)


def test_a_run_of_a_newer_format_is_refused(tmp_path, capsys, tiny_run):
    # fails if a folder that this version does not understand is read, or called damaged
    run = shutil.copytree(tiny_run, tmp_path / "run")
    manifest = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(manifest | {"format": FORMAT + 1, "herglotz": "9.1", "files": {}}))
    said = mistake(capsys, tmp_path, "trust", run)
    assert f"is of format {FORMAT + 1}, written by herglotz 9.1; this version reads formats up to {FORMAT}" in said
