"""Signals, locks and files in the way: nothing hangs, nothing is lost, no traceback."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from herglotz.cli import main
from herglotz.data.files import LOCK, locked
from herglotz.errors import InputError

HOLD = """
import sys, time
from herglotz.data.files import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(600)
"""
# A signal that comes just before a sleep begins is heard after the sleep: many short ones.
WAIT = """
import sys, time, types
import herglotz.cli as cli
def wait():
    for _ in range(6000):
        time.sleep(0.1)
def run(arguments):
    try:
        print("ready", flush=True)
        wait()
    finally:
        print("tidied", flush=True)
        if sys.argv[1] == "twice":
            wait()
cli.build_parser = lambda: types.SimpleNamespace(parse_args=lambda argv: types.SimpleNamespace(run=run))
sys.exit(cli.main([]))
"""


def started(script: str, *arguments: str) -> subprocess.Popen:
    """A process that has printed its first line."""
    process = subprocess.Popen(
        [sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline().strip() in ("held", "ready")
    return process


def test_a_second_writer_is_refused_and_a_dead_one_is_not(tmp_path):
    # fails if two fits write into one folder, the message does not name the owner, or kill -9 locks a folder for ever
    owner = started(HOLD, str(tmp_path))
    with pytest.raises(InputError, match=rf"process {owner.pid} is writing a fit there"), locked(tmp_path):
        pass
    owner.kill()
    owner.communicate()
    assert (tmp_path / LOCK).exists()  # of a process that is no more
    with locked(tmp_path), locked(tmp_path):  # `fit` locks again inside the command's lock
        assert (tmp_path / LOCK).read_text() == f"{os.getpid()}\n"
    assert not (tmp_path / LOCK).exists()


def test_two_fits_in_one_folder(tmp_path, capsys):
    # fails if `herglotz fit` or `fit(out=)` does not take the lock
    data = tmp_path / "a.csv"
    assert main(["simulate", "damped_oscillator", "--trajectories", "1", "--steps", "20", "--out", str(data)]) == 0
    owner = started(HOLD, str(tmp_path / "run"))
    assert main(["fit", str(data), "--out", str(tmp_path / "run")]) == 2
    assert f"process {owner.pid} is writing" in capsys.readouterr().err
    owner.kill()
    owner.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_ends_in_order(number):
    # fails if SIGTERM skips what a command does at its end, or Ctrl-C prints a traceback
    process = started(WAIT, "once")
    process.send_signal(number)
    out, error = process.communicate(timeout=60)
    assert (process.returncode, out.strip(), error.strip()) == (130, "tidied", "herglotz: interrupted")


def test_the_second_signal_ends_at_once():
    # fails if a second Ctrl-C, while the first is tidied up after, prints a traceback or is not heard
    process = started(WAIT, "twice")
    process.send_signal(signal.SIGINT)
    assert process.stdout is not None
    assert process.stdout.readline().strip() == "tidied"
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error.strip()) == (130, "herglotz: interrupted")


def test_force_overwrites(tmp_path):
    # fails if --force is not heard; that files are not overwritten without is in cli/test_wrong_input.py
    out = tmp_path / "a.csv"
    simulate = ["simulate", "damped_oscillator", "--trajectories", "1", "--steps", "9", "--out", str(out)]
    assert main(simulate) == 0
    content = out.read_bytes()
    assert main([*simulate, "--seed", "1"]) == 2
    assert out.read_bytes() == content
    assert main([*simulate, "--seed", "1", "--force"]) == 0
    assert out.read_bytes() != content


def test_verify_of_data_says_so(tmp_path, capsys):
    # fails if a csv is called a damaged .pt2 file
    (tmp_path / "a.csv").write_text("t,q\n0,1\n")
    assert main(["verify", str(tmp_path / "a.csv")]) == 2
    assert "is data, not a model; fit it first" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ends", "said"),
    [("SIGSTOP", "a process of torchrun has not answered for 5 s"), ("SIGKILL", "a process of torchrun has ended")],
)
def test_a_worker_that_ends_is_said(tmp_path, ends, said):
    # fails if a worker of torchrun that is stopped or killed hangs the others for ever, or ends them with code 0;
    # 5 s are waited here
    script = Path(tmp_path, "two.py")
    script.write_text(
        "import os, signal, sys, torch\n"
        "from herglotz.training.distributed import add_over_processes, process_group\n"
        "with process_group():\n"
        "    add_over_processes(torch.ones(1))\n"
        "    if os.environ['RANK'] == '1':\n"
        "        os.kill(os.getpid(), getattr(signal, sys.argv[1]))\n"
        "    add_over_processes(torch.ones(1))\n"
    )
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "HERGLOTZ_TIMEOUT": "5"}
    command = [sys.executable, str(script), ends]
    workers = [
        subprocess.Popen(command, env={**os.environ, **shared, "RANK": r}, stderr=subprocess.PIPE, text=True)
        for r in "01"
    ]
    try:
        _, error = workers[0].communicate(timeout=300)
        assert workers[0].returncode == 1
        assert said in error
        assert "start again with resume" in error
    finally:
        for worker in workers:
            worker.kill()
            worker.communicate()
