"""Damage every kind of file at random and count what happens: `make fuzz`, or `python tests/fuzz.py --seconds 60`.

tried: damaged files (bit flips, cut ends, blocks of zeros). refused: `InputError`. executed: damaged files that hold
code and whose code was reached. silent: damaged files that loaded as if they were whole, where a hash should have told;
data files have none, and what loads of them counts as tried. uncaught: any other exception. The last three must be 0.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest import mock

from herglotz.data import load, save, simulate
from herglotz.errors import InputError
from herglotz.export import export_c, export_onnx, export_pt2, load as loading, load_c, load_onnx, load_pt2
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.features import parse
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, load_run, save_run
from herglotz.training.run_folder import FILES, MANIFEST
from herglotz.training.stages import _read


@dataclass
class Count:
    """What happened to the files of one kind."""

    tried: int = 0
    refused: int = 0
    executed: int = 0
    silent: int = 0
    uncaught: int = 0

    @property
    def good(self) -> bool:
        """Whether nothing happened that must not."""
        return self.tried > 0 and not self.executed + self.silent + self.uncaught


@dataclass(frozen=True)
class Kind:
    """Files of one kind."""

    name: str
    path: Path
    open: Callable[[Path], object]
    hashed: bool = True  # whether no damaged file may load


def damaged(content: bytes, make: random.Random) -> bytes:
    """The content with a bit flipped, several, its end cut off, or a block of zeros; never the same."""
    out = bytearray(content)
    at = make.randrange(len(out))
    match make.randrange(8):
        case 0:
            out = out[:at]
        case 1:
            out[at : at + 64] = bytes(len(out[at : at + 64]))
        case 2:
            for _ in range(8):
                out[make.randrange(len(out))] ^= 1 << make.randrange(8)
        case _:
            out[at] ^= 1 << make.randrange(8)
    return bytes(out) if bytes(out) != content else content[:-1]


@contextmanager
def watched(count: Count) -> Iterator[None]:
    """Count when the code in a file is reached: a header compiled, torch's reader of graphs called."""
    from torch.export.pt2_archive import _package

    def reached(*_: object, **__: object) -> None:
        count.executed += 1
        raise InputError("reached")

    with mock.patch.object(loading, "build", reached), mock.patch.object(_package, "_load_exported_programs", reached):
        yield


def try_one(kind: Kind, content: bytes, make: random.Random, count: Count) -> None:
    """Damage one file and open it."""
    kind.path.write_bytes(damaged(content, make))
    count.tried += 1
    try:
        kind.open(kind.path)
    except InputError:
        count.refused += 1
    except Exception as error:
        count.uncaught += 1
        kept = Path(tempfile.gettempdir(), f"fuzz-{count.uncaught}-{kind.path.name}")
        kept.write_bytes(kind.path.read_bytes())
        print(f"{kind.name}: {type(error).__name__}: {error}; kept as {kept}", file=sys.stderr)
    else:
        count.silent += kind.hashed


def kinds(folder: Path, only: str = "", exports: bool = True) -> list[Kind]:
    """One good file of each kind."""
    data = simulate(scene("damped_oscillator"), trajectories=2, steps=20, h=0.2, seed=0)
    for name in ("motion.csv", "motion.npz"):
        save(folder / name, data)
    config = FitConfig(level="linear", objective="residual", iterations=3)
    save_run(fit(data, config, out=folder / "run", progress=False), folder / "run")
    (folder / "feature.txt").write_text("-9.81 cos(q1 - 2 q2) v1^2 v2")
    found = [Kind(f"run/{name}", folder / "run" / name, lambda x: load_run(x.parent)) for name in FILES]
    found.append(Kind("checkpoint.pt", folder / "run" / "checkpoint.pt", _read))
    # What stands in the manifest beside its hashes, such as spaces, binds nothing.
    found.append(Kind(f"run/{MANIFEST}", folder / "run" / MANIFEST, lambda x: load_run(x.parent), hashed=False))
    found += [Kind(name, folder / name, load, hashed=False) for name in ("motion.csv", "motion.npz")]
    text = lambda x: parse(x.read_bytes().decode("utf-8", "replace"), angles=(True, True))  # noqa: E731
    found.append(Kind("feature", folder / "feature.txt", text, hashed=False))
    model = ContactLagrangian(ModelConfig(level="linear", potential_width=2, damping_width=2))
    writers = {"pt2": export_pt2, "onnx": export_onnx, "h": export_c}
    trusted = {"pt2": load_pt2, "h": load_c}
    readers = {name: partial(load, trust_code=True) for name, load in trusted.items()} | {"onnx": load_onnx}
    for name, write in writers.items():
        if exports and only in name:
            found.append(Kind(name, write(model, folder / f"model.{name}", h=0.1), readers[name]))
    return [kind for kind in found if only in kind.name]


def fuzz(
    folder: Path, seconds: float = 0.0, *, least: int = 0, seed: int = 0, only: str = "", exports: bool = True
) -> dict[str, Count]:
    """Damage the files of every kind for so many seconds each, or so many times if that takes longer."""
    counts = {}
    for kind in kinds(folder, only, exports):
        content, make, count = kind.path.read_bytes(), random.Random(f"{seed} {kind.name}"), Count()
        end = time.monotonic() + seconds
        kind.open(kind.path)  # the good file loads; of a header, outside `watched`, which refuses to compile
        with watched(count), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            while count.tried < least or time.monotonic() < end:
                try_one(kind, content, make, count)
        kind.path.write_bytes(content)
        counts[kind.name] = count
    return counts


def main() -> int:
    """Fuzz, print a table, return 1 where something happened that must not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=45.0, help="for each kind of file (default %(default)s)")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the clock")
    parser.add_argument("--only", default="", help="kinds whose name holds this")
    arguments = parser.parse_args()
    print(f"seed {arguments.seed}")
    with tempfile.TemporaryDirectory() as folder:
        counts = fuzz(Path(folder), arguments.seconds, seed=arguments.seed, only=arguments.only)
    print(f"{'':18}{'tried':>9}{'refused':>9}{'executed':>9}{'silent':>9}{'uncaught':>9}")
    for name, c in counts.items():
        print(f"{name:18}{c.tried:>9}{c.refused:>9}{c.executed:>9}{c.silent:>9}{c.uncaught:>9}")
    return 0 if all(count.good for count in counts.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
