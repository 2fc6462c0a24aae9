"""One row: its data are made once, the command runs in a process of its own with a limit, its result is scored."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.judging import job
from benchmarks.judging.catalogue import Row
from benchmarks.judging.make import ABSENT

ROOT = Path(__file__).resolve().parents[2]
# A busy machine may take this multiple of a process's limit on processor time.
WALL = 20
# A signal of its own says that the time is over; 5 s later comes one that nothing can catch.
BOUND = 'ulimit -c 0; ulimit -H -t $(($0 + 5)); ulimit -S -t "$0"; exec "$@"'
# Time between two looks at a process. [s]
LOOK = 0.05
# Limit on the processor time of a row's data [s]: a draw of the zoo fits its true equation many times.
MAKING = 1200
# Bounds of the zoo's outcomes: as a multiple of a perfect model's error, and as a part of the spread.
AT_NOISE, USABLE = 1.5, 0.1
# Exit codes of the command line.
REFUSED, NO_FIT = 2, 3
# In kilobytes, the unit of Linux.
MEGABYTE = 1024


@dataclass(frozen=True)
class Ended:
    """How a process ended."""

    # Exit code; None if the limit was reached.
    code: int | None
    # Processor time with that of child processes [s], and the largest memory [MB].
    cpu: float
    peak: float
    out: str
    err: str

    @property
    def last(self) -> str:
        """The last line on stderr."""
        return (self.err.strip().splitlines() or [""])[-1]


def limited(command: list[str], limit: float, environment: dict[str, str], folder: Path) -> Ended:
    """Run a command with a bound on its processor time, and measure what it used.

    The bound is set by a shell that becomes the command. Until then a child has the memory of this process, which the
    peak includes: hence no torch here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "stdout").open("w+") as out, (folder / "stderr").open("w+") as err:
        bound = ["sh", "-c", BOUND, str(max(1, round(limit))), *command]
        process = subprocess.Popen(bound, stdout=out, stderr=err, env=environment, cwd=folder)
        # The time is counted, not read off a clock: a stopped judge may have stopped children.
        waited = 0.0
        while True:
            found, status, usage = os.wait4(process.pid, os.WNOHANG)
            if found:
                break
            if waited > WALL * limit:
                process.kill()
            time.sleep(LOOK)
            waited += LOOK
        process.returncode = os.waitstatus_to_exitcode(status)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read())
    cpu = usage.ru_utime + usage.ru_stime
    ended = process.returncode
    over = ended == -signal.SIGXCPU or (ended < 0 and (cpu > limit or waited > WALL * limit))
    return Ended(None if over else ended, cpu, usage.ru_maxrss / MEGABYTE, *texts)


def environment(source: Path | None) -> dict[str, str]:
    """Of every child: one thread, no pictures, the package of `source` or of PYTHONPATH, these benchmarks."""
    path = [str(source)] if source else []
    path += [*filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)), str(ROOT)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}


@dataclass(frozen=True)
class Judge:
    """What all rows share."""

    # Folder of data, kept between runs of the judge, and folder of runs.
    prepared: Path
    scratch: Path
    # Limit on the processor time of a command. [s]
    limit: float
    environment: dict[str, str]

    def row(self, of: Row) -> dict[str, Any]:
        """Measure one row."""
        home, folder = self.prepared / of.folder, self.scratch / of.folder
        row: dict[str, Any] = {"name": of.name}
        shutil.rmtree(folder, ignore_errors=True)
        if not (home / job.NAME).is_file():
            shutil.rmtree(home, ignore_errors=True)
            made = self._python(["benchmarks.judging.make", of.name, str(home)], MAKING, folder / "make")
            if made.code != 0:
                kind = "skipped" if made.code == ABSENT else "trouble"
                return {**row, kind: made.last or f"exit code {made.code}"}
        asked = job.read(home)
        command = ["herglotz", asked.command, asked.train, "--out", str(folder / "run"), *asked.flags, "--json"]
        plots = ["--no-plots"] if asked.command == "fit" else []
        done = self._python([*command, *plots], self.limit, folder / "fit")
        row |= {"cpu_s": round(done.cpu, 2), "peak_mb": round(done.peak), "exit": done.code, "unit": asked.unit}
        row |= {"error": None, "relative": None, "spread": None, "groups": {}, "trouble": ""}
        # Folders of this machine have no place in a table.
        row["said"] = done.last.replace(str(folder), "FOLDER").replace(str(home), "DATA")
        # True if the row measures an error.
        row["asks"] = bool(asked.trials) or asked.later
        row["verdict"] = f"no result in {self.limit:g} s" if done.code is None else _without_run(done.code)
        if done.code in (0, NO_FIT):
            score = self._python(["benchmarks.judging.scoring", str(home), str(folder / "run")], self.limit, folder)
            row |= json.loads(score.out.splitlines()[-1]) if score.code == 0 else {"trouble": f"score: {score.last}"}
        row["false"] = false_verdict(row, asked.attainable)
        shutil.rmtree(folder / "run", ignore_errors=True)
        return row

    def _python(self, module: list[str], limit: float, folder: Path) -> Ended:
        return limited([sys.executable, "-m", *module], limit, self.environment, folder)


def _without_run(code: int) -> str:
    return {0: "none", REFUSED: "refused", NO_FIT: "none"}.get(code, f"ended with {code}")


def false_verdict(row: dict[str, Any], attainable: float | None) -> str:
    """Why the verdict of a row is false; empty if it is not, or nobody can tell."""
    if not row["asks"]:
        return ""
    failed = row["exit"] != 0
    error, relative = (float("inf") if row[name] is None else row[name] for name in ("error", "relative"))
    good = attainable is not None and error <= AT_NOISE * attainable
    if not failed and not good and relative > USABLE:
        return "praised"
    return "rejected" if failed and good else ""
