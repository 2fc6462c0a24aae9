"""C of the tests is compiled without optimisation, and once; and the rounding shake, on request.

The rounding shake: every fit of the suite from data disturbed in the last digit.
`HERGLOTZ_SHAKE=SEED` multiplies the positions and inputs that `fit` is given by 1 + 1e-14 ξ, ξ standard normal and
decided by the seed and the data. An assertion on a trained quantity that holds with one rounding and fails with another
is found so on one machine (`make test-anywhere`).
"""

import functools
import gc
import os
import sys
import typing
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from herglotz.training import kernel
from tests.unoptimised import leave_out_optimisation

RELATIVE = 1e-14
SHAKEN = set()  # digests of what was disturbed


def shaken(data, seed):
    """The data with every recorded number disturbed by `RELATIVE`; the same data in the same way, and once."""
    if data.digest() in SHAKEN:  # those of a run, which is fitted again
        return data
    make = torch.Generator().manual_seed(seed + int(data.digest()[:8], 16))

    def disturbed(x):
        if x is None:
            return None
        moves = (x != x[:1]).any(0)  # what rests is refused, or has no input
        return torch.where(moves, x * (1 + RELATIVE * torch.randn(x.shape, generator=make, dtype=x.dtype)), x)

    found = replace(data, q=disturbed(data.q), u=disturbed(data.u))
    SHAKEN.add(found.digest())
    return found


def pytest_collectstart():
    """What is imported stays: looking through it for garbage took a quarter of the collection of the tests."""
    gc.disable()


def pytest_collection_finish():
    """Torch and the tests are not looked through again for garbage: that took 9 % of the tests of export."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


def pytest_configure():
    seed = os.environ.get("HERGLOTZ_SHAKE")
    if seed is None:
        return
    from herglotz import cli, training  # noqa: F401  their modules hold names of `fit`
    from herglotz.data import Trajectories

    fit = training.fit

    @functools.wraps(fit)
    def fit_shaken(data, *arguments, **options):
        known = isinstance(data, Trajectories)  # arrays and frames become one inside
        return fit(shaken(data, int(seed)) if known else data, *arguments, **options)

    for name, module in list(sys.modules.items()):
        if name.startswith("herglotz") and getattr(module, "fit", None) is fit:
            setattr(module, "fit", fit_shaken)  # noqa: B010  a module has no such attribute to type checkers


@pytest.fixture(autouse=True, scope="session")
def _unoptimised_c():
    with pytest.MonkeyPatch.context() as patch:
        leave_out_optimisation(patch.setattr)
        yield patch


@pytest.fixture(autouse=True, scope="session")
def _compiled_once():
    """Libraries are kept for all tests, workers and runs: their names are the hashes of their sources."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(Path(__file__).parents[1] / "build" / "tests"))
        yield


@pytest.fixture(scope="session")
def registered_once():
    """torch.onnx collects its operations once for all graphs, and reads the signature of an operation once.

    The collection took 0.3 s of each graph, of which a file has four; the signatures took a seventh of an export. A
    node's place in the source, which files leave out, is not written at all. Python 3.11 lists the attributes of a
    protocol anew at every `isinstance`, in 10 to 20 µs; onnx_ir asks 15 000 times an export.
    """
    registry = pytest.importorskip("torch.onnx._internal.exporter._registration").ONNXRegistry
    made = functools.cache(registry.from_torchlib)

    def copied(**options):
        found, known = registry(), made(**options)
        found._opset_version = known.opset_version
        found.functions = {target: list(functions) for target, functions in known.functions.items()}
        return found

    signature, read = pytest.importorskip("onnx_ir").schemas.OpSignature, {}
    of_schema = signature.from_op_schema

    def signature_of(schema):
        key = schema.domain, schema.name, schema.since_version
        if key not in read:
            read[key] = of_schema(schema)
        return read[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "from_torchlib", staticmethod(copied))
        patch.setattr(signature, "from_op_schema", staticmethod(signature_of))
        patch.setattr("torch.onnx._internal.exporter._core._set_node_metadata", lambda *_: None)
        if attributes := getattr(typing, "_get_protocol_attrs", None):
            patch.setattr(typing, "_get_protocol_attrs", functools.cache(attributes))
        yield


@pytest.fixture
def optimised_c(_unoptimised_c):
    """C as the package compiles it."""
    _unoptimised_c.undo()
    kernel._kernel.cache_clear()
    kernel._places.cache_clear()
    yield
    leave_out_optimisation(_unoptimised_c.setattr)
