"""exp, expm1, artanh and, in registers, sin and cos of the C runtime are series: here beside the C library's."""

import ctypes
import shutil

import numpy as np
import pytest

from herglotz.export import export_c
from herglotz.models import ContactLagrangian, ModelConfig
from tests.compilers import run_compiler

COMPILERS = [c for c in ("gcc", "clang") if shutil.which(c)]
pytestmark = pytest.mark.skipif(not COMPILERS, reason="neither gcc nor clang in the PATH")
FUNCTIONS = ("exp", "expm1", "atanh", "tanh", "sigmoid", "softplus", "sin", "cos")
TYPES = {"float64": np.float64, "float32": np.float32}
# Largest errors in eps of the value, of 2 million points a function with gcc, from -O0 to -O3 -march=native, one by one
# and in registers: exp 0.70, expm1 1.12, artanh 1.45 (float64); 0.73, 0.99, 1.09 (float32). Twice that is left for
# other compilers and libraries.
ROUNDINGS = 3.0
SOURCE = """
#include "model.h"
#define ONE_BY_ONE(f) \\
  void one_##f(int n, const model_real *x, model_real *y) { int k; for (k = 0; k < n; k++) y[k] = model_##f(x[k]); }
#define BY_REGISTERS(f) \\
  void wide_##f(int n, const model_real *x, model_real *y) { \\
    int k; for (k = 0; k + model_LANES <= n; k += model_LANES) \\
      *(model_part *)(y + k) = model_wide_##f(*(const model_part *)(x + k)); }
#define BOTH(f) ONE_BY_ONE(f) BY_REGISTERS(f)
"""


@pytest.fixture(scope="module", params=[(c, dtype) for c in COMPILERS for dtype in TYPES], ids=str)
def functions(request, tmp_path_factory):
    """(dtype, f(name, x)) of one compiler and precision; the name begins with one_ or wide_."""
    (compiler, dtype), folder = request.param, tmp_path_factory.mktemp("functions")
    one = (1.0,)
    config = ModelConfig((True,), "linear", one, one, one, (0.0,), 0.1, correction_width=4, correction_depth=1)
    export_c(ContactLagrangian(config), folder / "model.h", h=0.1, dtype=dtype)
    (folder / "own.c").write_text(SOURCE + "\n".join(f"BOTH({name})" for name in FUNCTIONS))
    command = [compiler, "-O2", "-march=native", "-shared", "-fPIC", "-o", "own.so", "own.c", "-lm"]
    assert run_compiler(command, folder).returncode == 0
    library, kind = ctypes.CDLL(str(folder / "own.so")), TYPES[dtype]

    def function(name, x):
        x = np.ascontiguousarray(np.resize(x, -(-len(x) // 64) * 64), kind)  # whole registers
        y = np.full_like(x, -7.0)
        pointer = ctypes.POINTER(np.ctypeslib.as_ctypes_type(kind))
        getattr(library, name)(ctypes.c_int(len(x)), x.ctypes.data_as(pointer), y.ctypes.data_as(pointer))
        return x, y

    return dtype, function


def points(most, dtype):
    """Numbers of both signs up to `most`, of every size, and what is special."""
    make, tiny = np.random.default_rng(0), np.finfo(dtype).tiny
    sizes = most * np.exp(make.uniform(np.log(tiny) / 2, 0.0, 20_000))
    x = np.concatenate([make.uniform(-most, most, 40_000), sizes, -sizes, [0.0, -0.0, tiny, -tiny, most, -most]])
    return x.astype(dtype)


@pytest.mark.parametrize("way", ["one", "wide"])
@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("exp", 85.0),
        ("exp", 708.0),
        ("expm1", 25.0),
        ("expm1", 60.0),
        ("expm1", 708.0),
        ("atanh", 1 / 3),
        ("atanh", 1.0),
        ("sin", 2.0),
        ("sin", 2e5),
        ("cos", 2.0),
        ("cos", 2e5),
    ],
)
def test_series_and_the_library_agree(functions, way, name, most):
    # fails if a series is cut short, holds too far, or what is beyond it does not reach the C library
    dtype, function = functions
    circular = name in ("sin", "cos")
    x = points(most if dtype == "float64" or circular else min(most, 85.0), dtype)
    if circular:  # next to zeros, where what is left of x is smallest
        x = np.concatenate([x, (np.pi / 2 * np.arange(most)).astype(dtype)])
    x, y = function(f"{way}_{name}", x)
    inner = np.abs(x) < 1 if name == "atanh" else np.full(len(x), True)
    true = getattr(np, {"atanh": "arctanh"}.get(name, name))(x[inner].astype(np.longdouble))
    eps = np.finfo(dtype).eps
    error = np.abs(y[inner] - true) / (eps * np.maximum(np.abs(true), np.finfo(dtype).tiny / eps))
    assert float(error.max()) <= ROUNDINGS, (float(x[inner][error.argmax()]), float(error.max()))


@pytest.mark.parametrize("way", ["one", "wide"])
def test_what_is_special(functions, way):
    # fails if a NaN becomes a number, what overflows is no infinity, or a register's neighbour spoils a number
    _, function = functions
    special = np.array([np.nan, np.inf, -np.inf, 1e4, -1e4, 0.25, -0.0])
    expected = {
        "exp": [np.nan, np.inf, 0.0, np.inf, 0.0, np.exp(0.25), 1.0],
        "expm1": [np.nan, np.inf, -1.0, np.inf, -1.0, np.expm1(0.25), -0.0],
        "atanh": [np.nan, np.nan, np.nan, np.nan, np.nan, np.arctanh(0.25), -0.0],
        "tanh": [np.nan, 1.0, -1.0, 1.0, -1.0, np.tanh(0.25), 0.0],
        "sigmoid": [np.nan, 1.0, 0.0, 1.0, 0.0, 1 / (1 + np.exp(-0.25)), 0.5],
        "sin": [np.nan, np.nan, np.nan, np.sin(1e4), -np.sin(1e4), np.sin(0.25), -0.0],
        "cos": [np.nan, np.nan, np.nan, np.cos(1e4), np.cos(1e4), np.cos(0.25), 1.0],
        "softplus": [np.nan, np.inf, 0.0, 1e4, 0.0, np.log1p(np.exp(0.25)), np.log(2.0)],
    }
    for name, values in expected.items():
        y = function(f"{way}_{name}", special)[1][: len(special)]
        np.testing.assert_allclose(y, values, rtol=1e-6, atol=1e-12, err_msg=name)
