"""The header where memory and time are counted: calls, stack, the bound of Newton's iteration, a Cortex-M4, Rust."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch
from export_models import randomise

from herglotz.export import export_c
from herglotz.models import ContactLagrangian, ModelConfig
from tests.compilers import run_compiler

ROOT = Path(__file__).resolve().parents[3]
needs_gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="no gcc in the PATH")
ARM = ("arm-none-eabi-gcc", "qemu-system-arm", "make", "gcc")
BOX = {"q_low": [-2.0], "q_high": [2.0], "p_low": [-2.0], "p_high": [2.0], "s_low": [-9.0], "s_high": [9.0]}
# Functions of <math.h> that the runtime names, what GCC makes of sin and cos of one number, and how it moves memory.
MATH = {"sin", "cos", "sincos", "exp", "expm1", "sqrt", "atanh", "pow", "floor", "log", "fabs"}
ALLOWED = MATH | {f"{name}f" for name in MATH} | {"memset", "memcpy", "memmove"}


def pendulum():
    """An angle with a network of two layers of 16 units beside the terms of every model."""
    model = ContactLagrangian(ModelConfig(correction_width=16))
    with torch.no_grad():
        randomise(model, 0.05, seed=1)
    return model


def rubbing():
    """A driven coordinate that dry friction can hold, and a mass that depends on position."""
    options: dict[str, Any] = {"potential_width": 3, "mass_width": 3, "coulomb": True, "sticking": True, "inputs": 1}
    model = ContactLagrangian(ModelConfig(level="forced", **options))
    with torch.no_grad():
        randomise(model, 0.05, seed=2)
        for name in ("viscous", "coulomb", "breakaway"):
            model.get_parameter(f"friction.{name}").abs_()
    return model


@pytest.fixture(scope="module")
def headers(tmp_path_factory):
    """Folders with stepper.h: the pendulum in float, and a model with all that a header can hold."""
    folders = {name: tmp_path_factory.mktemp(name) for name in ("float", "extras")}
    export_c(pendulum(), folders["float"] / "stepper.h", h=0.1, box=BOX, dtype="float32")
    chosen: Any = ("friction.viscous", "damping.rate")
    export_c(rubbing(), folders["extras"] / "stepper.h", h=0.1, parameters=chosen, extras=("adjoint", "filter"))
    return folders


@pytest.fixture(scope="module")
def compiled(headers):
    """Every function of two headers in object files, beside which GCC writes its calls and stack."""
    if not shutil.which("gcc"):
        pytest.skip("no gcc in the PATH: apt install gcc")
    for name in ("float", "extras"):
        (headers[name] / "use.c").write_text('#include "stepper.h"\n')
        words = ["gcc", "-std=c99", "-O1" if name == "float" else "-O0", "-fkeep-inline-functions", "-fno-pic"]
        words += ["-fno-stack-protector", "-fcallgraph-info=su", "-c", "use.c", "-o", "use.o"]
        subprocess.run(words, cwd=headers[name], check=True)
    return headers


@pytest.mark.parametrize("name", ["float", "extras"])
def test_nothing_is_called_but_the_mathematics(compiled, name):
    # fails if a function of the header prints, allocates, or asks for any library but libm
    found = subprocess.run(["nm", "-u", compiled[name] / "use.o"], capture_output=True, text=True, check=True).stdout
    called = set(re.findall(r"U (\w+)", found))
    assert {"cos", "cosf", "sincosf"} & called
    assert called <= ALLOWED, called - ALLOWED


def graph(folder):
    """Bytes of stack and kind of each function, and which functions each one calls, from GCC's call graph."""
    text = (folder / "use.ci").read_text()
    nodes = re.findall(r'node: \{ title: "([^"]*)" label: "[^"]*?\\n(\d+) bytes \(([\w,]+)\)', text)
    calls: dict[str, set[str]] = {}
    for caller, callee in re.findall(r'edge: \{ sourcename: "([^"]*)" targetname: "([^"]*)"', text):
        calls.setdefault(caller.split(":")[-1], set()).add(callee.split(":")[-1])
    return {name.split(":")[-1]: (int(size), kind) for name, size, kind in nodes}, calls


@pytest.mark.parametrize("name", ["float", "extras"])
def test_the_stack_is_known_when_it_is_compiled(compiled, name):
    # fails if a function allocates on the stack by a number of the run time, or calls itself
    frames, calls = graph(compiled[name])
    assert {"stepper_step", "stepper_evaluate", "stepper_take"} <= set(frames)
    assert {kind for _, kind in frames.values()} <= {"static", "dynamic,bounded"}  # the second: pushed arguments

    def deepest(function, above=()):
        assert function not in above, f"{function} calls itself by {above}"
        below = [deepest(callee, (*above, function)) for callee in calls.get(function, ())]
        return frames.get(function, (0, ""))[0] + max(below, default=0)

    total = {function: deepest(function) for function in frames}
    assert total["stepper_step"] > frames["stepper_take"][0] + frames["stepper_evaluate"][0]
    if name == "float":  # docs/microcontroller.md says so
        assert total["stepper_step"] <= 2 * 1024


BOUND = """
#include <stdio.h>
static int evaluations;
#include "counted.h"
int main(void) {
  int k, most = 0, worst = 0;
  for (k = 0; k < 2000; k++) {
    stepper_state x = {{-2.0 + 0.002 * k}, {(k % 41) - 20.0}, 0.0, 1.0};
    int status;
    evaluations = 0;
    status = stepper_step(&x, 0.1 + 0.001 * k, 0, 0, 0) & 15;
    if (evaluations > most) most = evaluations;
    if (status > worst) worst = status;
  }
  printf("%d %d %d\\n", most, worst, stepper_max_iterations);
  return 0;
}
"""


@needs_gcc
@pytest.mark.parametrize("limit", [30, 2])
def test_a_constant_of_the_header_bounds_the_iteration(headers, tmp_path, limit):
    # fails if Newton's loop goes on beyond NAME_max_iterations, or ends there without its status
    text = (headers["extras"] / "stepper.h").read_text()
    assert text.count("stepper_max_iterations = 30 }") == 1
    text = text.replace("stepper_max_iterations = 30", f"stepper_max_iterations = {limit}")
    text, calls = re.subn(r"stepper_evaluate(?:_first)?\(P, t\)(?=;)", r"(evaluations++, \g<0>)", text)
    assert calls == 3
    (tmp_path / "counted.h").write_text(text)
    (tmp_path / "use.c").write_text(BOUND)
    assert run_compiler(["gcc", "-std=c99", "-O1", "use.c", "-o", "use", "-lm"], tmp_path).returncode == 0
    printed = subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout
    most, worst, said = map(int, printed.split())
    assert said == limit
    assert (most, worst) == (limit + 1, 1)  # some of these states have no step


@pytest.fixture(scope="module")
def on_cortex_m4(headers, tmp_path_factory):
    """What the example prints on the emulated board and on this computer, and the folder of the program."""
    if missing := [tool for tool in ARM if not shutil.which(tool)]:
        pytest.skip(f"no {missing[0]}: apt install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm make gcc")
    build = tmp_path_factory.mktemp("cortex_m4")

    def printed(target):
        words = ["make", "-s", "-C", ROOT / "examples" / "cortex_m4", f"HEADER={headers['float']}/stepper.h"]
        words = [*words, f"BUILD={build}", target]
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=300)
        assert done.returncode == 0, done.stderr[:3000]
        rows = [line.split() for line in done.stdout.splitlines()]
        states = [list(map(float, row)) for row in rows if row[0].isdigit()]
        return states, {row[0]: int(row[1]) for row in rows if not row[0].isdigit()}

    return printed("measure"), printed("host"), build / "cortex_m4.elf"


def test_a_cortex_m4_steps_as_this_computer(on_cortex_m4):
    # fails if what the header computes depends on the processor, or is not float there; 1e-5 is what float keeps of
    # double over 1000 steps of a damped motion
    (states, said), (here, _), _ = on_cortex_m4
    assert said["status"] == 0
    assert [row[0] for row in states] == [100.0 * k for k in range(11)]
    away = torch.tensor(states) - torch.tensor(here)
    assert float(away.abs().max()) <= 1e-5
    assert abs(states[0][1]) > 10 * abs(states[-1][1]) > 0.0  # it moved, and is damped


def test_a_cortex_m4_needs_little(on_cortex_m4):
    # fails if constants go to RAM, numbers in double or their emulation come in, or the stack holds lanes of registers
    (_, said), _, program = on_cortex_m4
    assert said["flash"] <= 24 * 1024
    assert said["stack"] < said["ram"] <= 2 * 1024
    assert 0 < said["mean"] <= said["most"] <= 4 * said["mean"]
    symbols = subprocess.run(["arm-none-eabi-nm", program], capture_output=True, text=True, check=True).stdout
    assert not re.findall(r" (__aeabi_d\w+|__aeabi_f2d|malloc|printf|_sbrk)$", symbols, re.MULTILINE)
