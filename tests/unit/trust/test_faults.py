"""A slice of `make faults`: one fit struck by every fault; and how a command says that memory is out."""

import pytest

from herglotz.cli import main
from tests.faults import FAULTS, faults


@pytest.mark.slow
def test_a_fit_that_is_struck_goes_on(tmp_path):
    # fails if a fault leaves a torn file, is called a fault of the package, hangs, or if the resumed fit has other bits
    tmp_path.chmod(0o755)
    counts = faults(tmp_path, times=1, seed=1)
    assert len(counts) == len(FAULTS)
    assert {name: count for name, count in counts.items() if not count.good} == {}


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory"), RuntimeError("CUDA out of memory.")],
)
def test_no_memory_is_no_fault_of_the_package(error, monkeypatch, capsys):
    # fails if a machine that is too small ends with 70 and "please report it"
    import herglotz.verify

    def small(*_, **__):
        raise error

    monkeypatch.setattr(herglotz.verify, "verify", small)
    assert main(["verify", "damped_oscillator"]) == 2
    assert capsys.readouterr().err == "herglotz: error: out of memory; use fewer samples or a machine with more\n"
