"""Strike a fit at random moments and count what happens: `make faults`, or `python tests/faults.py --times 10`.

struck: fits that the fault ended. said: of these, those that ended as such a fault must (its signal, or one line on
stderr and exit code 2 or 130). whole: those that left no torn file. same: those whose `--resume` gave, bit for bit, the
run of a fit that nothing struck. hung: processes that were waited for in vain. All
of it forks from one process that has torch loaded; a strike takes two or three seconds of processor time.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import random
import resource
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import torch

from herglotz.cli import main as herglotz
from herglotz.data import save, simulate
from herglotz.data.npz_format import read_npz
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, load_run, save_run, stages
from herglotz.training.distributed import is_first, process_group

SETTINGS = {"level": "linear", "objective": "residual", "iterations": 6}
FLAGS = [text for name, value in SETTINGS.items() for text in (f"--{name.replace('_', '-')}", str(value))]
PATIENCE = 300  # seconds by the clock until a process is said to hang; a fit takes three on a busy machine
ANSWER = 5  # seconds that a worker of torchrun waits for the others
NOBODY = 65534  # the permissions of a folder do not hold for the superuser, who becomes this user


@dataclass
class Count:
    """What happened to the fits of one fault."""

    struck: int = 0
    said: int = 0
    whole: int = 0
    same: int = 0
    hung: int = 0

    @property
    def good(self) -> bool:
        """Whether every strike ended in order and was made good."""
        return self.struck == self.said == self.whole == self.same > 0 == self.hung


@dataclass(frozen=True)
class Fault:
    """What happens to a fit: inside its process before it begins, or from outside while it runs."""

    name: str
    ends: tuple[int, ...]  # how the process may end: an exit code, or minus a signal
    inside: Callable[[random.Random, Path], None] = lambda _make, _folder: None
    outside: int = 0  # the signal that the process is sent
    workers: int = 1
    speaks: bool = True  # whether the last line on stderr says what happened


@dataclass(frozen=True)
class Whole:
    """The fit that nothing struck."""

    folder: Path
    data: Path
    seconds: float


@contextmanager
def intercepted(before: Callable[[int], None]) -> Iterator[None]:
    """Call `before(k)` ahead of the k-th call that makes, syncs or renames a file."""
    calls, originals = count(), [(tempfile, "mkstemp"), (os, "fsync"), (os, "replace")]
    before_that = [(module, name, getattr(module, name)) for module, name in originals]

    def wrapped(original: Callable) -> Callable:
        def call(*arguments, **named):
            before(next(calls))
            return original(*arguments, **named)

        return call

    for module, name, original in before_that:
        setattr(module, name, wrapped(original))
    try:
        yield
    finally:
        for module, name, original in before_that:
            setattr(module, name, original)


def fork(work: Callable[[], int], said: Path) -> int:
    """A child that does the work; what it prints goes to a file."""
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    code = 99
    try:
        handle = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(handle, 2)
        sys.stdout = sys.stderr = os.fdopen(2, "w", buffering=1)
        code = work()
        sys.stderr.flush()
    finally:
        os._exit(code)


def ended(processes: list[int]) -> list[int | None]:
    """Exit codes, or minus signals; None of a process that hangs, which is killed."""
    codes: list[int | None] = []
    end = time.monotonic() + PATIENCE
    for process in processes:
        while not (found := os.waitpid(process, os.WNOHANG))[0] and time.monotonic() < end:
            time.sleep(0.02)
        codes.append(os.waitstatus_to_exitcode(found[1]) if found[0] else None)
        if not found[0]:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
    return codes


def over(codes: list[int | None]) -> bool:
    """Whether a fit was done; 3 is that of one that does not fit to the noise."""
    return all(code in (0, 3) for code in codes)


def begin(data: Path, folder: Path, workers: int, inside: Callable[[], None] = lambda: None) -> list[int]:
    """The processes of a fit, which goes on from a checkpoint where the folder has one."""
    if workers == 1:
        command = ["fit", str(data), "--out", str(folder / "run"), "--no-plots", "--resume", *FLAGS]

        def alone() -> int:
            inside()
            return herglotz(command)

        return [fork(alone, folder / "said")]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(probe.getsockname()[1])}
    shared |= {"WORLD_SIZE": str(workers), "HERGLOTZ_TIMEOUT": str(ANSWER)}

    def worker(rank: int) -> int:
        os.environ.update(shared | {"RANK": str(rank)})
        try:
            with process_group():
                run = fit(data, FitConfig(**SETTINGS), out=folder / "run", resume=True, progress=False)
                if is_first():
                    save_run(run, folder / "run")
        except RuntimeError as error:
            return say(error)
        return 0

    return [fork(lambda rank=rank: worker(rank), folder / f"said{rank or ''}") for rank in range(workers)]


def say(error: Exception) -> int:
    """One line on stderr."""
    print("herglotz:", error, file=sys.stderr)
    return 1


def torn(folder: Path) -> list[str]:
    """Files that are there under their own name, and are not whole."""
    readers = {
        "checkpoint.pt": stages._read,
        "model.pt": lambda path: torch.load(path, weights_only=True),
        "fit.npz": read_npz,
        **dict.fromkeys(("config.json", "metrics.json", "manifest.json"), lambda path: json.loads(path.read_text())),
    }
    found = []
    for name, read in readers.items():
        if (folder / name).exists():
            try:
                read(folder / name)
            except Exception as error:  # whatever it raises, it is not whole
                found.append(f"{name}: {error}")
    return found


def bits(folder: Path) -> list[object]:
    """All that a run says, but for the seconds it took."""
    load_run(folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics.pop("seconds")
    return [metrics, *((folder / name).read_bytes() for name in ("model.pt", "config.json", "fit.npz", "history.csv"))]


def undisturbed(folder: Path, workers: int) -> Whole:
    """The fit that nothing strikes; of one process, first in this one, so that torch is warm before the forks."""
    data = folder / "motion.csv"
    if not data.exists():
        motion = simulate(scene("damped_oscillator"), trajectories=1, steps=20, h=0.2, noise=1e-3, seed=0)
        save(data, motion)
        save_run(fit(data, FitConfig(**SETTINGS), progress=False), folder / "warm")
    whole = folder / f"whole{workers}"
    whole.mkdir()
    start = time.monotonic()
    codes = ended(begin(data, whole, workers))
    if not over(codes):
        raise SystemExit(f"the fit that nothing strikes ended with {codes}: {(whole / 'said').read_text()}")
    return Whole(whole / "run", data, time.monotonic() - start)


def from_call(strike: Callable[[], None]) -> Callable[[random.Random, Path], None]:
    """Strike at a random call of the writer, and at all later ones."""

    def inside(make: random.Random, _: Path) -> None:
        first = make.randrange(FEWEST)
        KEPT.enter_context(intercepted(lambda k: strike() if k >= first else None))

    return inside


FEWEST = 60  # calls of the fit here: 9 checkpoints and 6 files, 4 calls each
KEPT = ExitStack()  # what stays as it is until its process ends


def full() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def small_files(make: random.Random, _: Path) -> None:
    """No file may grow beyond a size: a write ends in the middle, of a checkpoint, not of what is said (500 bytes)."""
    size = make.randrange(1000, 9000)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def read_only(_: random.Random, folder: Path) -> None:
    (folder / "run").mkdir()
    os.chmod(folder / "run", 0o555)
    if os.getuid() == 0:
        os.setuid(NOBODY)


def hoard() -> None:
    """Take all memory up to a limit just above what is taken now."""
    if HOARD:
        return
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (1 << 20), resource.RLIM_INFINITY))
    for size in (1 << 20, 1 << 16, 1 << 12, 1 << 8):
        with suppress(MemoryError):
            while True:
                HOARD.append(bytearray(size))


HOARD: list[bytearray] = []


FAULTS = [
    Fault("kill -9", (-signal.SIGKILL,), outside=signal.SIGKILL, speaks=False),
    Fault(
        "kill -9 of a writer", (-signal.SIGKILL,), from_call(lambda: os.kill(os.getpid(), signal.SIGKILL)), speaks=False
    ),
    Fault("SIGTERM", (130,), outside=signal.SIGTERM),
    Fault("disk full", (2,), from_call(full)),
    Fault("file too large", (2,), small_files),
    Fault("read-only folder", (2,), read_only),
    Fault("out of memory", (2,), from_call(hoard)),
    Fault("worker killed", (1,), outside=signal.SIGKILL, workers=2),
    Fault("worker stopped", (1,), outside=signal.SIGSTOP, workers=2),
]


def strike(fault: Fault, whole: Whole, folder: Path, make: random.Random, counted: Count) -> None:
    """One fit that meets the fault, and its resumption."""
    draw = random.Random(make.random())
    processes = begin(whole.data, folder, fault.workers, lambda: fault.inside(draw, folder))
    if fault.outside:
        time.sleep(make.random() * whole.seconds)
        os.kill(processes[-1], fault.outside)
    codes = ended(processes[:1])
    if fault.workers > 1:
        os.kill(processes[-1], signal.SIGKILL)
        ended(processes[1:])
    if over(codes):
        return  # it was over before
    counted.struck += 1
    counted.hung += codes[0] is None
    text = (folder / "said").read_text() if (folder / "said").exists() else ""
    last = text.rstrip().split("\n")[-1]
    in_order = last.startswith("herglotz: ") == fault.speaks and "Traceback" not in text and "internal" not in last
    counted.said += bool(codes[0] in fault.ends and in_order)
    if not (codes[0] in fault.ends and in_order):
        print(f"{fault.name}: ended with {codes[0]}, said {text[-900:]!r}", file=sys.stderr)
    if (folder / "run").exists():
        os.chmod(folder / "run", 0o755)
    bad = torn(folder / "run")
    counted.whole += not bad
    again = ended(begin(whole.data, folder, fault.workers))
    same = over(again) and bits(folder / "run") == bits(whole.folder)
    counted.same += same
    if bad or not same:
        text = (folder / "said").read_text()
        print(f"{fault.name}: torn {bad}, resumed with {again}, {text[-900:]!r}", file=sys.stderr)


def faults(folder: Path, times: int, *, seed: int = 0, only: str = "") -> dict[str, Count]:
    """Strike so many fits with every fault whose name holds `only`."""
    counts, every = {}, stages.ITERATIONS_PER_CHECKPOINT
    stages.ITERATIONS_PER_CHECKPOINT = 1  # a checkpoint after every iteration
    try:
        whole = {}
        for fault in [fault for fault in FAULTS if only in fault.name]:
            if fault.workers not in whole:
                whole[fault.workers] = undisturbed(folder, fault.workers)
            make, counted = random.Random(f"{seed} {fault.name}"), Count()
            for _ in range(4 * times):  # a fit may be over before it is struck
                if counted.struck == times:
                    break
                with tempfile.TemporaryDirectory(dir=folder) as here:
                    os.chmod(here, 0o777)
                    strike(fault, whole[fault.workers], Path(here), make, counted)
            counts[fault.name] = c = counted
            print(f"{fault.name:20}{c.struck:>8}{c.said:>8}{c.whole:>8}{c.same:>8}{c.hung:>8}", flush=True)
    finally:
        stages.ITERATIONS_PER_CHECKPOINT = every
    return counts


def main() -> int:
    """Strike, print a table, return 1 where a fit was not made good."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=100, help="strikes of each fault (default %(default)s)")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the clock")
    parser.add_argument("--only", default="", help="faults whose name holds this")
    arguments = parser.parse_args()
    print(f"seed {arguments.seed}")
    print(f"{'':20}{'struck':>8}{'said':>8}{'whole':>8}{'same':>8}{'hung':>8}")
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        counts = faults(Path(folder), arguments.times, seed=arguments.seed, only=arguments.only)
    return 0 if all(count.good for count in counts.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
