"""Functions of the compiled kernel's own: sine, cosine and hyperbolic tangent; masses of joints that change with θ."""

import ctypes
import math

import pytest
import torch

from compilers import needs_compiler
from herglotz.codegen.c_compiler import SOURCE, built
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training.kernel import COMPILER_FLAGS, RUNTIME
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.shooting import JointMasses

ONES = """#define hz_N 1
#include <math.h>
"""
LIBRARY = "".join(f"double own_{name}(double x) {{ return FN_{name}(x); }}\n" for name in ("sin", "cos", "tanh"))
VALUES = (0.0, 1e-300, 1e-9, 0.3, 0.785398163397448, 1.0, 1.5707963267948966, 2.0, 3.1415926535897931, 4.7, 6.3, 21.9,
          22.1, 700.0, 9999.5, 10000.5, 1e6, 1e300)  # fmt: skip


@needs_compiler
@pytest.mark.parametrize("name", ["sin", "cos", "tanh"])
def test_functions_of_a_kernel_are_those_of_the_c_library(name):
    # fails in a wrong quadrant, in angles beyond 1e4, whose quadrant is not known, and where e^44 is no longer enough
    text = ONES + (RUNTIME / "mathematics.h").read_text() + LIBRARY
    function = getattr(built(text, lambda: {SOURCE: text}, COMPILER_FLAGS), f"own_{name}")
    function.argtypes, function.restype = [ctypes.c_double], ctypes.c_double
    for size in VALUES:
        for x in (size, -size):
            assert function(x) == pytest.approx(getattr(math, name)(x), rel=5e-16, abs=1e-300), x
    assert math.isnan(function(math.nan))


def test_masses_of_joints_follow_the_parameters():
    # fails if the masses of the last θ are given for another, or the slopes are not their derivatives
    config = ModelConfig(
        angles=(True, True), level="forced", scale=(1.0, 1.0), speed=(1.0, 1.0), stiffness=(1.0, 1.0), tilt=(0.0, 0.0),
        potential_width=0, damping_width=0, features=("cos(q1 - q2) v1 v2", "sin(q2) v1 v1"),
    )  # fmt: skip
    parameters = ParameterVector(ContactLagrangian(config))
    masses = JointMasses(parameters, torch.rand(20, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    theta, small = parameters.get() + 0.1, 1e-6
    slopes, here = masses.slopes(theta), masses.at(theta).log()
    for i, unit in enumerate(torch.eye(len(theta), dtype=torch.float64)):
        moved = (masses.at(theta + small * unit).log() - here) / small
        assert moved.tolist() == pytest.approx(slopes[:, i].tolist(), abs=1e-5)
    assert float(slopes.abs().max()) > 0.1
