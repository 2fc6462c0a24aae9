"""The header from Rust: the files and commands that docs/from_rust.md shows."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from herglotz.export import export_c
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper

PAGE = Path(__file__).resolve().parents[3] / "docs" / "from_rust.md"
TOOLS = ("cc", "ar", "rustc")
BOX = {"q_low": [-0.05], "q_high": [0.6], "p_low": [-1.0], "p_high": [1.0], "s_low": [-9.0], "s_high": [9.0]}


def test_the_program_of_the_page_steps_as_the_model(tmp_path):
    # fails if the layout of a state, an argument or a status is not that of the header, or a command does not do
    if missing := [tool for tool in TOOLS if not shutil.which(tool)]:
        pytest.skip(f"no {missing[0]} in the PATH: apt install gcc rustc")
    model = ContactLagrangian(ModelConfig(rate=0.3, potential_width=0))
    export_c(model, tmp_path / "arm.h", h=0.1, box=BOX)
    text = PAGE.read_text(encoding="utf-8")
    files = re.findall(r"^```(?:c|rust)\n(?:/\* (\S+) \*/|// (\S+))\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert [c or rust for c, rust, _ in files] == ["arm_c.c", "arm.rs"]
    for c, rust, body in files:
        (tmp_path / (c or rust)).write_text(body)
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    commands = [shlex.split(line) for line in re.findall(r"^    (\S.*)$", prose, re.MULTILINE)]
    assert [words[0] for words in commands] == ["herglotz", "cc", "ar", "rustc", "./arm"]
    for words in commands[1:4]:
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), done.stderr[:3000]
    printed = subprocess.run([tmp_path / "arm"], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in printed.splitlines()]
    with torch.no_grad():
        stepper, x = Stepper(model, tol=1e-15), torch.tensor([0.5], dtype=torch.float64)
        start = stepper.init_qv(x, torch.zeros_like(x), h=0.1)
        motion = stepper.rollout(*start, h=0.1, steps=20)
    found = torch.tensor([[float(x) for x in row[1:3]] for row in rows], dtype=torch.float64)
    exact = torch.stack([motion.q[1:, 0], motion.p[1:, 0]], -1)
    assert float((found - exact).abs().max()) <= 1e-12
    outside = [k for k, row in enumerate(rows) if row[3:] == ["outside", "the", "data"]]
    left = [k for k in range(20) if (motion.q[k : k + 2] < -0.05).any()]
    assert outside == left
    assert 0 < len(left) < 20
