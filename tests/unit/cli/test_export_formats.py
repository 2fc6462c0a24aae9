"""`export`, `verify` and `rollout` on a file that is not `.pt2`."""

import json
import re
import shutil
import zipfile
from argparse import Namespace
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.cli import main
from herglotz.cli.verify import _agreement, _table
from herglotz.data import load
from herglotz.data.files import DIGITS, ONNX_ENTRY, sealed_onnx
from herglotz.export import compare, export_run, load_exported
from herglotz.export.load import _is_of, read_header
from herglotz.export.metadata import KEY
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.numbers import values_of, with_values
from herglotz.training import load_run, save_run
from tests.compilers import needs_compiler

pytest.importorskip("onnxruntime")


def test_verify_and_compare_with_the_run(tiny_onnx, tiny_run, monkeypatch, capsys):
    # fails if the file is not differentiated by differences, or --against is not part of the verdict
    # (60 steps; test_verify_finds_the_run takes as many as the command does, of fewer motions)
    monkeypatch.setattr("herglotz.export.compare", partial(compare, steps=60))
    capsys.readouterr()
    arguments = ["verify", str(tiny_onnx), "--samples", "8", "--steps", "3", "--against", str(tiny_run), "--json"]
    assert main(arguments) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["passed"] is True
    assert found["details"]["kind"] == "onnx"
    assert set(found["against"]["per_batch"]) == {"1", "7", "4096"}
    assert found["against"]["same_weights"] is True
    assert main(["verify", "damped_oscillator", "--against", str(tiny_run)]) == 2
    assert "is no file" in capsys.readouterr().err
    # fails if the run of another machine ends in an internal error
    other = load_run(tiny_run)
    ones: Any = {name: (1.0, 1.0) for name in ("scale", "speed", "stiffness", "tilt")}
    model = ContactLagrangian(ModelConfig(angles=(False, False), **ones))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("herglotz.training.load_run", lambda *_: replace(other, model=model))
        assert main(arguments) == 2
    assert "the run has 2 coordinate(s) and 0 input(s)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("difference", "level", "agrees"),
    [
        ({}, "linear", True),
        # fails if a file that says nothing of its weights is refused
        ({"same_weights": None}, "linear", True),
        # fails if motions alone are compared: a weight that is off by less than their bound is another model
        ({"same_weights": False}, "linear", False),
        # fails if three of q, p, s and c are enough
        ({"p": 1.0}, "linear", False),
        # fails if steps may fail where those of the run do not: failed steps have no numbers to compare
        ({"status": 1}, "linear", False),
        # fails if the metadata of the file are not compared
        ({}, "forced", False),
    ],
)
def test_what_a_file_and_its_run_must_agree_on(difference, level, agrees, tiny_run, monkeypatch):
    config = load_run(tiny_run).model.config
    row = {**dict.fromkeys("qpsc", 0.0), "failed": 0, "status": difference.get("status", 0)}
    result = {**row, "same_weights": True, "per_batch": {1: row}, **difference}
    monkeypatch.setattr("herglotz.export.compare", lambda *_, **__: result)
    said = {"dtype": "float64", "level": level, "dof": 1, "model": config.to_dict()}
    file = SimpleNamespace(dtype=torch.float64, metadata=said)
    agreement = _agreement(file, Namespace(against=tiny_run, h=None, seed=0))
    assert agreement["passed"] is agrees
    assert ("DOES NOT AGREE" in _table(agreement, tiny_run)) is not agrees


def test_the_file_holds_a_model_card(tiny_onnx, tiny_run):
    # fails if the file does not say what it is a model of, how well it fits, and where it was fitted
    card = load_exported(tiny_onnx).metadata["card"]
    run = load_run(tiny_run)
    assert card.startswith("Model of tiny.csv (sha256 ")
    assert run.summary() in card
    # fails if the step of the recording, which the fit crosses in two, is beyond those of the file
    assert run.data.typical_step == pytest.approx(2 * run.h)
    assert f"For steps of {run.h:g} to {run.data.typical_step:g} s, and positions theta " in card


def test_rollout_of_the_file_is_that_of_the_run(tiny_onnx, tiny_run, tmp_path):
    # fails if export loses start, h or names
    for name, source in (("a.npz", tiny_run), ("b.npz", tiny_onnx)):
        assert main(["rollout", str(source), "--steps", "5", "--out", str(tmp_path / name)]) == 0
    one, two = load(tmp_path / "a.npz"), load(tmp_path / "b.npz")
    torch.testing.assert_close(one.q, two.q, rtol=0, atol=1e-12)
    assert one.t.tolist() == two.t.tolist()
    assert (one.names, one.units, one.angles, one.time_unit) == (two.names, two.units, two.angles, two.time_unit)


@needs_compiler
def test_a_file_says_where_it_was_not_fitted(tiny_run, tmp_path, capsys):
    # fails if a run or a file steps at any h in silence, or a motion leaves the data in silence
    out, motion = str(tmp_path / "a.h"), ["--steps", "3", "--out", str(tmp_path / "a.csv"), "--force"]
    assert main(["export", str(tiny_run), "--format", "c", "--out", out]) == 0
    own, text = f"{load_run(tiny_run).h:g}", Path(out).read_text()
    assert "typical step in s: recorded" in text
    assert "steps of the fit and of the recording in s" in text
    for source, steps in ((out, f"{own} to 0.2"), (str(tiny_run), own)):
        assert main(["rollout", source, *motion, "--h", "0.05"]) == 0
        note = f"note: steps of 0.05 s are outside of those that the model was fitted to, {steps} s"
        assert note in " ".join(capsys.readouterr().err.split())
    assert main(["export", str(tiny_run), "--format", "c", "--out", out, "--h-range", "0.05", own, "--force"]) == 0
    assert main(["rollout", out, *motion, "--h", "0.05", "--q0", "0.1", "--p0", "0"]) == 0
    assert "note" not in capsys.readouterr().err
    for source in (out, str(tiny_run)):
        assert main(["rollout", source, *motion, "--q0", "0.1", "--p0", "30"]) == 0
        assert "from step 0 on, the motion leaves the range of states" in " ".join(capsys.readouterr().err.split())
        box = load_run(tiny_run).box
        hair = box["q_high"][0] + 0.005 * (box["q_high"][0] - box["q_low"][0])  # half of what is told
        assert main(["rollout", source, *motion, "--q0", repr(hair), "--p0", "0"]) == 0
        assert "leaves the range" not in capsys.readouterr().err


def test_the_prefix_of_a_header(tiny_run, tmp_path, capsys):
    # fails if --name is not the prefix, or is taken in silence where it means nothing
    out = tmp_path / "a.h"
    assert main(["export", str(tiny_run), "--out", str(out), "--name", "arm"]) == 0
    assert "arm_step(" in out.read_text()
    assert read_header(out)[1]["name"] == "arm"
    assert main(["export", str(tiny_run), "--out", str(tmp_path / "a.onnx"), "--name", "arm"]) == 2
    assert "setting name is of c, casadi, acados, fmu, fmu2 only, not of onnx" in capsys.readouterr().err
    assert main(["export", str(tiny_run), "--out", str(out), "--force", "--name", "2 arms"]) == 2
    assert "must be a C identifier" in capsys.readouterr().err


def test_the_numbers_of_a_header(tiny_run, tmp_path, capsys):
    # fails if --dtype is not that of the header, is taken in silence where it means nothing, or a tuned run keeps the
    # tolerance of its double in float
    out = tmp_path / "a.h"
    assert main(["export", str(tiny_run), "--out", str(out), "--dtype", "float32"]) == 0
    assert "typedef float a_real;" in out.read_text()
    plain = read_header(out)[1]
    assert plain["dtype"] == "float32"
    assert main(["export", str(tiny_run), "--out", str(tmp_path / "a.onnx"), "--dtype", "float32"]) == 2
    assert "setting dtype is of c, casadi, acados, fmu, fmu2 only" in capsys.readouterr().err
    tuned = load_run(tiny_run)
    tuned.metrics["tuned"] = {"chosen": {"dtype": "float64", "tol": 1e-12}}
    export_run(tuned, out, dtype="float32")
    assert read_header(out)[1]["newton_tolerance"] == plain["newton_tolerance"]
    export_run(tuned, out)
    assert read_header(out)[1]["newton_tolerance"] == 1e-12


def test_verify_finds_the_run(tiny_onnx, tiny_run, tmp_path, monkeypatch, capsys):
    # fails if a file is not compared with its model unless it is named, a run of other weights is taken for it, or the
    # user is not told
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("herglotz.export.compare", partial(compare, batches=(1, 7)))
    few = ["verify", str(tiny_onnx), "--samples", "4", "--steps", "2"]
    other = load_run(tiny_run)
    other.model.load_state_dict({key: 2 * value for key, value in other.model.state_dict().items()})
    save_run(other, tmp_path / "runs" / "one")
    assert main(few) == 0
    out = capsys.readouterr().out
    assert "not compared with its model" in out
    assert ": its identities hold; its numbers are not verified" in out
    assert main([*few, "--against", "runs/one"]) == 1
    assert ": NOT verified" in capsys.readouterr().out  # fails if the rows alone make the headline
    shutil.copytree(tiny_run, tmp_path / "runs" / "two")
    assert main(few) == 0
    out = capsys.readouterr().out
    assert "beside runs/two, 1000 steps" in out
    rows = [line for line in out.splitlines() if str(tiny_onnx) not in line]
    assert max(map(len, rows)) <= 80  # fails if a row of a file's table is too wide for a terminal as it opens


@pytest.mark.parametrize(("form", "name"), [("onnx", "a.pt2"), ("pt2", "a.onnx"), ("aoti", "a.h"), ("c", "a.pt2")])
def test_a_name_of_another_format_is_refused(form, name, tiny_run, tmp_path, capsys):
    # fails if the extension, by which files are read, may disagree with the format
    assert main(["export", str(tiny_run), "--format", form, "--out", str(tmp_path / name)]) == 2
    assert "the name must end in" in capsys.readouterr().err


def test_a_file_made_by_hand_is_one_message(tiny_onnx, tmp_path, capsys):
    # fails if an entry that cannot be is a traceback where it is used, and no word of file, key and remedy
    onnx = pytest.importorskip("onnx")
    made = onnx.load_model_from_string(tiny_onnx.read_bytes()[: -DIGITS - len(ONNX_ENTRY)])
    (said,) = (entry for entry in made.metadata_props if entry.key == KEY)
    said.value = json.dumps(json.loads(said.value) | {"columns": [["t", "time"]]})
    path = tmp_path / "made.onnx"
    path.write_bytes(sealed_onnx(made.SerializeToString()))
    capsys.readouterr()
    assert main(["rollout", str(path), "--steps", "2", "--out", str(tmp_path / "a.csv")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith(f"herglotz: error: {path}: metadata: columns must be list[tuple[str, str, str]], got ")
    assert said.endswith("export the model again")


@needs_compiler
@pytest.mark.parametrize("form", ["casadi", "acados", "fmu", "fmu2"])
def test_files_around_the_header(form, tiny_run, tmp_path, capsys):
    # fails if a file lacks the run's names, start or prefix, or what compiles the header in it does not find it
    out = tmp_path / ("a.fmu" if form.startswith("fmu") else "a.c")
    assert main(["export", str(tiny_run), "--format", form, "--name", "arm", "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["metadata"]["name"].startswith("arm")
    assert said["metadata"]["names"] == ["theta"]
    assert main(["rollout", str(out), "--steps", "5", "--out", str(tmp_path / "b.npz")]) == 0
    assert main(["rollout", str(tiny_run), "--steps", "5", "--out", str(tmp_path / "a.npz")]) == 0
    torch.testing.assert_close(load(tmp_path / "b.npz").q, load(tmp_path / "a.npz").q, rtol=0, atol=1e-12)
    if form == "fmu":
        description = zipfile.ZipFile(out).read("modelDescription.xml").decode()
        (start,) = re.findall(r'name="q.theta"[^>]*start="([^"]*)"', description)
        assert float(start) == said["metadata"]["start"]["q"][0]
        few = ["--samples", "4", "--steps", "2", "--against", str(tiny_run)]
        monkey = "herglotz.data.files.private_folder"
        with pytest.MonkeyPatch.context() as patch:  # a file that another user wrote, beside its run
            patch.setattr(monkey, lambda name: tmp_path / name)
            patch.setattr("herglotz.data.files._written", set())
            assert main(["rollout", str(out), "--steps", "5", "--out", str(tmp_path / "c.npz")]) == 2
            assert "opening it runs code" in capsys.readouterr().err
            patch.setattr("herglotz.export.compare", partial(compare, steps=20))
            assert main(["verify", str(out), *few]) == 0  # the header is generated again, and is the same


def test_parameters_and_extras_of_a_header(tiny_run, tmp_path, capsys):
    # fails if the command loses a bound or an extra, the filter has no noise of the fit, or another format takes them
    path = tmp_path / "arm.h"
    asked = ["--parameters", "damping.rate=:9", "--extras", "adjoint", "filter"]
    assert main(["export", str(tiny_run), "--out", str(path), *asked]) == 0
    text, found = read_header(path)
    assert [row[1:] for row in found["parameters"].values()] == [[None, 9.0]]
    assert found["extras"] == ["adjoint", "filter"]
    assert all(x > 0 for x in found["noise"]["position"] + found["noise"]["momentum"])
    for name in ("arm_rollout_vjp", "arm_filter_update", "arm_noise_of_fit", "arm_set_parameter"):
        assert name in text
    capsys.readouterr()
    assert main(["export", str(tiny_run), "--out", str(tmp_path / "arm.onnx"), *asked]) == 2
    assert "is of c only, not of onnx" in capsys.readouterr().err


def test_a_number_between_two_runs(tiny_run, tmp_path, capsys):
    # fails if the command takes one run for the other or loses the bounds, the header is not generated again from the
    # first run alone, or its numbers are not of the type that was asked for
    run = load_run(tiny_run)
    (rate,) = values_of(run.model, ["damping.rate"])
    save_run(replace(run, model=with_values(run.model, {"damping.rate": rate + 0.2})), tmp_path / "loaded")
    path = tmp_path / "arm.h"
    asked = ["--between", f"load={tmp_path / 'loaded'}", "--parameters", "load=0:2", "--dtype", "float32"]
    assert main(["export", str(tiny_run), "--out", str(path), *asked]) == 0
    text, found = read_header(path)
    assert found["parameters"] == {"load": [0.0, 0.0, 2.0]}
    assert found["between"] == {"load": {"damping.rate": pytest.approx(rate + 0.2, rel=1e-12)}}
    assert "typedef float arm_real" in text
    assert _is_of(text, path, run.model)
    for other, said in (("load", "takes NAME=RUN"), (f"load={tiny_run}", "nothing differs for load")):
        capsys.readouterr()
        again = ["--between", other, "--parameters", "load", "--force"]
        assert main(["export", str(tiny_run), "--out", str(path), *again]) == 2
        assert said in capsys.readouterr().err
