"""What computes small matrices does so on one thread, and gives the caller's number back."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from herglotz import cli
from herglotz.threads import one_thread
from herglotz.training import ensemble_bands, fit, laplace, select
from herglotz.training.predict import predict
from herglotz.tune import tune
from herglotz.verify import verify


@pytest.fixture
def recorded(monkeypatch):
    """Every number of threads that is set; PyTorch's own number stays."""
    calls = []
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    monkeypatch.setattr(torch, "set_num_threads", calls.append)
    return calls


@pytest.mark.parametrize("function", [fit, select, predict, verify, laplace, ensemble_bands, tune])
def test_one_thread_inside_and_the_callers_number_afterwards(function, recorded):
    # fails if a function computes on all cores, which on a busy machine took ten times as long, or if it leaves one
    # thread behind after a failure
    wrong: list = [object()] * (2 if function is predict else 1)
    with pytest.raises((AttributeError, TypeError, ValueError)):
        function(*wrong)
    assert recorded == [1, 7]


def test_a_user_who_chose_keeps_the_number(recorded, monkeypatch):
    # fails if OMP_NUM_THREADS, which the command line respects, is overruled from Python
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with one_thread():
        pass
    assert recorded == [7]


@pytest.mark.parametrize(("chosen", "loaded", "expected"), [(None, False, "1"), ("3", False, "3"), (None, True, None)])
def test_a_command_leaves_no_choice_behind(recorded, monkeypatch, chosen, loaded, expected):
    # fails if `main`, called from a program, sets OMP_NUM_THREADS for good: every later fit would take it for the
    # user's choice and compute on all cores; or if a command computes on all cores itself
    if chosen:
        monkeypatch.setenv("OMP_NUM_THREADS", chosen)
    if not loaded:
        monkeypatch.delitem(sys.modules, "torch")
    seen = []
    of = SimpleNamespace(run=lambda _: seen.append(os.environ.get("OMP_NUM_THREADS")))
    monkeypatch.setattr(cli, "build_parser", lambda: SimpleNamespace(parse_args=lambda _: of))
    assert cli.main([]) == 0
    assert seen == [expected]
    assert os.environ.get("OMP_NUM_THREADS") == chosen
    assert recorded == ([1, 7] if loaded else [])


LARGE = """
import torch
from herglotz.mechanics.newton import solve
make = torch.Generator().manual_seed(0)
matrix = torch.randn(3, 256, 256, generator=make, dtype=torch.float64) + 256 * torch.eye(256, dtype=torch.float64)
x = torch.randn(2, 3, 256, generator=make, dtype=torch.float64)
torch.set_num_threads(2)
found = solve(matrix, (matrix @ x[..., None])[..., 0])
torch.testing.assert_close(found, x, rtol=1e-12, atol=1e-12)
"""


def test_large_matrices_are_solved_by_two_threads():
    # fails if a batch of them is handed to torch at once, which with two threads never came back: in a process of its
    # own, for nothing else ends that; two seconds are enough, most of them to import torch
    subprocess.run([sys.executable, "-c", LARGE], check=True, timeout=120)
