"""`export`, `verify` and `rollout` on a file that is not `.pt2`."""

import json

import pytest
import torch

from herglotz.cli import main
from herglotz.data import load

pytest.importorskip("onnxruntime")


@pytest.fixture(scope="module")
def tiny_onnx(tiny_run, tmp_path_factory):
    path = tmp_path_factory.mktemp("cli_onnx") / "tiny.onnx"
    assert main(["export", str(tiny_run), "--format", "onnx", "--out", str(path)]) == 0
    return path


def test_verify_and_compare_with_the_run(tiny_onnx, tiny_run, capsys):
    # fails if the file is not differentiated by differences, or --against is not part of the verdict
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


def test_rollout_of_the_file_is_that_of_the_run(tiny_onnx, tiny_run, tmp_path):
    # fails if export loses start, h or names
    for name, source in (("a.npz", tiny_run), ("b.npz", tiny_onnx)):
        assert main(["rollout", str(source), "--steps", "5", "--out", str(tmp_path / name)]) == 0
    one, two = load(tmp_path / "a.npz"), load(tmp_path / "b.npz")
    torch.testing.assert_close(one.q, two.q, rtol=0, atol=1e-12)
    assert (one.names, one.units, one.angles, one.time_unit) == (two.names, two.units, two.angles, two.time_unit)


@pytest.mark.parametrize(("form", "name"), [("onnx", "a.pt2"), ("pt2", "a.onnx"), ("aoti", "a.h"), ("c", "a.pt2")])
def test_a_name_of_another_format_is_refused(form, name, tiny_run, tmp_path, capsys):
    # fails if the extension, by which files are read, may disagree with the format
    assert main(["export", str(tiny_run), "--format", form, "--out", str(tmp_path / name)]) == 2
    assert "the name must end in" in capsys.readouterr().err
