"""Coverage-guided fuzzing of one reader, where atheris is installed: `python tests/guided.py csv -runs=1000000`.

What follows the reader's name goes to libFuzzer, which counts its executions, keeps inputs that reach new branches, and
ends with a traceback and the input in a file at the first exception that is not an `InputError`. atheris needs a
compiler's runtime and no other package of this project: install it into an environment of its own.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch  # noqa: F401  loaded before what is instrumented

atheris: Any = importlib.import_module("atheris")  # of an environment of its own, which no checker knows
with atheris.instrument_imports(include=["herglotz"]):
    from herglotz.data.csv_format import read_csv
    from herglotz.data.npz_format import trajectories_of
    from herglotz.errors import InputError
    from herglotz.export.metadata import describe, from_json
    from herglotz.models import ContactLagrangian, ModelConfig
    from herglotz.models.features import parse

MEMBERS = ("t.npy", "q.npy", "metadata.npy", "lengths.npy", "u.npy")
BETWEEN = b"\n--\n"  # members of an archive in one input
FILE = Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None), "one.csv")


def csv(content: bytes) -> None:
    """A table as a file."""
    FILE.write_bytes(content)
    read_csv(FILE)


def npz(content: bytes) -> None:
    """An archive whose members are damaged, and whose checksums are not: damage to these is found before all else."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, member in zip(MEMBERS, content.split(BETWEEN), strict=False):
            archive.writestr(name, member)
    trajectories_of(buffer.getvalue(), FILE)


def features(content: bytes) -> None:
    """A term of a model."""
    parse(content.decode("utf-8", "replace"), angles=(False, True))


def whole() -> dict[str, Any]:
    """What an exported file says of itself, with every entry that it can have."""
    model = ContactLagrangian(ModelConfig((True,), potential_width=2, damping_width=2, level="forced", inputs=1))
    box = {f"{x}_{end}": [sign] for x in "qps" for end, sign in (("low", -1.0), ("high", 1.0))}
    extra = dict.fromkeys(("time_unit", "card", "name"), "s") | {"names": ["x"], "degrees": ["x"], "metrics": {"x": 1}}
    extra |= {"start": {"q": [0.0], "p": [0.0], "s": 0.0, "t": 0.0}, "h_range": [0.05, 0.2]}
    extra |= {"arrival": {"hold": "zero", "delay": 0.1, "lag": 0.1}, "columns": [["x", "q", "m"]]}
    return describe(model, 0.1, box, ["m"], 30, extra)


def places(entries: Any) -> list[tuple[Any, ...]]:
    """The keys that lead to every entry of entries, nested ones too."""
    keys = entries if isinstance(entries, dict) else range(len(entries) if isinstance(entries, list) else 0)
    return [path for key in keys for path in ((key,), *((key, *rest) for rest in places(entries[key])))]


WHOLE = json.dumps(whole())
PLACES = places(json.loads(WHOLE))


def metadata(content: bytes) -> None:
    """What an exported file says of itself: all of it, or one entry; a byte says which, and JSON what stands there."""
    text = content.decode("utf-8", "replace")
    if content[:1] != b"{":
        entries = json.loads(WHOLE)
        with suppress(ValueError, RecursionError):  # what is no JSON leaves the entries as they are
            where = entries
            *above, last = PLACES[content[0] % len(PLACES)] if content else PLACES[0]
            for key in above:
                where = where[key]
            where[last] = json.loads(content[1:])
            text = json.dumps(entries)
    ModelConfig.from_dict(from_json(text, FILE)["model"])


def member(array: Any) -> bytes:
    """An array as a file of numpy."""
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


t = np.arange(5.0) / 10
SEEDS: dict[Callable[[bytes], None], list[bytes]] = {
    csv: [
        b"t[s],theta[rad],x[m],u_x[N]\n" + b"".join(b"%g,%g,%g,1\n" % (k / 10, k, -k) for k in range(5)),
        b"# hold: zero\ntrajectory;Time (s);q1 [deg]\n0;0;1,5\n0;0,1;2\n0;0,2;1\n",
    ],
    npz: [
        BETWEEN.join(map(member, (t, t.astype("f4"), np.array('{"names": ["x"], "units": ["m"], "angles": [false]}')))),
        BETWEEN.join(map(member, (t, np.stack([t, t], 1), np.array("{}"), np.array([5]), np.ones((5, 1), int)))),
    ],
    features: [b"-9.81 cos(q1 - 2 q2) v1^2 v2", b"(q1 - q2)^4", b"1.5e-3 r^-1", b"|v1| v1"],
    metadata: [WHOLE.encode(), *(bytes([k % 256]) + b"[0.5]" for k in range(len(PLACES)))],
}


def main() -> None:
    """Fuzz the reader that is named."""
    readers = {reader.__name__: reader for reader in SEEDS}
    if len(sys.argv) < 2 or sys.argv[1] not in readers:
        raise SystemExit(f"name one of {', '.join(readers)}")
    reader = readers[sys.argv[1]]

    def one(content: bytes) -> None:
        with suppress(InputError):
            reader(content)

    corpus = Path(tempfile.mkdtemp())
    for k, seed in enumerate(SEEDS[reader]):
        (corpus / str(k)).write_bytes(seed)
    atheris.Setup([sys.argv[0], *sys.argv[2:], str(corpus)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
