"""Damage: flipped bits, cut files and files of another run, of every kind of file. Nothing may load in silence."""

import hashlib
import json
import random
import shutil
import zipfile
from io import BytesIO
from pathlib import Path

import pytest
import torch

from herglotz.cli import main
from herglotz.cli.verify import other_metadata
from herglotz.data import simulate
from herglotz.data.files import DIGITS, ONNX_ENTRY, sealed_onnx, sealed_zip
from herglotz.errors import InputError
from herglotz.export import load_c, load_exported, load_onnx, load_pt2
from herglotz.export.metadata import check_metadata, describe, from_json
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, load_run, save_run
from herglotz.training.run_folder import FILES, MANIFEST
from tests.compilers import needs_compiler

FLIPS = 60  # of each file; `make fuzz` takes thousands


def damaged(content: bytes, make: random.Random) -> bytes:
    """One bit flipped, or, one time in eight, the file cut off."""
    at = make.randrange(len(content))
    if make.random() < 1 / 8:
        return content[:at]
    return content[:at] + bytes([content[at] ^ (1 << make.randrange(8))]) + content[at + 1 :]


def refused(load, path: Path, content: bytes) -> bool:
    path.write_bytes(content)
    try:
        load(path)
    except InputError as error:
        return str(path.parent) in str(error) and "sha256" in str(error)
    return False


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> tuple[Path, Path]:
    """Two short fits of two data sets."""
    folder = tmp_path_factory.mktemp("runs")
    for name, seed in (("one", 0), ("two", 1)):
        data = simulate(scene("damped_oscillator"), trajectories=1, steps=20, h=0.2, seed=seed)
        save_run(fit(data, FitConfig(level="linear", objective="residual", iterations=3)), folder / name)
    return folder / "one", folder / "two"


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_another_run_is_refused(runs, tmp_path, name, capsys):
    # fails if a file is judged by itself: both are whole, and they do not belong together
    folder = shutil.copytree(runs[0], tmp_path / "run")
    same = (runs[1] / name).read_bytes() == (folder / name).read_bytes()
    shutil.copy(runs[1] / name, folder / name)
    if same:  # both fits have the same settings
        assert name == "config.json"
        return
    assert main(["verify", str(folder)]) == 2
    assert f"{name}: is not the file that this run wrote" in capsys.readouterr().err


def test_an_interrupted_write_of_a_run_is_refused(runs, tmp_path):
    # fails if a folder with new and old files is a run
    folder = shutil.copytree(runs[0], tmp_path / "run")
    (folder / MANIFEST).unlink()
    with pytest.raises(InputError, match=r"has no manifest\.json: the fit was interrupted"):
        load_run(folder)


@pytest.mark.parametrize("kind", ["pt2", "onnx", "h"])
def test_a_damaged_exported_file_is_refused(kind, files, tmp_path):
    # fails if the seal is not checked before the file is opened
    load = {
        "pt2": lambda x: load_pt2(x, trust_code=True),
        "onnx": load_onnx,
        "h": lambda x: load_c(x, trust_code=True),
    }[kind]
    path, make = tmp_path / f"model.{kind}", random.Random(kind)
    if kind == "pt2":  # whose seal is that of any archive
        with zipfile.ZipFile(archive := BytesIO(), "w") as written:
            written.writestr("model.json", make.randbytes(20_000))
        content = sealed_zip(archive.getvalue())
    else:
        content = files(kind).read_bytes()
    assert all(refused(load, path, damaged(content, make)) for _ in range(FLIPS))


def test_weights_changed_on_purpose_are_refused(files, tmp_path):
    # fails if the seal of an ONNX file is not of its numbers: onnx writes the file again with all its metadata
    path = shutil.copy(files("onnx"), tmp_path / "model.onnx")
    import onnx

    proto = onnx.load(path)
    array = onnx.numpy_helper.to_array(
        next(x for x in proto.graph.initializer if x.data_type == onnx.TensorProto.DOUBLE)
    )
    position = [x.data_type for x in proto.graph.initializer].index(onnx.TensorProto.DOUBLE)
    name = proto.graph.initializer[position].name
    proto.graph.initializer[position].CopyFrom(onnx.numpy_helper.from_array(array * (1 + 1e-6), name))
    onnx.save(proto, path)
    with pytest.raises(InputError, match=r"model\.onnx: its sha256 is not the one it was written with.*export"):
        load_exported(path)


@needs_compiler
def test_line_ends_do_not_break_the_seal(files, tmp_path):
    # fails if a header that git gave \r\n is refused
    path = shutil.copy(files("h"), tmp_path / "model.h")
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_c(path, trust_code=True).dof == 1


def test_sealed_again_with_other_metadata(files, runs, tmp_path, capsys):
    # fails if `verify` takes the word of a file for its level: rows are left out, and the table says "verified"
    content = files("onnx").read_bytes()[: -DIGITS - len(ONNX_ENTRY)]
    assert sealed_onnx(content) == files("onnx").read_bytes()
    path = tmp_path / "model.onnx"
    path.write_bytes(sealed_onnx(content.replace(b'"level": "linear",', b'"level": "forced",')))
    assert main(["verify", str(path), "--samples", "2", "--steps", "2"]) == 1
    assert "could not be judged: contact, momentum" in capsys.readouterr().out
    run = load_run(runs[0])
    entries = describe(run.model, run.h, run.box, (), 30, {})
    assert other_metadata(entries, run) == []
    assert other_metadata({**entries, "level": "forced"}, run) == ["level"]


def test_metadata_of_a_wrong_type(model):
    # fails if an entry of a wrong type is found by a traceback where it is used
    good = describe(model, 0.1, None, (), 30, {})
    check_metadata(good, "a.onnx")
    wrong: list[tuple[str, object]] = [
        ("dof", 1.5), ("dof", 0), ("dtype", "float16"), ("angles", [1]), ("h", "0.1"), ("box", {"q_low": [0.0]}),
        ("units", ["rad", "m"]), ("start", []), ("h_range", [2.0, 1.0]), ("inputs", True),
        ("dof", 2**70), ("inputs", 2**70), ("columns", [["t", "time"]]), ("columns", [["t", "time", 1]]),
        ("columns", None), ("columns", ["abc"]), ("start", {"q": 1.0, "p": [1.0], "s": 0.0}), ("arrival", None),
        ("start", {"q": [1.0], "p": [1.0], "s": [0.0]}), ("start", {"q": [1.0], "p": [1.0]}), ("degrees", [1]),
        ("arrival", {"hold": 1}), ("arrival", {"hold": "second"}), ("arrival", {"delay": -1.0}),
        ("arrival", {"late": 1.0}), ("time_unit", None), ("box", {"q_low": "a"}),
    ]  # fmt: skip
    for name, value in wrong:
        with pytest.raises(InputError, match=name):
            check_metadata({**good, name: value}, "a.onnx")


@pytest.mark.parametrize("text", ["[" * 100_000, '{"format": ' + "1" * 5000 + "}", "{", "", None, "[]"])
def test_metadata_that_python_does_not_read(text):
    # fails if brackets beyond Python's recursion, or digits beyond its bound, end in a traceback
    with pytest.raises(InputError, match=r"a\.onnx: has no herglotz metadata"):
        from_json(text, "a.onnx")


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("model.pt", "h", "0.1"), ("model.pt", "states", {}), ("model.pt", "train_lengths", [3, 4]),
        ("model.pt", "box", {"q_low": ["a"]}), ("model.pt", "model", {"level": 3}), ("model.pt", "history", None),
        ("model.pt", "parameters", {}), ("config.json", "seed", "zero"), ("config.json", "unheard_of", 1),
        ("model.pt", "h", 10**400), ("config.json", "train_fraction", 10**400), ("config.json", "seed", 2**63),
        ("metrics.json", "verdict", 7), ("metrics.json", "outlier_samples", ["a"]),
    ],
)  # fmt: skip
def test_entries_of_a_wrong_type(runs, tmp_path, name, key, value, capsys):
    # fails if a run with an entry that cannot be, and a manifest that fits, ends in a traceback
    folder = shutil.copytree(runs[0], tmp_path / "run")
    if name == "model.pt":
        stored = torch.load(folder / name, weights_only=True) | {key: value}
        buffer = BytesIO()
        torch.save(stored, buffer)
        (folder / name).write_bytes(buffer.getvalue())
    else:
        (folder / name).write_text(json.dumps(json.loads((folder / name).read_text()) | {key: value}))
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(manifest))
    assert main(["verify", str(folder)]) == 2
    assert "fit again" in capsys.readouterr().err
