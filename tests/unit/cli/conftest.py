"""Tiny data and one fitted run for all tests of the command line."""

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from herglotz.cli import main


@pytest.fixture(scope="session")
def tiny_csv(tmp_path_factory) -> Path:
    """One pendulum motion of 61 samples, two periods: of one period a fit says that too little was recorded."""
    path = tmp_path_factory.mktemp("cli_data") / "tiny.csv"
    size = ["--trajectories", "1", "--steps", "60", "--h", "0.2", "--seed", "4", "--noise", "0.005"]
    assert main(["simulate", "damped_pendulum", "--out", str(path), *size]) == 0
    return path


@pytest.fixture(scope="session")
def tiny_run(tiny_csv, tmp_path_factory) -> Path:
    """A run fitted on it, without figures; treat it as read-only."""
    path = tmp_path_factory.mktemp("cli_run") / "run"
    assert main(["fit", str(tiny_csv), "--out", str(path), "--no-plots"]) == 0
    return path


@pytest.fixture(scope="session")
def exported(tiny_run, tmp_path_factory, request) -> tuple[Path, dict]:
    """The run as an ONNX file, the quickest to write and to read, and what `export --json` said; read-only."""
    pytest.importorskip("onnxruntime")
    request.getfixturevalue("registered_once")
    path, said = tmp_path_factory.mktemp("cli_onnx") / "tiny.onnx", StringIO()
    with redirect_stdout(said):
        assert main(["export", str(tiny_run), "--out", str(path), "--json"]) == 0
    return path, json.loads(said.getvalue())


@pytest.fixture(scope="session")
def tiny_onnx(exported) -> Path:
    """The ONNX file; treat it as read-only."""
    return exported[0]
