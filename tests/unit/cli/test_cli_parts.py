"""Small parts of every command: tables, signals, what is said of a fault of the package's own."""

import signal
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.cli import SIGNALS, _importing, _internal, _interruptible, main, rollout
from herglotz.cli.common import exit_code, print_next_of, print_table, warn_of_misfit
from herglotz.cli.tune import _whole
from herglotz.data import driving
from herglotz.data.holds import Arrival
from herglotz.errors import InputError


def test_a_long_value_goes_on_below_itself(capsys):  # fails if its second line begins under the names
    print_table([("a", "short"), ("name", " ".join(["word"] * 20))])
    first, second, third = capsys.readouterr().out.splitlines()
    assert first == "  a     short"
    assert second.startswith("  name  word")
    assert third.startswith(" " * 8 + "word")


@pytest.mark.parametrize(
    ("metrics", "code"), [({}, 0), ({"verdict": "fits to the noise"}, 0), ({"verdict": "does not fit: more data"}, 3)]
)
def test_only_a_verdict_warns(capsys, metrics, code):  # fails if a run that was never judged cannot be exported
    run: Any = SimpleNamespace(metrics=metrics)
    warn_of_misfit(run, "it steps otherwise")
    assert (exit_code(run), "it steps otherwise" in capsys.readouterr().err) == (code, code == 3)


def test_an_internal_error_names_the_innermost_line():  # fails if another frame of the traceback is named
    def inner():
        raise ZeroDivisionError("two\nlines")

    def outer():
        inner()

    with pytest.raises(ZeroDivisionError) as caught:
        outer()
    line = inner.__code__.co_firstlineno + 1
    assert f"ZeroDivisionError: two lines (test_cli_parts.py:{line})" in _internal(caught.value, ["fit", "a b"])
    assert "the command `herglotz fit 'a b'`" in _internal(caught.value, ["fit", "a b"])


def test_a_program_that_calls_a_command_keeps_its_signals():
    # fails if the handlers of a command outlive one that ended, or come back while an interrupted one ends
    before = [signal.getsignal(one) for one in SIGNALS]
    try:
        with _interruptible():
            assert all(signal.getsignal(one) not in before for one in SIGNALS)
        assert [signal.getsignal(one) for one in SIGNALS] == before
        with pytest.raises(KeyboardInterrupt), _interruptible():
            signal.raise_signal(signal.SIGTERM)
        assert all(signal.getsignal(one) not in before for one in SIGNALS)
    finally:
        for one, handler in zip(SIGNALS, before, strict=True):
            signal.signal(one, handler)


@pytest.mark.parametrize("program", [
    "import herglotz.__main__; os.kill(os.getpid(), signal.SIGINT); time.sleep(9)",  # before the arguments are read
    "sys.meta_path.insert(0, Struck()); main()",  # while torch is imported
    "import herglotz.cli.verify as v; v.run = struck; main()",  # while the command works
    "import herglotz.cli.verify as v; v.run = lambda _: Struck().find_spec('torch'); main()",  # as another error
])  # fmt: skip
def test_an_interrupt_is_one_line(program):
    # fails if an interrupt prints a traceback, is swallowed by an import, or ends otherwise than with 130
    words = """
import os, signal, sys, time
sys.argv = ["herglotz", "verify", "free_particle"]
class Struck:
    def find_spec(self, name, *rest):
        if name == "torch":
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(9)
            except KeyboardInterrupt:
                raise ImportError("numpy says so")
def struck(*_):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(9)
from herglotz.__main__ import main
"""
    done = subprocess.run([sys.executable, "-c", words + program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr, done.stdout) == (130, "herglotz: interrupted\n", "")


def test_an_interrupt_of_what_has_ended_changes_nothing():  # fails if the last moment of a process makes another code
    words = "import sys, os, atexit, signal; sys.argv = ['herglotz', '--version']; import herglotz.__main__ as m; "
    words += "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT)); sys.exit(m.command())"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_whole_numbers():  # fails if `none` is a number, or a slip a traceback
    assert (_whole("--widths", " none "), _whole("--widths", "1, 2")) == ((), (1, 2))
    with pytest.raises(InputError, match=r"--widths needs whole numbers .*, got .1\.5."):
        _whole("--widths", "1.5")


@pytest.mark.parametrize(("step", "said"), [(0.1, False), (0.2, False), (0.0999, True), (0.2001, True)])
def test_steps_beyond_those_of_the_fit_are_told(step, said, capsys):  # fails if a step at the end of the range is
    source = SimpleNamespace(h_range=(0.1, 0.2), time_unit="s")
    rollout._warn(source, step * torch.arange(4, dtype=torch.float64), None, [])  # type: ignore[arg-type]
    assert ("fitted to, 0.1 to 0.2 s" in " ".join(capsys.readouterr().err.split())) is said


@pytest.mark.parametrize("arrival", [Arrival("first", 0.2, 0.1), Arrival()])
def test_inputs_of_a_recording_arrive_as_those_of_the_fit(arrival, monkeypatch):
    # fails if a rollout drops the delay and the lag of the fit, or a file that names none is not driven
    asked = []
    monkeypatch.setattr(driving, "input_recording", lambda *given: asked.append(given) or SimpleNamespace(t=[0.0]))
    monkeypatch.setattr(driving, "driven", lambda *_: "driven")
    source = SimpleNamespace(arrival=arrival, time_unit="s", columns=())
    arguments = Namespace(steps=3, inputs=Path("u.csv"), u=None, h=0.1, q0=None, t0=None, trajectory=0)
    assert rollout._driven(arguments, source, 0.0) == "driven"  # pyright: ignore[reportArgumentType]
    assert asked == [(Path("u.csv"), 0, "s", arrival, ())]


def test_a_file_without_labels(monkeypatch):  # fails if a file that says nothing of its coordinates is not stepped
    file = SimpleNamespace(metadata={"box": None}, dof=2, h=0.1, inputs=0, dtype=torch.float64)
    monkeypatch.setattr("herglotz.export.load_exported", lambda *_, **__: file)
    found = rollout.read_source(Path("a.onnx"), 0)
    assert (found.names, found.units, found.angles, found.time_unit) == (("q1", "q2"), ("1", "1"), (False, False), "s")
    file.metadata = {"box": None, "angles": [True, False]}
    assert rollout.read_source(Path("a.onnx"), 0).units == ("rad", "1")


def test_what_comes_next_can_be_pasted(tmp_path, capsys):  # fails if a name with a blank stands there without quotes
    out = tmp_path / "my motion.csv"
    assert main(["simulate", "damped_pendulum", "--out", str(out)]) == 0
    assert f"Next: herglotz fit '{out}' --out 'runs/my motion'\n" in capsys.readouterr().out


def test_nothing_is_made_of_a_run_that_does_not_fit(capsys):  # fails if `select` sends a misfit on to verification
    verdicts = {"does not fit: 1 m": "what the verdict says, or herglotz trust 'my run'", "fits": "herglotz x"}
    for verdict, said in verdicts.items():
        run: Any = SimpleNamespace(metrics={"verdict": verdict})
        print_next_of(run, Path("my run"), ["x"])
        assert capsys.readouterr().out.startswith(f"Next: {said}")


def test_an_interrupt_knows_whether_a_module_is_imported():
    # fails if every frame counts as an import, after which Ctrl-C ended the process at once, or the first frame ends it
    frame = sys._getframe()
    assert not _importing(frame)
    assert not _importing(None)
    inside: Any = SimpleNamespace(f_code=SimpleNamespace(co_filename="<frozen importlib._bootstrap>"), f_back=None)
    around: Any = SimpleNamespace(f_code=frame.f_code, f_back=inside)
    assert _importing(around)
