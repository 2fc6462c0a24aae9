"""Any argument, under sanitizers and valgrind, as every language and compiler, beside a second header: `fuzz.c`."""

import functools
import os
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

pytestmark = pytest.mark.slow  # a compiler run of 3–30 s each
PROGRAM = Path(__file__).with_name("fuzz.c")
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
SANITIZED = ("-O1", "-g", "-fno-sanitize-recover=all", "-fsanitize=address,undefined,float-cast-overflow")
WIDE = ("-march=native", "-ffp-contract=fast")  # the widest registers of this processor
# How a program is built, what runs it, and how many trials take a few seconds so.
WAYS: dict[str, tuple[tuple[str, ...], tuple[str, ...], int]] = {
    "memory and undefined behaviour": (SANITIZED, (), 3000),
    "the same, wide registers": ((*SANITIZED, *WIDE), (), 3000),
    "threads": (("-O1", "-g", "-fsanitize=thread"), ("setarch", "-R"), 1000),
    # Line numbers of DWARF 4: valgrind 3.19 complains of those of clang 14, which are of DWARF 5.
    "valgrind": (("-O1", "-gdwarf-4"), ("valgrind", "-q", "--error-exitcode=9", "--leak-check=full"), 200),
    "optimised": (("-O3", *WIDE), (), 10_000),
    "fast-math": (("-O3", "-ffast-math", *WIDE), (), 10_000),
}
MODELS: dict[str, dict[str, Any]] = {
    "linear": {"level": "linear"},
    "network": {"level": "affine", "correction_width": 5, "mass_width": 3},
    "full": {"level": "full", "action_width": 3, "activation": "softplus"},
    "inputs": {"level": "forced", "coulomb": True, "inputs": 2},
    "dry friction": {"level": "forced", "coulomb": True, "sticking": True, "inputs": 1},
    "order 4": {"level": "linear", "order": 4, "potential_width": 0, "features": ("q2^4", "cos(q1) v1 v2")},
}


def model_of(dtype, **options):
    """An angle and a length; every parameter is random."""
    sizes = (1.0, 1.1)
    config = ModelConfig(
        (True, False), scale=sizes, speed=sizes, stiffness=sizes, tilt=(0.0, 0.0), rate=0.2,
        **{"potential_width": 4, "damping_width": 3, **options},
    )  # fmt: skip
    model = ContactLagrangian(config)
    with torch.no_grad():
        randomise(model, 0.05, seed=3)
        if model.friction is not None:
            model.friction.viscous.abs_()
            model.friction.coulomb.abs_()
    return model.to(dtype)


@pytest.fixture(scope="module")
def folder_of(tmp_path_factory):
    """Headers of a model, and of another of other size and precision, exported once."""

    @functools.cache
    def exported(name, dtype):
        folder = tmp_path_factory.mktemp("headers")
        box = {f"{x}_{end}": [sign] * (1 if x == "s" else 2) for x in "qps" for end, sign in (("low", -1), ("high", 1))}
        export_c(model_of(dtype, **MODELS[name]), folder / "arm.h", h=0.1, h_range=(0.05, 0.2), box=box)
        export_c(model_of(torch.float32), folder / "leg.h", h=0.1)
        return folder

    return exported


def checked(folder, compiler, way, *language):
    """What the program prints: calls, and how many of them succeeded."""
    flags, runner, trials = WAYS[way]
    if not shutil.which(compiler):
        pytest.skip(f"no {compiler} in the PATH")
    if runner and not shutil.which(runner[0]):
        pytest.skip(f"no {runner[0]} in the PATH")
    program = folder / "fuzz"
    words = [compiler, *language, *WARNINGS, *flags, f"-I{folder}", str(PROGRAM), "-o", str(program), "-lm", "-pthread"]
    built = run_compiler(words)
    assert built.returncode == 0, built.stderr[:3000]
    done = subprocess.run([*runner, program, str(trials)], capture_output=True, text=True, check=False,
                          env={**os.environ, "TSAN_OPTIONS": "halt_on_error=1"})  # fmt: skip
    assert done.returncode == 0, (done.stderr or done.stdout)[:3000]
    assert not done.stderr
    return tuple(map(int, done.stdout.split()))


def assert_tried(calls, good):
    # of the steps some succeed and some fail, else nothing was tried
    assert 0.1 * calls < good < 0.9 * calls


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "float"])
@pytest.mark.parametrize("name", MODELS)
def test_any_argument_ends_in_numbers_or_a_status(folder_of, name, dtype, compiler):
    # fails if an argument leads beyond an array, to a load that is not aligned, to an overflow of integers, or to NaN
    # under a status of success
    assert_tried(*checked(folder_of(name, dtype), compiler, "memory and undefined behaviour", "-std=c99"))


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("way", [way for way in WAYS if way != "memory and undefined behaviour"])
def test_every_way_to_build_and_to_watch(folder_of, way, compiler):
    # fails if wide registers want alignment, threads share what they write, a number is read before it is written, or
    # optimisation drops a check
    assert_tried(*checked(folder_of("inputs", torch.float64), compiler, way, "-std=c99"))


@pytest.mark.parametrize("compiler", ["gcc", "clang", "g++", "clang++"])
def test_every_language(folder_of, compiler):
    # fails if a header warns as C11 or C++17
    language = ("-x", "c++", "-std=c++17") if compiler.endswith("++") else ("-std=c11",)
    assert_tried(*checked(folder_of("network", torch.float64), compiler, "memory and undefined behaviour", *language))
