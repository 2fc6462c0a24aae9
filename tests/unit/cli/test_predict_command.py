"""`herglotz predict` reads a run and a recording, prints, writes and draws."""

import json
from dataclasses import replace

import numpy as np
import pytest

from herglotz.cli import main
from herglotz.training import load_run, save_run


@pytest.fixture(scope="module")
def other_csv(tmp_path_factory):
    path = tmp_path_factory.mktemp("predict") / "other.csv"
    arguments = ["--trajectories", "2", "--steps", "60", "--h", "0.2", "--noise", "0.005", "--seed", "8"]
    assert main(["simulate", "damped_pendulum", "--out", str(path), *arguments]) == 0
    return path


def test_json_has_the_promised_numbers(tiny_run, other_csv, capsys):
    # fails if a number is missing, or text is printed beside the JSON
    assert main(["predict", str(tiny_run), str(other_csv), "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert {"rms", "rms_per_coordinate", "rms_from_best_start", "failed_steps", "warmup"} <= set(numbers)
    assert numbers["warmup"] == 20
    assert numbers["failed_steps"] == 0.0
    assert set(numbers["rms_per_coordinate"]) == {"theta"}
    assert numbers["predicted_samples"] == 2 * 41


def test_files_and_words(tiny_run, other_csv, tmp_path, capsys):
    # fails if the motion or the picture is not written, or the table lacks a unit
    out = tmp_path / "motion.csv"
    assert main(["predict", str(tiny_run), str(other_csv), "--out", str(out), "--warmup", "10"]) == 0
    text = capsys.readouterr().out
    assert "RMS theta" in text
    assert "from best start" in text
    assert "rad" in text
    assert out.read_text().startswith("trajectory,t[s],theta[rad],theta_dot[rad/s]\n")
    assert (tmp_path / "motion.png").read_bytes()[:4] == b"\x89PNG"


def test_a_longer_warm_up_is_named(tiny_run, other_csv, capsys, monkeypatch):
    # fails if the warm-up that would do stays with the program
    monkeypatch.setattr("herglotz.training.predict.longer_warmup", lambda *_: 37)
    assert main(["predict", str(tiny_run), str(other_csv)]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "the start that 20 samples tell misses, and not the model; try --warmup 37" in said


def test_degrees_of_a_run_are_those_of_other_recordings(tiny_run, other_csv, tmp_path, capsys):
    # fails if a header that says rad in another recording, too, replaces what the user said of the first: 474 rad
    run = load_run(tiny_run)
    save_run(replace(run, reading={**run.reading, "degrees": ["theta"]}), tmp_path / "run")
    head, *rows = other_csv.read_text().splitlines()
    at = head.split(",").index("theta[rad]")
    cells = [row.split(",") for row in rows]
    turned = [",".join([*row[:at], repr(float(np.degrees(float(row[at])))), *row[at + 1 :]]) for row in cells]
    (tmp_path / "other.csv").write_text("\n".join([head, *turned]) + "\n")
    errors = []
    for of, file, flags in ((tiny_run, other_csv, ()), (tmp_path / "run", tmp_path / "other.csv", ()),
                            (tmp_path / "run", other_csv, ("--degrees", ""))):  # fmt: skip
        assert main(["predict", str(of), str(file), "--json", *flags]) == 0
        found = capsys.readouterr()
        errors.append(json.loads(found.out)["rms"])
        assert ("theta read in degrees, as in the run; for positions in rad --degrees ''" in found.err) is (
            file != other_csv
        )
    assert errors == pytest.approx([errors[0]] * 3, rel=1e-6)


@pytest.fixture(scope="module")
def two_rates(tmp_path_factory):
    """Two recordings of a damped spring under a force; the force is written at other times than the position."""
    folder, files = tmp_path_factory.mktemp("rates"), []
    for seed in range(2):
        t = np.arange(24_000) * 5e-4
        draw = np.random.default_rng(seed)
        force = np.interp(t, np.arange(60) * 0.2, draw.normal(size=60))
        x, v, rows = 0.1, 0.0, []
        for k, (now, f) in enumerate(zip(t, force, strict=True)):
            if k % 10 == 0:
                rows.append(f"{now:.4f},{f:.6f},")
            if k % 60 == 3:
                rows.append(f"{now:.4f},,{x + 1e-3 * draw.normal():.6f}")
            v += 5e-4 * (f - 9 * x - 0.5 * v)
            x += 5e-4 * v
        files.append(folder / f"{seed}.csv")
        files[-1].write_text("\n".join(["t[s],force[N],x[m]", *rows]) + "\n")
    return files


def test_blanks_of_a_slower_column_are_filled_as_in_the_fit(two_rates, tmp_path, capsys):
    # fails if predict holds inputs where the fit drew straight lines, or offers a flag that predict does not have
    train, other = two_rates
    flags = ["--hold", "first", "--no-plots", "--quiet"]
    assert main(["fit", str(train), *flags, "--out", str(tmp_path / "run")]) == 0
    capsys.readouterr()
    assert main(["predict", str(tmp_path / "run"), str(other), "--json"]) == 0
    err = " ".join(capsys.readouterr().err.split())
    assert "force has no value in some rows; straight lines go there" in err
    assert "--hold" not in err
    other.write_text(f"# hold: zero\n{other.read_text()}")
    assert main(["predict", str(tmp_path / "run"), str(other), "--json"]) == 0
    assert "force has no value in some rows: the last one is held" in " ".join(capsys.readouterr().err.split())


def test_columns_of_other_names_are_said(tiny_run, other_csv, tmp_path, capsys):
    # fails if another coordinate is taken for the run's, or one is left aside, without a word
    (tmp_path / "a.csv").write_text(text := other_csv.read_text().replace("theta", "phi"))
    rows = text.splitlines()
    (tmp_path / "b.csv").write_text(
        f"{rows[0].replace('phi', 'theta')},y[m]\n" + "".join(f"{row},{k}\n" for k, row in enumerate(rows[1:]))
    )
    said = []
    (tmp_path / "c.csv").write_text(
        f"{rows[0].replace('phi', 'theta')},push[N]\n" + "".join(f"{row},1\n" for row in rows[1:])
    )
    for file in (other_csv, *(tmp_path / f"{name}.csv" for name in "abc")):
        assert main(["predict", str(tiny_run), str(file)]) == 0
        said.append(" ".join(capsys.readouterr().err.split()))
    assert not any(words in said[0] for words in ("taken for theta", "left aside"))
    assert "note: phi is taken for theta, the run's only coordinate" in said[1]
    assert "note: the run has no coordinate y: left aside" in said[2]
    assert "note: the run has no input: push left aside" in said[3]


def test_windows(tiny_run, other_csv, capsys):
    # fails if --windows does not reach the function
    assert main(["predict", str(tiny_run), str(other_csv), "--windows", "4", "--horizon", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["trajectories"] == 4


def test_mistakes_are_one_line(tiny_run, other_csv, tmp_path, capsys):
    # fails if a mistake is found after the work, or is a traceback
    cases = {
        ("--warmup", "200"): "other.csv: trajectory 0 has 61 samples",
        ("--out", str(tmp_path / "x.png")): "must end in .csv or .npz",
        ("--windows", "3"): "go together",
        ("--horizon", "-1"): "must be > 0",
    }
    for flags, message in cases.items():
        assert main(["predict", str(tiny_run), str(other_csv), *flags]) == 2
        err = capsys.readouterr().err
        assert message in err
        assert len([line for line in err.splitlines() if line.startswith("herglotz:")]) == 1
    assert main(["predict", str(tmp_path), str(other_csv)]) == 2
    assert "no model.pt in this folder" in capsys.readouterr().err


def test_a_drift_that_is_taken_off_is_said(tiny_run, other_csv, tmp_path, capsys):
    # fails if positions are changed without a word, or the drift of the fit is forgotten
    run = load_run(tiny_run)
    plan = {**run.metrics["plan"], "drifts": (0.01,)}
    save_run(replace(run, metrics={**run.metrics, "plan": plan}), tmp_path / "drifting")
    found = {}
    for name, folder in (("still", tiny_run), ("drifts", tmp_path / "drifting")):
        assert main(["predict", str(folder), str(other_csv), "--json"]) == 0
        told = capsys.readouterr()
        found[name] = json.loads(told.out)["rms"]
        said = "its sensors are taken to drift as those of the fit did: theta 0.01 rad/s"
        assert (said in " ".join(told.err.split())) is (name == "drifts"), told.err
    assert found["drifts"] != found["still"]
