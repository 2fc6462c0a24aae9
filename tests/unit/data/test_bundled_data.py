"""The sets in data/: what the generator makes is what is committed and what the README says."""

import hashlib
import importlib.util
from pathlib import Path

import pytest
import torch

from herglotz.data import load, read_csv

FOLDER = Path(__file__).parents[3] / "data"


@pytest.fixture(scope="module")
def generator():
    spec = importlib.util.spec_from_file_location("generate", FOLDER / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_demo_is_what_the_generator_makes(generator, tmp_path):  # fails if file, generator or scene changed alone
    generator.generate(tmp_path)
    made, kept = read_csv(tmp_path / "demo_pendulum.csv"), read_csv(FOLDER / "demo_pendulum.csv")
    assert (made.lengths, made.names, made.units) == (kept.lengths, kept.names, kept.units)
    torch.testing.assert_close(made.t, kept.t, rtol=0, atol=1e-9)
    torch.testing.assert_close(made.q, kept.q, rtol=0, atol=1e-9)
    assert (tmp_path / "demo_pendulum.csv").read_text().split("\n")[:4] == (
        (FOLDER / "demo_pendulum.csv").read_text().split("\n")[:4]
    )


def test_demo_matches_the_readme():  # fails if the file is edited or regenerated without the README
    sha256 = hashlib.sha256((FOLDER / "demo_pendulum.csv").read_bytes()).hexdigest()
    assert f"`{sha256}`" in (FOLDER / "README.md").read_text(encoding="utf-8")


def test_demo_contents():  # fails if the counts in the README are wrong, or hidden state is stored
    data = load(FOLDER / "demo_pendulum.csv")
    assert (len(data), data.samples, data.angles, data.gaps) == (4, 629, (True,), 8)
    assert [round(one.t[-1].item(), 9) for one in data] == [16.0] * 4
    assert all(one.gaps == 2 for one in data)
    assert (data.s, data.p, data.u) == (None, None, None)
