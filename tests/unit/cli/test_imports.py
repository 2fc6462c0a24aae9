"""What a command imports, and that torch's objects are left out of searches for garbage."""

import ast
import gc
import inspect
import subprocess
import sys

import pytest

import herglotz.cli
from herglotz.cli import export, fit, plot, predict, report, rollout, select, simulate, trust, tune, verify
from herglotz.cli.common import import_torch

SUBCOMMANDS = (export, fit, plot, predict, report, rollout, select, simulate, trust, tune, verify)
# Rooms that a fit with its figures does without; parts of torch that take 0.1 s and more each; pyplot, which looks for
# a display; libraries of extras.
NEVER = (
    *(f"herglotz.{room}" for room in ("theory", "scenes", "export", "verify", "tune", "report")),
    *("torch._dynamo", "torch._inductor", "torch.onnx", "torch.utils.tensorboard", "torch.testing", "sympy"),
    *("matplotlib.pyplot", "scipy", "pandas", "onnx", "onnxruntime", "sklearn", "gymnasium", "tensorboard"),
)
OF_A_FIT = """
import gc, sys
from herglotz.cli.common import import_torch
import_torch()
frozen, enabled, by_torch = gc.get_freeze_count(), gc.isenabled(), set(sys.modules)
from herglotz.plots import save_figures
from herglotz.training import fit, load_run, save_run
import herglotz.cli.fit, herglotz.codegen, herglotz.data.csv_format, herglotz.training.run_folder
print(frozen > 100_000, enabled, *sorted(set(sys.modules) - by_torch))
"""


def test_a_fit_imports_what_it_needs_and_torch_is_left_out_of_collections():
    found = subprocess.run([sys.executable, "-c", OF_A_FIT], capture_output=True, text=True, check=True).stdout.split()
    # fails if a module of these moves back to the top of one that a fit imports
    assert [name for name in found if name in NEVER] == []
    assert "herglotz.training.search" in found
    # fails if full collections meet torch's objects, or there are none any more
    assert found[:2] == ["True", "True"]


def test_a_program_that_calls_main_keeps_its_collections():  # fails if the objects of a caller are frozen
    before = gc.get_freeze_count()
    import_torch()
    assert gc.get_freeze_count() == before


def called(node: ast.AST) -> str | None:
    """The plain name that a call calls."""
    return node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else None


@pytest.mark.parametrize("module", SUBCOMMANDS, ids=lambda m: m.__name__.rpartition(".")[2])
def test_every_subcommand_imports_torch_so(module):  # fails if torch is imported before its objects are left out
    tree = ast.parse(inspect.getsource(module.run))
    (ours,) = (node.lineno for node in ast.walk(tree) if isinstance(node, ast.expr) and called(node) == "import_torch")
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            assert ours < node.lineno
    assert module.run is vars(herglotz.cli.build_parser()._subparsers._group_actions[0].choices[  # pyright: ignore
        module.__name__.rpartition(".")[2]])["_defaults"]["run"]  # fmt: skip
