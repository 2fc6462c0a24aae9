"""Break the package on purpose, one place at a time, and see whether the tests of that room notice: `make mutants`.

The mutants are a sample of all that `mutant_operators.py` finds, `--number` of each room. First the tests of the rooms
run on the sound sources, which says what each test costs and which functions it calls; then each mutant, on a copy of
the sources, meets the tests of its own room that call its function, the cheapest first, until one fails. All of it
forks from one process that has torch loaded.

What was found is kept in `runs/mutants`: a run that was stopped goes on where it stopped, and only what changed since
(the mutated file, a test file, for a survivor) is tried again. `--shard 2/4` takes every fourth mutant.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import inspect
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

# What takes a second to load is loaded once, before the forks.
import matplotlib.pyplot  # noqa: F401
import pytest
import torch

from mutant_operators import sample

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "runs" / "mutants"
ROOMS = {  # room → where its tests are
    "mechanics": ["tests/unit/mechanics"],
    "theory": ["tests/unit/theory", "tests/verification"],
    "verify": ["tests/unit/verify", "tests/verification"],
    "plots": ["tests/unit/plots", "tests/verification"],
    "scenes": ["tests/unit/scenes"],
    "models": ["tests/unit/models", "tests/contracts"],
    "stepping": ["tests/unit/stepping"],
    "training": ["tests/unit/training"],
    "export": ["tests/unit/export"],
    "data": ["tests/unit/data"],
    "cli": ["tests/unit/cli"],
    "tune": ["tests/unit/tune"],
}
SURVEY_SECONDS = 150  # of processor time for the sound run of a test file; tests beyond are not used
MUTANT_SECONDS = 30  # of processor time for all tests of a mutant; what has not noticed by then, has not
MOST_SECONDS = 900  # by the clock, for a child that blocks
SHARED = ""  # the name of what the tests of a file share: its import, and fixtures that are set up once
PATIENCE = 5  # a test that takes so many times what it took on the sound sources, and 10 s more, has noticed


class Mutant(NamedTuple):
    """One place changed: what stands at `at` in the file, and what stands there instead."""

    name: str
    at: int
    old: str
    new: str

    @property
    def room(self) -> str:
        return self.name.split("/")[0]

    def key(self) -> str:
        """Changes with the file and with the mutant."""
        return _digest(self.name, str(self.at), self.old, self.new, source(self.name))


def source(name: str) -> str:
    return (ROOT / "src" / "herglotz" / name).read_text(encoding="utf-8")


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def drawn(number: int, seed: int) -> list[Mutant]:
    """So many mutants of each room."""
    return [Mutant(*m) for room in ROOMS for m in sample(ROOT / "src" / "herglotz", room, number, seed)]


def function_of(mutant: Mutant) -> int | None:
    """The first line of the innermost function around the mutant, as code objects count it; None outside functions."""
    text = source(mutant.name)
    line = text.count("\n", 0, mutant.at) + 1
    inside = [
        min([node.lineno, *(d.lineno for d in node.decorator_list)])
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef) and node.body[0].lineno <= line <= (node.end_lineno or 0)
    ]
    return max(inside, default=None)


class Survey:
    """A pytest plugin: seconds of every passing test, and the functions of the package that it calls.

    What is called while the file is imported or a wider fixture is set up, in whichever test, stands under `SHARED`.
    """

    pipe: int

    def __init__(self, src: Path):
        self.src, self.failed, self.spent = f"{src}/", set(), time.process_time()
        self.calls: set[tuple[str, int]] = set()
        self.found: dict[str, dict[str, Any]] = {SHARED: {"seconds": 0.0, "calls": []}}

    def _tracer(self, frame: Any, *_: Any) -> None:
        code = frame.f_code
        if code.co_filename.startswith(self.src):
            self.calls.add((code.co_filename.removeprefix(self.src), code.co_firstlineno))

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        self.calls, start = set(), time.process_time()
        sys.settrace(self._tracer)
        yield
        sys.settrace(None)
        self.found[item.nodeid] = {"seconds": time.process_time() - start, "calls": sorted(self.calls)}

    @pytest.hookimpl(hookwrapper=True)
    def pytest_collection(self) -> Iterator[None]:
        sys.settrace(self._tracer)
        yield from self._share()
        sys.settrace(None)

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        if fixturedef.scope == "function":
            yield
        else:
            yield from self._share()

    def _share(self) -> Iterator[None]:
        before, self.calls, start = self.calls, set(), time.process_time()
        yield
        shared = self.found[SHARED]
        shared["calls"] = sorted({*shared["calls"], *self.calls})
        shared["seconds"] += time.process_time() - start
        self.calls |= before

    def pytest_runtest_logreport(self, report: Any) -> None:
        if not report.passed:
            self.failed.add(report.nodeid)

    def pytest_runtest_setup(self) -> None:
        if time.process_time() - self.spent > SURVEY_SECONDS:
            pytest.exit("enough")

    def answer(self) -> None:
        rows = {name: row for name, row in self.found.items() if name not in self.failed}
        with os.fdopen(self.pipe, "w") as pipe:
            json.dump(rows, pipe)


class Killer:
    """A pytest plugin: the first test that fails, or hangs; the tests go in the order in which they are given."""

    pipe: int

    def __init__(self, seconds: dict[str, float]):
        self.seconds, self.spent = seconds, time.process_time()

    def answer(self, by: str | None = None) -> None:
        os.write(self.pipe, json.dumps({"by": by}).encode())
        os._exit(0)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self.answer(report.nodeid)

    pytest_collectreport = pytest_runtest_logreport

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        signal.signal(signal.SIGVTALRM, lambda *_: self.answer(f"{item.nodeid} (hangs)"))
        signal.setitimer(signal.ITIMER_VIRTUAL, 10 + PATIENCE * self.seconds.get(item.nodeid, 10.0))
        yield
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)

    def pytest_runtest_setup(self) -> None:
        if time.process_time() - self.spent > MUTANT_SECONDS:
            self.answer()

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        first = {name: k for k, name in enumerate(self.seconds)}
        items.sort(key=lambda item: first.get(item.nodeid, len(first)))


def in_fork(tree: Path, plugin: Any, tests: list[str]) -> tuple[int, int]:
    """Run pytest with a plugin in a child, on a tree of sources; the process, and the pipe with `plugin.result()`."""
    reader, writer = os.pipe()
    process = os.fork()
    if process:
        os.close(writer)
        return process, reader
    try:
        signal.alarm(MOST_SECONDS)
        most = SURVEY_SECONDS + MUTANT_SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (most, most))
        os.chdir(tree)
        os.environ["PYTHONPATH"] = f"{tree / 'src'}:{tree}"
        sys.path[:0] = [str(tree / "src"), str(tree)]
        null = os.open(os.devnull, os.O_RDWR)
        for standard in (0, 1, 2):
            os.dup2(null, standard)
        plugin.pipe = writer
        pytest.main(["-q", "--tb=no", "-p", "no:cacheprovider", *tests], plugins=[plugin])
        plugin.answer()
    finally:
        os._exit(0)


class Workers:
    """So many children at the same time, each on a copy of the sources of its own."""

    def __init__(self, number: int, folder: Path):
        self.free = [self._copy(folder / str(k) / "tree") for k in range(number)]
        self.busy: dict[int, tuple[int, Path, Callable[[Path, Any], None]]] = {}
        self.stamp = 1_000_000_000

    @staticmethod
    def _copy(folder: Path) -> Path:
        ignored = shutil.ignore_patterns("__pycache__", ".git", ".venv", "runs", ".*_cache", "build")
        shutil.copytree(ROOT, folder, ignore=ignored)
        if (ROOT.parent / "shared").exists():
            (folder.parent / "shared").symlink_to(ROOT.parent / "shared")
        return folder

    def start(self, begin: Callable[[Path], tuple[int, int]], end: Callable[[Path, Any], None]) -> None:
        """Begin when a tree is free; `end` has the tree and the answer, None of a child that died."""
        while not self.free:
            self.wait()
        tree = self.free.pop()
        process, pipe = begin(tree)
        self.busy[pipe] = (process, tree, end)

    def wait(self) -> None:
        """Until one child is over."""
        pipe = select.select(list(self.busy), [], [])[0][0]
        process, tree, end = self.busy.pop(pipe)
        with os.fdopen(pipe) as stream:
            text = stream.read()
        os.waitpid(process, 0)
        end(tree, json.loads(text) if text else None)
        self.free.append(tree)

    def write(self, tree: Path, name: str, text: str) -> None:
        """Each version of a file has a second of its own, so that compiled files of another version do not fit."""
        self.stamp += 1
        path = tree / "src" / "herglotz" / name
        path.write_text(text, encoding="utf-8")
        os.utime(path, (self.stamp, self.stamp))


def survey(workers: Workers, rooms: set[str]) -> dict[str, dict[str, Any]]:
    """What every passing test of the rooms costs and calls, by test file; kept until the file or a source changes."""
    sources = _digest(*(p.read_text(encoding="utf-8") for p in sorted((ROOT / "src").rglob("*.py"))))
    folders = sorted({folder for room in rooms for folder in ROOMS[room]})
    found: dict[str, dict[str, Any]] = {}
    for path in [p for folder in folders for p in sorted((ROOT / folder).rglob("test_*.py"))]:
        name = str(path.relative_to(ROOT))
        kept = KEPT / f"survey-{name.replace('/', '-')}.json"
        key = _digest(sources, inspect.getsource(Survey), path.read_text(encoding="utf-8"))
        before: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {"key": "", "tests": {}}
        if before["key"] == key:
            found[name] = before["tests"]
            continue

        def end(_: Path, answer: Any, name: str = name, kept: Path = kept, key: str = key) -> None:
            found[name] = answer or {}
            if len(found[name]) < 2:
                print(f"nothing   passes in {name}; run it alone", flush=True)
                return
            kept.write_text(json.dumps({"key": key, "tests": found[name]}))
            spent = sum(row["seconds"] for row in found[name].values())
            print(f"sound     {name}: {max(0, len(found[name]) - 1)} tests, {spent:.0f} s", flush=True)

        workers.start(lambda tree, name=name: in_fork(tree, Survey(tree / "src" / "herglotz"), [name]), end)
    while workers.busy:
        workers.wait()
    return found


def tests_of(mutant: Mutant, found: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The tests of the mutant's room that call its function, and what each costs, the cheapest first.

    Last come those of files whose tests share what it makes. The cost has what is shared: any test may pay for it.
    """
    line, files = function_of(mutant), ROOMS[mutant.room]
    chosen: list[tuple[bool, float, str, float]] = []
    for name, tests in found.items():
        if not tests or not any(name.startswith(folder + "/") for folder in files):
            continue
        calling = {
            test
            for test, row in tests.items()
            for file, at in row["calls"]
            if file == mutant.name and line in (None, at)
        }
        shared = tests[SHARED]["seconds"]
        chosen += [
            (test not in calling, row["seconds"], test, row["seconds"] + shared)
            for test, row in tests.items()
            if test != SHARED and (test in calling or SHARED in calling)
        ]
    return {test: most for *_, test, most in sorted(chosen)}


def attempt(workers: Workers, mutant: Mutant, seconds: dict[str, float], end: Callable[[str | None], None]) -> None:
    """Meet the tests in a tree where the mutant stands."""
    text = source(mutant.name)
    changed = text[: mutant.at] + mutant.new + text[mutant.at + len(mutant.old) :]

    def begin(tree: Path) -> tuple[int, int]:
        workers.write(tree, mutant.name, changed)
        return in_fork(tree, Killer(seconds), list(seconds))

    def restore(tree: Path, answer: Any) -> None:
        workers.write(tree, mutant.name, text)
        end("the process died" if answer is None else answer["by"])

    if not seconds:
        end(None)
        return
    workers.start(begin, restore)


def table(chosen: list[Mutant], survivors: list[Mutant]) -> str:
    """Tried and killed, a line a room."""
    lines = [f"{'room':<10} {'tried':>5} {'killed':>6} {'%':>4}"]
    for room in (*sorted({m.room for m in chosen}), ""):
        tried, alive = (sum(m.room == room or not room for m in each) for each in (chosen, survivors))
        lines.append(f"{room or 'all':<10} {tried:>5} {tried - alive:>6} {100 * (tried - alive) / (tried or 1):>4.0f}")
    return "\n".join(lines)


def main() -> int:
    """Run the mutants that are chosen and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="mutants whose file name contains this")
    parser.add_argument("--number", type=int, default=40, help="mutants a room (default: 40)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default: 0)")
    parser.add_argument("--shard", default="1/1", metavar="K/N", help="every N-th mutant, from the K-th")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="at the same time (default: cores)")
    arguments = parser.parse_args()
    chosen = [m for m in drawn(arguments.number, arguments.seed) if arguments.only in m.name]
    k, n = map(int, arguments.shard.split("/"))
    chosen = chosen[k - 1 :: n]
    KEPT.mkdir(parents=True, exist_ok=True)
    kept = KEPT / "killed.json"
    killed: dict[str, str] = json.loads(kept.read_text()) if kept.exists() else {}
    torch.func.jvp(torch.sin, (torch.ones(()),), (torch.ones(()),))  # the first one takes half a second
    survivors: list[Mutant] = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        workers = Workers(arguments.workers, Path(folder))
        found = survey(workers, {m.room for m in chosen})
        for mutant in chosen:

            def end(by: str | None, mutant: Mutant = mutant) -> None:
                where = f"{mutant.name}:{source(mutant.name).count(chr(10), 0, mutant.at) + 1}"
                print(
                    f"{'SURVIVED' if by is None else 'killed  '}  {where}: {mutant.old!r} → {mutant.new!r}", flush=True
                )
                if by is None:
                    survivors.append(mutant)
                    return
                print(f"          by {by}", flush=True)
                killed[mutant.key()] = by
                kept.write_text(json.dumps(killed, indent=0))

            if mutant.key() in killed:
                end(killed[mutant.key()])
            else:
                attempt(workers, mutant, tests_of(mutant, found), end)
        while workers.busy:
            workers.wait()
    print(table(chosen, survivors))
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
