"""A small model, and one exported file of each kind of it; treat the files as read-only."""

from pathlib import Path

import pytest

from herglotz.export import export_c, export_onnx, export_pt2
from herglotz.models import ContactLagrangian, ModelConfig

BOX = {"q_low": [-1.0], "q_high": [1.0], "p_low": [-1.0], "p_high": [1.0], "s_low": [-1.0], "s_high": [1.0]}


@pytest.fixture(scope="session")
def model() -> ContactLagrangian:
    return ContactLagrangian(ModelConfig(level="linear", potential_width=2, damping_width=2))


@pytest.fixture(scope="session")
def files(request, model, tmp_path_factory):
    """The file of a kind, pt2, onnx or h; made once."""
    folder, made = tmp_path_factory.mktemp("files"), {}

    def file(kind: str) -> Path:
        if kind == "onnx":
            pytest.importorskip("onnx")
            pytest.importorskip("onnxruntime")
            request.getfixturevalue("registered_once")
        if kind not in made:
            write = {"pt2": export_pt2, "onnx": export_onnx, "h": export_c}[kind]
            made[kind] = write(model, folder / f"model.{kind}", h=0.1, box=BOX)
        return made[kind]

    return file
